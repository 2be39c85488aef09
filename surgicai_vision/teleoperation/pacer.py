"""Pacing: ticks at a fixed rate of the wall clock; where drawing takes too long, images are
dropped, never ticks.
"""

import time
from collections.abc import Callable

from surgicai_vision.core import names

BEHIND = 5
"""Ticks that may be caught up; what is lost beyond them is given up, for a hand cannot steer a
burst.
"""
BLIND = 10
"""Ticks after which an image is due even when late: five a second."""


class Pacer:
    """Keeps the time of a loop that ticks and draws.

    Args:
        pace: share of real time; 0.5 is half as fast as life.
        clock: seconds, monotonic.
        sleep: waits so many seconds.
    """

    def __init__(
        self,
        pace: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self._period, self._clock, self._sleep = 1.0 / (names.FPS * pace), clock, sleep
        self._due = clock() + self._period
        self._blind = 0

    def may_draw(self) -> bool:
        """Say whether an image fits in before the next tick is due, or has been missing for too
        long.
        """
        self._blind += 1
        if self._clock() >= self._due and self._blind < BLIND:
            return False
        self._blind = 0
        return True

    def wait(self) -> None:
        """Wait until the next tick is due."""
        now = self._clock()
        if now < self._due:
            self._sleep(self._due - now)
        elif now > self._due + BEHIND * self._period:
            self._due = now
        self._due += self._period
