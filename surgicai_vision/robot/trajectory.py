"""Trajectory: how `move_jp` and `move_cp` reach their goal.

All joints start and arrive together, at rest, along the straight line between start and goal in
joint space, with a minimum-jerk time law. The joint that needs longest just reaches its speed limit
on the way. The contract requires synchronised joints within speed limits
(dvrk_simulator_base/trajectory.py, which moves at a constant speed); a start and an end at rest
spare the needle the jerk.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from surgicai_vision.core.errors import InputError

SHORTEST = 1e-9
"""Duration below which there is no motion [s]."""
PEAK = 1.875
"""Ratio of the highest speed of s(u) = 10u³ - 15u⁴ + 6u⁵ to its mean: s'(1/2)."""


@dataclass(frozen=True)
class Sample:
    """A point of a trajectory: positions, velocities, and whether it is the end."""

    position: tuple[float, ...]
    velocity: tuple[float, ...]
    is_end: bool


class Trajectory:
    """A motion from one joint vector to another; see the module's docstring.

    Args:
        start: joints at its beginning [rad, m].
        goal: joints at its end.
        speeds: highest speed of each joint, above 0 [rad/s, m/s].
        began: time of its beginning [s].

    Attributes:
        duration: how long it takes [s].
    """

    def __init__(
        self, start: Sequence[float], goal: Sequence[float], speeds: Sequence[float], began: float
    ):
        if not len(start) == len(goal) == len(speeds):
            raise InputError(
                f"A trajectory from {len(start)} to {len(goal)} joints with {len(speeds)} speeds; "
                "give the same number of each."
            )
        self._start = tuple(start)
        self._way = tuple(b - a for a, b in zip(start, goal, strict=True))
        self._goal = tuple(goal)
        self._began = began
        self.duration = PEAK * max(
            (abs(way) / speed for way, speed in zip(self._way, speeds, strict=True)), default=0.0
        )

    def sample(self, now: float) -> Sample:
        """Return where the joints should be at the time `now` [s]."""
        share = 1.0 if self.duration < SHORTEST else (now - self._began) / self.duration
        if share >= 1.0:
            return Sample(self._goal, (0.0,) * len(self._goal), True)
        u = max(share, 0.0)
        done = u * u * u * (10.0 + u * (6.0 * u - 15.0))
        rate = 30.0 * u * u * (1.0 - u) * (1.0 - u) / self.duration
        position = tuple(a + done * way for a, way in zip(self._start, self._way, strict=True))
        return Sample(position, tuple(rate * way for way in self._way), False)


def is_within(values: Sequence[float], limits: Sequence[tuple[float, float]]) -> bool:
    """Return True if all values are finite and within their lower and upper limits."""
    return all(
        math.isfinite(value) and low <= value <= high
        for value, (low, high) in zip(values, limits, strict=True)
    )
