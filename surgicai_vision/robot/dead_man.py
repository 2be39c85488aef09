"""Dead-man's switch: what a person must hold for anything to be sent.

Each reports the time since it was last certainly held; `robot.guards.DEAD_MAN_S` is the limit. What
has been waiting to be read may have come at any time since the previous reading, so it counts from
there: a press from before a pause does not count as one of now.
"""

import math
import os
import select
import sys
import termios
import time
import tty
from typing import Self, final

from surgicai_vision.core.errors import InputError
from surgicai_vision.robot.messages import Joy
from surgicai_vision.robot.topics import Topic
from surgicai_vision.robot.transport import Transport

KEY = " "
"""The key that is held in the terminal: space."""


@final
class HeldKey:
    """The space bar of this terminal; a context manager.

    A terminal reports no releases: a held key repeats, and counts as held while it does.

    Raises:
        InputError: standard input is not a terminal.
    """

    def __init__(self) -> None:
        if not sys.stdin.isatty():
            raise InputError(
                "The space bar is the dead-man's switch, and standard input is no terminal; give "
                "--dead-man a topic."
            )
        self._descriptor = sys.stdin.fileno()
        self._seen = -math.inf
        self._read = -math.inf

    def __enter__(self) -> Self:
        self._before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        return self

    def __exit__(self, *_: object) -> None:
        termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def age(self) -> float:
        """Return the time since the key was last seen held [s]."""
        now = time.monotonic()
        while select.select([self._descriptor], [], [], 0.0)[0]:
            text = os.read(self._descriptor, 64).decode("utf-8", "ignore")
            if not text:
                break
            if KEY in text:
                self._seen = self._read
        self._read = now
        return now - self._seen


@final
class HeldPedal:
    """A pedal or a gamepad's button: a `sensor_msgs/Joy` whose first button is 1.

    It must be sent repeatedly while held: a sender that has died cannot report a release.

    Args:
        transport: carries the messages.
        topic: where they arrive.
    """

    def __init__(self, transport: Transport, topic: str):
        self._inbox = transport.inbox(Topic(topic, Joy))
        self._seen = -math.inf
        self._read = -math.inf

    def age(self) -> float:
        """Return the time since the button was last seen held [s]."""
        now = time.monotonic()
        for received in self._inbox():
            message = received.message
            if isinstance(message, Joy):
                is_held = message.buttons[:1] == (1,)
                self._seen = self._read if is_held else -math.inf
        self._read = now
        return now - self._seen
