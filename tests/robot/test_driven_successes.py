"""A released policy at a served simulation: the same successes, episode by episode."""

import io

from stepped_server import Served

from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.robot.client import Client, ClientConfig
from surgicai_vision.robot.driven import DrivenRobot
from surgicai_vision.robot.driver import DriveConfig, Driver
from surgicai_vision.robot.guards import GuardConfig

SEEDS = (900_000, 900_001)


def test_a_released_policy_succeeds_where_it_does_in_process():
    """From its images, its measured poses and its guards; steps and ends are the same too."""
    spec = open_policy("released:grasp")
    agent = spec.make_agent()
    own = evaluate(lambda: agent, spec.config, SEEDS, batch=1, workers=1)
    views = tuple(agent.cameras)
    served = Served("grasp", views, size=agent.image_size)
    client = Client(served, ClientConfig(views=views, is_simulated=True))
    client.connect()
    robot = DrivenRobot(client, views, "grasp", agent.image_size)
    config = DriveConfig(GuardConfig(), sends=True, is_simulated=True, is_stepped=True)
    driver = Driver(agent, robot, spec.config, config, float, io.StringIO(), lambda text: None)
    driven = [driver.episode(seed, spec.config.max_steps) for seed in SEEDS]
    assert [episode.held for episode in driven] == [0, 0]
    assert [episode.success for episode in driven] == [entry.row.success for entry in own]
    assert [episode.steps for episode in driven] == [entry.row.steps for entry in own]
