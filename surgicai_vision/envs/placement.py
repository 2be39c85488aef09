"""Placement: where the phantom lies in an episode, and which of its hole pairs is sewn.

`Placement(pair, slide, shift, turn)` is one placement; `placed(hole)` and `T_world_phantom` say
where the phantom's parts then are. The phantom turns about the vertical through `PIVOT`, which is
its centre in the scene's own model.

If the pair is drawn, the phantom first slides along the wound by the share `SLIDE` of the distance
from the first pair to the drawn one. Without the slide, pair 4 lies 72 mm beyond pair 1: outside
the image of every camera, and 104 mm from PSM1's start, so that the expert's handoff takes 184 of
its 200 steps. With a slide of two thirds, every pair is in view of the endoscopes and of the
opposite camera for any shift and turn (`tests/envs/test_feasibility.py`), and at most 56 mm away.
What lies on the phantom shifts and turns with it, but does not slide.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.scene.holes import Hole, HolePair, Point
from surgicai_vision.scene.phantom import ORIGIN

PIVOT = (*ORIGIN, 0.0)
"""A point on the axis about which the phantom turns [m, world]; the axis is vertical."""
SLIDE = 2 / 3
"""Share of the drawn pair's distance from the first by which the phantom slides back."""


@dataclass(frozen=True)
class Placement:
    """Where the phantom lies, and what is sewn.

    Attributes:
        pair: index of the hole pair that is sewn, 0 to 3.
        slide: of the phantom along its wound, before the turn [m].
        shift: of the phantom in world x and y, after the turn [m].
        turn: of the phantom about world z [rad].
    """

    pair: int
    slide: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0

    @property
    def is_own(self) -> bool:
        """Return True if the phantom lies where the scene's own model has it."""
        return self.slide == self.turn == 0.0 and self.shift == (0.0, 0.0)

    def point(self, point: Point, slide: float = 0.0) -> Point:
        """Return where a point of the turned and shifted phantom is in world [m].

        Args:
            point: where it is in the scene's own model [m].
            slide: [m]; that of the placement for a part of the phantom, 0 for what lies on it.
        """
        cosine = math.cos(self.turn)
        sine = math.sin(self.turn)
        x = point[0] - PIVOT[0]
        y = point[1] + slide - PIVOT[1]
        return (
            PIVOT[0] + cosine * x - sine * y + self.shift[0],
            PIVOT[1] + sine * x + cosine * y + self.shift[1],
            point[2],
        )

    def placed(self, hole: Hole) -> Hole:
        """Return where a hole is; `hole` is that of the scene's own model."""
        if self.is_own:
            return hole
        centre = self.point(hole.centre, self.slide)
        return dataclasses.replace(hole, centre=centre, turn=hole.turn + self.turn)

    def placed_pair(self, pair: HolePair) -> HolePair:
        """Return where a pair of holes is."""
        return pair if self.is_own else HolePair(self.placed(pair.entry), self.placed(pair.exit))

    @property
    def T_world_phantom(self) -> NDArray[np.float64]:
        """Return the pose (4, 4) of the phantom's body, the identity in the scene's own model."""
        return self._transform(self.slide)

    @property
    def T_world_bed(self) -> NDArray[np.float64]:
        """Return the pose (4, 4) of what lies on the phantom: the phantom's without the slide."""
        return self._transform(0.0)

    def _transform(self, slide: float) -> NDArray[np.float64]:
        pose = np.eye(4)
        if not self.is_own:
            cosine = math.cos(self.turn)
            sine = math.sin(self.turn)
            pose[:2, :2] = [[cosine, -sine], [sine, cosine]]
            pose[:3, 3] = self.point((0.0, 0.0, 0.0), slide)
        return pose
