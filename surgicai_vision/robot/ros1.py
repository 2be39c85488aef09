"""ROS 1: the transport through rospy, if ROS 1 itself is installed and a master runs.

    ROS_MASTER_URI=http://127.0.0.1:11311 surgicai-vision robot serve --transport rospy

rospy calls back in its own threads; messages are kept until they are taken. `crtk_msgs` need not be
installed: if it cannot be imported, its types are made from their definitions, and have the same
MD5 sums. ROS 1 has no domains: masters separate systems.

On the loopback all of rospy's sockets are bound to 127.0.0.1. On another interface, rospy tells
others this machine's address there, but listens on every address of the machine.
"""

import fcntl
import importlib
import os
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol, Self, cast, final

import genpy
import genpy.dynamic
import rosgraph
import rospy

from surgicai_vision.core.errors import InputError
from surgicai_vision.robot.codecs import PARTS, ROS_NAMES, Codecs, Dialect, Stamp
from surgicai_vision.robot.messages import Message
from surgicai_vision.robot.sockets import check_domain, check_interface
from surgicai_vision.robot.topics import DEPTHS, STAYING, Topic
from surgicai_vision.robot.transport import LOOPBACK, Inbox, Publish, Received

if TYPE_CHECKING:
    from surgicai_vision.robot import idl

NODE = "surgicai_vision"
CRTK = "crtk_msgs"
HEADER = "Header header\n"
NESTED = f"{'=' * 80}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
DEFINITIONS = {
    "crtk_msgs/OperatingState": f"{HEADER}string state\nbool is_homed\nbool is_busy\n{NESTED}",
    "crtk_msgs/StringStamped": f"{HEADER}string string\n{NESTED}",
}
"""Type → its definition (collaborative-robotics/crtk_msgs, msg/)."""
SIOCGIFADDR = 0x8915
"""The ioctl request for an interface's address (linux/sockios.h)."""
WAITING = 64
"""Most messages of a topic that wait to be taken; beyond that the oldest is dropped."""


class _Stamp(Protocol):
    """A stamp as in ROS 1."""

    def to_nsec(self) -> int: ...


class _Info(Protocol):
    """A camera info as in ROS 1."""

    K: Sequence[float]


def dialect() -> Dialect:
    """Return ROS 1's message types as installed for this Python.

    Raises:
        ImportError: a package of messages is missing.
    """
    types: dict[str, Callable[..., object]] = {}
    for name in (*PARTS, *ROS_NAMES.values()):
        package, _, kind = name.partition("/")
        try:
            types[name] = vars(importlib.import_module(f"{package}.msg"))[kind]
        except ImportError:
            if package != CRTK:
                raise
            types[name] = genpy.dynamic.generate_dynamic(name, DEFINITIONS[name])[name]

    def time(nanoseconds: int) -> object:
        return genpy.Time(*divmod(nanoseconds, 1_000_000_000))

    def nanoseconds(stamp: Stamp) -> int:
        return cast(_Stamp, stamp).to_nsec()

    def intrinsics(sample: "idl.CameraInfo") -> Sequence[float]:
        return cast(_Info, sample).K

    return Dialect(types, time, nanoseconds, bytes, ("D", "K", "R", "P"), intrinsics)


@final
class RospyTransport:
    """Carries messages with rospy; a context manager.

    Args:
        interface: name of the network interface.
        domain: must be 0; ROS 1 has none.

    Raises:
        InputError: no such interface, a domain, no master, or rospy already ran in this process.
        ImportError: a package of messages is missing.
    """

    def __init__(self, interface: str, domain: int):
        check_domain(domain)
        check_interface(interface)
        if domain:
            raise InputError(
                f"ROS 1 has no domains, got domain {domain}; separate systems with ROS_MASTER_URI."
            )
        if rospy.core.is_initialized():
            raise InputError("rospy can be opened only once per process.")
        self._dialect = dialect()
        self._codecs = Codecs(self._dialect)
        address = "127.0.0.1" if interface == LOOPBACK else _address(interface)
        os.environ["ROS_IP"] = address
        os.environ.pop("ROS_HOSTNAME", None)
        if not rosgraph.is_master_online():
            raise InputError(
                f"No master answers at {rosgraph.get_master_uri()}; start one (roscore), or set "
                "ROS_MASTER_URI."
            )
        self._came = threading.Event()
        self._made: list[Callable[[], None]] = []
        self._publishers: dict[str, Callable[[], int]] = {}
        rospy.init_node(NODE, anonymous=True, disable_signals=True, disable_rosout=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the master."""
        for unregister in self._made:
            unregister()
        self._made.clear()
        rospy.signal_shutdown("closed")

    def publisher(self, topic: Topic) -> Publish:
        """Return a function that publishes messages on a topic."""
        made = rospy.Publisher(
            topic.name,
            self._type(topic),
            queue_size=DEPTHS[topic.quality],
            latch=topic.quality in STAYING,
            tcp_nodelay=True,
        )
        self._made.append(made.unregister)
        self._publishers[topic.name] = made.get_num_connections

        def publish(message: Message) -> None:
            made.publish(self._codecs.encode(message))

        return publish

    def inbox(self, topic: Topic) -> Inbox:
        """Return a function that takes a topic's new messages; it skips those it cannot read."""
        waiting: deque[tuple[object, str, int]] = deque(maxlen=WAITING)

        def keep(sample: object) -> None:
            source = cast("_Sample", sample)._connection_header["callerid"]
            waiting.append((sample, source, time.time_ns()))
            self._came.set()

        made = rospy.Subscriber(topic.name, self._type(topic), keep, tcp_nodelay=True)
        self._made.append(made.unregister)

        def take() -> list[Received]:
            found: list[Received] = []
            while waiting:
                sample, source, sent = waiting.popleft()
                try:
                    message = self._codecs.decode(topic.type, sample)
                except InputError:
                    continue
                found.append(Received(message, source, sent))
            return found

        return take

    def listeners(self, topic: Topic) -> int:
        """Return the number of listeners to this transport's publisher on a topic."""
        return self._publishers[topic.name]()

    def wait(self, seconds: float) -> None:
        """Wait until a message comes, but no longer than `seconds`."""
        self._came.wait(max(0.0, seconds))
        self._came.clear()

    def _type(self, topic: Topic) -> Callable[..., object]:
        return self._dialect.types[ROS_NAMES[topic.type]]


class _Sample(Protocol):
    """What rospy adds to a message."""

    _connection_header: dict[str, str]


def _address(interface: str) -> str:
    """Return the address of an interface.

    Raises:
        InputError: it has no address.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        try:
            request = struct.pack("256s", interface[:15].encode())
            answer = fcntl.ioctl(one.fileno(), SIOCGIFADDR, request)
        except OSError as error:
            raise InputError(f"{interface} has no IPv4 address ({error.strerror}).") from None
    return socket.inet_ntoa(answer[20:24])
