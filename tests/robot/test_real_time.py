"""Real time on the test's own clock: no action of a policy is lost on the round trip."""

import io
import json

import numpy as np
import pytest
from stepped_server import SEED
from virtual_time import VirtualTime

from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.robot.client import Client, ClientConfig
from surgicai_vision.robot.driven import DrivenRobot
from surgicai_vision.robot.driver import DriveConfig, Driver
from surgicai_vision.robot.guards import GuardConfig

STEPS = 40
ALONG = (0.5, 0.0, 0.3, 0.0, 0.0, 0.2, -0.5)


class Slow(Agent):
    """Moves steadily, and takes `latency` [s] over each action."""

    name = "slow"
    cameras = ()
    image_size = 64

    def __init__(self, served, latency):
        self.served = served
        self.latency = latency

    def reset(self, slot, robot, seed):
        pass

    def act(self, slots, robots, observations):
        self.served.pass_time(self.latency)
        return np.array([ALONG], np.float32)


def driven(monkeypatch, phase, latency):
    """Drive for `STEPS` steps; return the served simulation and the lines of the log."""
    served = VirtualTime(monkeypatch, "grasp", phase)
    client = Client(served, ClientConfig(is_simulated=True))
    client.connect()
    robot = DrivenRobot(client, (), "grasp", 64)
    config = DriveConfig(GuardConfig(), sends=True, is_simulated=True)
    log = io.StringIO()
    agent = Slow(served, latency)
    driver = Driver(agent, robot, TaskConfig("grasp"), config, float, log, lambda text: None)
    driver.episode(SEED, STEPS)
    served.pass_time(0.1)
    return served, [json.loads(line) for line in log.getvalue().splitlines()]


@pytest.mark.parametrize("phase", [0.001, 0.006, 0.011, 0.016])
@pytest.mark.parametrize("latency", [0.002, 0.012, 0.019])
def test_every_action_counts_whenever_it_comes(monkeypatch, phase, latency):
    """Whatever the phase of the two clocks, and however long the policy thinks within a step."""
    own = envs.make(TaskConfig("grasp"))
    own.reset(seed=SEED)
    start = own.agent_pos()
    for _ in range(STEPS):
        own.step(np.array(ALONG, np.float32))
    for _ in range(5):
        own.step(np.zeros(7, np.float32))
    moved = own.agent_pos() - start
    own.close()
    served, lines = driven(monkeypatch, phase, latency)
    assert all(line["sent"] for line in lines)
    there = served.robot.env.agent_pos() - start
    assert np.linalg.norm(moved[:3]) > 8e-3
    # At most one of the forty actions is lost: the one that the last of them superseded.
    assert np.linalg.norm((there - moved)[:3]) < 1.1 * np.linalg.norm(moved[:3]) / STEPS
    assert abs((there - moved)[6]) < 1.1 * abs(moved[6]) / STEPS + 1e-3
