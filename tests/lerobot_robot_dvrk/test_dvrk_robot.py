"""The LeRobot robot `dvrk` at a served simulation, driven by LeRobot's own functions."""

import dataclasses
import importlib.metadata
import json
import logging
import math
import sys
import time

import numpy as np
import pytest
from lerobot_robot_dvrk.actions import INCREMENTS, POSITIONS, TARGETS, Increments
from lerobot_robot_dvrk.board import BOARD
from lerobot_robot_dvrk.dvrk import NEXT, RESET
from scripted_teleop import Scripted, ScriptedConfig
from served import DOMAIN, serving
from stepped_server import SEED, Served

from lerobot_robot_dvrk import Dvrk, DvrkConfig, SurgicaiPage, SurgicaiPageConfig
from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs import poses
from surgicai_vision.envs.absolute import T_WORLD_VIEW
from surgicai_vision.envs.control import JAW_OPEN, StepSize
from surgicai_vision.robot import topics
from surgicai_vision.robot.guards import GuardConfig
from surgicai_vision.robot.messages import Header, StringStamped
from surgicai_vision.teleoperation.inputs import JAW, START, Input

STEP = StepSize.of("paper")
VALUES = Increments.features


@pytest.fixture
def robot(monkeypatch, tmp_path):
    """Make connected robots at a served simulation of this process."""
    made = []

    def make(task="grasp", served=None, **changes):
        transport = served or Served(task, tuple(changes.get("views", ())))
        monkeypatch.setattr("lerobot_robot_dvrk.dvrk.open_transport", lambda *_: transport)
        settings = {"task": task, "views": [], "image_size": 64, "seed": SEED, **changes}
        config = DvrkConfig(calibration_dir=tmp_path, simulated=True, clock="stepped", **settings)
        one = Dvrk(config)
        one.connect()
        one.served = transport
        made.append(one)
        return one

    yield make
    for one in made:
        if one.is_connected:
            one.disconnect()


def actions(count, seed=0):
    """Return rows of random increments."""
    return np.random.default_rng(seed).uniform(-1, 1, (count, 7)).tolist()


def in_process(rows, task="grasp", seed=SEED):
    """Return what the active arm measures before each of the actions, and the env's joints."""
    env = envs.make(TaskConfig(task))
    env.reset(seed=seed)
    seen = []
    for row in rows:
        seen.append(env.agent_pos())
        env.step(np.array(row, np.float32))
    return np.array(seen), env.data.qpos.copy()


def test_lerobot_finds_the_distribution_by_its_name():
    from lerobot.robots import RobotConfig, make_robot_from_config
    from lerobot.teleoperators import TeleoperatorConfig, make_teleoperator_from_config
    from lerobot.utils.import_utils import register_third_party_plugins

    name = "lerobot_robot_dvrk"
    assert importlib.metadata.distribution(name).metadata["Name"] == name
    register_third_party_plugins()
    robot_config = RobotConfig.get_choice_class("dvrk")(simulated=True)
    assert isinstance(make_robot_from_config(robot_config), Dvrk)
    page_config = TeleoperatorConfig.get_choice_class("surgicai_page")()
    assert isinstance(make_teleoperator_from_config(page_config), SurgicaiPage)


def test_lerobots_teleoperation_moves_the_simulation_as_in_process(robot, tmp_path):
    from lerobot.processor import make_default_processors
    from lerobot.scripts.lerobot_teleoperate import teleop_loop

    rows = [*actions(15), [0.0] * 7]
    teleop = Scripted(ScriptedConfig(names=list(VALUES), rows=rows, calibration_dir=tmp_path))
    teleop.connect()
    one = robot()
    first, second, third = make_default_processors()
    teleop_loop(teleop, one, 200, first, second, third, duration=0.3)
    steps = one.served.robot.steps
    played = [rows[min(place, 15)] for place in range(steps)]
    assert steps >= 1
    assert np.allclose(one.served.robot.env.data.qpos, in_process(played)[1], atol=1e-8)


def test_lerobots_record_writes_what_was_measured_and_told(tmp_path, monkeypatch):
    """Over DDS on the loopback: states, actions and images of every frame, in our own layout."""
    pytest.importorskip("cyclonedds", reason="the extra `ros` is not installed")
    from lerobot.datasets import LeRobotDataset
    from lerobot.scripts import lerobot_record

    domain = DOMAIN % 200 + 4
    rows = actions(400)
    root = tmp_path / "dataset"
    arguments = [
        *("--robot.type=dvrk", "--robot.simulated=true", "--robot.clock=stepped"),
        *(f"--robot.domain={domain}", "--robot.views=[front]", "--robot.image_size=64"),
        *(f"--robot.seed={SEED}", f"--robot.calibration_dir={tmp_path}"),
        *("--teleop.type=scripted", f"--teleop.names={json.dumps(VALUES)}"),
        *(f"--teleop.rows={json.dumps(rows)}", f"--teleop.calibration_dir={tmp_path}"),
        *("--dataset.repo_id=local/robot", "--dataset.no_stamp=true", f"--dataset.root={root}"),
        *("--dataset.fps=50", "--dataset.num_episodes=1", "--dataset.episode_time_s=0.4"),
        *("--dataset.video=false", "--dataset.push_to_hub=false", "--play_sounds=false"),
        "--dataset.single_task=grasp",
    ]
    monkeypatch.setattr(sys, "argv", ["lerobot-record", *arguments])
    options = ("--task", "grasp", "--clock", "stepped", "--view", "front", "--size", "64")
    with serving(*options, domain=domain):
        lerobot_record.main()
    dataset = LeRobotDataset("local/robot", root=root)
    count = len(dataset)
    assert count >= 2
    assert dataset.meta.robot_type == "dvrk"
    assert dataset.meta.features[names.STATE]["shape"] == (7,)
    states, _ = in_process(rows[:count])
    frames = [dataset[index] for index in range(count)]
    assert np.allclose([frame[names.STATE] for frame in frames], states, atol=1e-6)
    assert np.allclose([frame[names.ACTION] for frame in frames], rows[:count], atol=1e-6)
    assert frames[0][names.image_key("front")].shape == (3, 64, 64)


def saved_policy(out):
    """Save a policy of random weights that sees the state alone; return it with its processors."""
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    from lerobot_env_surgicai import SurgicaiBcConfig

    config = SurgicaiBcConfig(
        encoder=None,
        device="cpu",
        input_features={names.STATE: PolicyFeature(FeatureType.STATE, (7,))},
        output_features={names.ACTION: PolicyFeature(FeatureType.ACTION, (7,))},
    )
    torch.manual_seed(0)
    policy = get_policy_class("surgicai_bc")(config).eval()
    stats = {names.STATE: {"mean": np.zeros(7, np.float32), "std": np.ones(7, np.float32)}}
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    for part in (policy, before, after):
        part.save_pretrained(out)
    return policy, before, after


def test_lerobots_rollout_acts_as_the_policy_does_in_process(robot, tmp_path, monkeypatch):
    import torch
    from lerobot.scripts import lerobot_rollout

    policy, before, after = saved_policy(tmp_path / "policy")
    served = Served("grasp")
    monkeypatch.setattr("lerobot_robot_dvrk.dvrk.open_transport", lambda *_: served)
    arguments = [
        *(f"--policy.path={tmp_path / 'policy'}", "--device=cpu", "--fps=50", "--duration=0.5"),
        *("--robot.type=dvrk", "--robot.simulated=true", "--robot.clock=stepped"),
        *("--robot.views=[]", f"--robot.seed={SEED}", f"--robot.calibration_dir={tmp_path}"),
        *("--return_to_initial_position=false", "--task=grasp", "--play_sounds=false"),
    ]
    monkeypatch.setattr(sys, "argv", ["lerobot-rollout", *arguments])
    lerobot_rollout.main()
    steps = served.robot.steps
    env = envs.make(TaskConfig("grasp"))
    env.reset(seed=SEED)
    policy.reset()
    for _ in range(steps):
        seen = {names.STATE: torch.from_numpy(env.agent_pos())[None]}
        with torch.inference_mode():
            action = after(policy.select_action(before(seen)))
        env.step(action.numpy()[0])
    assert steps >= 1
    assert np.allclose(served.robot.env.data.qpos, env.data.qpos, atol=1e-6)


# -- what actions mean -----------------------------------------------------------------------------


def in_view(one, arm="PSM2"):
    """Return where an arm is told to be, in the endoscope's view."""
    _, base = one._robot.frame(arm)
    return np.array(poses.position(poses.compose(base, one._robot.told(arm).pose)))


@pytest.mark.parametrize(
    ("value", "axis"),
    [({"delta_x": 1.0}, 2), ({"delta_y": 1.0}, 0), ({"delta_z": 1.0}, 1)],
)
def test_lerobots_gamepad_moves_away_left_and_up_in_the_view(robot, value, axis):
    one = robot(action="delta")
    start = in_view(one)
    for _ in range(5):
        one.send_action({"delta_x": 0.0, "delta_y": 0.0, "delta_z": 0.0, "gripper": 1, **value})
    one.get_observation()
    moved = in_view(one) - start
    assert np.argmax(np.abs(moved)) == axis
    assert moved[axis] == pytest.approx(5 * STEP.translation, rel=0.05)


def test_lerobots_gripper_opens_and_closes(robot):
    one = robot(action="delta")
    jaws = []
    for gripper in (2, 2, 1, 0):
        one.send_action({"gripper": gripper})
        jaws.append(one._robot.told("PSM2").jaw)
    assert np.allclose(np.diff(jaws), [STEP.jaw, 0.0, -STEP.jaw], atol=1e-6)


def test_a_leaders_way_is_the_tips_however_fast_it_moves(robot):
    """What is more than a step is caught up with; the first action moves nothing."""
    one = robot(action="leader")
    joints = dict.fromkeys(one.action_features, 0.0)
    start = in_view(one)
    jaw = one._robot.told("PSM2").jaw
    one.send_action(joints)
    for _ in range(30):
        one.send_action({**joints, "shoulder_pan.pos": 20.0, "gripper.pos": -20.0})
    one.get_observation()
    moved = in_view(one) - start
    assert moved == pytest.approx([-0.010, 0.0, 0.0], abs=3e-4)
    assert one._robot.told("PSM2").jaw == pytest.approx(jaw - 0.2 * JAW_OPEN, abs=0.01)


def test_a_leaders_diagonal_comes_back_to_where_it_began(robot):
    """In the base an increment may be longer than a step; what is cut off is not lost."""
    one = robot(action="leader", leader={"a": "right", "b": "up", "c": "away"})

    def go(*joints):
        for _ in range(40):
            one.send_action(dict(zip(("a.pos", "b.pos", "c.pos"), joints, strict=True)))
        return in_view(one)

    start = go(0.0, 0.0, 0.0)
    assert np.linalg.norm(go(8.0, 8.0, 8.0) - start) > 5e-3
    go(0.0, 8.0, 8.0)
    go(0.0, 0.0, 8.0)
    assert np.linalg.norm(go(0.0, 0.0, 0.0) - start) < 5e-4


def test_two_leaders_move_both_arms(robot):
    leader = {"left_shoulder_pan": "PSM1:right", "right_shoulder_pan": "PSM2:-right"}
    one = robot(action="leader", leader=leader)
    starts = [in_view(one, arm) for arm in ("PSM1", "PSM2")]
    one.send_action({f"{name}.pos": 0.0 for name in leader})
    for _ in range(20):
        one.send_action({f"{name}.pos": 10.0 for name in leader})
    moved = [in_view(one, arm) - start for arm, start in zip(("PSM1", "PSM2"), starts, strict=True)]
    assert moved[0][0] == pytest.approx(-0.005, abs=3e-4)
    assert moved[1][0] == pytest.approx(0.005, abs=3e-4)


@pytest.mark.parametrize("stop", ["pause", "reset", "reconnect"])
def test_what_a_leader_does_while_nothing_is_sent_is_not_made_up_for(robot, stop):
    one = robot(action="leader")
    joints = dict.fromkeys(one.action_features, 0.0)
    command = one.served.publisher(topics.psm_topics("PSM2", heard=True)["state_command"])

    def turn(degrees):
        one.send_action({**joints, "shoulder_pan.pos": degrees})

    turn(0.0)
    turn(20.0)  # more than one step: the rest waits
    if stop == "pause":
        command(StringStamped(Header(), "pause"))
        for degrees in (30.0, 40.0, 50.0):
            turn(degrees)
        command(StringStamped(Header(), "resume"))
        one.send_action({})
    elif stop == "reset":
        one.send_action({RESET: NEXT})
    else:
        one.disconnect()
        one.connect()
    one.get_observation()
    start = in_view(one)
    for _ in range(20):
        turn(90.0)
    assert in_view(one) == pytest.approx(start, abs=1e-4)
    for _ in range(20):
        turn(100.0)
    assert in_view(one)[0] - start[0] == pytest.approx(-0.005, abs=3e-4)


def test_absolute_actions_lead_both_arms_to_where_they_say(robot):
    """In steps; the pose that is observed, sent back, holds the arms."""
    one = robot(action="absolute")
    seen = one.get_observation()
    assert tuple(seen) == POSITIONS
    for _ in range(3):
        one.send_action(seen)
    still = one.get_observation()
    assert np.allclose([still[key] for key in POSITIONS], list(seen.values()), atol=2e-3)
    goal = dict(zip(TARGETS, seen.values(), strict=True))
    goal["psm1_sp.position.y.pos"] += 0.006
    goal["psm2_sp.position.x.pos"] += 0.004
    goal["psm2_jaw_sp.pos"] = 0.3
    for _ in range(40):
        one.send_action(goal)
    reached = one.get_observation()
    wanted = [goal[key] for key in TARGETS]
    assert np.allclose([reached[key] for key in POSITIONS], wanted, atol=1.5e-3)


def test_the_observed_absolute_pose_is_that_of_the_view(robot):
    one = robot(action="absolute")
    seen = one.get_observation()
    tip = one.served.robot.env.simulation.tip(names.PSM1)
    place = poses.position(poses.compose(poses.invert(T_WORLD_VIEW), tip))
    assert [seen[key] for key in POSITIONS[:3]] == pytest.approx(place, abs=1e-9)


@pytest.mark.parametrize(
    ("leader", "problem"),
    [({"a": "sideways"}, "way of a"), ({"a": "PSM3:up"}, "arm of a"), ({}, "leader is empty")],
)
def test_ways_that_there_are_not_are_refused(leader, problem):
    with pytest.raises(InputError, match=problem):
        Dvrk(DvrkConfig(simulated=True, action="leader", leader=leader))


# -- guards, episodes ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("action", "problem"),
    [
        ({"dx.vel": math.nan}, "not seven finite numbers"),
        # What LeRobot sends to return to the first pose.
        ({"x.pos": 0.1, "y.pos": 0.2}, "has x.pos, y.pos, but --robot.action=increments takes dx"),
        # A gamepad of LeRobot's, without --robot.action=delta.
        ({"delta_x": 1.0, "gripper": 2.0}, "has delta_x, gripper, but --robot.action=increments"),
        ({}, ""),
    ],
)
def test_an_action_that_says_nothing_usable_holds_the_arm(robot, action, problem, caplog):
    one = robot()
    before = one.served.robot.state("PSM2").setpoint
    with caplog.at_level(logging.INFO):
        one.send_action(action)
    assert one.served.robot.state("PSM2").setpoint == pytest.approx(before, abs=1e-9)
    assert problem in caplog.text


def test_a_pose_that_cannot_be_used_leaves_the_last_observation(robot, caplog):
    one = robot()
    with caplog.at_level(logging.WARNING):
        before = one.get_observation()
        topic = topics.psm_topics("PSM2", heard=False)["local/measured_cp"]
        heard = one._client.newest(topic.name).message
        header = dataclasses.replace(heard.header, stamp=heard.header.stamp + 1)
        spoilt = dataclasses.replace(heard, header=header, position=(math.nan, 0.0, 0.0))
        one.served.publisher(topic)(spoilt)
        assert one.get_observation() == before
    assert "finite numbers" in caplog.text


def test_a_judgement_of_another_sender_changes_nothing(robot):
    one = robot()
    text = json.dumps({"a": 1})
    one.served.publisher(topics.JUDGEMENT)(StringStamped(Header(time.time_ns()), text))
    assert one.get_observation()
    assert not BOARD.success


@pytest.mark.parametrize("command", ["pause", "disable", "fault"])
def test_an_emergency_stop_holds_the_arm_and_the_log_says_why(robot, command, caplog):
    one = robot()
    for row in actions(3):
        one.send_action(dict(zip(VALUES, row, strict=True)))
    stop = topics.psm_topics("PSM2", heard=True)["state_command"]
    one.served.publisher(stop)(StringStamped(Header(), command))
    one.send_action(dict.fromkeys(VALUES, 0.0))
    held = one.served.robot.state("PSM2").setpoint
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            one.send_action(dict.fromkeys(VALUES, 1.0))
    assert one.served.robot.state("PSM2").setpoint == held
    assert "held: PSM2 is" in caplog.text


def test_a_robot_needs_its_workspace_and_a_person_that_holds_it():
    with pytest.raises(InputError, match="a real robot needs a dead-man's switch: dead_man"):
        DvrkConfig()
    with pytest.raises(InputError, match="where this robot's tips may be"):
        DvrkConfig(dead_man="/pedal")
    with pytest.raises(InputError, match="clock that can be stepped"):
        DvrkConfig(dead_man="/pedal", guards={"frame": "base"} and _guards("base"), clock="stepped")
    with pytest.raises(InputError, match="give the subtask"):
        DvrkConfig(task="suture", dead_man="/pedal", guards=_guards("base"))
    with pytest.raises(InputError, match="dead_man is '/a b'; a topic begins with '/'"):
        DvrkConfig(dead_man="/a b", guards=_guards("base"))


def _guards(frame):
    return GuardConfig(frame, (-0.1, -0.1, -0.2), (0.1, 0.1, -0.05))


def test_a_next_start_begins_when_asked_for_and_between_rollouts(robot):
    one = robot()
    served = one.served.robot
    assert served.seed == SEED
    one.send_action({RESET: NEXT})
    assert served.seed == SEED + 1
    for _ in range(3):
        one.get_observation()
        one.send_action(dict.fromkeys(VALUES, 0.0))
    assert served.seed == SEED + 1
    for _ in range(12):
        one.get_observation()
    assert served.seed == SEED + 2
    assert served.steps == 0


def test_a_next_start_begins_after_a_success(robot):
    """An expert's actions, as any teleoperator's."""
    env = envs.make(TaskConfig("grasp"))
    env.reset(seed=SEED)
    expert = Expert(env)
    one = robot(reset_after=1e-6)
    ended = False
    while not ended:
        action = expert.action()
        one.get_observation()
        one.send_action(dict(zip(VALUES, action.tolist(), strict=True)))
        _, _, ended, _, info = env.step(action)
    assert info["is_success"]
    one.get_observation()
    assert BOARD.success
    one.get_observation()
    assert one.served.robot.seed == SEED + 1


# -- the page --------------------------------------------------------------------------------------


class Hands:
    """A device whose inputs are given."""

    def __init__(self, *inputs):
        self.inputs = list(inputs)

    def poll(self):
        return self.inputs.pop(0) if self.inputs else Input()


@pytest.fixture
def page(tmp_path):
    one = SurgicaiPage(SurgicaiPageConfig(port=0, calibration_dir=tmp_path, speed=1.0))
    one.connect()
    yield one
    one.disconnect()


@pytest.mark.parametrize(("move", "axis", "sign"), [(0, 0, -1), (1, 1, -1), (2, 2, 1)])
def test_the_pages_keys_move_the_tip_in_the_image(robot, page, move, axis, sign):
    """Right, down and away, of the active arm, as any LeRobot robot would be told."""
    one = robot()
    one.get_observation()
    start = in_view(one)
    given = [0.0, 0.0, 0.0]
    given[move] = 1.0
    page._device = Hands(*[Input(move=tuple(given))] * 5)
    for _ in range(5):
        one.send_action(page.get_action())
    moved = in_view(one) - start
    assert np.argmax(np.abs(moved)) == axis
    assert moved[axis] == pytest.approx(sign * 5 * STEP.translation, rel=0.05)


def test_the_page_toggles_the_jaw_and_asks_for_starts(robot, page):
    one = robot()
    one.get_observation()
    BOARD.jaw = 0.0
    page._device = Hands(Input(events=(JAW,)), Input(), Input(events=(START,)))
    assert page.get_action()["jaw.vel"] == 1.0
    assert page.get_action()["jaw.vel"] == 1.0
    assert page.get_action()[RESET] == NEXT
    assert set(page.action_features) == set(one.action_features)
    assert one.config.action == INCREMENTS
