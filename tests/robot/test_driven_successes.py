"""Released policies at a served simulation: the same ends, episode by episode, as in process."""

import io
from pathlib import Path

import pytest
from stepped_server import Served

from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.robot.client import Client, ClientConfig
from surgicai_vision.robot.driven import DrivenRobot
from surgicai_vision.robot.driver import DriveConfig, Driver
from surgicai_vision.robot.guards import GuardConfig

PROCEDURE = Path(__file__).resolve().parents[2] / "examples" / "learned-ends.yaml"


@pytest.mark.parametrize(
    ("policy", "seeds"),
    [("released:grasp", (900_000,)), (PROCEDURE, (900_001,))],
    ids=["grasp", "procedure"],
)
def test_released_policies_end_as_they_do_in_process(policy, seeds):
    """From images, measured poses and within guards; the steps are the same too.

    The whole procedure is five low-level policies, the high-level one that says when each ends,
    and PSM2's letting go. `benchmarks/robot.py` counts more episodes, a process on each side.
    """
    spec = open_policy(str(policy))
    task = spec.config
    agent = spec.make_agent()
    own = evaluate(lambda: agent, task, seeds, batch=1, workers=1)
    views = tuple(agent.cameras)
    served = Served(task.task, views, size=agent.image_size, advance=task.advance)
    client = Client(served, ClientConfig(views=views, is_simulated=True))
    client.connect()
    robot = DrivenRobot(client, views, task.task, agent.image_size)
    config = DriveConfig(GuardConfig(), sends=True, is_simulated=True, is_stepped=True)
    driver = Driver(agent, robot, task, config, float, io.StringIO(), lambda text: None)
    driven = [driver.episode(seed, task.max_steps) for seed in seeds]
    assert [episode.held for episode in driven] == [0] * len(seeds)
    assert [episode.success for episode in driven] == [entry.row.success for entry in own]
    assert [episode.steps for episode in driven] == [entry.row.steps for entry in own]
    assert all(episode.success for episode in driven)
