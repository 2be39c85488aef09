"""Skin: how an env's soft tissue looks in its present state.

It is a function of the state alone, so a restored state looks as it did. `Skin.follow` reads

* what presses: the needle's tip and the shaft behind it before they pierce, and the jaws' pads on
  the flat tissue, which may dent it by `phantom.DENT`;
* a tip that lifts the skin from inside before it comes out;
* the places where the skin holds the needle and follows it;
* the wounds of all bites: round where the needle went through, and as long as the tissue tore.

Lengths are rounded (`PLACE`, `WAY`), so that the meshes are rewritten only for visible changes.
"""

import math

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.envs.bite import Passage
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.tissue import INSIDE, OUTSIDE, Tissue
from surgicai_vision.scene.holes import SURFACE, Point
from surgicai_vision.scene.needle import BODY_RADIUS, TIP_RADIUS
from surgicai_vision.scene.phantom import DENT, ORIGIN, SIZE
from surgicai_vision.scene.visual.skin_state import Pull, SkinState, Wound
from surgicai_vision.scene.visual.soft_skin import SoftSkin

PLACE = 3e-4
"""Places are rounded to this [m]."""
WAY = 1.2e-4
"""Displacements are rounded to this [m]."""
TIP_REACH = 0.0012
"""Reach of the dent about a needle [m]: about as deep as wide, like skin under a point."""
LIFT_REACH = 0.0009
"""Reach of the skin that a tip lifts from inside [m]."""
HOLD_REACH = 0.0015
"""Reach of the skin that follows the needle [m]."""
JAW_REACH = 0.0022
"""Reach of the dent about a corner of a jaw's pad [m]: half a pad is 1.5 mm wide."""
SHAFT = (0.0, 0.08, 0.16, 0.24, 0.4, 0.6, 0.8)
"""Points of the needle that can press, measured from the tip in shares of its arc."""
AHEAD = 0.0003
"""How far ahead of a tip coming from inside the skin begins to rise [m]."""
PRESSING = 6
"""Most dents that are drawn at once, the deepest ones."""
CORNERS = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 0.0, 1.0)])
"""Points of a jaw's pad, in units of half its sides."""


class Skin:
    """The skin of one simulation with soft tissue; `FrameRenderer` shows it.

    Args:
        simulation: the env's.
        tissue: its soft tissue.
    """

    def __init__(self, simulation: Simulation, tissue: Tissue):
        self._simulation = simulation
        self._tissue = tissue
        self._drawn = SoftSkin(simulation.model, simulation.scene.config.layout)
        self.meshes = self._drawn.meshes
        self._pads = [pad for arm in names.ARMS for pad in simulation.scene.arms[arm].pads]

    def follow(self) -> tuple[int, ...]:
        """Write the meshes of the present state into the model and return their versions."""
        self._drawn.shape(self.state())
        return self._drawn.versions

    def state(self) -> SkinState:
        """Return what the skin shows now."""
        wounds = [wound for passage in self._tissue.passages for wound in _wounds_of(passage)]
        pressed = [*self._needle_dents(), *self._jaw_dents()]
        pressed.sort(key=lambda pull: -math.hypot(*pull.way))
        pulls = [*self._held(), *self._lifted(), *pressed[:PRESSING]]
        return SkinState(
            self._simulation.pair_index,
            tuple(_rounded(pull) for pull in pulls),
            tuple(wounds),
        )

    def _point(self, angle: float) -> Point:
        """Return the needle's point at an angle [rad] in the phantom's frame [m]."""
        return self._tissue.ridge.to_phantom(self._simulation.needle_point(angle))

    def _held(self) -> list[Pull]:
        """Return where the skin follows the needle that it holds."""
        pulls = []
        for anchor, carried in self._tissue.held_at_skin():
            x, y, z = (now - rest for now, rest in zip(carried, anchor, strict=True))
            pulls.append(Pull(anchor, (x, y, z), HOLD_REACH))
        return pulls

    def _lifted(self) -> list[Pull]:
        """Return where the tip lifts the skin from inside."""
        if self._tissue.stage != INSIDE:
            return []
        tip = self._point(self._simulation.tip_angle)
        height, normal = self._surface(tip)
        if not 0.0 < height + AHEAD < DENT:
            return []
        return [_along(tip, height, normal, height + AHEAD, LIFT_REACH)]

    def _needle_dents(self) -> list[Pull]:
        """Return where a needle outside presses on the ridge."""
        if self._tissue.stage != OUTSIDE:
            return []
        pulls = []
        for share in SHAFT:
            point = self._point((1.0 - share) * self._simulation.tip_angle)
            height, normal = self._surface(point)
            thickness = BODY_RADIUS if share else TIP_RADIUS
            if normal[2] < 1.0 and -DENT < height < thickness - WAY:
                pulls.append(_along(point, height, normal, height - thickness, TIP_REACH))
        return pulls

    def _jaw_dents(self) -> list[Pull]:
        """Return where the jaws press on the tissue: the deepest points of each pad."""
        simulation = self._simulation
        pulls = []
        for pad in self._pads:
            centre = simulation.data.geom_xpos[pad]
            if centre[2] > SURFACE + 3 * DENT:
                continue
            half = simulation.model.geom_size[pad]
            turn = simulation.data.geom_xmat[pad].reshape(3, 3)
            corners = centre + (CORNERS * half) @ turn.T
            found = []
            for x, y, z in corners.tolist():
                point = self._tissue.ridge.to_phantom((x, y, z))
                height, normal = self._surface(point)
                if height < -WAY and _is_over(point):
                    found.append(_along(point, height, normal, max(height, -2 * DENT), JAW_REACH))
            found.sort(key=lambda pull: -math.hypot(*pull.way))
            pulls += found[:3]
        return pulls

    def _surface(self, point: Point) -> tuple[float, Point]:
        """Return the height of a point over the whole skin [m] and the skin's normal there."""
        ridge = self._tissue.ridge
        flat = point[2] - SURFACE
        if ridge.piece(point) < 0:
            return flat, (0.0, 0.0, 1.0)
        first = 2 * ridge.nearest_piece(point)
        heights = (ridge.over(first, point), ridge.over(first + 1, point))
        over = max(heights)
        if over >= 0.0 and flat < over:
            return flat, (0.0, 0.0, 1.0)
        return over, _upright(ridge.normal(first + heights.index(over)))


def _upright(normal: tuple[float, float]) -> Point:
    return (normal[0], 0.0, normal[1])


def _is_over(point: Point) -> bool:
    """Return True if a point is over the phantom, not beside it."""
    return abs(point[0] - ORIGIN[0]) < SIZE[0] / 2 and abs(point[1] - ORIGIN[1]) < SIZE[1] / 2


def _along(point: Point, height: float, normal: Point, way: float, reach: float) -> Pull:
    """Return the pull that moves the skin below or above a point by `way` along its normal."""
    x, y, z = (p - height * n for p, n in zip(point, normal, strict=True))
    u, v, w = (way * n for n in normal)
    return Pull((x, y, z), (u, v, w), reach)


def _wounds_of(passage: Passage) -> list[Wound]:
    """Return the wounds of a bite; where the skin tore, they are as long as it gave way."""
    is_torn = passage.tears > 0
    wounds = [Wound(passage.entry if is_torn else passage.entry_now, passage.entry_now)]
    if passage.is_out:
        wounds.append(Wound(passage.exit if is_torn else passage.exit_now, passage.exit_now))
    return wounds


def _rounded(pull: Pull) -> Pull:
    """Return a pull rounded to what can be seen."""
    x, y, z = (round(value / PLACE) * PLACE for value in pull.place)
    u, v, w = (round(value / WAY) * WAY for value in pull.way)
    return Pull((x, y, z), (u, v, w), pull.reach)
