"""Holes: where the stitch goes in and out of each phantom layout.

A hole's frame has +z along the outward normal of its flank and +y along the wound (world y); x runs
up the flank at the entry and down it at the exit. World frame, metres.

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


@dataclass(frozen=True)
class Hole:
    """One hole: its centre [m] and its outward normal's tilt about world y [rad]."""

    centre: tuple[float, float, float]
    tilt: float

    @functools.cached_property
    def slope(self) -> tuple[float, float]:
        """Return cosine and sine of the tilt."""
        return math.cos(self.tilt), math.sin(self.tilt)

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Return R_world_hole, shape (3, 3)."""
        cosine = math.cos(self.tilt)
        sine = math.sin(self.tilt)
        return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])

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
