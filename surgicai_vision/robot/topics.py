"""Topics: the name of each, the type of its messages, and how they are kept.

They follow docs/ros_crtk_contract.md of dvrk_simulator_base (names, types and the QoS of states),
its ros_interface.py (queue depths) and ros_qos.py. Cameras are not in the contract: theirs are
ROS's own (`<view>/image_raw`, `…/compressed`, `<view>/camera_info`). Only the simulation has the
topics under `/simulation` and the needle's pose; no robot has them.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from types import MappingProxyType

from surgicai_vision.core.errors import InputError, shown
from surgicai_vision.robot import messages as m

STATE = "state"
"""Reliable, the last ten; for what is published continually."""
EVENT = "event"
"""Reliable, the last ten, also for late subscribers."""
LATCHED = "latched"
"""Reliable, the last one, also for late subscribers."""
SERVO = "servo"
"""Reliable, the last one: a set point supersedes the one before."""
IMAGE = "image"
"""Reliable, the last two: images are large."""
DEPTHS = MappingProxyType({STATE: 10, EVENT: 10, LATCHED: 1, SERVO: 1, IMAGE: 2})
"""Quality → how many messages are kept."""
STAYING = (EVENT, LATCHED)
"""Qualities whose messages are also for late subscribers."""


NAME = re.compile(r"(/[A-Za-z0-9_]+)+", re.ASCII)
"""A topic's full name, in ROS 1 and 2 (design.ros2.org, "Topic and Service name mapping")."""


def check_topic(name: str, what: str) -> None:
    """Refuse what is not the full name of a topic.

    Args:
        name: the name as given.
        what: what it names, the beginning of the message.

    Raises:
        InputError: it does not begin with /, or holds what ROS does not allow.
    """
    if not NAME.fullmatch(name):
        raise InputError(
            f"{what} is {shown(name)}; a topic begins with '/': /NAME or /NAME/NAME…, of letters, "
            "digits and _."
        )


@dataclass(frozen=True)
class Topic:
    """One topic.

    Attributes:
        name: the full name, such as "/PSM1/measured_js".
        type: class of its messages.
        quality: how messages are kept: `STATE`, `EVENT`, `LATCHED`, `SERVO` or `IMAGE`.
    """

    name: str
    type: type[m.Message]
    quality: str = STATE


_STATES = MappingProxyType(
    {
        "measured_js": (m.JointState, STATE),
        "setpoint_js": (m.JointState, STATE),
        "measured_cp": (m.PoseStamped, STATE),
        "setpoint_cp": (m.PoseStamped, STATE),
        "measured_cv": (m.TwistStamped, STATE),
        "operating_state": (m.OperatingState, EVENT),
        "state": (m.StringStamped, EVENT),
        "info": (m.StringStamped, STATE),
        "warning": (m.StringStamped, STATE),
        "error": (m.StringStamped, STATE),
    }
)
"""What every arm publishes."""
_COMMANDS = MappingProxyType(
    {
        "servo_jp": (m.JointState, SERVO),
        "move_jp": (m.JointState, STATE),
        "servo_cp": (m.PoseStamped, SERVO),
        "move_cp": (m.PoseStamped, STATE),
        "state_command": (m.StringStamped, STATE),
    }
)
"""What every arm subscribes to."""
_PSM_STATES = MappingProxyType(
    {
        "jaw/measured_js": (m.JointState, STATE),
        "jaw/setpoint_js": (m.JointState, STATE),
        "tool_type": (m.String, LATCHED),
        "local/measured_cp": (m.PoseStamped, STATE),
        "local/setpoint_cp": (m.PoseStamped, STATE),
    }
)
"""What a PSM publishes in addition."""
_PSM_COMMANDS = MappingProxyType(
    {"jaw/servo_jp": (m.JointState, SERVO), "jaw/move_jp": (m.JointState, STATE)}
)
"""What a PSM subscribes to in addition."""

NEEDLE = Topic("/needle/measured_cp", m.PoseStamped)
"""Ground truth: the needle's pose in world. The name is the one that `import-demos` looks for."""
LABEL = Topic("/subtask", m.String)
"""Ground truth: the active subtask as the simulation judges it (`import-demos`' label)."""
RESET = Topic("/simulation/reset", m.StringStamped)
"""Requests a new episode; the text is its seed."""
ENTER = Topic("/simulation/enter", m.StringStamped)
"""Tells the simulation's judge which subtask is active; the text is its name, or "" to change
nothing: then everything is published once more."""
STEP = Topic("/simulation/step", m.StringStamped)
"""Requests one control step, if the client sets the clock.

The text names the topics, separated by blanks, whose message with the same stamp must come first.
"""
STEPPED = Topic("/simulation/stepped", m.StringStamped, EVENT)
"""Answers `RESET`, `ENTER` and `STEP`: the text is the stamp of the request, its own stamp is that
of the states published with it."""
JUDGEMENT = Topic("/simulation/judgement", m.StringStamped)
"""Ground truth: the judged episode as JSON: task, seed, steps, subtask, who advances it, progress,
success, errors."""


def psm_topics(name: str, *, heard: bool) -> dict[str, Topic]:
    """Return channel → topic of a PSM, for what it subscribes to or for what it publishes."""
    tables = (_COMMANDS, _PSM_COMMANDS) if heard else (_STATES, _PSM_STATES)
    return {
        channel: Topic(f"/{name}/{channel}", *entry)
        for table in tables
        for channel, entry in table.items()
    }


def ecm_topics(name: str, *, heard: bool) -> dict[str, Topic]:
    """Return channel → topic of the endoscope's arm."""
    table = _COMMANDS if heard else _STATES
    return {channel: Topic(f"/{name}/{channel}", *entry) for channel, entry in table.items()}


def image_topic(view: str) -> Topic:
    """Return the topic of a view's images."""
    return Topic(f"/{view}/image_raw", m.Image, IMAGE)


def compressed_topic(view: str) -> Topic:
    """Return the topic of a view's compressed images."""
    return Topic(f"/{view}/image_raw/compressed", m.CompressedImage, IMAGE)


def info_topic(view: str) -> Topic:
    """Return the topic of a view's camera info."""
    return Topic(f"/{view}/camera_info", m.CameraInfo, STATE)


def known_topics(views: Iterable[str]) -> tuple[str, ...]:
    """Return the names of all topics that a robot with these views and the simulation may have."""
    arms = [
        topic.name
        for heard in (True, False)
        for of, name in ((psm_topics, "PSM1"), (psm_topics, "PSM2"), (ecm_topics, "ECM"))
        for topic in of(name, heard=heard).values()
    ]
    cameras = [
        of(view).name for view in views for of in (image_topic, compressed_topic, info_topic)
    ]
    own = (NEEDLE, LABEL, RESET, ENTER, STEP, STEPPED, JUDGEMENT)
    return (*arms, *cameras, *(topic.name for topic in own))
