"""Programs that run with a real ROS, in a Python that imports it, alongside the test."""

import contextlib
import os
import socket
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ROSPY_PATH = os.environ.get("SURGICAI_ROSPY_PATH", "/usr/lib/python3/dist-packages")
"""Folder of rospy's packages (Debian: python3-rospy, python3-rosmaster, python3-sensor-msgs)."""
RCLPY_PYTHON = os.environ.get("SURGICAI_RCLPY_PYTHON", sys.executable)
"""A Python that imports rclpy; it needs this Python's version to import us too."""
APPENDED = "import sys; sys.path += {paths!r}\n"
"""Code that lets a Python find packages after its own."""
MASTER = """
import os, time
from rosmaster.master import Master
master = Master(port=int(sys.argv[1]))
master.start()
print("up", flush=True)
while True:
    time.sleep(1.0)
"""
COMMAND = "from surgicai_vision.commands.main import main\nsys.exit(main())\n"
CRTK = ("OperatingState", "StringStamped")
"""Messages of crtk_msgs, which has no wheels; `scripts/crtk_msgs.py` builds them."""
STAND_IN = """
import types
from std_msgs.msg import String
package, module = types.ModuleType("crtk_msgs"), types.ModuleType("crtk_msgs.msg")
module.OperatingState = module.StringStamped = String  # never sent
sys.modules |= {"crtk_msgs": package, "crtk_msgs.msg": module}
"""
ECHO = """
import json, os, socket, time
from example_messages import EXAMPLES
from surgicai_vision.robot import topics
from surgicai_vision.robot.sockets import open_sockets
from surgicai_vision.robot.transport import open_transport

def elsewhere():
    found = []
    for descriptor in open_sockets():
        with socket.socket(fileno=os.dup(descriptor)) as one:
            if one.family not in (socket.AF_INET, socket.AF_INET6):
                continue
            device = one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16)
            if device.rstrip(b"\\0") != b"lo" and not one.getsockname()[0].startswith("127."):
                found.append(one.getsockname())
    return found

name, domain, left_out = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
with open_transport(name, domain=domain) as transport:
    same = {}
    for message in EXAMPLES:
        kind = type(message).__name__
        if kind in left_out:
            continue
        topic = topics.Topic(f"/test/{kind}", type(message), topics.EVENT)
        publish = transport.publisher(topic)
        inbox = transport.inbox(topic)
        found = []
        ends = time.monotonic() + 10.0
        while not found and time.monotonic() < ends:
            if transport.listeners(topic):
                publish(message)
            transport.wait(0.2)
            found = inbox()
        same[kind] = bool(found) and repr(found[0].message) == repr(message)
        sources = {received.source for received in found}
    print(json.dumps({"same": same, "sources": len(sources), "elsewhere": elsewhere()}))
"""


def missing_rospy():
    """Return why rospy cannot be used here, or ""."""
    probe = run_ros("rospy", "import rospy, rosmaster, sensor_msgs.msg")
    return (
        ""
        if probe.returncode == 0
        else (
            "no rospy here (Debian: python3-rospy, python3-rosmaster, python3-sensor-msgs); "
            "SURGICAI_ROSPY_PATH may name the folder of its packages"
        )
    )


def missing_rclpy(*packages):
    """Return why rclpy cannot be used here, or ""."""
    imports = ", ".join(("rclpy", "numpy", "sensor_msgs.msg", "surgicai_vision.robot", *packages))
    probe = run_ros("rclpy", f"import {imports}")
    return (
        ""
        if probe.returncode == 0
        else (
            f"no rclpy here that imports {' and '.join(('us', *packages))}; "
            "SURGICAI_RCLPY_PYTHON may name a Python of this version that has it (crtk_msgs: "
            "scripts/crtk_msgs.py, run by that Python)"
        )
    )


def ros_command(kind, code, *arguments):
    """Return the command that runs code with the ROS of that kind, and its environment."""
    python = RCLPY_PYTHON if kind == "rclpy" else sys.executable
    own = [str(ROOT), str(ROOT / "tests/helpers")]
    if kind == "rclpy":
        appended = [*own, *(path for path in sys.path if path.endswith("site-packages"))]
    else:
        appended = [*own, ROSPY_PATH]
    text = APPENDED.format(paths=appended) + code
    env = {**os.environ, "MUJOCO_GL": "egl", "ROS_IP": "127.0.0.1"}
    return [python, "-c", text, *map(str, arguments)], env


def run_ros(kind, code, *arguments, timeout=120):
    """Run code to completion."""
    command, env = ros_command(kind, code, *arguments)
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=timeout)


@contextlib.contextmanager
def running(kind, code, *arguments, until):
    """Run code alongside the test, after waiting for an output line with `until`."""
    command, env = ros_command(kind, code, *arguments)
    process = subprocess.Popen(
        command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        said = ""
        for line in process.stdout:
            said += line
            if until in line:
                break
        else:
            raise AssertionError(said)
        yield process
    finally:
        process.terminate()
        process.wait(20)
        process.stdout.close()


@contextlib.contextmanager
def master(monkeypatch):
    """Run a rosmaster on a free port of the loopback; ROS_MASTER_URI names it."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    monkeypatch.setenv("ROS_MASTER_URI", f"http://127.0.0.1:{port}")
    with running("rospy", MASTER, port, until="up"):
        yield
