"""Dead-man's switch: what a person must hold for anything to be sent.

Each says for how long it has not been seen held; `robot.guards.DEAD_MAN_S` is what that may be.
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

    A terminal knows no releases: a held key repeats, and counts while it does.

    Raises:
        InputError: standard input is no terminal.
    """

    def __init__(self) -> None:
        if not sys.stdin.isatty():
            raise InputError(
                "The space bar is the dead-man's switch, and standard input is no terminal; give "
                "--dead-man a topic."
            )
        self._descriptor = sys.stdin.fileno()
        self._seen = -math.inf

    def __enter__(self) -> Self:
        self._before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        return self

    def __exit__(self, *_: object) -> None:
        termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def age(self) -> float:
        """Return for how long the key has not been seen held [s]."""
        while select.select([self._descriptor], [], [], 0.0)[0]:
            text = os.read(self._descriptor, 64).decode("utf-8", "ignore")
            if not text:
                break
            if KEY in text:
                self._seen = time.monotonic()
        return time.monotonic() - self._seen


@final
class HeldPedal:
    """A pedal or a gamepad's button: a `sensor_msgs/Joy` whose first button is 1.

    It must be sent anew while it is held: of a sender that has died nobody knows what it held.

    Args:
        transport: carries the messages.
        topic: where they come.
    """

    def __init__(self, transport: Transport, topic: str):
        self._inbox = transport.inbox(Topic(topic, Joy))
        self._seen = -math.inf

    def age(self) -> float:
        """Return for how long the button has not been seen held [s]."""
        for received in self._inbox():
            message = received.message
            if isinstance(message, Joy):
                is_held = message.buttons[:1] == (1,)
                self._seen = time.monotonic() if is_held else -math.inf
        return time.monotonic() - self._seen
