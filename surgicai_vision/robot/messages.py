"""Messages: what is sent, as plain data, whatever transport carries it.

Each has the content of the ROS message with the same name; the fields of CRTK's messages are those
of collaborative-robotics/crtk_msgs (OperatingState.msg, StringStamped.msg). Units are ROS's: m,
rad, m/s, rad/s; quaternions are x y z w. A stamp is in whole nanoseconds since the epoch; 0 means
that the sender gave none.
"""

from dataclasses import dataclass

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Header:
    """The time of a message's content, and the frame of its numbers."""

    stamp: int = 0
    frame: str = ""


@dataclass(frozen=True)
class JointState:
    """sensor_msgs/JointState: names, positions, velocities and efforts of joints; () if absent."""

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
    """geometry_msgs/TwistStamped: a linear and an angular velocity, each x y z."""

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
