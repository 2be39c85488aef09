"""Faults: whatever goes wrong, the arm stands still within 100 ms and the log says why.

On the robot's side: what a client does wrong or no longer does. On the client's side: what a robot
reports wrongly or no longer reports.
"""

import dataclasses
import io
import json
import math

import numpy as np
import pytest
from memory_transport import Medium, MemoryTransport
from stepped_server import SEED, Served, env_of
from virtual_time import VirtualTime

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.envs import poses
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.robot import topics
from surgicai_vision.robot.client import Client, ClientConfig, _Lag
from surgicai_vision.robot.driven import DrivenRobot
from surgicai_vision.robot.driver import DriveConfig, Driver
from surgicai_vision.robot.frames import read_pose, write_pose
from surgicai_vision.robot.guards import GuardConfig
from surgicai_vision.robot.messages import Header, JointState, StringStamped
from surgicai_vision.robot.server import ServeConfig, Server
from surgicai_vision.robot.simulated import SimulatedRobot

STILL_STEPS = 5
"""Control steps of 100 ms."""
STILL_M = 2e-4
"""Most that a still tip moves in ten control steps [m]; at a millimetre per step it moves 10 mm."""
SECOND = 1_000_000_000
START = 1_800_000_000 * SECOND
HEARD = topics.psm_topics("PSM2", heard=True)
SAID = topics.psm_topics("PSM2", heard=False)


class RealServer:
    """A real-time server whose control steps are taken one at a time, when the test asks."""

    def __init__(self, monkeypatch):
        self.medium = Medium()
        self.robot = SimulatedRobot(env_of("grasp"))
        self.robot.reset(SEED)
        self.server = Server(self.robot, MemoryTransport(self.medium, "robot"), ServeConfig())
        self.server.__enter__()
        self.now = START
        monkeypatch.setattr("surgicai_vision.robot.server.time.time_ns", lambda: self.now)
        self.pose = read_pose(self.newest("local/setpoint_cp"))
        self.notes = {
            level: MemoryTransport(self.medium).inbox(SAID[level]) for level in ("warning", "error")
        }

    def newest(self, channel):
        inbox = MemoryTransport(self.medium).inbox(SAID[channel])
        self.server._publish_all(self.server._stamp())
        return inbox()[-1].message

    def send(self, source="client", shift=1e-3, **changes):
        """Send a set point a step further to the side, as a client at full speed does."""
        self.pose = (self.pose[0] + shift, *self.pose[1:])
        message = write_pose(self.pose, self.now, "PSM2_base")
        for name, value in changes.items():
            if name in ("stamp", "frame"):
                message = dataclasses.replace(
                    message, header=dataclasses.replace(message.header, **{name: value})
                )
            else:
                message = dataclasses.replace(message, **{name: value})
        MemoryTransport(self.medium, source).publisher(HEARD["servo_cp"])(message)

    def tick(self):
        self.server._tick()
        self.now += SECOND // 50

    def tip(self):
        return np.array(self.robot.env.simulation.tip("psm2")[:3])

    def said(self, level):
        return " ".join(received.message.text for received in self.notes[level]())


def late(served):
    served.send(stamp=served.now - SECOND)


def out_of_order(served):
    served.send(stamp=START + SECOND // 10)  # between stamps already obeyed


def not_finite(served):
    served.send(position=(math.nan, 0.0, 0.0))


def in_another_frame(served):
    served.send(frame="moon")


def out_of_reach(served):
    served.send(position=(0.0, 0.0, 9.0))


def by_two_clients(served):
    served.send("client")
    served.send("another", shift=-2e-3)


def killed(served):
    pass


def command(text):
    def stop(served):
        message = StringStamped(Header(served.now), text)
        MemoryTransport(served.medium).publisher(HEARD["state_command"])(message)
        served.send()

    return stop


@pytest.mark.parametrize(
    ("fault", "level", "reason"),
    [
        (killed, "warning", ""),
        (late, "warning", "1.00 s old"),
        (out_of_order, "warning", "out of order"),
        (not_finite, "warning", "finite numbers"),
        (in_another_frame, "warning", "moon"),
        (out_of_reach, "warning", "rejected servo_cp"),
        (by_two_clients, "error", "two clients move the arm"),
        (command("pause"), "warning", "the arm is PAUSED"),
        (command("disable"), "warning", "the arm is DISABLED"),
        (command("fault"), "warning", "the arm is FAULT"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_a_moving_arm_is_still_within_100_ms_of_a_clients_fault(monkeypatch, fault, level, reason):
    served = RealServer(monkeypatch)
    start = served.tip()
    for _ in range(10):
        served.send()
        served.tick()
    assert np.linalg.norm(served.tip() - start) > 4e-3
    for _ in range(STILL_STEPS):
        fault(served)
        served.tick()
    place = served.tip()
    for _ in range(10):
        fault(served)
        served.tick()
    assert np.linalg.norm(served.tip() - place) < STILL_M
    assert reason in served.said(level)


def test_a_jaw_keeps_its_grip_through_an_emergency_stop(monkeypatch):
    served = RealServer(monkeypatch)
    jaw = JointState(Header(served.now), ("jaw",), (0.4,))
    MemoryTransport(served.medium).publisher(HEARD["jaw/servo_jp"])(jaw)
    for _ in range(20):
        served.tick()
    command("fault")(served)
    for _ in range(20):
        served.tick()
    assert served.robot.state("PSM2").jaw_setpoint == pytest.approx(0.4)


# -- the client's side -----------------------------------------------------------------------------


class Along(Agent):
    """Moves the tip to the side at full speed."""

    name = "along"
    cameras = ()
    image_size = 64

    def reset(self, slot, robot, seed):
        pass

    def act(self, slots, robots, observations):
        return np.array([[1, 0, 0, 0, 0, 0, 0]], np.float32)


class Faulty(Served):
    """A robot whose messages are altered or dropped once a fault begins."""

    def __init__(self):
        super().__init__("grasp")
        self.fault = None

    def inbox(self, topic):
        take = super().inbox(topic)

        def taken():
            found = take()
            if self.fault is None:
                return found
            spoilt = (self.fault(topic, received.message) for received in found)
            return [
                dataclasses.replace(received, message=message)
                for received, message in zip(found, spoilt, strict=True)
                if message is not None
            ]

        return taken


def header_of(message, **changes):
    return dataclasses.replace(message, header=dataclasses.replace(message.header, **changes))


def is_pose(topic):
    return topic.name in (SAID["local/measured_cp"].name, SAID["setpoint_cp"].name)


def robot_is_silent(topic, message):
    return None if topic.name.startswith("/PSM2/") else message


def robot_is_late(topic, message):
    if not is_pose(topic):
        return message
    return header_of(message, stamp=message.header.stamp - SECOND // 2)


def robot_is_not_finite(topic, message):
    nan = (math.nan,) * 3
    return dataclasses.replace(message, position=nan) if is_pose(topic) else message


def robot_is_in_another_frame(topic, message):
    return header_of(message, frame="moon") if is_pose(topic) else message


def robot_says_old_things(topic, message):
    if not is_pose(topic):
        return message
    return header_of(message, stamp=message.header.stamp - 10 * SECOND)


def robot_jumps(topic, message):
    if topic.name != SAID["local/measured_cp"].name:
        return message
    x, y, z = message.position
    return dataclasses.replace(message, position=(x + 0.03, y, z))


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (robot_is_silent, "s old"),
        (robot_is_late, "s old"),
        (robot_says_old_things, "s old"),
        (robot_is_not_finite, "finite"),
        (robot_is_in_another_frame, "moon"),
        (robot_jumps, "does not follow"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_nothing_is_sent_within_100_ms_of_a_robots_fault(monkeypatch, fault, reason):
    """In real time on the test's own clock: each step of the driver takes 20 ms."""
    served = Faulty()
    clock = [100.0]

    def sleep(seconds):
        clock[0] += 0.005
        if served.ticks < round((clock[0] - 100.0) * 50):
            served.ticks += 1
            served.server._tick()

    served.ticks = 0
    served.wait = sleep
    for module in ("client", "driver"):
        monkeypatch.setattr(f"surgicai_vision.robot.{module}.time.monotonic", lambda: clock[0])
    monkeypatch.setattr("time.time_ns", lambda: int((2e9 + clock[0]) * SECOND))
    client = Client(served, ClientConfig(is_simulated=True))
    client.connect()
    robot = DrivenRobot(client, (), "grasp", 64)
    config = DriveConfig(GuardConfig(), sends=True, is_simulated=True)
    log = io.StringIO()
    told = []
    driver = Driver(Along(), robot, TaskConfig("grasp"), config, float, log, told.append)
    monkeypatch.setattr(client, "reset", lambda seed: 0)
    begun = []

    class Watched(io.StringIO):
        def write(self, text):
            lines = log.getvalue().count("\n")
            if lines == 15 and served.fault is None:
                served.fault = fault
                begun.append(lines)
            return log.write(text)

    driver._log = Watched()
    driver.episode(SEED, 40)
    lines = [json.loads(line) for line in log.getvalue().splitlines()]
    assert all(line["sent"] for line in lines[1:15]), told
    held = lines[begun[0] + STILL_STEPS + 1 :]
    assert held
    assert not any(line["sent"] for line in held)
    assert reason in held[-1]["held"]
    assert any(reason in text for text in told)


class Interrupted(Along):
    """Moves along, and makes something happen in one of its steps."""

    def __init__(self, act):
        self.does = act
        self.steps = 0

    def act(self, slots, robots, observations):
        self.steps += 1
        if self.steps == 15:
            self.does()
        return super().act(slots, robots, observations)


def state_command(text):
    def act(served):
        served.publisher(HEARD["state_command"])(StringStamped(Header(), text))

    return act


def another_client(served):
    pose = served.robot.env.simulation.commands["psm2"].pose
    other = MemoryTransport(served.medium, "another").publisher(HEARD["servo_cp"])
    other(write_pose((pose[0] - 3e-3, *pose[1:]), 0, "PSM2_base"))


@pytest.mark.parametrize(
    ("act", "reason", "ends"),
    [
        (state_command("pause"), "PSM2 is PAUSED", False),
        (state_command("disable"), "PSM2 is DISABLED", True),
        (state_command("fault"), "PSM2 is FAULT", True),
        (another_client, "PSM2 is PAUSED", False),
    ],
    ids=["pause", "disable", "fault", "two clients"],
)
def test_a_driven_arm_that_is_stopped_is_still_and_told_nothing(monkeypatch, act, reason, ends):
    """In real time on both sides: still within 100 ms; the log says why and has all that was sent.

    After `resume` another episode is driven with nothing held back.
    """
    served = VirtualTime(monkeypatch, "grasp", 0.007)
    sent = MemoryTransport(served.medium).inbox(HEARD["servo_cp"])
    client = Client(served, ClientConfig(is_simulated=True))
    client.connect()
    robot = DrivenRobot(client, (), "grasp", 64)
    config = DriveConfig(GuardConfig(), sends=True, is_simulated=True)
    log = io.StringIO()
    told = []
    agent = Interrupted(lambda: act(served))
    driver = Driver(agent, robot, TaskConfig("grasp"), config, float, log, told.append)
    episode = driver.episode(SEED, 15 + STILL_STEPS)
    place = np.array(served.robot.env.simulation.tip("psm2")[:3])
    served.pass_time(0.2)
    assert np.linalg.norm(served.robot.env.simulation.tip("psm2")[:3] - place) < STILL_M
    lines = [json.loads(line) for line in log.getvalue().splitlines()]
    assert all(line["sent"] for line in lines[1:15]), told
    assert not lines[-1]["sent"] or ends
    assert any(reason in text for text in (*told, episode.ended))
    own = [entry.message for entry in sent() if entry.source != "another"]
    logged = [line["commands"]["PSM2"]["pose"][:3] for line in lines if line["sent"]]
    assert len(own) == len(logged)
    _, base = robot.frame("PSM2")
    assert np.allclose(
        [read_pose(message)[:3] for message in own],
        [poses.transform(base, tuple(place)) for place in logged],
        atol=1e-9,
    )
    if not ends:
        served.publisher(HEARD["state_command"])(StringStamped(Header(), "resume"))
        served.pass_time(0.7)
        again = driver.episode(SEED, 20)
        assert again.held == 0


def test_a_diverged_episode_says_so_and_the_next_one_is_driven():
    served = Served("grasp")
    client = Client(served, ClientConfig(is_simulated=True))
    client.connect()
    robot = DrivenRobot(client, (), "grasp", 64)
    config = DriveConfig(GuardConfig(), sends=True, is_simulated=True, is_stepped=True)

    def diverge():
        served.robot.env.data.ctrl[:] = math.nan

    def stop():
        diverge()
        client.step([], client.stamp())
        state_command("fault")(served)

    def driver(act):
        agent = Interrupted(act)
        return Driver(agent, robot, TaskConfig("grasp"), config, float, io.StringIO(), print)

    diverging = driver(diverge)
    assert diverging.episode(SEED, 20).ended == "the physics diverged"
    again = diverging.episode(SEED + 1, 20)
    assert (again.steps, again.held) == (20, 0)
    # A person's stop outlasts the reset.
    driver(stop).episode(SEED, 20)
    assert diverging.episode(SEED + 1, 20).ended == "PSM2 is FAULT: the robot was stopped"


def test_a_lag_is_what_is_later_than_usual_whatever_the_senders_clock():
    lag = _Lag()
    offset = 12345.0
    for number in range(100):
        now = 10.0 + 0.02 * number
        message = JointState(Header(int((now + offset - 0.003) * SECOND)), (), ())
        assert lag.of(message, now) == pytest.approx(0.0, abs=1e-5)
    message = JointState(Header(int((12.0 + offset - 0.303) * SECOND)), (), ())
    assert lag.of(message, 12.0) == pytest.approx(0.3, abs=1e-3)
    assert lag.of(JointState(Header(), (), ()), 12.0) == 0.0


@pytest.mark.parametrize("text", ["{", "[1]", "3", "", "[" * 100_000, "{}", '{"progress": "x"}'])
def test_what_is_no_judgement_is_none(text):
    transport = MemoryTransport()
    client = Client(transport, ClientConfig(is_simulated=True))
    transport.publisher(topics.JUDGEMENT)(StringStamped(Header(START), text))
    client.update()
    assert client.judgement() == ({"progress": "x"} if "progress" in text else {})
