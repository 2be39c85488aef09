"""CRTK over DDS: messages arrive between two processes, by default only over the loopback."""

import contextlib
import ctypes
import fcntl
import io
import json
import os
import socket
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from example_messages import EXAMPLES
from served import DOMAIN, serving

from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.evaluation.agents import RandomAgent
from surgicai_vision.robot import frames, topics
from surgicai_vision.robot import messages as m
from surgicai_vision.robot.client import Client, ClientConfig
from surgicai_vision.robot.driven import DrivenRobot
from surgicai_vision.robot.driver import DriveConfig, Driver
from surgicai_vision.robot.guards import GuardConfig
from surgicai_vision.robot.topics import Topic
from surgicai_vision.robot.transport import open_transport

pytest.importorskip("cyclonedds", reason="the extra `ros` is not installed")
from surgicai_vision.robot.codecs import ROS_NAMES
from surgicai_vision.robot.idl import TYPES
from surgicai_vision.robot.sockets import keep_to, open_sockets

SEED = 900_001
SIOCGIFADDR = 0x8915
"""Request for an interface's address (linux/sockios.h)."""
PIDFD_GETFD = 438
"""Number of the system call that copies another process's descriptor (linux/unistd.h)."""


@pytest.fixture(scope="module")
def transport():
    with open_transport("cyclonedds", domain=DOMAIN) as opened:
        yield opened


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_a_message_is_the_same_after_its_way(transport, message):
    topic = Topic(f"/test/{type(message).__name__}", type(message), topics.EVENT)
    inbox = transport.inbox(topic)
    transport.publisher(topic)(message)
    for _ in range(100):
        found = inbox()
        if found:
            break
        transport.wait(0.05)
    assert [received.message for received in found] == [message]


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_a_type_has_the_name_that_ros_gives_it(message):
    package = {
        "JointState": "sensor_msgs",
        "Joy": "sensor_msgs",
        "Image": "sensor_msgs",
        "CompressedImage": "sensor_msgs",
        "CameraInfo": "sensor_msgs",
        "String": "std_msgs",
        "OperatingState": "crtk_msgs",
        "StringStamped": "crtk_msgs",
    }.get(type(message).__name__, "geometry_msgs")
    wanted = f"{package}::msg::dds_::{type(message).__name__}_"
    assert TYPES[ROS_NAMES[type(message)]].__idl_typename__ == wanted


def test_every_socket_hears_the_loopback_alone(transport):
    """Bound to the device: the kernel drops what arrives by another interface."""
    checked = 0
    for descriptor in open_sockets():
        with socket.socket(fileno=os.dup(descriptor)) as one:
            if one.family != socket.AF_INET or one.type != socket.SOCK_DGRAM:
                continue
            device = one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16)
            assert device.rstrip(b"\0") == b"lo", one.getsockname()
            checked += 1
    assert checked >= 2


def test_sockets_that_cannot_be_kept_to_an_interface_are_refused():
    refused = pytest.raises(InputError, match="cannot be restricted to moon0")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one, refused:
        keep_to({one.fileno()}, "moon0")


def sockets_of(process):
    """Return (address, device it is bound to, whether it listens) of a process's IP sockets."""
    found = []
    handle = os.pidfd_open(process.pid)
    for entry in Path(f"/proc/{process.pid}/fd").iterdir():
        try:
            if not os.readlink(entry).startswith("socket:"):
                continue
        except FileNotFoundError:  # closed by now
            continue
        descriptor = ctypes.CDLL(None, use_errno=True).syscall(
            PIDFD_GETFD, handle, int(entry.name), 0
        )
        if descriptor < 0:
            pytest.skip(
                f"another process's sockets cannot be seen: {os.strerror(ctypes.get_errno())}"
            )
        with socket.socket(fileno=descriptor) as one:
            if one.family in (socket.AF_INET, socket.AF_INET6):
                device = one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16)
                listens = one.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
                found.append((one.getsockname()[0], device.rstrip(b"\0").decode(), bool(listens)))
    os.close(handle)
    return found


def interfaces():
    """Return the names of the loopback and of one other interface that has an address."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):
                fcntl.ioctl(one.fileno(), SIOCGIFADDR, struct.pack("256s", name.encode()))
                found.append(name)
    return sorted(found, key=lambda name: name != "lo")[:2]


@pytest.mark.parametrize("interface", interfaces())
def test_a_served_simulation_listens_on_the_named_interface_alone(interface):
    """Seen from outside, while it serves: the loopback, unless `--interface` names another."""
    given = () if interface == "lo" else ("--interface", interface)
    with serving("--task", "grasp", *given, domain=DOMAIN % 200 + 6) as process:
        found = sockets_of(process)
    assert len(found) >= 2
    for address, device, listens in found:
        assert device == interface or address.startswith("127."), found
        assert not listens, found


def test_what_cannot_be_opened_is_refused():
    with pytest.raises(InputError, match="no interface 'moon0'; available:"):
        open_transport("cyclonedds", "moon0")
    with pytest.raises(InputError, match="allowed: 0 to 232"):
        open_transport("cyclonedds", domain=233)
    with pytest.raises(InputError, match="Unknown transport"):
        open_transport("carrier_pigeon")


def test_a_served_simulation_is_driven_from_another_process(transport):
    """Stepped: the same motion as in this process, to rounding, and the images of its states."""
    own = envs.make(TaskConfig("grasp"))
    own.reset(seed=SEED)
    config = ClientConfig(arms=("PSM2",), views=("front",), is_simulated=True)
    options = ("--task", "grasp", "--clock", "stepped", "--view", "front", "--size", "64")
    with serving(*options):
        client = Client(transport, config)
        client.connect()
        client.reset(SEED)
        for _ in range(8):
            state = client.newest("/PSM2/measured_js").message
            measured = own.simulation.reported_joints("psm2")
            assert np.allclose(state.position, measured, atol=1e-9)
            image = client.newest("/front/image_raw").message
            frame = np.frombuffer(image.data, np.uint8).reshape(64, 64, 3)
            assert image.header.stamp == state.header.stamp
            assert np.abs(frame - own.image("front", (64, 64)).astype(int)).max() <= 1
            told = client.newest("/PSM2/local/setpoint_cp").message
            stamp = client.stamp()
            x, y, z = told.position
            header = m.Header(stamp, told.header.frame)
            lower = m.PoseStamped(header, (x, y, z + 0.0005), told.quaternion)
            client.send("/PSM2/servo_cp", lower)
            client.step(["/PSM2/servo_cp"], stamp)
            own.step(np.array([0, 0, 1, 0, 0, 0, 0], np.float32))
        goal = frames.read_pose(client.newest("/PSM2/local/setpoint_cp").message)
        assert np.allclose(goal, own.simulation.commands["psm2"].pose, atol=1e-9)
    own.close()


def test_a_policy_drives_the_served_simulation_as_in_process(tmp_path):
    """`serve` and `drive`, in one process each: the same poses at every step as in this process."""
    own = envs.make(TaskConfig("grasp", max_steps=25))
    own.reset(seed=SEED)
    agent = RandomAgent()
    agent.reset(0, own, SEED)
    poses = []
    for _ in range(25):
        poses.append(own.both_arms())
        own.step(agent.act([0], [own], [own.observe()])[0])
    own.close()
    domain = DOMAIN % 200 + 2
    drive = [
        *(sys.executable, "-m", "surgicai_vision", "robot", "drive", "random", "--task", "grasp"),
        *("--simulated", "--clock", "stepped", "--send", "--seed", str(SEED), "--seconds", "0.5"),
        *("--domain", str(domain), "--out", str(tmp_path / "log"), "--json"),
    ]
    with serving("--task", "grasp", "--clock", "stepped", domain=domain):
        driven = subprocess.run(drive, capture_output=True, text=True, timeout=300)
    assert driven.returncode == 0, driven.stderr
    said = json.loads(driven.stdout.splitlines()[-1])
    assert said["sent"]
    assert [row["steps"] for row in said["episodes"]] == [25]
    lines = [json.loads(row) for row in (tmp_path / "log" / "drive.jsonl").open()]
    assert lines[0]["policy"] == "random"
    assert np.allclose([line["both_arms"] for line in lines[1:]], poses, atol=1e-6)


def test_a_robot_that_falls_silent_is_told_nothing_more(transport):
    """In real time: when the publisher is killed, the guards hold everything back and say why."""
    log = io.StringIO()
    with serving("--task", "grasp") as process:
        client = Client(transport, ClientConfig(is_simulated=True))
        client.connect()
        config = DriveConfig(GuardConfig(), sends=True, is_simulated=True)
        killed = []

        def dead_man():
            if log.getvalue().count('"sent": true') > 10 and not killed:
                process.kill()
                process.wait()
                killed.append(len(log.getvalue().splitlines()))
            return 0.0

        robot = DrivenRobot(client, (), "grasp", 224)
        task = TaskConfig("grasp")
        driver = Driver(RandomAgent(), robot, task, config, dead_man, log, lambda text: None)
        driver.episode(SEED, 400)
    lines = [json.loads(line) for line in log.getvalue().splitlines()]
    assert killed
    late = int(2 * config.guards.max_age * 50) + killed[0]
    assert not any(line["sent"] for line in lines[late:])
    assert "s old" in lines[-1]["held"]


RCLPY = """
import json, sys, time
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("probe")
heard = {"poses": 0, "joints": 0}
last = {}
def on_pose(message):
    heard["poses"] += 1
    last["pose"] = message
def on_jaw(message):
    last["jaw"] = message.position[0]
def on_joints(message):
    heard["joints"] += 1
    last["joints"] = message
node.create_subscription(PoseStamped, "/PSM1/measured_cp", on_pose, 10)
node.create_subscription(JointState, "/PSM1/measured_js", on_joints, 10)
node.create_subscription(JointState, "/PSM1/jaw/measured_js", on_jaw, 10)
late = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(String, "/PSM1/tool_type", lambda m: last.update(tool=m.data), late)
jaw = node.create_publisher(JointState, "/PSM1/jaw/servo_jp", 1)
ends = time.time() + 30
while time.time() < ends:
    rclpy.spin_once(node, timeout_sec=0.05)
    jaw.publish(JointState(position=[0.5]))
    if heard["poses"] > 50 and "tool" in last and abs(last["jaw"] - 0.5) < 0.05:
        break
print(json.dumps({**heard, "frame": last["pose"].header.frame_id, "tool": last.get("tool"),
    "names": list(last["joints"].name), "jaw": last["jaw"]}))
"""


def test_a_real_rclpy_hears_and_moves_the_served_simulation():
    """With ROS 2 itself, where `SURGICAI_RCLPY_PYTHON` names a Python that imports it."""
    python = os.environ.get("SURGICAI_RCLPY_PYTHON", sys.executable)
    imports = "import rclpy, geometry_msgs.msg, sensor_msgs.msg"
    if subprocess.run([python, "-c", imports], capture_output=True).returncode:
        pytest.skip("no rclpy here; SURGICAI_RCLPY_PYTHON may name a Python that has it")
    domain = DOMAIN % 200 + 1
    ros = {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    with serving("--task", "grasp", domain=domain):
        probe = subprocess.run(
            [python, "-c", RCLPY], env=ros, capture_output=True, text=True, timeout=90
        )
    assert probe.returncode == 0, probe.stderr
    said = json.loads(probe.stdout.splitlines()[-1])
    assert said["frame"] == "ECM_view"
    assert said["names"][:3] == ["yaw", "pitch", "insertion"]
    assert said["tool"] == "400006"
    assert said["jaw"] == pytest.approx(0.5, abs=0.05)
    assert said["poses"] > 50
