"""ROS 2: the transport through rclpy, if ROS 2 itself is installed.

Messages are taken from the subscriptions as `rclpy.wait_for_message` takes them: without an
executor, which would rebuild its wait set for every message. Messages are sent and received on one
interface only, as with Cyclone DDS (`robot.sockets`). On the loopback, nodes find each other as
with `ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST`, also through shared memory.

rclpy does not report who sent a message, only its number among those of its sender. `Senders`
distinguishes two senders by these numbers; if a middleware gives none, all senders count as one.
"""

import importlib
import os
from collections.abc import Callable
from typing import Protocol, Self, cast, final

import rclpy
from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from surgicai_vision.core.errors import InputError
from surgicai_vision.robot.codecs import PARTS, ROS_NAMES, Codecs, Dialect, Stamp, array_of
from surgicai_vision.robot.messages import Message
from surgicai_vision.robot.senders import Senders
from surgicai_vision.robot.sockets import check_domain, check_interface, keep_to, open_sockets
from surgicai_vision.robot.topics import DEPTHS, STAYING, Topic
from surgicai_vision.robot.transport import LOOPBACK, Inbox, Publish, Received

SECOND = 1_000_000_000
NODE = "surgicai_vision"
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
LOCALHOST = "LOCALHOST"


class _Subscription(Protocol):
    """The part of rclpy's subscription that is used."""

    handle: "_Handle"
    msg_type: type
    raw: bool


class _Handle(Protocol):
    """A subscription's own handle."""

    def take_message(
        self, kind: type, raw: bool
    ) -> tuple[object, dict[str, int | None]] | None: ...


def dialect() -> Dialect:
    """Return ROS 2's message types as installed for this Python.

    Raises:
        ImportError: a package of messages is missing.
    """
    types: dict[str, Callable[..., object]] = {}
    for name in (*PARTS, *ROS_NAMES.values(), "builtin_interfaces/Time"):
        package, _, kind = name.partition("/")
        types[name] = vars(importlib.import_module(f"{package}.msg"))[kind]
    make_time = types["builtin_interfaces/Time"]

    def time(nanoseconds: int) -> object:
        sec, nanosec = divmod(nanoseconds, SECOND)
        return make_time(sec=sec, nanosec=nanosec)

    def nanoseconds(stamp: Stamp) -> int:
        return stamp.sec * SECOND + stamp.nanosec

    return Dialect(types, time, nanoseconds, array_of)


@final
class RclpyTransport:
    """Carries messages with rclpy; a context manager.

    Args:
        interface: name of the network interface.
        domain: ROS's domain number.

    Raises:
        InputError: no such interface or domain, or the sockets cannot be kept to the interface.
        ImportError: a package of messages is missing.
    """

    def __init__(self, interface: str, domain: int):
        check_domain(domain)
        check_interface(interface)
        self._dialect = dialect()
        self._codecs = Codecs(self._dialect)
        self._publishers: dict[str, Callable[[], int]] = {}
        self._subscriptions: list[_Subscription] = []
        before = open_sockets()
        range_before = os.environ.get(RANGE)
        if interface == LOOPBACK:
            os.environ[RANGE] = LOCALHOST
        try:
            self._context = Context()
            rclpy.init(context=self._context, domain_id=domain)
            self._node = Node(
                NODE,
                context=self._context,
                enable_rosout=False,
                start_parameter_services=False,
            )
        finally:
            if interface == LOOPBACK and range_before is None:
                del os.environ[RANGE]
            elif range_before is not None:
                os.environ[RANGE] = range_before
        try:
            keep_to(open_sockets() - before, interface)
        except InputError:
            self.__exit__()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the domain."""
        self._subscriptions.clear()
        self._publishers.clear()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def publisher(self, topic: Topic) -> Publish:
        """Return a function that publishes messages on a topic."""
        made = self._node.create_publisher(self._type(topic), topic.name, _quality(topic))
        self._publishers[topic.name] = made.get_subscription_count

        def publish(message: Message) -> None:
            made.publish(self._codecs.encode(message))

        return publish

    def inbox(self, topic: Topic) -> Inbox:
        """Return a function that takes a topic's new messages; it skips those it cannot read."""
        made = cast(
            _Subscription,
            self._node.create_subscription(
                self._type(topic), topic.name, lambda message: None, _quality(topic)
            ),
        )
        self._subscriptions.append(made)
        senders = Senders()

        def take() -> list[Received]:
            found: list[Received] = []
            while (taken := made.handle.take_message(made.msg_type, made.raw)) is not None:
                sample, info = taken
                number = info.get("publication_sequence_number")
                source = senders.source(number)
                try:
                    message = self._codecs.decode(topic.type, sample)
                except InputError:
                    continue
                found.append(Received(message, source, info["source_timestamp"] or 0))
            return found

        return take

    def listeners(self, topic: Topic) -> int:
        """Return the number of listeners to this transport's publisher on a topic."""
        return self._publishers[topic.name]()

    def wait(self, seconds: float) -> None:
        """Wait until a message comes, but no longer than `seconds`."""
        count = len(self._subscriptions)
        waiting = rclpy_implementation.WaitSet(count, 0, 0, 0, 0, 0, self._context.handle)
        waiting.clear_entities()
        for subscription in self._subscriptions:
            waiting.add_subscription(subscription.handle)
        waiting.wait(max(0, int(seconds * SECOND)))

    def _type(self, topic: Topic) -> Callable[..., object]:
        return self._dialect.types[ROS_NAMES[topic.type]]


def _quality(topic: Topic) -> QoSProfile:
    """Return the QoS of a topic's messages."""
    stays = topic.quality in STAYING
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=DEPTHS[topic.quality],
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if stays else DurabilityPolicy.VOLATILE,
    )
