"""Codecs: our messages to ROS messages and back, whatever Python types the latter have.

The fields are those of the message definitions of ROS's common_interfaces and of
collaborative-robotics/crtk_msgs. All versions of ROS name them alike, except for the parts of a
stamp and the matrices of a camera info. A `Dialect` holds the types and these differences.
"""

from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Protocol, cast, final

from surgicai_vision.core.errors import InputError
from surgicai_vision.robot import messages as m

if TYPE_CHECKING:
    from surgicai_vision.robot import idl

ROS_NAMES: Mapping[type[m.Message], str] = MappingProxyType(
    {
        m.JointState: "sensor_msgs/JointState",
        m.PoseStamped: "geometry_msgs/PoseStamped",
        m.TwistStamped: "geometry_msgs/TwistStamped",
        m.OperatingState: "crtk_msgs/OperatingState",
        m.StringStamped: "crtk_msgs/StringStamped",
        m.String: "std_msgs/String",
        m.Image: "sensor_msgs/Image",
        m.CompressedImage: "sensor_msgs/CompressedImage",
        m.CameraInfo: "sensor_msgs/CameraInfo",
        m.Joy: "sensor_msgs/Joy",
    }
)
"""Message → the name of its type in ROS."""
PARTS = (
    "std_msgs/Header",
    *(f"geometry_msgs/{part}" for part in ("Vector3", "Point", "Quaternion", "Pose", "Twist")),
    "sensor_msgs/RegionOfInterest",
)
"""Types that are nested in those."""
COLOURS = ("rgb8", "bgr8")
EYE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class Stamp(Protocol):
    """A stamp as in ROS 2."""

    sec: int
    nanosec: int


def _intrinsics(sample: "idl.CameraInfo") -> Sequence[float]:
    return sample.k


@dataclass(frozen=True)
class Dialect:
    """The Python types of one ROS, and what it names differently.

    Attributes:
        types: a type's name, such as "geometry_msgs/Point" → what makes one from its named fields.
        time: makes a stamp from nanoseconds.
        nanoseconds: reads a stamp.
        data: converts bytes to what a bytes field takes.
        matrices: a camera info's names for the distortion, K, R and P.
        intrinsics: reads K.
    """

    types: Mapping[str, Callable[..., object]]
    time: Callable[[int], object]
    nanoseconds: Callable[[Stamp], int]
    data: Callable[[bytes], object] = bytes
    matrices: tuple[str, str, str, str] = ("d", "k", "r", "p")
    intrinsics: "Callable[[idl.CameraInfo], Sequence[float]]" = _intrinsics


def array_of(data: bytes) -> "array[int]":
    """Return bytes in the form that rclpy accepts without checking each one."""
    return array("B", data)


@final
class Codecs:
    """Encodes and decodes messages in one dialect.

    Args:
        dialect: the types and where they differ.
    """

    def __init__(self, dialect: Dialect):
        self._dialect = dialect
        self._types = dialect.types
        self._codecs = MappingProxyType(
            {
                m.JointState: _pair(self._to_joints, self._from_joints),
                m.PoseStamped: _pair(self._to_pose, self._from_pose),
                m.TwistStamped: _pair(self._to_twist, self._from_twist),
                m.OperatingState: _pair(self._to_state, self._from_state),
                m.StringStamped: _pair(self._to_text, self._from_text),
                m.String: _pair(self._to_string, _from_string),
                m.Image: _pair(self._to_image, self._from_image),
                m.CompressedImage: _pair(self._to_compressed, self._from_compressed),
                m.CameraInfo: _pair(self._to_info, self._from_info),
                m.Joy: _pair(self._to_joy, self._from_joy),
            }
        )

    def encode(self, message: m.Message) -> object:
        """Return the ROS message for one of ours."""
        return self._codecs[type(message)][0](message)

    def decode(self, kind: type[m.Message], sample: object) -> m.Message:
        """Return our message for a ROS message.

        Raises:
            InputError: an image that cannot be used.
        """
        return self._codecs[kind][1](sample)

    def _to_header(self, header: m.Header) -> object:
        return self._types["std_msgs/Header"](
            stamp=self._dialect.time(header.stamp), frame_id=header.frame
        )

    def _from_header(self, header: "idl.Header") -> m.Header:
        return m.Header(self._dialect.nanoseconds(header.stamp), header.frame_id)

    def _to_joints(self, state: m.JointState) -> object:
        return self._types["sensor_msgs/JointState"](
            header=self._to_header(state.header),
            name=list(state.names),
            position=list(state.position),
            velocity=list(state.velocity),
            effort=list(state.effort),
        )

    def _from_joints(self, sample: "idl.JointState") -> m.JointState:
        return m.JointState(
            self._from_header(sample.header),
            tuple(sample.name),
            tuple(sample.position),
            tuple(sample.velocity),
            tuple(sample.effort),
        )

    def _three(self, name: str, values: m.Numbers) -> object:
        x, y, z = values
        return self._types[name](x=x, y=y, z=z)

    def _to_pose(self, message: m.PoseStamped) -> object:
        x, y, z, w = message.quaternion
        return self._types["geometry_msgs/PoseStamped"](
            header=self._to_header(message.header),
            pose=self._types["geometry_msgs/Pose"](
                position=self._three("geometry_msgs/Point", message.position),
                orientation=self._types["geometry_msgs/Quaternion"](x=x, y=y, z=z, w=w),
            ),
        )

    def _from_pose(self, sample: "idl.PoseStamped") -> m.PoseStamped:
        place = sample.pose.position
        turn = sample.pose.orientation
        return m.PoseStamped(
            self._from_header(sample.header),
            (place.x, place.y, place.z),
            (turn.x, turn.y, turn.z, turn.w),
        )

    def _to_twist(self, message: m.TwistStamped) -> object:
        return self._types["geometry_msgs/TwistStamped"](
            header=self._to_header(message.header),
            twist=self._types["geometry_msgs/Twist"](
                linear=self._three("geometry_msgs/Vector3", message.linear),
                angular=self._three("geometry_msgs/Vector3", message.angular),
            ),
        )

    def _from_twist(self, sample: "idl.TwistStamped") -> m.TwistStamped:
        linear = sample.twist.linear
        angular = sample.twist.angular
        return m.TwistStamped(
            self._from_header(sample.header),
            (linear.x, linear.y, linear.z),
            (angular.x, angular.y, angular.z),
        )

    def _to_state(self, message: m.OperatingState) -> object:
        return self._types["crtk_msgs/OperatingState"](
            header=self._to_header(message.header),
            state=message.state,
            is_homed=message.is_homed,
            is_busy=message.is_busy,
        )

    def _from_state(self, sample: "idl.OperatingState") -> m.OperatingState:
        header = self._from_header(sample.header)
        return m.OperatingState(header, sample.state, bool(sample.is_homed), bool(sample.is_busy))

    def _to_text(self, message: m.StringStamped) -> object:
        return self._types["crtk_msgs/StringStamped"](
            header=self._to_header(message.header), string=message.text
        )

    def _from_text(self, sample: "idl.StringStamped") -> m.StringStamped:
        return m.StringStamped(self._from_header(sample.header), sample.string)

    def _to_string(self, message: m.String) -> object:
        return self._types["std_msgs/String"](data=message.text)

    def _to_image(self, image: m.Image) -> object:
        return self._types["sensor_msgs/Image"](
            header=self._to_header(image.header),
            height=image.height,
            width=image.width,
            encoding="rgb8",
            is_bigendian=0,
            step=3 * image.width,
            data=self._dialect.data(image.data),
        )

    def _from_image(self, sample: "idl.Image") -> m.Image:
        """Return an image in the order red, green, blue.

        Raises:
            InputError: an unknown encoding, or a size other than announced.
        """
        height = sample.height
        width = sample.width
        if sample.encoding not in COLOURS:
            raise InputError(
                f"an image of encoding {sample.encoding[:20]}; allowed: {', '.join(COLOURS)}."
            )
        data = bytes(sample.data)
        if sample.step != 3 * width or len(data) != 3 * width * height:
            raise InputError(f"an image of {height} × {width} with {len(data)} bytes.")
        if sample.encoding == "bgr8":
            turned = bytearray(data)
            turned[0::3] = data[2::3]
            turned[2::3] = data[0::3]
            data = bytes(turned)
        return m.Image(self._from_header(sample.header), height, width, data)

    def _to_compressed(self, image: m.CompressedImage) -> object:
        return self._types["sensor_msgs/CompressedImage"](
            header=self._to_header(image.header),
            format=image.format,
            data=self._dialect.data(image.data),
        )

    def _from_compressed(self, sample: "idl.CompressedImage") -> m.CompressedImage:
        header = self._from_header(sample.header)
        return m.CompressedImage(header, sample.format, bytes(sample.data))

    def _to_info(self, info: m.CameraInfo) -> object:
        a, b, c, d, e, f, g, h, i = info.intrinsics
        matrices = (
            [0.0] * 5,
            [*info.intrinsics],
            [*EYE],
            [a, b, c, 0.0, d, e, f, 0.0, g, h, i, 0.0],
        )
        return self._types["sensor_msgs/CameraInfo"](
            header=self._to_header(info.header),
            height=info.height,
            width=info.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=self._types["sensor_msgs/RegionOfInterest"](
                x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
            ),
            **dict(zip(self._dialect.matrices, matrices, strict=True)),
        )

    def _from_info(self, sample: "idl.CameraInfo") -> m.CameraInfo:
        header = self._from_header(sample.header)
        intrinsics = tuple(float(value) for value in self._dialect.intrinsics(sample))
        return m.CameraInfo(header, sample.height, sample.width, intrinsics)

    def _to_joy(self, message: m.Joy) -> object:
        return self._types["sensor_msgs/Joy"](
            header=self._to_header(message.header),
            axes=list(message.axes),
            buttons=list(message.buttons),
        )

    def _from_joy(self, sample: "idl.Joy") -> m.Joy:
        header = self._from_header(sample.header)
        return m.Joy(header, tuple(sample.axes), tuple(sample.buttons))


def _from_string(sample: "idl.String") -> m.String:
    return m.String(sample.data)


Encode = Callable[[m.Message], object]
Decode = Callable[[object], m.Message]


def _pair[M, S](encode: Callable[[M], object], decode: Callable[[S], M]) -> tuple[Encode, Decode]:
    return cast(Encode, encode), cast(Decode, decode)
