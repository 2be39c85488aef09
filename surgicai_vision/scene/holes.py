"""Holes: where the stitch goes in and out of each phantom layout.

A hole's frame has +z along the outward normal of its flank and +y along the wound (world y, turned
with the phantom); x runs up the flank at the entry and down it at the exit. World frame, metres.

Sources: layout `simple` holds the entry and exit poses of SurgicAI's phantom (opening about 3.8 mm
square). `3dmed` and `3dmed_straight` keep the gaps and tilts of the new surgical robotics
challenge; their places along the wound are ours. The insertion path through `simple` is derived in
`envs.geometry`.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

OPENING = 0.0038
"""Side of the square opening [m]."""
SURFACE = 0.07126
"""Height of the phantom's flat tissue in world [m]: the needle's home height less half its
thickness.
"""


Point = tuple[float, float, float]


@dataclass(frozen=True)
class Hole:
    """One hole.

    Attributes:
        centre: [m, world].
        tilt: of its outward normal about the wound's direction [rad].
        turn: of the phantom about world z [rad].
    """

    centre: Point
    tilt: float
    turn: float = 0.0

    @functools.cached_property
    def axes(self) -> tuple[Point, Point, Point]:
        """Return the hole's x, y and z axes in world; z is the outward normal."""
        cosine = math.cos(self.tilt)
        sine = math.sin(self.tilt)
        along = math.cos(self.turn)
        across = math.sin(self.turn)
        return (
            (along * cosine, across * cosine, -sine),
            (-across, along, 0.0),
            (along * sine, across * sine, cosine),
        )

    @property
    def normal(self) -> Point:
        """Return the outward normal in world."""
        return self.axes[2]

    def height(self, point: Point) -> float:
        """Return the signed height [m] of a world point above the hole's plane."""
        x, y, z = self.centre
        a, b, c = self.axes[2]
        return a * (point[0] - x) + b * (point[1] - y) + c * (point[2] - z)

    def local(self, point: Point) -> Point:
        """Return a world point in the hole's frame [m]."""
        x, y, z = self.centre
        dx = point[0] - x
        dy = point[1] - y
        dz = point[2] - z
        first, second, third = self.axes
        return (
            first[0] * dx + first[1] * dy + first[2] * dz,
            second[0] * dx + second[1] * dy,
            third[0] * dx + third[1] * dy + third[2] * dz,
        )

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Return R_world_hole, shape (3, 3)."""
        return np.array(self.axes).T

    @property
    def pose(self) -> NDArray[np.float64]:
        """Return T_world_hole, shape (4, 4)."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotation
        pose[:3, 3] = self.centre
        return pose


@dataclass(frozen=True)
class HolePair:
    """The entry and the exit of one stitch."""

    entry: Hole
    exit: Hole

    @property
    def gap(self) -> float:
        """Return the distance from entry to exit [m]."""
        return math.dist(self.entry.centre, self.exit.centre)


def _simple() -> tuple[HolePair, ...]:
    entries = ((-3.740, 44.189), (-4.316, 20.691), (-3.337, -2.032), (-4.394, -27.678))
    tilt = 0.8053
    return tuple(
        HolePair(
            Hole((x / 1e3, y / 1e3, 0.075004), -tilt), Hole((0.004078, y / 1e3, 0.074860), tilt)
        )
        for x, y in entries
    )


def _symmetric(
    gaps: tuple[float, ...], tilt: float, bow: tuple[float, ...]
) -> tuple[HolePair, ...]:
    """Return pairs about x = bow[i] with the given gaps [mm]; y as in `simple`."""
    rows = (44.189, 20.691, -2.032, -27.678)
    return tuple(
        HolePair(
            Hole(((x - gap / 2) / 1e3, y / 1e3, 0.0750), -tilt),
            Hole(((x + gap / 2) / 1e3, y / 1e3, 0.0750), tilt),
        )
        for gap, x, y in zip(gaps, bow, rows, strict=True)
    )


PAIRS: dict[str, tuple[HolePair, ...]] = {
    "simple": _simple(),
    "3dmed": _symmetric((13.1, 14.1, 13.2, 12.2), 0.9457, (0.0, 1.2, 1.2, 0.0)),
    "3dmed_straight": _symmetric((10.0, 9.8, 10.1, 10.9), 1.25, (0.0, 0.0, 0.0, 0.0)),
}
"""Layout → its four hole pairs."""
