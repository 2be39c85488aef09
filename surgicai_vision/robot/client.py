"""Client: a dVRK as its topics show it, and what is sent to it.

    client = Client(transport, ClientConfig(views=("front",)))
    client.update()                      # take new messages
    client.age("/PSM1/measured_js")      # how old the newest is [s]
    client.send("/PSM1/servo_cp", pose)
    client.step(["/PSM1/servo_cp"])      # only if we set the simulation's clock

The topics are a dVRK's (`robot.topics`); a `RenamedTransport` renames them where a robot's differ.
Messages that are sent have their own stamps. Since clocks differ, the age of a received message is
the time since its arrival here, plus the lag of its stamp behind the least late message of the last
minutes.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

from surgicai_vision.core.config import JSON
from surgicai_vision.core.errors import BadFile, InputError, SurgicaiError
from surgicai_vision.core.untrusted import parse_json
from surgicai_vision.robot import topics
from surgicai_vision.robot.messages import Header, Message, String, StringStamped
from surgicai_vision.robot.simulated import PSM_NAMES
from surgicai_vision.robot.topics import Topic
from surgicai_vision.robot.transport import Inbox, Publish, Transport

STEP_S = 10.0
"""Time within which a served simulation must answer a request [s]; rendering may be slow."""
POLL_S = 0.005
CONNECT_S = 20.0
"""Time within which a robot must be found [s]."""
ASK_AGAIN_S = 0.5
DRIFT = 1e-4
"""How fast clocks may drift apart [s/s]; quartz clocks drift by less than 1e-4."""
_DUE = (
    *("measured_js", "setpoint_js", "measured_cp", "setpoint_cp", "image_raw", "compressed"),
    "judgement",
)
"""Last part of the names of topics that are published continually."""


@dataclass(frozen=True)
class ClientConfig:
    """What a client subscribes to.

    Attributes:
        arms: arms it listens to and moves.
        views: views whose images it receives.
        is_compressed: receive the compressed images instead of the raw ones.
        is_simulated: also use the topics that only a served simulation has.
    """

    arms: tuple[str, ...] = tuple(PSM_NAMES)
    views: tuple[str, ...] = ()
    is_compressed: bool = False
    is_simulated: bool = False


@dataclass(frozen=True)
class Heard:
    """A message that was received.

    Attributes:
        message: the message.
        arrived: when it arrived here [s, monotonic].
        lag: how much later it came than the least late ones of its topic [s].
    """

    message: Message
    arrived: float
    lag: float = 0.0


class _Lag:
    """How much later than usual the messages of one topic arrive.

    The sender has a different clock: its stamps differ from arrivals by the difference of the
    clocks and by the delay. The least difference so far counts as no delay; it may rise by `DRIFT`,
    since clocks drift.
    """

    def __init__(self) -> None:
        self._least = math.inf
        self._last = 0.0

    def of(self, message: Message, arrived: float) -> float:
        """Return the lag of a message that arrived at a time [s]; 0 without a stamp."""
        if isinstance(message, String) or not message.header.stamp:
            return 0.0
        difference = arrived - message.header.stamp / 1e9
        self._least = min(difference, self._least + DRIFT * (arrived - self._last))
        self._last = arrived
        return difference - self._least


@final
class Client:
    """A dVRK as its topics show it; see the module's docstring.

    Args:
        transport: carries the messages.
        config: what it subscribes to.
    """

    def __init__(self, transport: Transport, config: ClientConfig):
        self._transport = transport
        self._inboxes: dict[str, Inbox] = {}
        self._publishers: dict[str, Publish] = {}
        self._newest: dict[str, Heard] = {}
        self._last_stamp = 0
        heard: list[Topic] = []
        said: list[Topic] = []
        for arm in config.arms:
            heard += topics.psm_topics(arm, heard=False).values()
            said += topics.psm_topics(arm, heard=True).values()
        self._image_of = topics.compressed_topic if config.is_compressed else topics.image_topic
        heard += [self._image_of(view) for view in config.views]
        if config.is_simulated:
            heard += [topics.STEPPED, topics.JUDGEMENT]
            said += [topics.STEP, topics.RESET, topics.ENTER]
        for topic in heard:
            self._inboxes[topic.name] = transport.inbox(topic)
        self._lags = {name: _Lag() for name in self._inboxes}
        self._said = said
        for topic in said:
            self._publishers[topic.name] = transport.publisher(topic)
        self._is_simulated = config.is_simulated

    def connect(self, seconds: float = CONNECT_S) -> None:
        """Wait until all our topics have listeners and all continual ones have a message.

        Raises:
            SurgicaiError: a listener, a message or an answer is missing after that many seconds.
        """
        ends = time.monotonic() + seconds
        asked = 0.0
        stamp = 0
        while True:
            self.update()
            deaf = [topic.name for topic in self._said if not self._transport.listeners(topic)]
            missing = self._missing(deaf, stamp)
            if not missing:
                return
            if time.monotonic() > ends:
                raise SurgicaiError(
                    f"No robot answers: {'; '.join(missing)}. Is it on, in the same domain and on "
                    "the same interface?"
                )
            if self._is_simulated and not deaf and time.monotonic() > asked + ASK_AGAIN_S:
                asked = time.monotonic()
                stamp = self.stamp()
                self.send(topics.ENTER.name, StringStamped(Header(stamp), ""))
            self._transport.wait(POLL_S)

    def update(self) -> None:
        """Take new messages; of a topic's messages, the one with the latest stamp counts."""
        for name, inbox in self._inboxes.items():
            for received in inbox():
                before = self._newest.get(name)
                if before is None or not _is_older(received.message, before.message):
                    now = time.monotonic()
                    lag = self._lags[name].of(received.message, now)
                    self._newest[name] = Heard(received.message, now, lag)

    def image_topic(self, view: str) -> str:
        """Return the topic on which a view's images arrive."""
        return self._image_of(view).name

    def newest(self, topic: str) -> Heard | None:
        """Return the newest message of a topic, None before the first."""
        return self._newest.get(topic)

    def age(self, topic: str) -> float:
        """Return how old the newest message of a topic is [s], infinity before the first."""
        heard = self._newest.get(topic)
        return math.inf if heard is None else time.monotonic() - heard.arrived + heard.lag

    def stamp(self) -> int:
        """Return the present time [ns since the epoch], later than any before."""
        self._last_stamp = max(time.time_ns(), self._last_stamp + 1)
        return self._last_stamp

    def send(self, topic: str, message: Message) -> None:
        """Publish a message."""
        self._publishers[topic](message)

    def wait(self, seconds: float) -> None:
        """Wait until a message comes, but no longer than `seconds`."""
        self._transport.wait(seconds)

    # -- a served simulation -----------------------------------------------------------------------

    def step(self, sent: Sequence[str], stamp: int) -> int:
        """Let a served simulation take one control step, and wait for all it publishes.

        Args:
            sent: topics on which a message with `stamp` was sent, which must be received first.
            stamp: the stamp of those messages [ns].

        Returns:
            The stamp of the states that followed, which `update` has already taken.

        Raises:
            SurgicaiError: no answer, or the step was not taken.
        """
        return self._ask(topics.STEP, " ".join(sent), stamp)

    def reset(self, seed: int) -> int:
        """Begin an episode of a served simulation; wait as `step` does."""
        return self._ask(topics.RESET, str(seed), self.stamp())

    def enter(self, subtask: str) -> int:
        """Tell a served simulation's judge which subtask is active; wait as `step` does."""
        return self._ask(topics.ENTER, subtask, self.stamp())

    def tell_subtask(self, subtask: str) -> None:
        """Tell a served simulation's judge which subtask is active, without waiting."""
        self.send(topics.ENTER.name, StringStamped(Header(self.stamp()), subtask))

    def judgement(self) -> Mapping[str, JSON]:
        """Return how a served simulation judges the episode.

        It is empty at a robot, and if what was received is not a judgement.
        """
        heard = self.newest(topics.JUDGEMENT.name)
        if heard is None or not isinstance(heard.message, StringStamped):
            return {}
        try:
            judged = parse_json(heard.message.text, topics.JUDGEMENT.name)
        except BadFile:  # another sender's, or damaged on the way
            return {}
        return judged if isinstance(judged, dict) else {}

    def _ask(self, topic: Topic, text: str, stamp: int) -> int:
        request = StringStamped(Header(stamp), text)
        asked = -math.inf
        ends = time.monotonic() + STEP_S
        while time.monotonic() < ends:
            if time.monotonic() > asked + ASK_AGAIN_S:  # it may not have been received yet
                asked = time.monotonic()
                self.send(topic.name, request)
            self.update()
            heard = self.newest(topics.STEPPED.name)
            if heard is not None and isinstance(heard.message, StringStamped):
                answered, _, problem = heard.message.text.partition(" ")
                if answered == str(stamp):
                    if problem:
                        raise InputError(f"the served simulation refused: {problem.rstrip('.')}.")
                    self._wait_for(heard.message.header.stamp, ends)
                    return heard.message.header.stamp
            self._transport.wait(POLL_S)
        raise SurgicaiError(
            f"The served simulation has not answered on {topics.STEPPED.name} for {STEP_S:g} s; "
            "is it served with --clock stepped, in the same domain and on the same interface?"
        )

    def _missing(self, deaf: Sequence[str], stamp: int) -> list[str]:
        """Return what is missing of a connection, one sentence each.

        Args:
            deaf: topics that nobody subscribes to.
            stamp: stamp of the request that a served simulation has to answer [ns].
        """
        missing = []
        if deaf:
            missing.append(f"nobody subscribes to {', '.join(deaf)}")
        mute = [name for name in self._inboxes if self._is_due(name) and not self.newest(name)]
        if mute:
            missing.append(f"nothing arrives on {', '.join(mute)}")
        if not missing and self._is_simulated and not self._is_answered(stamp):
            missing.append("a request is not answered")
        return missing

    def _is_answered(self, stamp: int) -> bool:
        """Return True if a request was answered and all that was published with it has arrived."""
        heard = self.newest(topics.STEPPED.name)
        if heard is None or not isinstance(heard.message, StringStamped):
            return False
        published = heard.message.header.stamp
        return heard.message.text == str(stamp) and all(
            self._has(name, published) for name in self._inboxes
        )

    def _wait_for(self, stamp: int, ends: float) -> None:
        """Wait until every topic that is published continually has at least `stamp`."""
        while missing := [name for name in self._inboxes if not self._has(name, stamp)]:
            if time.monotonic() > ends:
                raise SurgicaiError(f"Nothing new has arrived on {', '.join(missing)}.")
            self._transport.wait(POLL_S)
            self.update()

    def _has(self, name: str, stamp: int) -> bool:
        """Return True if a topic's newest message is of `stamp` or later, or none is due on it."""
        if not self._is_due(name):
            return True
        heard = self._newest.get(name)
        if heard is None or isinstance(heard.message, String):
            return False
        return heard.message.header.stamp >= stamp

    @staticmethod
    def _is_due(name: str) -> bool:
        """Return True if a topic is published continually."""
        return name.rpartition("/")[2] in _DUE


def _is_older(message: Message, than: Message) -> bool:
    """Return True if a message was overtaken by another, according to their stamps."""
    if isinstance(message, String) or isinstance(than, String):
        return False
    return 0 < message.header.stamp < than.header.stamp
