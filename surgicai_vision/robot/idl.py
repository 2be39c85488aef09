"""IDL: the ROS messages as DDS types.

On the wire, ROS 2 calls the type `geometry_msgs/msg/PoseStamped` `geometry_msgs::msg::dds_::
PoseStamped_`, and the topic `/PSM1/servo_cp` `rt/PSM1/servo_cp` (design.ros2.org, "Topic and
Service name mapping to DDS"). The fields are those of the message definitions of ROS 2's
common_interfaces and of collaborative-robotics/crtk_msgs, in the same order.

The general serialiser would handle the bytes of an image one by one (6 ms per image). Here they are
copied as they are, in CDR's own form: a count of four bytes, then the bytes.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Protocol, Self, cast

from cyclonedds.idl import IdlStruct

from surgicai_vision.core.errors import InputError
from surgicai_vision.robot.codecs import Codecs, Dialect

if TYPE_CHECKING:
    from collections.abc import Sequence

    # What a field holds in Python; the IDL's types below say how it is written.
    float64 = float
    int32 = int
    uint8 = int
    uint32 = int
    Texts = Sequence[str]
    Floats = Sequence[float]
    Singles = Sequence[float]
    Integers = Sequence[int]
    Nine = Sequence[float]
    Twelve = Sequence[float]
    Bytes = bytes
else:
    from cyclonedds.idl.types import array, float32, float64, int32, sequence, uint8, uint32

    Texts = sequence[str]
    Floats = sequence[float64]
    Singles = sequence[float32]
    Integers = sequence[int32]
    Nine = array[float64, 9]
    Twelve = array[float64, 12]
    Bytes = sequence[uint8]

SECOND = 1_000_000_000


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """builtin_interfaces/Time."""

    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """std_msgs/Header."""

    stamp: Time
    frame_id: str


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    """std_msgs/String."""

    data: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    """geometry_msgs/Vector3."""

    x: float64
    y: float64
    z: float64


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    """geometry_msgs/Point."""

    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    """geometry_msgs/Quaternion."""

    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    """geometry_msgs/Pose."""

    position: Point
    orientation: Quaternion


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    """geometry_msgs/PoseStamped."""

    header: Header
    pose: Pose


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    """geometry_msgs/Twist."""

    linear: Vector3
    angular: Vector3


@dataclass
class TwistStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TwistStamped_"):
    """geometry_msgs/TwistStamped."""

    header: Header
    twist: Twist


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    """sensor_msgs/JointState."""

    header: Header
    name: Texts
    position: Floats
    velocity: Floats
    effort: Floats


@dataclass
class OperatingState(IdlStruct, typename="crtk_msgs::msg::dds_::OperatingState_"):
    """crtk_msgs/OperatingState."""

    header: Header
    state: str
    is_homed: bool
    is_busy: bool


@dataclass
class StringStamped(IdlStruct, typename="crtk_msgs::msg::dds_::StringStamped_"):
    """crtk_msgs/StringStamped."""

    header: Header
    string: str


@dataclass
class Joy(IdlStruct, typename="sensor_msgs::msg::dds_::Joy_"):
    """sensor_msgs/Joy."""

    header: Header
    axes: Singles
    buttons: Integers


@dataclass
class RegionOfInterest(IdlStruct, typename="sensor_msgs::msg::dds_::RegionOfInterest_"):
    """sensor_msgs/RegionOfInterest."""

    x_offset: uint32
    y_offset: uint32
    height: uint32
    width: uint32
    do_rectify: bool


@dataclass
class CameraInfo(IdlStruct, typename="sensor_msgs::msg::dds_::CameraInfo_"):
    """sensor_msgs/CameraInfo."""

    header: Header
    height: uint32
    width: uint32
    distortion_model: str
    d: Floats
    k: Nine
    r: Nine
    p: Twelve
    binning_x: uint32
    binning_y: uint32
    roi: RegionOfInterest


class _EndsInBytes(Protocol):
    """A type whose last field is a long sequence of bytes."""

    data: Bytes


def _write_bytes[S: _EndsInBytes](sample: S, version_2: bool | None) -> bytes:
    """Return the CDR of a sample's other fields, followed by its bytes as they are."""
    data = bytes(sample.data)
    sample.data = b""
    head = IdlStruct.serialize(cast(IdlStruct, sample), use_version_2=version_2)
    sample.data = data
    return head[:-4] + struct.pack("<I", len(data)) + data


def _read_bytes[S: _EndsInBytes](
    kind: type[S], fields: str, data: bytes, has_header: bool, version_2: bool | None
) -> S:
    """Return the sample of a CDR whose last field is a long sequence of bytes.

    Args:
        kind: the sample's type.
        fields: what lies between the header and the bytes: "u" of 4 bytes, "b" of 1, "s" a text.
        data: the CDR.
        has_header: as Cyclone DDS passes it.
        version_2: likewise.
    """
    found = _bytes_at(data, fields)
    empty = data[: found.start - 4] + bytes(4)
    idl = cast(type[IdlStruct], kind).__idl__
    versions = cast(bool, version_2)  # None is Cyclone DDS's own default, but not in its type
    sample = cast(S, idl.deserialize(empty, has_header=has_header, use_version_2=versions))
    sample.data = bytes(data[found])
    return sample


def _bytes_at(data: bytes, fields: str) -> slice:
    """Return where the last field's bytes lie in a little-endian CDR that begins with a header.

    Args:
        data: four bytes of encapsulation, then the CDR, from which alignment counts.
        fields: what lies between the header and the bytes.

    Raises:
        InputError: it is not one.
    """
    if data[:2] not in (b"\x00\x01", b"\x00\x07"):  # CDR or XCDR2, little-endian
        raise InputError("an image arrived in an encoding other than little-endian CDR.")
    offset = 4 + 8  # the stamp
    number = 0
    for field in f"s{fields}u":
        if field == "b":
            offset += 1
            continue
        offset += -offset % 4
        (number,) = struct.unpack_from("<I", data, offset)
        offset += 4 + (number if field == "s" else 0)
    end = offset + number
    if end > len(data):
        raise InputError("an image arrived with fewer bytes than it announces.")
    return slice(offset, end)


@dataclass
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    """sensor_msgs/Image."""

    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: Bytes

    def serialize(
        self, buffer: object = None, endianness: object = None, use_version_2: bool | None = None
    ) -> bytes:
        """Return the CDR."""
        return _write_bytes(self, use_version_2)

    @classmethod
    def deserialize(
        cls, data: bytes, has_header: bool = True, use_version_2: bool | None = None
    ) -> Self:
        """Return the sample of a CDR."""
        return _read_bytes(cls, "uusbu", data, has_header, use_version_2)


@dataclass
class CompressedImage(IdlStruct, typename="sensor_msgs::msg::dds_::CompressedImage_"):
    """sensor_msgs/CompressedImage."""

    header: Header
    format: str
    data: Bytes

    def serialize(
        self, buffer: object = None, endianness: object = None, use_version_2: bool | None = None
    ) -> bytes:
        """Return the CDR."""
        return _write_bytes(self, use_version_2)

    @classmethod
    def deserialize(
        cls, data: bytes, has_header: bool = True, use_version_2: bool | None = None
    ) -> Self:
        """Return the sample of a CDR."""
        return _read_bytes(cls, "s", data, has_header, use_version_2)


def _time(nanoseconds: int) -> Time:
    sec, nanosec = divmod(nanoseconds, SECOND)
    return Time(sec, nanosec)


TYPES: Mapping[str, type[IdlStruct]] = MappingProxyType(
    {
        kind.__idl_typename__.replace("::msg::dds_::", "/").rstrip("_"): kind
        for kind in (
            *(Header, String, Vector3, Point, Quaternion, Pose, PoseStamped, Twist, TwistStamped),
            *(JointState, OperatingState, StringStamped, Joy, RegionOfInterest, CameraInfo),
            *(Image, CompressedImage),
        )
    }
)
"""A type's name in ROS → the type."""
CODECS = Codecs(Dialect(TYPES, _time, lambda stamp: stamp.sec * SECOND + stamp.nanosec))
