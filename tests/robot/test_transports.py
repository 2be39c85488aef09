"""The table of transports; the real ROS 1 and ROS 2, where they can be imported."""

import importlib
import json
import sys

import numpy as np
import pytest
from example_messages import EXAMPLES
from ros_programs import (
    COMMAND,
    CRTK,
    ECHO,
    STAND_IN,
    master,
    missing_rclpy,
    missing_rospy,
    run_ros,
    running,
)
from served import DOMAIN

from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.evaluation.agents import RandomAgent
from surgicai_vision.robot.codecs import ROS_NAMES
from surgicai_vision.robot.senders import Senders
from surgicai_vision.robot.transport import TRANSPORTS, open_transport

SEED = 900_001
STEPS = 25


def test_every_message_has_a_name_in_ros_and_an_example():
    assert {type(message) for message in EXAMPLES} == set(ROS_NAMES)


def test_a_transport_of_no_table_is_refused():
    with pytest.raises(UnknownName, match="carrier_pigeon"):
        open_transport("carrier_pigeon")


@pytest.mark.parametrize("name", sorted(TRANSPORTS))
def test_a_missing_transport_is_refused_in_one_line_that_says_what_to_install(name, monkeypatch):
    module = TRANSPORTS[name].place.partition(":")[0]
    library = {"cyclonedds": "cyclonedds", "rclpy": "rclpy", "rospy": "genpy"}[name]
    for loaded in [entry for entry in sys.modules if entry.split(".")[0] == library]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, library, None)
    for own in (module, "surgicai_vision.robot.idl"):
        monkeypatch.delitem(sys.modules, own, raising=False)
    with pytest.raises(InputError) as raised:
        open_transport(name)
    text = str(raised.value)
    assert "\n" not in text
    assert library in text
    assert TRANSPORTS[name].needs in text
    monkeypatch.undo()
    importlib.invalidate_caches()


@pytest.mark.parametrize(
    ("numbers", "sources"),
    [
        ([1, 2, 3, 9, 10], 1),  # gaps: messages that were superseded
        ([1, 2, 1, 3, 2], 2),  # two that began together
        ([500, 1, 501, 2, 502], 2),  # one began later
        ([5, 5], 2),
        ([None, None, 2**64 - 1], 1),  # a middleware without numbers
        ([7, 8, 1, 2, 3], 2),  # another begins when the first has ended
    ],
)
def test_senders_are_told_apart_by_their_numbers(numbers, sources):
    senders = Senders()
    assert len({senders.source(number) for number in numbers}) == sources


def random_poses():
    """Return both arms' measured poses at every step of a random policy in this process."""
    env = envs.make(TaskConfig("grasp", max_steps=STEPS))
    env.reset(seed=SEED)
    agent = RandomAgent()
    agent.reset(0, env, SEED)
    poses = []
    for _ in range(STEPS):
        poses.append(env.both_arms())
        env.step(agent.act([0], [env], [env.observe()])[0])
    env.close()
    return poses


def check_serve_and_drive(name, options, tmp_path):
    """Serve and drive over a transport, in one process each; every pose is as in this process."""
    serve = ("robot", "serve", "--task", "grasp", "--clock", "stepped", "--transport", name)
    drive = (
        *("robot", "drive", "random", "--task", "grasp", "--simulated", "--clock", "stepped"),
        *("--send", "--seed", SEED, "--seconds", STEPS / 50, "--transport", name, "--json"),
    )
    with running(name, COMMAND, *serve, *options, until="serving"):
        driven = run_ros(name, COMMAND, *drive, *options, "--out", tmp_path / "log", timeout=300)
    assert driven.returncode == 0, driven.stderr
    assert [row["steps"] for row in json.loads(driven.stdout.splitlines()[-1])["episodes"]] == [
        STEPS
    ]
    lines = [json.loads(row) for row in (tmp_path / "log" / "drive.jsonl").open()]
    assert np.allclose([line["both_arms"] for line in lines[1:]], random_poses(), atol=1e-6)


def test_a_real_rospy_carries_every_message_and_a_driven_episode(monkeypatch, tmp_path):
    """With ROS 1 and its master themselves, on the loopback."""
    if problem := missing_rospy():
        pytest.skip(problem)
    with master(monkeypatch):
        echo = run_ros("rospy", ECHO, "rospy", 0)
        assert echo.returncode == 0, echo.stderr
        said = json.loads(echo.stdout.splitlines()[-1])
        assert all(said["same"].values()), said
        assert said["sources"] == 1
        assert said["elsewhere"] == []
        check_serve_and_drive("rospy", (), tmp_path)


def test_a_real_rospy_without_a_master_is_refused(monkeypatch):
    if problem := missing_rospy():
        pytest.skip(problem)
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:9")
    served = run_ros("rospy", COMMAND, "robot", "serve", "--transport", "rospy")
    assert served.returncode == 2
    assert "No master answers" in served.stderr


def test_a_real_rclpy_carries_every_message_that_is_not_crtks():
    """With ROS 2 itself, on the loopback; its wheels have no crtk_msgs."""
    if problem := missing_rclpy():
        pytest.skip(problem)
    echo = run_ros("rclpy", STAND_IN + ECHO, "rclpy", DOMAIN % 200 + 5, *CRTK)
    assert echo.returncode == 0, echo.stderr
    said = json.loads(echo.stdout.splitlines()[-1])
    assert len(said["same"]) == len(EXAMPLES) - len(CRTK)
    assert all(said["same"].values()), said
    assert said["elsewhere"] == []


def test_a_real_rclpy_carries_crtks_messages_and_a_driven_episode(tmp_path):
    """With ROS 2 itself and crtk_msgs, on the loopback."""
    if problem := missing_rclpy("crtk_msgs.msg"):
        pytest.skip(problem)
    domain = DOMAIN % 200 + 3
    echo = run_ros("rclpy", ECHO, "rclpy", domain)
    assert echo.returncode == 0, echo.stderr
    said = json.loads(echo.stdout.splitlines()[-1])
    assert all(said["same"].values()), said
    assert said["elsewhere"] == []
    check_serve_and_drive("rclpy", ("--domain", domain), tmp_path)
