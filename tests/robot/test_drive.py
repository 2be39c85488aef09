"""A policy driving a served simulation over an in-process transport, and its guards."""

import dataclasses
import io
import json
import math
import os
import pty
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from memory_transport import MemoryTransport
from stepped_server import SEED, Served, env_of
from told_clock import Clock

from surgicai_vision import envs
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, from_mapping
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.demos.expert import Expert
from surgicai_vision.demos.imports.drive_log import import_drive_log
from surgicai_vision.demos.imports.rosbag.config import BagConfig
from surgicai_vision.demos.imports.rosbag.config import Frames as BagFrames
from surgicai_vision.demos.store import list_demos, read_demo
from surgicai_vision.envs import contact_sheet, poses
from surgicai_vision.envs.control import StepSize
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.evaluation.agents import ExpertAgent, RandomAgent
from surgicai_vision.robot import topics
from surgicai_vision.robot.client import Client, ClientConfig
from surgicai_vision.robot.dead_man import HeldKey, HeldPedal
from surgicai_vision.robot.driven import DrivenRobot
from surgicai_vision.robot.driver import DriveConfig, Driver
from surgicai_vision.robot.frames import read_pose, write_pose
from surgicai_vision.robot.guards import (
    GuardConfig,
    Input,
    Planned,
    TargetGuard,
    problem_of_dead_man,
    problem_of_inputs,
)
from surgicai_vision.robot.messages import CompressedImage, Header, Joy, PoseStamped, StringStamped
from surgicai_vision.robot.server import ServeConfig, Server
from surgicai_vision.robot.transport import RenamedTransport
from surgicai_vision.scene import kinematics
from surgicai_vision.teleoperation.recordings import open_recordings

SIMULATED = DriveConfig(GuardConfig(), sends=True, is_simulated=True, is_stepped=True)
STEP = StepSize.of("paper")


class Script(Agent):
    """Plays (phase, action) pairs, then holds still."""

    name = "script"

    def __init__(self, rows, cameras=(), image_size=64):
        self.rows = rows
        self.cameras = cameras
        self.image_size = image_size
        self.seen = []

    def reset(self, slot, robot, seed):
        self.place = 0

    def act(self, slots, robots, observations):
        self.seen.append(observations[0])
        if self.place >= len(self.rows):
            return np.zeros((1, 7), np.float32)
        phase, action = self.rows[self.place]
        self.place += 1
        if phase >= 0:
            robots[0].enter(phase)
        return np.asarray([action], np.float32)


def drive(
    agent,
    task,
    steps,
    config=SIMULATED,
    dead_man=lambda: 0.0,
    transport=None,
    views=(),
    through=None,
    frames=None,
    seed=SEED,
):
    """Drive one episode; return it, the lines of its log, the notices and the transport."""
    served = transport or Served(task, views)
    client = Client(through or served, ClientConfig(views=views, is_simulated=config.is_simulated))
    client.connect()
    log = io.StringIO()
    told = []
    robot = DrivenRobot(client, views, task, 64, frames)
    driver = Driver(agent, robot, TaskConfig(task), config, dead_man, log, told.append)
    episode = driver.episode(seed, steps)
    return episode, [json.loads(line) for line in log.getvalue().splitlines()], told, served


def by_expert(task, seed=SEED):
    """Return the env, and the (phase, action) pairs of the expert's success from a start."""
    env = env_of(task)
    env.reset(seed=seed)
    expert = Expert(env)
    rows = []
    ended = False
    while not ended:
        rows.append((env.phase if task == "suture" else -1, expert.action()))
        _, _, terminated, truncated, info = env.step(rows[-1][1])
        ended = terminated or truncated
    assert info["is_success"]
    return env, rows


def test_a_driven_policy_moves_as_in_process():
    episode, lines, _, served = drive(RandomAgent(), "grasp", 50)
    assert episode.steps == 50
    assert episode.held == 0
    assert np.allclose(served.robot.env.data.qpos, random_positions(50), atol=1e-8)
    assert all(line["sent"] for line in lines)


def random_positions(steps):
    """Return the joint positions after a random policy's steps in this process."""
    own = envs.make(TaskConfig("grasp"))
    own.reset(seed=SEED)
    agent = RandomAgent()
    agent.reset(0, own, SEED)
    for _ in range(steps):
        own.step(agent.act([0], [own], [own.observe()])[0])
    return own.data.qpos.copy()


class OtherFrames:
    """A robot with other local frames and another tip: a transport that transforms its poses."""

    def __init__(self, inner, bases, tip):
        self.inner = inner
        self.bases = bases
        self.tip = tip
        self.wait = inner.wait
        self.listeners = inner.listeners

    def publisher(self, topic):
        publish = self.inner.publisher(topic)
        if not topic.name.endswith("servo_cp"):
            return publish

        def turned(message):
            pose = poses.compose(read_pose(message), poses.invert(self.tip))
            publish(write_pose(pose, message.header.stamp, message.header.frame))

        return turned

    def inbox(self, topic):
        take = self.inner.inbox(topic)
        if not topic.name.endswith("_cp"):
            return take
        base = self.bases.get(topic.name[1:5]) if "/local/" in topic.name else poses.IDENTITY
        return lambda: [self._said(received, base) for received in take()]

    def _said(self, received, base):
        message = received.message
        pose = poses.compose(poses.invert(base), poses.compose(read_pose(message), self.tip))
        said = write_pose(pose, message.header.stamp, message.header.frame)
        return dataclasses.replace(received, message=said)


def test_a_robot_with_frames_of_its_own_is_driven_the_same():
    turn = (0.5, 0.5, -0.5, 0.5)
    given = BagFrames(
        psm1=(0.1, 0.0, -0.2, *turn),
        psm2=(0.0, 0.3, 0.1, *turn),
        tip=(0.0, 0.0, 0.01, 0.6, 0.8, 0, 0),
    )

    def pose(values):
        x, y, z, w, qx, qy, qz = values
        return read_pose(PoseStamped(Header(), (x, y, z), (qx, qy, qz, w)))

    served = Served("grasp")
    other = OtherFrames(
        served, {"PSM1": pose(given.psm1), "PSM2": pose(given.psm2)}, pose(given.tip)
    )
    episode, _, _, _ = drive(
        RandomAgent(), "grasp", 30, transport=served, through=other, frames=given
    )
    assert episode.held == 0
    assert np.allclose(served.robot.env.data.qpos, random_positions(30), atol=1e-7)


def test_a_robot_with_names_of_its_own_is_driven_the_same():
    served = Served("grasp")
    renamed = {"/PSM2/servo_cp": "/dvrk/PSM2/servo_cp", "/PSM2/local/measured_cp": "/where"}
    served.server = Server(
        served.robot, RenamedTransport(served, renamed, ()), ServeConfig("stepped")
    )
    served.server.__enter__()
    episode, _, _, _ = drive(
        RandomAgent(), "grasp", 10, transport=served, through=RenamedTransport(served, renamed, ())
    )
    assert episode.steps == 10
    assert np.allclose(served.robot.env.data.qpos, random_positions(10), atol=1e-8)


@pytest.mark.parametrize(
    ("renamed", "problem"),
    [
        ({"/PSM3/servo_cp": "/x"}, "Unknown topic"),
        ({"/PSM1/servo_cp": "x"}, "begins with '/'"),
        ({"/PSM1/servo_cp": "/a b"}, "of letters, digits and _"),
        ({"/PSM1/servo_cp": "/a\0b"}, "of letters, digits and _"),
        ({"/PSM1/servo_cp": "/näht"}, "of letters, digits and _"),
        ({"/PSM1/servo_cp": "/PSM1//servo_cp"}, "of letters, digits and _"),
        ({"/PSM1/servo_cp": "/PSM2/servo_cp"}, "two are called /PSM2/servo_cp"),
    ],
)
def test_names_that_cannot_be_used_are_refused(renamed, problem):
    with pytest.raises(InputError, match=problem):
        RenamedTransport(MemoryTransport(), renamed, ())


def test_an_agent_reads_the_same_poses_as_in_process():
    served = Served("suture")
    client = Client(served, ClientConfig(is_simulated=True))
    client.connect()
    client.reset(SEED)
    robot = DrivenRobot(client, (), "suture", 64)
    env = served.robot.env
    assert np.allclose(robot.agent_pos(), env.agent_pos(), atol=1e-6)
    assert np.allclose(robot.both_arms(), env.both_arms(), atol=1e-6)
    assert np.allclose(robot.setpoint(), env.setpoint(), atol=1e-6)
    robot.enter(3)
    env.enter(3)
    assert robot.active == "PSM1"
    assert np.allclose(robot.agent_pos(), env.agent_pos(), atol=1e-6)
    with pytest.raises(InputError, match="no subtask 5"):
        robot.enter(5)


def test_a_whole_procedure_succeeds_as_in_process():
    """Both arms, all five subtasks and PSM2 letting go, through topics alone."""
    env, rows = by_expert("suture")
    final = env.data.qpos.copy()
    episode, lines, _, served = drive(Script(rows), "suture", len(rows) + 100)
    assert episode.success
    assert episode.ended == "the judge reports success"
    assert episode.steps == len(rows)
    assert np.allclose(served.robot.env.data.qpos, final, atol=1e-3)
    let_go = [line for line in lines if set(line["commands"]) == {"PSM1", "PSM2"}]
    assert {line["phase"] for line in let_go} == {4}


def test_what_a_client_does_is_recorded_as_it_was_told(tmp_path):
    """The recorded actions are the client's increments; the states are the simulation's."""
    seed = 3
    env, rows = by_expert("grasp", seed)
    told = []
    with open_recordings(tmp_path / "demos", env.config, env.scene.hash) as recordings:
        served = Served("grasp", recordings=recordings, tell=told.append)
        episode, _, _, _ = drive(Script(rows), "grasp", 300, transport=served, seed=seed)
    assert episode.success
    demo = read_demo(list_demos(tmp_path / "demos")[0])
    assert np.allclose(demo.action, [action for _, action in rows], atol=1e-5)
    assert demo.success[-1]
    assert demo.demonstrator == "robot"
    assert demo.seed == seed
    assert np.array_equal(demo.state[-1], served.robot.env.get_state())
    assert told[0].startswith(f"start {SEED} is not kept") and "0 % of them clipped" in told[1]


@pytest.mark.parametrize(("seed", "bank"), [(SEED, "tests"), (500_000, "validation")])
def test_starts_that_are_reserved_are_not_recorded(tmp_path, seed, bank):
    """A policy trained on them would be evaluated on what it has seen."""
    env, rows = by_expert("grasp", seed)
    told = []
    with open_recordings(tmp_path / "demos", env.config, env.scene.hash) as recordings:
        served = Served("grasp", recordings=recordings, tell=told.append)
        episode, _, _, _ = drive(Script(rows), "grasp", 300, transport=served, seed=seed)
    assert episode.success and not recordings.seeds
    assert f"start {seed} is not kept: it is in the bank for {bank}" in told[-1]
    assert "request a seed below 500000" in told[-1]


def test_the_log_of_a_drive_becomes_demonstrations(tmp_path):
    """One demonstration per driven subtask, with the arms where they were measured."""
    env, rows = by_expert("suture")
    _, lines, _, _ = drive(Script(rows), "suture", len(rows) + 100)
    about = json.dumps({"policy": "script"})
    text = "\n".join([about, *map(json.dumps, lines), '{"cut off'])
    log = tmp_path / "drive.jsonl"
    log.write_text(text)
    config = BagConfig(drop_pauses=False)
    made = import_drive_log(log, task=None, out=tmp_path / "demos", config=config)
    assert [summary.task for summary in made] == list(names.SUBTASKS)
    measured = np.array([line["both_arms"] for line in lines])
    phases = np.array([line["phase"] for line in lines])
    for phase, summary in enumerate(made):
        demo = read_demo(summary.paths[0])
        assert demo.demonstrator == "drive"
        there = measured[phases == phase]
        assert abs(len(demo) - len(there)) <= 2
        arm = 7 * names.ARMS.index(names.ACTIVE_ARM[summary.task])
        for index in range(0, len(demo), 20):
            env.set_state_vector(demo.state[index])
            tip = env.both_arms()[arm : arm + 3]
            assert np.linalg.norm(there[:, arm : arm + 3] - tip, axis=1).min() < 1e-3
    log.write_text(text.replace("both_arms", "arms"))
    with pytest.raises(BadFile, match="line 2"):
        import_drive_log(log, task=None, out=tmp_path / "other")


def driven_by_command(monkeypatch, out, *options, policy="random"):
    """Run `robot drive` at a simulation served in this process; return the exit code."""
    monkeypatch.setattr(
        "surgicai_vision.robot.transport.open_transport", lambda *_: Served("grasp")
    )
    command = ["robot", "drive", policy, "--task", "grasp", "--simulated", "--clock", "stepped"]
    return main([*command, "--send", "--seconds", "0.06", "--out", str(out), *options])


def test_a_log_that_was_cut_off_is_continued_with_whole_lines(monkeypatch, tmp_path):
    assert driven_by_command(monkeypatch, tmp_path) == 0
    log = tmp_path / "drive.jsonl"
    whole = log.read_bytes()
    log.write_bytes(whole + b'{"time": 17')
    assert driven_by_command(monkeypatch, tmp_path) == 0
    assert log.read_bytes().startswith(whole)
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [number for number, line in enumerate(lines) if "policy" in line] == [0, 4]
    assert len(lines) == 8


@pytest.mark.parametrize(
    ("options", "given", "problem"),
    [
        ((), {"jaw_scale": math.nan}, "jaw_scale is nan"),
        ((), {"guards": {"max_speed": 9.0}}, "max_speed is 9"),
        (("--dead-man", "pedal"), {}, "--dead-man is 'pedal'"),
        (("--dead-man", "/a b"), {}, "--dead-man is '/a b'"),
    ],
)
def test_wrong_input_is_refused_before_a_robot_is_looked_for(
    monkeypatch, tmp_path, capsys, options, given, problem
):
    def connect(self):
        raise AssertionError("it looks for a robot")

    monkeypatch.setattr(Client, "connect", connect)
    config = tmp_path / "robot.yaml"
    config.write_text(yaml.safe_dump(given))
    options = (*options, "--config", str(config))
    assert driven_by_command(monkeypatch, tmp_path / "log", *options) == 2
    assert problem in capsys.readouterr().err
    assert not (tmp_path / "log").exists()


def test_a_simulation_of_another_task_is_refused():
    with pytest.raises(InputError, match="served with --task grasp; this policy needs --task ins"):
        drive(RandomAgent(), "insert", 3, transport=Served("grasp"))


def test_images_reach_the_agent_as_they_were_rendered():
    script = Script([(-1, np.zeros(7))] * 2, cameras=("front",))
    drive(script, "grasp", 2, views=("front",))
    assert script.seen[0]["front"].shape == (64, 64, 3)
    assert script.seen[0]["front"].std() > 5
    assert np.array_equal(script.seen[0]["agent_pos"].shape, (7,))


def compressed(*shape):
    return contact_sheet.png(np.arange(np.prod(shape), dtype=np.uint8).reshape(shape))


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "cannot be read"),
        (b"no image", "cannot be read"),
        (compressed(8, 8, 3)[:40], "cannot be read"),
        (compressed(16, 8, 3), "16 × 8"),
    ],
)
def test_a_compressed_image_that_cannot_be_used_is_refused(content, problem):
    shown = [content]
    client = SimpleNamespace(
        image_topic=str,
        newest=lambda _: SimpleNamespace(message=CompressedImage(Header(), "png", shown[0])),
    )
    robot = DrivenRobot(client, ("front",), "grasp", 8)
    with pytest.raises(InputError, match=problem):
        robot.images()
    shown[0] = compressed(8, 8, 3)
    frame = robot.images()["front"]
    assert np.array_equal(frame, np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3))


def test_a_dry_run_tells_and_moves_nothing():
    dry = dataclasses.replace(SIMULATED, sends=False)
    served = Served("grasp")
    before = served.robot.state("PSM2").setpoint
    script = Script([(-1, [1, 0, 0, 0, 0, 0, 1])] * 5)
    _, lines, told, _ = drive(script, "grasp", 5, dry, transport=served)
    assert served.robot.state("PSM2").setpoint == before
    assert not any(line["sent"] for line in lines)
    assert lines[0]["commands"]["PSM2"]["jaw"] > 0
    assert any("would be sent to" in line for line in told)


def test_nothing_is_sent_while_the_switch_is_not_held():
    ages = iter([0.0, 0.0, 0.1, 0.1, 9.9, 9.9, 0.0, 0.0])
    script = Script([(-1, [1, 0, 0, 0, 0, 0, 0])] * 5)
    episode, lines, told, _ = drive(script, "grasp", 5, dead_man=lambda: next(ages))
    assert [line["sent"] for line in lines] == [True, True, False, False, True]
    assert episode.held == 2
    assert "held: the dead-man's switch is not held" in told


def test_a_switch_released_while_the_policy_decides_holds_the_arm():
    ages = iter([0.0, 0.0, 0.1, 0.6])
    script = Script([(-1, [1, 0, 0, 0, 0, 0, 0])] * 2)
    served = Served("grasp")
    _, lines, _, _ = drive(script, "grasp", 2, dead_man=lambda: next(ages), transport=served)
    assert [line["sent"] for line in lines] == [True, False]
    assert lines[1]["action"] == [1, 0, 0, 0, 0, 0, 0]


def test_a_pedal_counts_only_while_it_is_sent_anew():
    transport = MemoryTransport()
    pedal = HeldPedal(transport, "/pedal")
    say = transport.publisher(topics.Topic("/pedal", Joy))
    assert pedal.age() == math.inf
    say(Joy(Header(), (), (1,)))
    assert pedal.age() < 0.5
    say(Joy(Header(), (), (0,)))
    assert pedal.age() == math.inf


def test_an_old_press_is_as_old_as_the_last_reading(monkeypatch):
    """What waits to be read may have come at any time since then."""
    clock = Clock()
    monkeypatch.setattr("surgicai_vision.robot.dead_man.time.monotonic", clock)
    transport = MemoryTransport()
    say = transport.publisher(topics.Topic("/pedal", Joy))
    pedal = HeldPedal(transport, "/pedal")
    master, slave = pty.openpty()
    with os.fdopen(slave) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        with HeldKey() as key:
            ages = []
            for pause in (0.0, 0.02, 9.0, 0.02):
                say(Joy(Header(), (), (1,)))
                os.write(master, b" ")
                clock.now += pause
                ages.append((key.age(), pedal.age()))
    os.close(master)
    assert ages == [(pytest.approx(age),) * 2 for age in (math.inf, 0.02, 9.0, 0.02)]


def test_the_space_bar_of_a_terminal_is_a_switch(monkeypatch):
    master, slave = pty.openpty()
    with os.fdopen(slave) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        with HeldKey() as key:
            assert key.age() == math.inf
            os.write(master, b"x")
            assert key.age() == math.inf
            os.write(master, b"   ")
            assert key.age() < 0.5
    os.close(master)
    with open(os.devnull) as nothing:
        monkeypatch.setattr("sys.stdin", nothing)
        with pytest.raises(InputError, match="no terminal"):
            HeldKey()


@pytest.mark.parametrize(("command", "ends"), [("pause", False), ("disable", True)])
def test_an_emergency_stop_is_obeyed_at_once(command, ends):
    served = Served("grasp")
    moved = [(-1, [1, 0, 0, 0, 0, 0, 0])] * 12

    class Stopped(Script):
        def act(self, slots, robots, observations):
            if self.place == 3:
                stop = topics.psm_topics("PSM2", heard=True)["state_command"]
                served.publisher(stop)(StringStamped(Header(), command))
            return super().act(slots, robots, observations)

    episode, lines, told, _ = drive(Stopped(moved), "grasp", 12, transport=served)
    assert [line["sent"] for line in lines][:4] == [True] * 4
    assert not any(line["sent"] for line in lines[4:])
    place = served.robot.state("PSM2").joints
    assert np.allclose(served.robot.state("PSM2").setpoint, place, atol=2e-3)
    assert ("stopped" in episode.ended) == ends
    if not ends:
        assert any("PSM2 is PAUSED" in line for line in told)


def test_an_action_that_is_not_finite_ends_the_episode():
    script = Script([(-1, [0] * 7), (-1, [math.nan] * 7)])
    episode, lines, _, _ = drive(script, "grasp", 9)
    assert "not finite" in episode.ended
    assert [line["sent"] for line in lines] == [True, False]


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"position": (math.nan, 0.0, 0.0)}, "finite"),
        ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, "unit quaternion"),
    ],
)
def test_a_pose_that_cannot_be_used_holds_the_arm_and_the_log_says_why(changes, problem):
    served = Served("grasp")
    topic = topics.psm_topics("PSM2", heard=False)["local/measured_cp"]
    calls = iter(range(100))

    class Spoilt(Client):
        def update(self):
            super().update()
            heard = self.newest(topic.name)
            if heard is not None and next(calls) > 40:
                spoilt = dataclasses.replace(heard.message, **changes)
                self._newest[topic.name] = dataclasses.replace(heard, message=spoilt)

    client = Spoilt.__new__(Spoilt)
    Client.__init__(client, served, ClientConfig(is_simulated=True))
    client.connect()
    log = io.StringIO()
    robot = DrivenRobot(client, (), "grasp", 64)
    driver = Driver(
        Script([(-1, [1] * 7)] * 30), robot, TaskConfig("grasp"), SIMULATED, float, log, print
    )
    episode = driver.episode(SEED, 30)
    lines = [json.loads(line) for line in log.getvalue().splitlines()]
    assert lines[0]["sent"]
    assert not lines[-1]["sent"]
    assert problem in lines[-1]["held"]
    assert episode.held >= 1


def test_messages_out_of_order_are_left():
    served = Served("grasp")
    client = Client(served, ClientConfig(is_simulated=True))
    client.connect()
    topic = topics.psm_topics("PSM2", heard=False)["measured_cp"]
    newest = client.newest(topic.name).message
    old = dataclasses.replace(newest, header=Header(newest.header.stamp - 5, "ECM_view"))
    served.publisher(topic)(old)
    client.update()
    assert client.newest(topic.name).message is newest


def test_an_oracle_is_refused():
    with pytest.raises(InputError, match="reads the state of a simulation"):
        drive(ExpertAgent(), "grasp", 1)


# -- guards ----------------------------------------------------------------------------------------

POSE = poses.flat(kinematics.start_in_base(names.PSM2))
WORLD_BASE = poses.flat(kinematics.base_in_world(names.PSM2))
ENABLED = {"PSM2": ("ENABLED", True)}


def planned(shift=0.0, lead=0.0):
    told = (POSE[0] + lead, *POSE[1:])
    return Planned("PSM2", told, POSE, (told[0] + shift, *told[1:]), WORLD_BASE)


@pytest.mark.parametrize(
    ("inputs", "states", "dead_man", "problem"),
    [
        ([Input("/a", 0.05, 0.1)], ENABLED, 0.0, ""),
        ([Input("/a", 0.2, 0.1)], ENABLED, 0.0, "/a is 0.20 s old"),
        ([Input("/a", math.inf, 0.1)], ENABLED, 0.0, "/a has never arrived"),
        ([], {"PSM2": ("", False)}, 0.0, "silent"),
        ([], {"PSM2": ("PAUSED", True)}, 0.0, "PSM2 is PAUSED"),
        ([], {"PSM2": ("ENABLED", False)}, 0.0, "not homed"),
        ([], ENABLED, 0.6, "dead-man"),
    ],
)
def test_what_holds_a_policy_back(inputs, states, dead_man, problem):
    said = problem_of_dead_man(dead_man) or problem_of_inputs(inputs, states)
    assert problem in said
    assert bool(said) == bool(problem)


def test_a_set_point_may_not_jump_lead_or_race():
    guard = TargetGuard(GuardConfig(max_speed=0.03), STEP)
    assert guard.problem_of_target(planned(0.0005), 0.0) == ""
    assert "a step of" in guard.problem_of_target(planned(0.002), 0.0)
    assert "does not follow" in guard.problem_of_target(planned(0.0005, lead=0.03), 0.0)
    assert "not finite" in guard.problem_of_target(planned(math.nan), 0.0)
    for step in range(60):
        plan = planned(0.0008, lead=0.0008 * (step % 2))
        problem = guard.problem_of_target(plan, 0.02 * step)
        if problem:
            break
        guard.remember(plan, 0.02 * step)
    assert "would be commanded to move" in problem


def test_a_largest_action_of_the_policys_own_step_size_is_allowed():
    guard = TargetGuard(GuardConfig(), STEP)
    for shift in (0.0, 1e-4, STEP.translation):
        assert guard.problem_of_target(planned(shift), 0.0) == ""


def test_the_tip_is_kept_in_the_workspace_and_the_jaw_still_moves():
    guard = TargetGuard(GuardConfig(), STEP)
    assert not guard.is_outside(planned())
    assert guard.is_outside(planned(0.5))
    low = GuardConfig().low
    narrow = GuardConfig(low=low, high=(low[0] + 0.001, low[1] + 0.001, low[2] + 0.001))
    config = dataclasses.replace(SIMULATED, guards=narrow)
    served = Served("grasp")
    script = Script([(-1, [1, 1, 1, 0, 0, 0, -1])] * 4)
    episode, lines, _, _ = drive(script, "grasp", 4, config, transport=served)
    assert episode.held == 0
    places = [line["commands"]["PSM2"]["pose"][:3] for line in lines]
    assert np.allclose(places, places[0], atol=1e-9)
    jaws = [line["commands"]["PSM2"]["jaw"] for line in lines]
    assert (np.diff(jaws) < 0).all()


@pytest.mark.parametrize(
    "limits",
    [
        {"max_age": 9.0},
        {"max_speed": 0.0},
        {"max_lead": math.nan},
        {"low": (0.0, 0.0, 0.0), "high": (0.0, 0.1, 0.1)},
        {"frame": "map"},
        {"high": (9.0, 9.0, 9.0)},
    ],
)
def test_guards_have_no_switch(limits):
    with pytest.raises(InputError):
        GuardConfig(**limits)


@pytest.mark.parametrize("low", [[], [0.0], [0.0] * 4])
def test_a_box_has_three_sides(low):
    with pytest.raises(InputError, match="expected 3 values"):
        from_mapping(GuardConfig, {"low": low, "high": [0.4] * len(low)})


def test_a_robot_must_be_given_its_own_workspace():
    with pytest.raises(InputError, match="where this robot's tips may be"):
        DriveConfig(GuardConfig())
    DriveConfig(GuardConfig("ECM_view", (-0.05, -0.05, 0.05), (0.05, 0.05, 0.2)))
