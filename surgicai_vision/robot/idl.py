"""IDL: the ROS messages as DDS types, and the way there and back.

ROS 2 names a type `geometry_msgs/msg/PoseStamped` on the wire `geometry_msgs::msg::dds_::
PoseStamped_` and a topic `/PSM1/servo_cp` `rt/PSM1/servo_cp` (design.ros2.org, "Topic and Service
name mapping to DDS"). The fields are those of the message definitions of ROS 2's common_interfaces
and of collaborative-robotics/crtk_msgs, in their order.

Bytes of images would be taken apart one by one by the general serialiser (6 ms an image); here they
are copied as they are, in CDR's own form: a count of four bytes, then the bytes.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Protocol, Self, cast

from cyclonedds.idl import IdlStruct

from surgicai_vision.core.errors import InputError
from surgicai_vision.robot import messages as m

if TYPE_CHECKING:
    from collections.abc import Sequence

    # What a field holds; the types of the IDL say how it is written.
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
    """A type whose last field is many bytes."""

    data: Bytes


def _write_bytes[S: _EndsInBytes](sample: S, version_2: bool | None) -> bytes:
    """Return the CDR of a sample's other fields, then its bytes as they are."""
    data = bytes(sample.data)
    sample.data = b""
    head = IdlStruct.serialize(cast(IdlStruct, sample), use_version_2=version_2)
    sample.data = data
    return head[:-4] + struct.pack("<I", len(data)) + data


def _read_bytes[S: _EndsInBytes](
    kind: type[S], fields: str, data: bytes, has_header: bool, version_2: bool | None
) -> S:
    """Return the sample of a CDR whose last field is many bytes.

    Args:
        kind: its type.
        fields: what lies between the header and the bytes: "u" of 4 bytes, "b" of 1, "s" a text.
        data: the CDR.
        has_header: as Cyclone DDS asks.
        version_2: likewise.
    """
    found = _bytes_at(data, fields)
    empty = data[: found.start - 4] + bytes(4)
    idl = cast(type[IdlStruct], kind).__idl__
    versions = cast(bool, version_2)  # None is Cyclone DDS's own default, and not in its type
    sample = cast(S, idl.deserialize(empty, has_header=has_header, use_version_2=versions))
    sample.data = bytes(data[found])
    return sample


def _bytes_at(data: bytes, fields: str) -> slice:
    """Return where the last field's bytes lie in a little-endian CDR that begins with a header.

    Args:
        data: four bytes of encapsulation, then the CDR, whose alignments count from there.
        fields: what lies between the header and the bytes.

    Raises:
        InputError: it is none.
    """
    if data[:2] not in (b"\x00\x01", b"\x00\x07"):  # CDR or XCDR2, little-endian
        raise InputError("an image came in an encoding other than little-endian CDR.")
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
        raise InputError("an image came with fewer bytes than it announces.")
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


def _to_header(header: m.Header) -> Header:
    sec, nanosec = divmod(header.stamp, SECOND)
    return Header(Time(sec, nanosec), header.frame)


def _from_header(header: Header) -> m.Header:
    return m.Header(header.stamp.sec * SECOND + header.stamp.nanosec, header.frame_id)


def _to_joints(state: m.JointState) -> JointState:
    return JointState(
        _to_header(state.header),
        list(state.names),
        list(state.position),
        list(state.velocity),
        list(state.effort),
    )


def _from_joints(sample: JointState) -> m.JointState:
    return m.JointState(
        _from_header(sample.header),
        tuple(sample.name),
        tuple(sample.position),
        tuple(sample.velocity),
        tuple(sample.effort),
    )


def _to_pose(message: m.PoseStamped) -> PoseStamped:
    pose = Pose(Point(*message.position), Quaternion(*message.quaternion))
    return PoseStamped(_to_header(message.header), pose)


def _from_pose(sample: PoseStamped) -> m.PoseStamped:
    place = sample.pose.position
    turn = sample.pose.orientation
    return m.PoseStamped(
        _from_header(sample.header), (place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w)
    )


def _to_twist(message: m.TwistStamped) -> TwistStamped:
    twist = Twist(Vector3(*message.linear), Vector3(*message.angular))
    return TwistStamped(_to_header(message.header), twist)


def _from_twist(sample: TwistStamped) -> m.TwistStamped:
    linear = sample.twist.linear
    angular = sample.twist.angular
    return m.TwistStamped(
        _from_header(sample.header),
        (linear.x, linear.y, linear.z),
        (angular.x, angular.y, angular.z),
    )


def _to_state(message: m.OperatingState) -> OperatingState:
    header = _to_header(message.header)
    return OperatingState(header, message.state, message.is_homed, message.is_busy)


def _from_state(sample: OperatingState) -> m.OperatingState:
    header = _from_header(sample.header)
    return m.OperatingState(header, sample.state, bool(sample.is_homed), bool(sample.is_busy))


def _to_image(image: m.Image) -> Image:
    header = _to_header(image.header)
    return Image(header, image.height, image.width, "rgb8", 0, 3 * image.width, image.data)


def _from_image(sample: Image) -> m.Image:
    """Return an image of red, green, blue.

    Raises:
        InputError: another encoding, or another size than announced.
    """
    height = sample.height
    width = sample.width
    if sample.encoding not in ("rgb8", "bgr8"):
        raise InputError(f"an image of encoding {sample.encoding[:20]}; allowed: rgb8, bgr8.")
    if sample.step != 3 * width or len(sample.data) != 3 * width * height:
        raise InputError(f"an image of {height} × {width} with {len(sample.data)} bytes.")
    data = bytes(sample.data)
    if sample.encoding == "bgr8":
        turned = bytearray(data)
        turned[0::3] = data[2::3]
        turned[2::3] = data[0::3]
        data = bytes(turned)
    return m.Image(_from_header(sample.header), height, width, data)


def _to_info(info: m.CameraInfo) -> CameraInfo:
    a, b, c, d, e, f, g, h, i = info.intrinsics
    return CameraInfo(
        _to_header(info.header),
        info.height,
        info.width,
        "plumb_bob",
        [0.0] * 5,
        [*info.intrinsics],
        [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        [a, b, c, 0.0, d, e, f, 0.0, g, h, i, 0.0],
        0,
        0,
        RegionOfInterest(0, 0, 0, 0, False),
    )


def _from_info(sample: CameraInfo) -> m.CameraInfo:
    header = _from_header(sample.header)
    return m.CameraInfo(header, sample.height, sample.width, tuple(sample.k))


@dataclass(frozen=True)
class Codec:
    """A message's DDS type, and the way there and back.

    Attributes:
        type: the DDS type.
        encode: makes a sample of a message.
        decode: makes a message of a sample; InputError: it cannot be used.
    """

    type: type[IdlStruct]
    encode: Callable[[m.Message], IdlStruct]
    decode: Callable[[IdlStruct], m.Message]


def _codec[M, S](
    sample: type[IdlStruct], encode: Callable[[M], S], decode: Callable[[S], M]
) -> Codec:
    return Codec(
        sample,
        cast(Callable[[m.Message], IdlStruct], encode),
        cast(Callable[[IdlStruct], m.Message], decode),
    )


CODECS = MappingProxyType(
    {
        m.JointState: _codec(JointState, _to_joints, _from_joints),
        m.PoseStamped: _codec(PoseStamped, _to_pose, _from_pose),
        m.TwistStamped: _codec(TwistStamped, _to_twist, _from_twist),
        m.OperatingState: _codec(OperatingState, _to_state, _from_state),
        m.StringStamped: _codec(
            StringStamped,
            lambda message: StringStamped(_to_header(message.header), message.text),
            lambda sample: m.StringStamped(_from_header(sample.header), sample.string),
        ),
        m.String: _codec(
            String, lambda message: String(message.text), lambda sample: m.String(sample.data)
        ),
        m.Image: _codec(Image, _to_image, _from_image),
        m.CompressedImage: _codec(
            CompressedImage,
            lambda message: CompressedImage(
                _to_header(message.header), message.format, message.data
            ),
            lambda sample: m.CompressedImage(
                _from_header(sample.header), sample.format, bytes(sample.data)
            ),
        ),
        m.CameraInfo: _codec(CameraInfo, _to_info, _from_info),
        m.Joy: _codec(
            Joy,
            lambda message: Joy(
                _to_header(message.header), list(message.axes), list(message.buttons)
            ),
            lambda sample: m.Joy(
                _from_header(sample.header), tuple(sample.axes), tuple(sample.buttons)
            ),
        ),
    }
)
"""Message → its codec."""
