"""Pacer: ticks at a fixed rate of the wall clock; slow rendering costs images, never ticks."""

import time
from collections.abc import Callable

from surgicai_vision.core import names

MAX_CATCH_UP_TICKS = 5
"""Ticks that may be caught up; further ones are dropped, since nobody can steer a burst."""
MAX_TICKS_WITHOUT_IMAGE = 10
"""Ticks after which an image is due even when late: five per second at real time."""

MEMORY_TICKS = 25
"""Ticks over which the achieved pace is averaged."""


class Pacer:
    """Keeps the time of a loop that ticks and draws.

    Args:
        pace: share of real time; 0.5 is half speed.
        clock: returns monotonic seconds.
        sleep: waits the given number of seconds.
        patience: ticks after which an image is due even when late.
    """

    def __init__(
        self,
        pace: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        patience: int = MAX_TICKS_WITHOUT_IMAGE,
    ):
        self._period = 1.0 / (names.FPS * pace)
        self._patience = patience
        self._clock = clock
        self._sleep = sleep
        self._due = clock() + self._period
        self._last = clock()
        self._length = self._period
        self._ticks_without_image = 0

    def set_pace(self, pace: float) -> None:
        """Tick at another share of real time from the next tick on."""
        self._period = 1.0 / (names.FPS * pace)

    def can_draw(self) -> bool:
        """Return True if there is time for an image, or the last one is too long ago."""
        self._ticks_without_image += 1
        is_late = self._clock() >= self._due
        if is_late and self._ticks_without_image < self._patience:
            return False
        self._ticks_without_image = 0
        return True

    def wait(self) -> None:
        """Wait until the next tick is due."""
        now = self._clock()
        if now < self._due:
            self._sleep(self._due - now)
        elif now > self._due + MAX_CATCH_UP_TICKS * self._period:
            self._due = now
        self._due += self._period
        ended = self._clock()
        self._length += (ended - self._last - self._length) / MEMORY_TICKS
        self._last = ended

    @property
    def reached(self) -> float:
        """Return the share of real time that the last ticks achieved."""
        return 1.0 / (names.FPS * max(self._length, 1e-6))
