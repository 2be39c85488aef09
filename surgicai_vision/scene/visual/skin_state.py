"""Skin state: what soft skin shows, as plain numbers in the phantom's frame.

* pulls: places of the skin that are displaced: inwards by a needle or jaws that press, outwards by
  a tip that lifts it from inside, sideways by a needle that is held there. The skin between follows
  a bell curve with the pull's reach.
* wounds: dark spots where it was pierced, longer where it tore. They stay.
* which pair is to be sewn: its marks are larger and darker.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.scene.holes import Point

Array = NDArray[np.float64]


LEAST = 1e-4
"""Smallest weight of a pull that counts: beyond three reaches nothing moves."""


@dataclass(frozen=True)
class Pull:
    """A place of the skin that is displaced.

    Attributes:
        place: on the undeformed skin [m].
        way: displacement from there [m].
        reach: of the bell around it [m]: at this distance the skin follows by 1 / e.
    """

    place: Point
    way: Point
    reach: float


@dataclass(frozen=True)
class Wound:
    """A wound from `start` to `end` on the undeformed skin [m]; of a puncture they are the same."""

    start: Point
    end: Point


@dataclass(frozen=True)
class SkinState:
    """What the skin shows; see the module's docstring. `pair` is the index of the pair to sew."""

    pair: int = 0
    pulls: tuple[Pull, ...] = ()
    wounds: tuple[Wound, ...] = ()


def displaced(points: Array, pulls: tuple[Pull, ...]) -> Array:
    """Return points displaced by the pulls.

    A single pull moves its place all the way. Of several near each other the stronger prevails:
    each has a weight w, and the sum of w² × way is divided by the sum of w.
    """
    if not pulls:
        return points
    total = np.full(len(points), 1e-12)
    moved = np.zeros_like(points)
    for pull in pulls:
        square = ((points - pull.place) ** 2).sum(axis=1)
        weight = np.exp(-square / pull.reach**2)
        weight[weight < LEAST] = 0.0
        total += weight
        moved += (weight**2)[:, None] * pull.way
    result: Array = points + moved / total[:, None]
    return result
