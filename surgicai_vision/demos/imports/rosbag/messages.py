"""ROS messages: the few types that describe a demonstration, decoded without running their code.

`rosbags` would turn a bag's message definitions into Python code and run it. Here a definition is
data: a table of fields that a cursor follows. The tables below are the published ones
(common_interfaces, ambf_msgs). The bag's own definition is read only for AMBF's types, which
changed between its versions, and may name only the types in these tables.

    layout = layout_of("geometry_msgs/PoseStamped", ros1=True)
    decode(data, layout, ros1=True)["pose.position.x"]
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from surgicai_vision.core.errors import BadFile
from surgicai_vision.demos.imports.rosbag.config import printable

PRIMITIVES: Mapping[str, str] = MappingProxyType(
    {
        "bool": "B",
        "byte": "b",
        "char": "B",
        "int8": "b",
        "uint8": "B",
        "int16": "h",
        "uint16": "H",
        "int32": "i",
        "uint32": "I",
        "int64": "q",
        "uint64": "Q",
        "float32": "f",
        "float64": "d",
    }
)
"""ROS type → `struct` code."""
STRING = "string"

_INTEGERS = MappingProxyType(
    {
        f"std_msgs/{message}{bits}": f"{primitive}{bits}"
        for bits in (8, 16, 32, 64)
        for message, primitive in (("Int", "int"), ("UInt", "uint"))
    }
)
INTEGER_MESSAGES = tuple(_INTEGERS)
DEFINITIONS: Mapping[str, str] = MappingProxyType(
    {
        "std_msgs/Header": "uint32 sec\nuint32 nanosec\nstring frame_id",
        "std_msgs/String": "string data",
        "std_msgs/Float32": "float32 data",
        "std_msgs/Float64": "float64 data",
        **{message: f"{primitive} data" for message, primitive in _INTEGERS.items()},
        "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
        "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
        "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
        "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
        "geometry_msgs/Transform": (
            "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation"
        ),
        "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
        "geometry_msgs/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque",
        "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
        "geometry_msgs/TransformStamped": (
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
        ),
        "sensor_msgs/JointState": (
            "std_msgs/Header header\nstring[] name\n"
            "float64[] position\nfloat64[] velocity\nfloat64[] effort"
        ),
        "ambf_msgs/RigidBodyState": (
            "Header header\nuint32 sim_step\nstd_msgs/String identifier\nstd_msgs/String name\n"
            "float32 wall_time\nfloat32 sim_time\nfloat32 mass\ngeometry_msgs/Point pInertia\n"
            "geometry_msgs/Pose pose\ngeometry_msgs/Twist twist\ngeometry_msgs/Wrench wrench\n"
            "string[] children_names\nstring[] joint_names\nfloat32[] joint_positions\n"
            "float32[] joint_velocities\nfloat32[] joint_efforts"
        ),
        "ambf_msgs/ObjectState": (
            "Header header\nuint32 sim_step\nstd_msgs/String name\nfloat32 wall_time\n"
            "float32 sim_time\nfloat32 mass\ngeometry_msgs/Point pInertia\n"
            "geometry_msgs/Pose pose\ngeometry_msgs/Wrench wrench\nstring userdata_description\n"
            "string[] children_names\nstring[] joint_names\nfloat32[] userdata\n"
            "float32[] joint_positions"
        ),
    }
)
"""Message type → its fields, one "type name" per line; `_flatten` adds the counter that ROS 1
headers have before the stamp."""
AMBF = ("ambf_msgs/RigidBodyState", "ambf_msgs/ObjectState")
MAX_FIELDS = 200
"""Most fields of a definition; one with more is refused."""
MAX_TEXT = 20_000
"""Most characters of a definition; a longer one is refused."""


@dataclass(frozen=True)
class Field:
    """One field of a message: a number, a text, or a sequence of them.

    Attributes:
        name: its name, with dots for nested fields.
        kind: a key of `PRIMITIVES`, or "string".
        many: whether it is a sequence.
    """

    name: str
    kind: str
    many: bool


Layout = tuple[Field, ...]


def layout_of(kind: str, *, ros1: bool, text: str = "") -> Layout:
    """Return a type's fields in the order of its bytes.

    Args:
        kind: a key of `DEFINITIONS`.
        ros1: whether the messages were serialised by ROS 1.
        text: the definition in the bag; only read for AMBF's types.

    Raises:
        BadFile: an unknown type, or a definition of an AMBF type with fields of unknown types.
    """
    if kind not in DEFINITIONS:
        raise BadFile(
            f"messages of type {printable(kind)} are not supported; supported types: "
            f"{', '.join(sorted(DEFINITIONS))}."
        )
    own = text.split("\n====", 1)[0] if kind in AMBF else ""
    return tuple(_flatten(own if own.strip() else DEFINITIONS[kind], "", ros1))


def _flatten(text: str, prefix: str, ros1: bool) -> list[Field]:
    fields: list[Field] = []
    for kind, name in _lines(text):
        many = kind.endswith("[]")
        plain = kind.removesuffix("[]")
        plain = "std_msgs/Header" if plain == "Header" else plain.replace("/msg/", "/")
        if plain in PRIMITIVES or plain == STRING:
            fields.append(Field(prefix + name, plain, many))
        elif plain in DEFINITIONS and plain not in AMBF and not many:
            if plain == "std_msgs/Header" and ros1:
                fields.append(Field(f"{prefix}{name}.seq", "uint32", False))
            fields += _flatten(DEFINITIONS[plain], f"{prefix}{name}.", ros1)
        else:
            raise BadFile(
                f"a message definition has a field of type {printable(kind)}, which is not "
                "supported."
            )
    if len(fields) > MAX_FIELDS:
        raise BadFile(
            f"a message definition has {len(fields)} fields; definitions with more than "
            f"{MAX_FIELDS} are not read."
        )
    return fields


def _lines(text: str) -> list[tuple[str, str]]:
    """Return (type, name) of each field of a definition; comments and constants are left out."""
    if len(text) > MAX_TEXT:
        raise BadFile(
            f"a message definition has {len(text)} characters; definitions with more than "
            f"{MAX_TEXT} are not read."
        )
    pairs = []
    for line in text.splitlines():
        words = line.split("#", 1)[0].split()
        if not words or any("=" in word for word in words):
            continue
        if len(words) < 2 or not words[1].isidentifier():
            raise BadFile(
                f"a message definition has the line '{printable(line.strip())}', which is not of "
                "the form 'type name'."
            )
        pairs.append((words[0], words[1]))
    return pairs


Message = Mapping[str, Any]
"""Field → its value: a number, a text, or a tuple of them, according to the bag's definition."""


def decode(data: bytes | memoryview, layout: Layout, *, ros1: bool) -> Message:
    """Return a message's fields by name, with dots for nested ones.

    Args:
        data: the serialised message, for ROS 2 including CDR's four bytes of encapsulation.
        layout: its fields.
        ros1: whether it was serialised by ROS 1, which does not align.

    Raises:
        ValueError: bytes that do not fit the layout: too few, too many, a length beyond the end.
    """
    cursor = _Cursor(bytes(data), ros1)
    values = {field.name: cursor.take(field) for field in layout}
    cursor.finish()
    return values


class _Cursor:
    """Reads a message's fields one after another."""

    def __init__(self, data: bytes, ros1: bool):
        self._data = data
        self._aligned = not ros1
        self._order = "<"
        self._start = 0
        if not ros1:
            if len(data) < 4 or data[:2] not in (b"\0\0", b"\0\1"):
                raise ValueError("not plain CDR")
            self._order = "<" if data[1] else ">"
            self._start = 4
        self._offset = self._start

    def take(self, field: Field) -> Any:
        """Return the next field's value: a number, a text, or a tuple of them."""
        if not field.many:
            return (
                self._text()
                if field.kind == STRING
                else self._numbers(PRIMITIVES[field.kind], 1)[0]
            )
        count = self._count()
        if count > len(self._data) - self._offset:
            raise ValueError(f"a sequence of {count} elements in {len(self._data)} bytes")
        if field.kind == STRING:
            return tuple(self._text() for _ in range(count))
        return self._numbers(PRIMITIVES[field.kind], count) if count else ()

    def finish(self) -> None:
        """Raise ValueError for leftover bytes other than CDR's padding."""
        left = len(self._data) - self._offset
        if left > (3 if self._aligned else 0):
            raise ValueError(f"{left} bytes too many")

    def _numbers(self, code: str, count: int) -> tuple[Any, ...]:
        size = struct.calcsize(f"={code}")
        if self._aligned:
            self._offset += -(self._offset - self._start) % size
        end = self._offset + size * count
        if end > len(self._data):
            raise ValueError(f"{end - len(self._data)} bytes too few")
        values = struct.unpack_from(f"{self._order}{count}{code}", self._data, self._offset)
        self._offset = end
        return values

    def _count(self) -> int:
        return int(self._numbers("I", 1)[0])

    def _text(self) -> str:
        count = self._count()
        end = self._offset + count
        if end > len(self._data):
            raise ValueError(f"a text of {count} bytes in a message of {len(self._data)} bytes")
        text = self._data[self._offset : end].decode()
        self._offset = end
        return text.removesuffix("\0")
