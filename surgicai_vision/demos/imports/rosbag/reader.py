"""Reader: bags of ROS 1 and ROS 2 as arrays, before any plausibility check.

    arrays = read(Path("trial.bag"), {"psm2_pose": "/PSM2/measured_cp"})

The library `rosbags` opens the containers: `.bag`, a ROS 2 folder (`metadata.yaml` with sqlite3 or
mcap storage), a single `.db3` or `.mcap`. Messages are decoded by `messages`, never by code
generated from the bag's own definitions. The reader runs in the child process of `sandbox`.

The result holds `topics`, all topics of the bag. For each role whose topic is there, it also holds
the topic's N messages in the order of the bag: the time of reception `<role>.time` and the header's
stamp `<role>.stamp` (0 where there is none), both (N,) int64 [ns]; `<role>.value`; `<role>.type`
and `<role>.frame`, one text each. Values: poses (N, 7), x y z in the recording's unit and a unit
quaternion w x y z; joints (N, 6); jaw (N,); label (N,) texts.
"""

import bz2
import itertools
import re
import sqlite3
from array import array
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from types import MappingProxyType

import lz4.frame
import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import reader as ros1_reader
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import reader as ros2_reader
from rosbags.rosbag2 import storage_mcap

from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.demos.imports.rosbag.config import (
    ENDINGS,
    METADATA,
    is_bag,
    printable,
    topic_list,
)
from surgicai_vision.demos.imports.rosbag.messages import (
    AMBF,
    INTEGER_MESSAGES,
    Layout,
    Message,
    decode,
    layout_of,
)

POSES = (
    "geometry_msgs/PoseStamped",
    "geometry_msgs/TransformStamped",
    "geometry_msgs/Pose",
    "geometry_msgs/Transform",
)
KINDS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "pose": POSES,
        "joints": ("sensor_msgs/JointState", *AMBF),
        "jaw": ("sensor_msgs/JointState", "std_msgs/Float64", "std_msgs/Float32", *AMBF),
        "needle": (*POSES, *AMBF),
        "label": ("std_msgs/String", *INTEGER_MESSAGES),
    }
)
"""Last word of a role → the message types it can be read from."""
ROLES = (
    "psm1_pose",
    "psm1_jaw",
    "psm1_joints",
    "psm2_pose",
    "psm2_jaw",
    "psm2_joints",
    "needle",
    "label",
)

MAX_MESSAGES = 5_000_000
"""Most messages of all roles together."""
MAX_MESSAGE = 2**20
"""Largest size of a message [byte]."""
MAX_CHUNK = 2**26
"""Largest size of an unpacked chunk [byte]; ROS packs 768 KB, and more where there are images."""
MAX_METADATA = 2**18
"""Largest size of the text that describes a ROS 2 folder [byte]."""
MAX_DEPTH = 20
"""Deepest nesting of brackets in that text."""
MAX_LISTED = 1000
"""Most topics of a bag that an error message may name."""
UNIT_TOLERANCE = 0.01
"""Largest deviation of a quaternion's length from 1."""
_POSE_FIELDS = (
    ("pose.position", "pose.orientation"),
    ("position", "orientation"),
    ("transform.translation", "transform.rotation"),
    ("translation", "rotation"),
)


def read(
    path: Path, topics: Mapping[str, str], needed: Collection[str] = ()
) -> dict[str, NDArray[np.generic]]:
    """Read the messages of some topics.

    Args:
        path: the bag.
        topics: role, one of `ROLES` → topic.
        needed: roles whose topic must be there; the others may be missing.

    Raises:
        InputError: a needed topic is not there, or its type does not fit its role; the message
            names what there is.
        BadFile: a bag that is missing, damaged, malicious, or has numbers that are not finite.
    """
    try:
        _inspect(path)
        with Reader1(path) if path.suffix == ".bag" else Reader2(path) as reader:
            return _read(reader, path, topics, needed)
    except InputError as error:
        raise error if str(path) in str(error) else type(error)(f"{path}: {error}") from None
    except Exception as error:  # a damaged bag can fail in any way
        line = printable((str(error).splitlines() or ["it asks for too much"])[0], 160)
        raise BadFile(f"{path} is not a readable bag ({type(error).__name__}: {line}).") from None


def _read(
    reader: Reader1 | Reader2, path: Path, topics: Mapping[str, str], needed: Collection[str]
) -> dict[str, NDArray[np.generic]]:
    ros1 = isinstance(reader, Reader1)
    there = {connection.topic: _plain(connection.msgtype) for connection in reader.connections}
    known = [
        f"{printable(topic)} ({printable(kind)})"
        for topic, kind in sorted(there.items())[:MAX_LISTED]
    ]
    missing = [role for role in needed if topics[role] not in there]
    if missing:
        wanted_topic = topics[missing[0]]
        raise InputError(
            f"{path} has no topic {wanted_topic} ({missing[0]}); "
            f"it has {topic_list(known, wanted_topic)}."
        )
    # Check the types of the topics that are there before any message is read.
    wanted = [
        connection for connection in reader.connections if connection.topic in topics.values()
    ]
    layouts = {}
    for connection in wanted:
        _check_kind(connection, topics)
        layouts[connection.topic] = layout_of(
            _plain(connection.msgtype), ros1=ros1, text=connection.msgdef.data
        )
    columns = {role: _Column(role, topic, path) for role, topic in topics.items() if topic in there}
    if wanted:
        _fill(reader, wanted, layouts, columns, ros1)
    arrays = {"topics": np.array(known, dtype=str)}
    for role, column in columns.items():
        if len(column.times):
            arrays |= column.arrays(there[topics[role]])
        elif role in needed:
            raise InputError(f"{path} has no message on {topics[role]} ({role}).")
    return arrays


def _fill(
    reader: Reader1 | Reader2,
    wanted: list[Connection],
    layouts: Mapping[str, Layout],
    columns: Mapping[str, "_Column"],
    ros1: bool,
) -> None:
    """Read the messages of the wanted connections into the columns of their roles."""
    columns_of: dict[str, list[_Column]] = {}
    for column in columns.values():
        columns_of.setdefault(column.topic, []).append(column)
    for number, (connection, time, data) in enumerate(reader.messages(wanted)):
        if number >= MAX_MESSAGES or len(data) > MAX_MESSAGE:
            raise BadFile(
                f"it has over {MAX_MESSAGES} messages, or one over {MAX_MESSAGE >> 20} MB."
            )
        try:
            message = decode(data, layouts[connection.topic], ros1=ros1)
        except ValueError as error:
            kind = printable(_plain(connection.msgtype))
            raise BadFile(
                f"a message on {connection.topic} is not of type {kind} ({error})."
            ) from None
        for column in columns_of[connection.topic]:
            column.add(time, message)


def _check_kind(connection: Connection, topics: Mapping[str, str]) -> None:
    """Refuse a topic whose messages do not hold what its role needs."""
    kind = _plain(connection.msgtype)
    for role, topic in topics.items():
        allowed = KINDS[role.rsplit("_", 1)[-1]]
        if topic == connection.topic and kind not in allowed:
            raise InputError(
                f"{topic} ({role}) holds {printable(kind)}; types allowed for {role}: "
                f"{', '.join(allowed)}."
            )


class _Column:
    """The messages of one role's topic, stored as numbers: there are hundreds of thousands.

    Args:
        role: one of `ROLES`.
        topic: its topic.
        path: the bag, for error messages.
    """

    def __init__(self, role: str, topic: str, path: Path):
        self.topic = topic
        self.times = array("q")
        self._name = role
        self._where = f"{path}: {topic} ({role})"
        self._read = _VALUES[role.rsplit("_", 1)[-1]]
        self._stamps = array("q")
        self._numbers = array("d")
        self._width = 0
        self._texts: list[str] = []
        self._frames: set[str] = set()

    def add(self, time: int, message: Message) -> None:
        """Add a message that was received at `time` [ns]."""
        try:
            value = self._read(message)
        except (IndexError, KeyError):
            raise InputError(
                f"{self._where} has messages without the values that {self._name} needs."
            ) from None
        self.times.append(time)
        self._stamps.append(message.get("header.sec", 0) * 10**9 + message.get("header.nanosec", 0))
        self._frames.add(str(message.get("header.frame_id", "")))
        if len(self._frames) > 1:
            frames = printable(", ".join(sorted(self._frames)), 160)
            raise InputError(f"{self._where} changes its frame: {frames}.")
        if isinstance(value, str):
            self._texts.append(value)
        else:
            self._numbers.extend(value)
            self._width = len(value)

    def arrays(self, kind: str) -> dict[str, NDArray[np.generic]]:
        """Return the role's arrays.

        Raises:
            BadFile: numbers that are not finite, quaternions that are not unit.
        """
        value = (
            np.array(self._texts)
            if self._texts
            else np.array(self._numbers).reshape(-1, self._width)
        )
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise BadFile(f"{self._where} holds numbers that are not finite.")
        if self._width == 7:
            lengths = np.linalg.norm(value[:, 3:], axis=1)
            if np.abs(lengths - 1.0).max() > UNIT_TOLERANCE:
                raise BadFile(f"{self._where} holds rotations that are not unit quaternions.")
            value[:, 3:] /= lengths[:, None]
        return {
            f"{self._name}.time": np.array(self.times),
            f"{self._name}.stamp": np.array(self._stamps),
            f"{self._name}.value": value[:, 0] if self._width == 1 else value,
            f"{self._name}.type": np.array(kind),
            f"{self._name}.frame": np.array(next(iter(self._frames))),
        }


def _pose(message: Message) -> list[float]:
    for place, turn in _POSE_FIELDS:
        if f"{place}.x" in message:
            return [message[f"{place}.{axis}"] for axis in "xyz"] + [
                message[f"{turn}.{axis}"] for axis in "wxyz"
            ]
    raise KeyError("pose")


def _joints(message: Message) -> list[float]:
    values = message["position"] if "position" in message else message["joint_positions"]
    if len(values) < 6:
        raise IndexError("six joints")
    return [float(value) for value in values[:6]]


def _jaw(message: Message) -> list[float]:
    if "data" in message:
        return [float(message["data"])]
    # AMBF's state of a PSM has its two fingers after the six joints.
    return [
        float(message["position"][0] if "position" in message else message["joint_positions"][6])
    ]


_VALUES: Mapping[str, Callable[[Message], list[float] | str]] = MappingProxyType(
    {
        "pose": _pose,
        "needle": _pose,
        "joints": _joints,
        "jaw": _jaw,
        "label": lambda message: str(message["data"])[:64],
    }
)


def _plain(kind: str) -> str:
    """Return a message type as ROS 1 spells it."""
    return kind.replace("/msg/", "/")


# -- before rosbags opens it -----------------------------------------------------------------------


def _inspect(path: Path) -> None:
    """Refuse a path that is not a bag, and content that `rosbags` would trust too much."""
    if not path.exists():
        raise BadFile(f"Cannot read {path}: no such file.")
    if not is_bag(path):
        raise BadFile(
            f"{path} is not a bag; a bag is a file ending in {', '.join(ENDINGS)} or a folder "
            f"with {METADATA}."
        )
    if path.is_dir():
        _inspect_metadata(path / METADATA)
        databases = sorted(path.glob("*.db3"))
    else:
        databases = [path] if path.suffix == ".db3" else []
    for database in databases:
        _inspect_database(database)


def _inspect_metadata(path: Path) -> None:
    """Check a folder's description before `rosbags` parses it: YAML is slow on deep brackets."""
    size = path.stat().st_size
    if size > MAX_METADATA:
        raise BadFile(f"{path} has {size} bytes; files above {MAX_METADATA} bytes are not read.")
    text = path.read_text(encoding="utf-8", errors="replace")
    opened = itertools.accumulate(1 if mark in "[{" else -1 for mark in re.findall(r"[][{}]", text))
    if "rosbag2_bagfile_information:" not in text or max(opened, default=0) > MAX_DEPTH:
        raise BadFile(f"{path} is not the description of a ROS 2 bag.")
    if re.search(r"compression_mode\W+file\b", text, re.IGNORECASE):
        raise BadFile(
            f"{path.parent} is compressed file by file; decompress it first (zstd -d, then `ros2 "
            "bag reindex`)."
        )


def _inspect_database(path: Path) -> None:
    """Refuse a database with anything but tables and indices: views and triggers are programs."""
    connection = sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)
    try:
        rows = connection.execute("SELECT type, name, sql FROM sqlite_master").fetchmany(1000)
    finally:
        connection.close()
    for kind, name, sql in rows:
        if (
            kind not in ("table", "index")
            or "VIRTUAL" in str(sql).upper()
            or "GENERATED" in str(sql).upper()
        ):
            raise BadFile(
                f"{path} has a {printable(kind)} '{printable(name, 40)}', "
                "which no ROS 2 bag has; it is not read."
            )


def _bounded(whole: bytes) -> bytes:
    """Return an unpacked chunk, or refuse it if it is too large."""
    if len(whole) > MAX_CHUNK:
        raise BadFile(f"a chunk unpacks to more than {MAX_CHUNK >> 20} MB; it is not read.")
    return whole


def _bz2(data: bytes) -> bytes:
    return _bounded(bz2.BZ2Decompressor().decompress(data, MAX_CHUNK + 1))


def _lz4(data: bytes) -> bytes:
    return _bounded(lz4.frame.LZ4FrameDecompressor().decompress(data, MAX_CHUNK + 1))


def _zstd(data: bytes) -> bytes:
    return _bounded(storage_mcap.zstd.ZstdDecompressor().decompress(data, MAX_CHUNK + 1))


class _Zstd:
    """The part of zstd that `rosbags` uses for single messages."""

    decompress = staticmethod(_zstd)


# `rosbags` unpacks a chunk however large it becomes; here it stops at `MAX_CHUNK`.
ros1_reader.decompressors.update({"bz2": _bz2, "lz4": _lz4})
storage_mcap.DECOMPRESSORS.update(
    {"lz4": lambda data, _: _lz4(data), "zstd": lambda data, _: _zstd(data)}
)
setattr(ros2_reader, "zstd", _Zstd)  # noqa: B010  # typed as a module
