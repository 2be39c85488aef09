"""Messages: what travels, as plain data, whatever carries it.

Each is the ROS message of its name with the same content; the fields of CRTK's are those of
collaborative-robotics/crtk_msgs (OperatingState.msg, StringStamped.msg). Units are ROS's: m, rad,
m/s, rad/s; quaternions are x y z w. A stamp is whole nanoseconds since the epoch, and 0 says that
the sender gave none.
"""

from dataclasses import dataclass

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Header:
    """When something was so, and in which frame its numbers are."""

    stamp: int = 0
    frame: str = ""


@dataclass(frozen=True)
class JointState:
    """sensor_msgs/JointState: names, positions, velocities and efforts of joints; () is none."""

    header: Header
    names: tuple[str, ...]
    position: Numbers
    velocity: Numbers = ()
    effort: Numbers = ()


@dataclass(frozen=True)
class PoseStamped:
    """geometry_msgs/PoseStamped: a position x y z and a quaternion x y z w."""

    header: Header
    position: Numbers
    quaternion: Numbers


@dataclass(frozen=True)
class TwistStamped:
    """geometry_msgs/TwistStamped: a linear and an angular velocity, x y z each."""

    header: Header
    linear: Numbers
    angular: Numbers


@dataclass(frozen=True)
class OperatingState:
    """crtk_msgs/OperatingState: an arm's state, and whether it is homed and moving by itself."""

    header: Header
    state: str
    is_homed: bool
    is_busy: bool


@dataclass(frozen=True)
class StringStamped:
    """crtk_msgs/StringStamped: a text with a stamp."""

    header: Header
    text: str


@dataclass(frozen=True)
class String:
    """std_msgs/String."""

    text: str


@dataclass(frozen=True)
class Image:
    """sensor_msgs/Image of encoding "rgb8": rows of red, green, blue, from the top."""

    header: Header
    height: int
    width: int
    data: bytes


@dataclass(frozen=True)
class CompressedImage:
    """sensor_msgs/CompressedImage: a file's bytes and its format, "jpeg" or "png"."""

    header: Header
    format: str
    data: bytes


@dataclass(frozen=True)
class CameraInfo:
    """sensor_msgs/CameraInfo of a pinhole camera without distortion.

    Attributes:
        header: its frame is the camera's optical frame (x right, y down, z forward).
        height, width: of the image [pixel].
        intrinsics: K, row by row (9).
    """

    header: Header
    height: int
    width: int
    intrinsics: Numbers


@dataclass(frozen=True)
class Joy:
    """sensor_msgs/Joy: a pedal's or a gamepad's axes in [-1, 1] and buttons, 1 where pressed."""

    header: Header
    axes: Numbers
    buttons: tuple[int, ...]


Message = (
    JointState
    | PoseStamped
    | TwistStamped
    | OperatingState
    | StringStamped
    | String
    | Image
    | CompressedImage
    | CameraInfo
    | Joy
)
