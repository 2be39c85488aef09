"""DDS: the transport that ROS 2 nodes speak, through cyclonedds, with no ROS installed.

Messages are sent and received on the named interface only. Cyclone DDS sends on the interface it is
given, but its receiving sockets are bound to every address of the machine. Each is therefore bound
to the device as well (Linux: SO_BINDTODEVICE); if that is refused, nothing is opened. On the
loopback there is no multicast: participants find each other at 127.0.0.1, as those of ROS 2 do with
`ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST`.
"""

import struct
from typing import Self, cast, final
from xml.sax.saxutils import quoteattr

from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState
from cyclonedds.core import WaitSet as Waiting
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.internal import SampleInfo
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic as DdsTopic
from cyclonedds.util import duration

from surgicai_vision.core.errors import InputError
from surgicai_vision.robot.codecs import ROS_NAMES
from surgicai_vision.robot.idl import CODECS, TYPES
from surgicai_vision.robot.messages import Message
from surgicai_vision.robot.sockets import check_domain, check_interface, keep_to, open_sockets
from surgicai_vision.robot.topics import DEPTHS, STAYING, Topic
from surgicai_vision.robot.transport import LOOPBACK, Inbox, Publish, Received

PARTICIPANTS = 60
"""Most processes that are looked for on the loopback; ROS 2's own default is 32."""
BLOCKED_MS = 100
"""Time for which a writer waits for a slow reader [ms]; ROS 2's default."""


def configuration(interface: str) -> str:
    """Return the configuration that keeps Cyclone DDS to one interface."""
    is_loopback = interface == LOOPBACK
    discovery = (
        f"<ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{PARTICIPANTS}</MaxAutoParticipantIndex>"
    )
    if is_loopback:
        discovery += "<Peers><Peer address='127.0.0.1'/></Peers>"
    return (
        "<CycloneDDS><Domain Id='any'><General>"
        f"<Interfaces><NetworkInterface name={quoteattr(interface)}"
        f"{' multicast=' + quoteattr('false') if is_loopback else ''}/></Interfaces>"
        f"<AllowMulticast>{'false' if is_loopback else 'default'}</AllowMulticast>"
        f"</General><Discovery>{discovery}</Discovery></Domain></CycloneDDS>"
    )


@final
class CycloneTransport:
    """Carries messages with Cyclone DDS; a context manager.

    Args:
        interface: name of the network interface.
        domain: ROS's domain number.

    Raises:
        InputError: no such interface or domain, or this process has the domain open already, or
            the sockets cannot be kept to the interface.
    """

    def __init__(self, interface: str, domain: int):
        check_domain(domain)
        check_interface(interface)
        before = open_sockets()
        try:
            self._domain = Domain(domain, configuration(interface))
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise InputError(
                f"Cyclone DDS cannot open domain {domain} on {interface}: {error.msg}. Another "
                "--domain may be free."
            ) from None
        self._entities: list[object] = []
        self._writers: dict[str, DataWriter[IdlStruct]] = {}
        self._topics: dict[str, DdsTopic[IdlStruct]] = {}
        try:
            keep_to(open_sockets() - before, interface)
        except InputError:
            self.__exit__()
            raise
        self._waiting = Waiting(self._participant)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the domain."""
        self._entities.clear()
        self._writers.clear()
        self._domain.__del__()

    def publisher(self, topic: Topic) -> Publish:
        """Return a function that publishes messages on a topic."""
        writer = DataWriter(self._participant, self._topic(topic), qos=_quality(topic))
        self._writers[topic.name] = writer

        def publish(message: Message) -> None:
            writer.write(cast(IdlStruct, CODECS.encode(message)))

        return publish

    def inbox(self, topic: Topic) -> Inbox:
        """Return a function that takes a topic's new messages; it skips those it cannot read."""
        reader = DataReader(self._participant, self._topic(topic), qos=_quality(topic))
        condition = ReadCondition(reader, ViewState.Any | SampleState.NotRead | InstanceState.Alive)
        self._waiting.attach(condition)
        self._entities += [reader, condition]

        def take() -> list[Received]:
            found: list[Received] = []
            while True:
                try:
                    samples = reader.take(1)
                    if not samples:
                        return found
                    info: SampleInfo = vars(samples[0])["sample_info"]
                    if info.valid_data:
                        message = CODECS.decode(topic.type, samples[0])
                        source = f"{info.publication_handle:x}"
                        found.append(Received(message, source, info.source_timestamp))
                except (InputError, ValueError, IndexError, struct.error):
                    continue  # bytes that are not such a message

        return take

    def listeners(self, topic: Topic) -> int:
        """Return the number of listeners to this transport's publisher on a topic."""
        return len(self._writers[topic.name].get_matched_subscriptions())

    def wait(self, seconds: float) -> None:
        """Wait until a message comes, but no longer than `seconds`."""
        self._waiting.wait(max(0, int(seconds * 1e9)))

    def _topic(self, topic: Topic) -> DdsTopic[IdlStruct]:
        """Return a topic with the name that ROS 2 gives it on the wire."""
        if topic.name not in self._topics:
            made = DdsTopic(self._participant, f"rt{topic.name}", TYPES[ROS_NAMES[topic.type]])
            self._topics[topic.name] = made
        return self._topics[topic.name]


def _quality(topic: Topic) -> Qos:
    """Return the QoS of a topic's messages."""
    depth = DEPTHS[topic.quality]
    stays = topic.quality in STAYING
    policies = [
        Policy.Reliability.Reliable(duration(milliseconds=BLOCKED_MS)),
        Policy.History.KeepLast(depth),
        Policy.Durability.TransientLocal if stays else Policy.Durability.Volatile,
    ]
    if stays:
        policies.append(
            Policy.DurabilityService(
                cleanup_delay=0,
                history=Policy.History.KeepLast(depth),
                max_samples=depth,
                max_instances=1,
                max_samples_per_instance=depth,
            )
        )
    return Qos(*policies)
