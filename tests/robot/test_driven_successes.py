"""Released policies at a served simulation: the same ends, episode by episode, as in process."""

import io

import pytest
from stepped_server import Served

from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.robot.client import Client, ClientConfig
from surgicai_vision.robot.driven import DrivenRobot
from surgicai_vision.robot.driver import DriveConfig, Driver
from surgicai_vision.robot.guards import GuardConfig


@pytest.mark.parametrize(
    ("policy", "seeds"),
    [("released:grasp", (900_000, 900_001)), ("released:suture", (900_000,))],
)
def test_a_released_policy_ends_as_it_does_in_process(policy, seeds):
    """From its images, its measured poses and its guards; the steps are the same too.

    `released:suture` is the whole procedure: five low-level policies, the high-level one that
    says when each ends, and PSM2's letting go.
    """
    spec = open_policy(policy)
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
    assert any(episode.success for episode in driven)
