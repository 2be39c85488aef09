"""Transport: what carries messages, and the table of transports.

    with open_transport("cyclonedds", interface="lo", domain=0) as transport:
        publish = transport.publisher(topic)
        publish(message)
        inbox = transport.inbox(topic)
        for received in inbox():
            received.message, received.source

A transport has no threads that call back: messages are taken when they are wanted, in the order in
which they came. Nothing leaves this machine unless an interface other than the loopback is named.
"""

import dataclasses
import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol, Self, final

from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.robot.messages import Message
from surgicai_vision.robot.topics import Topic, check_topic, known_topics

LOOPBACK = "lo"
"""The loopback's name on Linux."""


@dataclass(frozen=True)
class Received:
    """A message that was received.

    Attributes:
        message: the message.
        source: who sent it, as far as the transport distinguishes senders.
        sent: when it was sent, by the sender's clock [ns] (with rospy: when it arrived); it orders
            messages of several topics.
    """

    message: Message
    source: str
    sent: int


Publish = Callable[[Message], None]
Inbox = Callable[[], list[Received]]


class Transport(Protocol):
    """Carries messages; a context manager."""

    def publisher(self, topic: Topic) -> Publish:
        """Return a function that publishes messages on a topic."""

    def inbox(self, topic: Topic) -> Inbox:
        """Return a function that takes a topic's messages that came since its last call."""

    def listeners(self, topic: Topic) -> int:
        """Return the number of listeners to this transport's publisher on a topic."""

    def wait(self, seconds: float) -> None:
        """Wait until a message comes, but no longer than `seconds`."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


@final
class RenamedTransport:
    """Carries messages of topics that a robot calls by other names.

    Args:
        inner: what carries them; whoever opened it closes it.
        renamed: topic of `robot.topics` → the robot's own name for it.
        views: views that have topics.

    Raises:
        UnknownName: a topic that does not exist.
        InputError: an invalid name, or two topics with the same name.
    """

    def __init__(self, inner: Transport, renamed: Mapping[str, str], views: Iterable[str]):
        known = known_topics(views)
        for name, own in renamed.items():
            check_name("topic", name, known)
            check_topic(own, f"topics: {name}")
        names = [renamed.get(name, name) for name in known]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(f"topics: two are called {', '.join(twice)}.")
        self._inner = inner
        self._renamed = dict(renamed)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the inner transport open."""

    def publisher(self, topic: Topic) -> Publish:
        """Return a function that publishes messages on a topic."""
        return self._inner.publisher(self._own(topic))

    def inbox(self, topic: Topic) -> Inbox:
        """Return a function that takes a topic's messages that came since its last call."""
        return self._inner.inbox(self._own(topic))

    def listeners(self, topic: Topic) -> int:
        """Return the number of listeners to this transport's publisher on a topic."""
        return self._inner.listeners(self._own(topic))

    def wait(self, seconds: float) -> None:
        """Wait until a message comes, but no longer than `seconds`."""
        self._inner.wait(seconds)

    def _own(self, topic: Topic) -> Topic:
        return dataclasses.replace(topic, name=self._renamed.get(topic.name, topic.name))


@dataclass(frozen=True)
class _Entry:
    """A transport of the table.

    Attributes:
        place: "module:class" of what carries messages, made with (interface, domain).
        needs: what to do if something it imports is missing.
    """

    place: str
    needs: str


TRANSPORTS = MappingProxyType(
    {
        "cyclonedds": _Entry(
            "surgicai_vision.robot.dds:CycloneTransport", "pip install 'surgicai-vision[ros]'"
        ),
        "rclpy": _Entry(
            "surgicai_vision.robot.ros2:RclpyTransport",
            "source ROS 2's setup.bash, built for this Python version, and that of a workspace "
            "with crtk_msgs; or use --transport cyclonedds, which needs no ROS",
        ),
        "rospy": _Entry(
            "surgicai_vision.robot.ros1:RospyTransport",
            "source ROS 1's setup.bash (Debian: apt-get install python3-rospy "
            "python3-sensor-msgs, and PYTHONPATH=/usr/lib/python3/dist-packages)",
        ),
    }
)
"""Name → the transport."""


def open_transport(name: str, interface: str = LOOPBACK, domain: int = 0) -> Transport:
    """Return a transport.

    Args:
        name: a key of `TRANSPORTS`.
        interface: name of the network interface.
        domain: ROS's domain number, 0 to 232.

    Raises:
        UnknownName: no such transport.
        InputError: what it needs is not installed, or the interface cannot be used.
    """
    check_name("transport", name, TRANSPORTS)
    entry = TRANSPORTS[name]
    module, _, member = entry.place.partition(":")
    try:
        make: Callable[[str, int], Transport] = vars(importlib.import_module(module))[member]
        return make(interface, domain)
    except ImportError as error:
        missing = error.name or str(error).splitlines()[0]
        raise InputError(
            f"The transport {name} needs a package that is not installed ({missing}): "
            f"{entry.needs}."
        ) from None
