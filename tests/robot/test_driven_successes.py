"""Released policies driving a served simulation: each episode ends as it does in process."""

import io

import pytest
from served import DOMAIN, serving
from stepped_server import Served

from surgicai_vision.evaluation.policy_spec import PolicySpec, open_policy
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.robot.client import Client, ClientConfig
from surgicai_vision.robot.driven import DrivenRobot
from surgicai_vision.robot.driver import DriveConfig, Driver
from surgicai_vision.robot.guards import GuardConfig
from surgicai_vision.robot.transport import Transport, open_transport


def check_same_ends(spec: PolicySpec, transport: Transport, seeds: tuple[int, ...]) -> None:
    """Drive over a transport, and compare with the same policy and starts in process."""
    agent = spec.make_agent()
    task = spec.config
    own = evaluate(lambda: agent, task, seeds, batch=1, workers=1)
    views = tuple(agent.cameras)
    client = Client(transport, ClientConfig(views=views, is_simulated=True))
    client.connect(60.0)
    robot = DrivenRobot(client, views, task.task, agent.image_size)
    config = DriveConfig(GuardConfig(), sends=True, is_simulated=True, is_stepped=True)
    driver = Driver(agent, robot, task, config, float, io.StringIO(), lambda text: None)
    driven = [driver.episode(seed, task.max_steps) for seed in seeds]
    assert [episode.held for episode in driven] == [0] * len(seeds)
    assert [episode.success for episode in driven] == [entry.row.success for entry in own]
    assert [episode.steps for episode in driven] == [entry.row.steps for entry in own]
    assert all(episode.success for episode in driven)


def test_a_released_policy_ends_as_it_does_in_process():
    """From images and measured poses, within the guards; the step counts are the same too."""
    spec = open_policy("released:grasp")
    agent = spec.make_agent()
    served = Served("grasp", tuple(agent.cameras), size=agent.image_size)
    check_same_ends(spec, served, (900_000,))


def test_the_whole_procedure_ends_as_it_does_in_process():
    """With released policies, over cyclonedds, served in a separate process.

    Five low-level policies, the high-level one that says when each ends, and PSM2 letting go.
    `benchmarks/robot.py` evaluates more episodes, and in real time.
    """
    pytest.importorskip("cyclonedds", reason="the extra `ros` is not installed")
    spec = open_policy("released:suture")
    agent = spec.make_agent()
    options = ("--task", "suture", "--clock", "stepped", "--advance", spec.config.advance)
    views = ("--view", ",".join(agent.cameras), "--size", str(agent.image_size))
    domain = DOMAIN % 200 + 8
    with (
        serving(*options, *views, domain=domain),
        open_transport("cyclonedds", domain=domain) as transport,
    ):
        check_same_ends(spec, transport, (900_001,))
