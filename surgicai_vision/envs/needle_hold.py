"""Needle hold: soft tissue holds the needle's shaft at up to two places.

Each hold ties a carrier, a point that slides along the needle's arc with friction, to an anchor in
the tissue. A hold is an elastic spring; its anchor gives way across the shaft as defined by
`TissueForces.give_way`. One of the two can hold the middle of a path: its anchor then moves with
the path and keeps the displacement by which it has given way.
"""

import math
from collections.abc import Sequence
from typing import ClassVar

import mujoco

from surgicai_vision.envs.ridge import NeedleArc, Ridge
from surgicai_vision.scene import tissue as elements
from surgicai_vision.scene.holes import Point

NEITHER = -1
"""Neither hold is at the middle of a path."""
SHORTEST = 4
"""Fewest points of a path whose middle can be held."""


class NeedleHolds:
    """The two holds of one simulation's needle.

    Args:
        model: the simulation's own copy of its model.
        data: the simulation's.
        ridge: the phantom's frame.
        arc: the needle in it.
        forces: how the tissue resists.
    """

    SIZE: ClassVar[int] = 14
    """Number of values in the packed holds."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        ridge: Ridge,
        arc: NeedleArc,
        forces: elements.TissueForces,
    ):
        self._model = model
        self._data = data
        self._ridge = ridge
        self._arc = arc
        self._forces = forces
        joints = [model.joint(f"carrier_{index}") for index in range(2)]
        self._hinge = [int(joint.qposadr[0]) for joint in joints]
        self._dof = [int(joint.dofadr[0]) for joint in joints]
        self._site = [model.site(f"carrier_{index}").id for index in range(2)]
        self._carrier = [model.body(f"carrier_{index}").id for index in range(2)]
        self._mocap = [int(model.body(f"hold_{index}").mocapid[0]) for index in range(2)]
        self.equalities = [model.equality(f"hold_{index}").id for index in range(2)]

    def meet(self) -> None:
        """Adapt to a randomised model: the needle's radius and mass."""
        model = self._model
        for site, body, equality in zip(self._site, self._carrier, self.equalities, strict=True):
            model.site_pos[site] = (-self._arc.radius, 0.0, 0.0)
            inverse_mass = float(model.body_invweight0[body, 0])
            spring = elements.spring(self._forces.lateral_stiffness, inverse_mass)
            model.eq_solref[equality], model.eq_solimp[equality] = spring

    def clear(self) -> None:
        """Hold nothing."""
        self._anchors: list[Point] = [elements.HIDDEN, elements.HIDDEN]
        self._yielded = [0.0, 0.0]
        self._middle = NEITHER
        self._given: Point = (0.0, 0.0, 0.0)
        for index in range(2):
            self.release(index)
        self.rub(0.0, 0.0)

    def angle(self, index: int) -> float:
        """Return the angle of the needle's point that passes a hold [rad].

        This is not the carrier's angle: by friction the shaft drags the tissue along before it
        slides.
        """
        return self._arc.nearest(self._anchors[index])

    def drag(self, index: int) -> float:
        """Return the force with which the shaft drags the tissue along, towards the tip [N]."""
        carrier: float = self._data.qpos.item(self._hinge[index])
        way = self._arc.radius * (carrier - self.angle(index))
        return self._forces.lateral_stiffness * way

    def carried(self, index: int) -> Point:
        """Return where the shaft has dragged the tissue to, in the phantom's frame [m]."""
        x, y, z = self._data.site_xpos[self._site[index]].tolist()
        return self._ridge.to_phantom((x, y, z))

    def anchor(self, index: int) -> Point:
        """Return where a hold is anchored, in the phantom's frame [m]."""
        return self._anchors[index]

    def hold(self, index: int, angle: float, anchor: Point) -> None:
        """Hold the needle's point at `angle` [rad] at an anchor that has not given way yet."""
        data = self._data
        data.qpos[self._hinge[index]] = angle
        data.qvel[self._dof[index]] = 0.0
        data.eq_active[self.equalities[index]] = 1
        self._yielded[index] = 0.0
        if self._middle == index:
            self._middle = NEITHER
        self._move(index, anchor)

    def hold_middle(self, index: int, path: Sequence[Point], share: float) -> None:
        """Hold the shaft at a share of a path in the phantom's frame.

        A path that is too short for this is not held.
        """
        if len(path) < SHORTEST:
            self.release(index)
            return
        place = share * (len(path) - 1)
        first = min(int(place), len(path) - 2)
        part = place - first
        x, y, z = (a + part * (b - a) for a, b in zip(path[first], path[first + 1], strict=True))
        if self._middle != index:
            self.hold(index, self._arc.nearest((x, y, z)), (x, y, z))
            self._middle = index
            self._given = (0.0, 0.0, 0.0)
            return
        dx, dy, dz = self._given
        self._move(index, (x + dx, y + dy, z + dz))

    def _move(self, index: int, anchor: Point) -> None:
        self._anchors[index] = anchor
        self._data.mocap_pos[self._mocap[index]] = self._ridge.to_world(anchor)

    def release(self, index: int) -> None:
        """Let the needle go."""
        self._data.eq_active[self.equalities[index]] = 0
        if self._middle == index:
            self._middle = NEITHER
        self._anchors[index] = elements.HIDDEN
        self._data.mocap_pos[self._mocap[index]] = elements.HIDDEN

    def rub(self, first: float, second: float) -> None:
        """Set the friction along the arc at the two holds [N]."""
        self._friction = (first, second)
        friction = self._model.dof_frictionloss
        friction[self._dof[0]] = first * self._arc.radius
        friction[self._dof[1]] = second * self._arc.radius

    def give_way(self) -> int:
        """Let the anchors give way to the shaft; return how often the tissue tore."""
        tears = 0
        for index in range(2):
            if not self._data.eq_active[self.equalities[index]]:
                continue
            ax, ay, az = anchor = self._anchors[index]
            x, y, z = held = self._arc.at(self.angle(index))
            share, self._yielded[index], is_torn = self._forces.give_way(
                math.dist(anchor, held), self._yielded[index]
            )
            if share > 0.0:
                dx = share * (x - ax)
                dy = share * (y - ay)
                dz = share * (z - az)
                if self._middle == index:
                    gx, gy, gz = self._given
                    self._given = (gx + dx, gy + dy, gz + dz)
                self._move(index, (ax + dx, ay + dy, az + dz))
            tears += is_torn
        return tears

    def pack(self) -> list[float]:
        """Return what MuJoCo's own state does not contain, as `SIZE` numbers."""
        return [
            *self._anchors[0],
            *self._anchors[1],
            *self._yielded,
            self._middle,
            *self._given,
            *self._friction,
        ]

    def unpack(self, values: Sequence[float]) -> None:
        """Restore what `pack` returned; MuJoCo's state must already be set."""
        self._anchors = [
            (values[0], values[1], values[2]),
            (values[3], values[4], values[5]),
        ]
        self._yielded = [values[6], values[7]]
        self._middle = int(values[8])
        self._given = (values[9], values[10], values[11])
        self.rub(values[12], values[13])
