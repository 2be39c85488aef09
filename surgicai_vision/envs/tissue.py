"""Tissue: what happens in soft tissue during an episode; `scene.tissue` has its forces.

`Simulation.tissue` is a `Tissue` if the scene's tissue is "soft", else None. Others read:

* `bite -> Bite | None`: the needle's present passage, None while it is outside.
* `bites -> tuple[Bite, ...]`: the passages of this episode, the present one last; `BITES` at most,
  the oldest are forgotten.
* `stage`: `OUTSIDE`, `INSIDE` (the skin is pierced and the tip is in), `THROUGH` (the tip is out
  again), `TRAILING` (the needle's base has gone in).
* `tears`: how often the tissue tore in this episode.
* `force_on_needle() -> (3,)`: force of the tissue on the needle in world [N].
* `thread_drawn`: length of thread drawn out of the last exit that it passed [m].
* `passed(pair) -> int`: the value for `TaskState.holes_passed`.
* `passages`, `ridge`, `held_at_skin()`: the same in the phantom's frame, to draw the skin.

Once per control step, before positions are computed for it, `update` checks where the needle is:

* Outside: a tip that points inwards and dents the skin deeper than its puncture force allows goes
  through. The needle's contact with the ridge ends, and the first hold takes the point of the
  needle in the skin. Its friction grows with the embedded length; an advancing tip also cuts.
* Inside: the second hold takes the shaft in the middle of the path that the tip cut, so that the
  shaft cannot swing. A tip that lifts the skin from inside goes through at the force for the way
  out; the second hold then takes the point of the needle there. This can happen on any flank, also
  on that of the entry.
* When the base goes in, the first hold moves to the middle of the remaining path. When the base
  comes out, the bite is done. A needle that is drawn back goes through the same stages in reverse.
* A hold is an elastic spring up to the yield force; beyond it a part of the displacement remains
  (isotropic hardening). At the tear force the tissue tears: the anchor follows until the yield
  force is left, and `tears` is incremented.
* The thread is held where it goes in and where it comes out (`thread_hold`), and slides through
  when the force along it exceeds the friction.

Geometry is in the phantom's frame, in plain floats: the phantom may be shifted and turned about z.
Everything is packed into MuJoCo's user data, so a state restored in the middle of an insertion
continues bit for bit.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.envs.bite import NO_FLANK, SIDES, Bite, Passage
from surgicai_vision.envs.hole_crossing import OUT
from surgicai_vision.envs.needle_hold import NeedleHolds
from surgicai_vision.envs.ridge import NeedleArc, Ridge
from surgicai_vision.envs.thread_hold import ThreadHolds
from surgicai_vision.scene import Scene
from surgicai_vision.scene import tissue as elements
from surgicai_vision.scene.compose import SURFACES, THREAD
from surgicai_vision.scene.holes import PAIRS, SURFACE, HolePair, Point

if TYPE_CHECKING:
    from surgicai_vision.envs.skin import Skin

OUTSIDE, INSIDE, THROUGH, TRAILING = range(4)
"""Stages of the needle's passage; see the module's docstring."""

BITES = 8
"""Passages that are remembered."""
PATH = 100
"""Points of the present passage that are remembered: 50 mm, more than any needle is long."""
SPACING = 0.0005
"""Distance between two points of the path that the tip cut [m]."""
STEEP = 0.5
"""Cosine of the largest angle to the inward normal at which a tip pierces (60°); else it slides."""
OUTWARD = 0.2
"""Cosine of the largest angle to the outward normal at which a tip pierces from inside: 78°."""
SEARCH = 0.005
"""How far from the tip along the arc the skin can be where it is pierced [m]."""
FRONT = 0.0001
"""A tip this near to its furthest advance [m] is cutting."""
SLIDING = 0.97
"""Share of the shaft's sliding force from which it counts as sliding."""
HIGHEST = 0.003
"""How far the tip can lift the skin at most, however little it is pushed [m]."""
LEAVING = 0.0002
"""Embedded length [m] below which the needle is out."""

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
SIZE = 7 + NeedleHolds.SIZE + ThreadHolds.SIZE + 1 + BITES * Passage.SIZE + 1 + 3 * PATH
"""Largest number of values in a packed state; `Simulation` says where they are in the user data."""


class Tissue:
    """The soft tissue of one simulation; see the module's docstring.

    Args:
        scene: a scene with soft tissue.
        model: the simulation's own copy of its model; bits, friction and holds are written to it.
        data: the simulation's.

    Attributes:
        drawn_skin: what draws it, None before the first image (`camera_rig`). All renderers of the
            simulation share it, since it writes to the model's only meshes.
    """

    def __init__(self, scene: Scene, model: mujoco.MjModel, data: mujoco.MjData):
        config = scene.config
        self.forces = elements.FORCES[config.tissue_forces]
        self._model = model
        self._data = data
        self._ridge = Ridge(config.layout)
        self._arc = NeedleArc(self._ridge)
        self._holds = NeedleHolds(model, data, self._ridge, self._arc, self.forces)
        self._thread = ThreadHolds(model, data, self._ridge, config.thread)
        self._free = scene.needle_qpos
        self._needle_geoms = scene.needle_geoms
        self._scratch: mujoco.MjData | None = None
        self.drawn_skin: Skin | None = None
        self._look_up(len(PAIRS[config.layout]))
        self.meet(self._arc.radius, self._arc.tip_angle)
        self.clear()

    def _look_up(self, pieces: int) -> None:
        """Find the elements in the model."""
        model = self._model
        self._phantom = model.body("phantom").id
        self._needle = model.body("needle").id
        numbers = range(1, pieces + 1)
        self._boxes = [
            model.geom(elements.skin_name(side, piece)).id for piece in numbers for side in SIDES
        ]
        crests = [model.geom(elements.crest_skin_name(piece)).id for piece in numbers]
        self._skin = self._boxes + crests
        self._firm = [
            [model.geom(f"phantom_{part}{piece}").id for part in (*SIDES, "crest")]
            for piece in numbers
        ]

    def meet(self, radius: float, tip_angle: float) -> None:
        """Adapt to a randomised model: the phantom's placement and the needle's size and mass.

        Args:
            radius: of the needle's arc [m].
            tip_angle: of its tip [rad].
        """
        model = self._model
        forces = self.forces
        self._arc.radius = radius
        self._arc.tip_angle = tip_angle
        x, y, z = model.body_pos[self._phantom].tolist()
        w, _, _, k = model.body_quat[self._phantom].tolist()
        self._ridge.put((x, y, z), 2.0 * math.atan2(k, w))
        inverse_mass = float(model.body_invweight0[self._needle, 0])
        skin = elements.skin_spring(forces.skin_stiffness, inverse_mass)
        for box in self._boxes:
            model.geom_solref[box], model.geom_solimp[box] = skin
        self._holds.meet()
        self._thread.meet()

    # -- what others read --------------------------------------------------------------------------

    @property
    def bite(self) -> Bite | None:
        """Return the needle's present passage, None while it is outside."""
        return self._shown(self._passages[-1], self._path) if self.stage else None

    @property
    def bites(self) -> tuple[Bite, ...]:
        """Return the passages of this episode, the present one last."""
        present = self.bite
        done = self._passages[:-1] if present else self._passages
        shown = tuple(self._shown(passage, ()) for passage in done)
        return (*shown, present) if present else shown

    def _shown(self, passage: Passage, path: Sequence[Point]) -> Bite:
        """Return a passage in world."""
        is_out = passage.is_out
        return Bite(
            entry=self._ridge.to_world(passage.entry),
            exit=self._ridge.to_world(passage.exit) if is_out else None,
            entry_side=SIDES[passage.entry_flank % 2],
            exit_side=SIDES[passage.exit_flank % 2] if is_out else "",
            entry_piece=passage.entry_flank // 2 + 1,
            exit_piece=passage.exit_flank // 2 + 1 if is_out else 0,
            depth=passage.depth,
            length=passage.length,
            tears=passage.tears,
            is_done=passage.is_done,
            path=tuple(self._ridge.to_world(point) for point in path),
        )

    @property
    def passages(self) -> tuple[Passage, ...]:
        """Return the bites as they are stored, in the phantom's frame; treat as read-only."""
        return tuple(self._passages)

    @property
    def ridge(self) -> Ridge:
        """Return the phantom's frame and surface."""
        return self._ridge

    def held_at_skin(self) -> list[tuple[Point, Point]]:
        """Return where the skin holds the needle, in the phantom's frame [m].

        Each is a point at rest and where the shaft has dragged it to.
        """
        return [
            (self._holds.anchor(index), self._holds.carried(index)) for index in self._skin_holds
        ]

    @property
    def _skin_holds(self) -> tuple[int, ...]:
        """Return the holds that are in the skin, not in the middle of the path."""
        return {OUTSIDE: (), INSIDE: (0,), THROUGH: (0, 1), TRAILING: (1,)}[self.stage]

    def passed(self, pair: HolePair) -> int:
        """Return how many flanks of a stitch the needle passed in the direction of travel.

        0 to 2, and `hole_crossing.OUT` when it has left through the second. Neither the distance to
        the marks nor the piece of the ridge is checked here.
        """
        if not self._passages:
            return 0
        passage = self._passages[-1]
        first = SIDES.index("entry" if pair.entry.tilt < 0.0 else "exit")
        if passage.entry_flank % 2 != first:
            return 0
        is_out = passage.is_out and passage.exit_flank % 2 != first
        if self.stage == OUTSIDE:
            return OUT if is_out else 0
        return 2 if is_out else 1

    def force_on_needle(self) -> NDArray[np.float64]:
        """Return the force of the tissue on the needle in world, (3,) [N].

        It includes the skin's contacts and the two holds. It is computed on separate data, so the
        simulation is not affected.
        """
        model = self._model
        if self._scratch is None:
            self._scratch = mujoco.MjData(model)
            self._vector = np.empty(mujoco.mj_stateSize(model, _STATE))
        scratch = self._scratch
        mujoco.mj_getState(model, self._data, self._vector, _STATE)
        mujoco.mj_setState(model, scratch, self._vector, _STATE)
        mujoco.mj_forward(model, scratch)
        return self._contact_force(scratch) + self.hold_force(scratch)

    def _contact_force(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """Return the force of the phantom's contacts on the needle [N]."""
        force = np.zeros(3)
        wrench = np.empty(6)
        first, last = self._needle_geoms.start, self._needle_geoms.stop
        bodies = self._model.geom_bodyid
        for index, (one, other) in enumerate(data.contact.geom.tolist()):
            is_first = first <= one < last
            if not (is_first or first <= other < last):
                continue
            if bodies[other if is_first else one] == self._phantom:
                mujoco.mj_contactForce(self._model, data, index, wrench)
                # MuJoCo's force is that on the second geom.
                sign = -1.0 if is_first else 1.0
                force += sign * (data.contact[index].frame.reshape(3, 3).T @ wrench[:3])
        return force

    def hold_force(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """Return the force of the two holds on the needle, (3,) [N]; `data` needs its forces."""
        rows = data.efc_type[: data.nefc] == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        held = rows & np.isin(data.efc_id[: data.nefc], self._holds.equalities)
        force: NDArray[np.float64] = data.efc_force[: data.nefc][held].reshape(-1, 3).sum(axis=0)
        return force

    # -- stages ------------------------------------------------------------------------------------

    def clear(self) -> None:
        """Forget everything: the tissue is intact and the needle outside."""
        self.stage = OUTSIDE
        self.tears = 0
        self.thread_drawn = 0.0
        self._passages: list[Passage] = []
        self._path: list[Point] = []
        self._front = 0.0
        self._entry_anchor: Point = elements.HIDDEN
        self._holds.clear()
        self._thread.clear()
        self._write()

    def update(self) -> None:
        """Follow the needle and the thread; call this when positions have just changed."""
        self._arc.read(self._data.qpos[self._free].tolist())
        if self.stage == OUTSIDE:
            self._try_entry()
        else:
            _STAGES[self.stage](self)
            if self.stage != OUTSIDE:
                self._count_tears(self._holds.give_way())
                self._note_skin()
        self._follow_thread()

    def _note_skin(self) -> None:
        """Record where the pierced points lie now."""
        passage = self._passages[-1]
        for index in self._skin_holds:
            if index == 0:
                passage.entry_now = self._holds.anchor(0)
            else:
                passage.exit_now = self._holds.anchor(1)

    def embed(self) -> None:
        """Begin anew with a needle that was put where it is, in the tissue or outside.

        A needle whose arc leads through the tissue counts as having pierced it along that arc, and
        pulls at nothing.
        """
        self.clear()
        self._arc.read(self._data.qpos[self._free].tolist())
        found = self._arc.embedded()
        if found is None:
            return
        into, out_of, start, end = found
        passage = Passage(self._arc.at(start), into)
        self._passages = [passage]
        self._front = self._arc.radius * (end - start)
        steps = int(self._front / SPACING)
        self._path = [
            self._arc.at(start + SPACING / self._arc.radius * step) for step in range(steps + 1)
        ]
        passage.depth = max(-self._ridge.height(point) for point in self._path)
        passage.length = self._front
        self.stage = INSIDE
        self._holds.hold(0, max(start, 0.0), passage.entry)
        self._entry_anchor = passage.entry
        if out_of != NO_FLANK:
            passage.exit = self._arc.at(end)
            passage.exit_flank = out_of
            self.stage = THROUGH
            self._holds.hold(1, end, passage.exit)
        self._write()
        self.update()

    def _try_entry(self) -> None:
        """Pierce the skin where the tip presses hard enough."""
        tip = self._arc.tip
        piece = self._ridge.piece(tip)
        if tip[2] > self._ridge.top or tip[2] < SURFACE or piece < 0:
            return
        dent = self.forces.dent_in
        heights = [self._ridge.over(flank, tip) for flank in (2 * piece, 2 * piece + 1)]
        if max(heights) >= 0.0:
            return
        for flank, height in zip((2 * piece, 2 * piece + 1), heights, strict=True):
            if -elements.THICKNESS < height < -dent and self._arc.towards(flank) < -STEEP:
                angle = self._arc.crossing(flank, self._arc.tip_angle, inward=True)
                if (
                    angle is not None
                    and 0.0 <= (self._arc.tip_angle - angle) * self._arc.radius < SEARCH
                ):
                    self._pierce(flank, angle, -height)
                    return

    def _pierce(self, flank: int, angle: float, depth: float) -> None:
        """Go through the skin of `flank` with the needle's point at `angle` [rad] in it."""
        entry = self._arc.at(angle)
        length = self._arc.radius * (self._arc.tip_angle - angle)
        self._passages.append(Passage(entry, flank, depth=depth, length=length))
        del self._passages[:-BITES]
        self.stage = INSIDE
        self._front = length
        self._path = [entry]
        self._extend_path()
        self._entry_anchor = entry
        self._holds.hold(0, angle, entry)
        self._holds.rub(self.forces.friction * length + self.forces.cutting, 0.0)
        self._write()

    def _go_in(self) -> None:
        """Follow a needle whose tip is inside."""
        forces = self.forces
        passage = self._passages[-1]
        tip = self._arc.tip
        length = self._arc.radius * (self._arc.tip_angle - self._holds.angle(0))
        flank = passage.entry_flank
        if length < LEAVING or (
            self._ridge.over(flank, tip) > LEAVING and self._arc.towards(flank) < OUTWARD
        ):
            self._leave()
            return
        is_cutting = length > self._front - FRONT
        if length > self._front:
            self._front = length
            self._extend_path()
            passage.depth = max(passage.depth, -self._ridge.height(tip))
            passage.length = length
        lifting, height = self._lifted()
        resistance = forces.friction * max(length - height, 0.0)
        if is_cutting:
            resistance += forces.cutting
            if height > 0.0:
                # The skin lets the tip through when the shaft no longer drags the tissue along.
                is_pushed = self._holds.drag(0) > SLIDING * (resistance + forces.puncture_out)
                if (is_pushed or height > HIGHEST) and self._come_out(lifting):
                    return
                resistance += min(forces.skin_stiffness * height, forces.puncture_out)
        self._holds.hold_middle(1, self._path, 0.5 * min(length / self._front, 1.0))
        self._holds.rub(resistance, 0.0)

    def _lifted(self) -> tuple[int, float]:
        """Return the flank that the tip lifts from inside and how far [m], or `NO_FLANK`, 0."""
        tip = self._arc.tip
        first = 2 * self._ridge.nearest_piece(tip)
        for flank in (first, first + 1):
            height = self._ridge.over(flank, tip)
            if height > 0.0 and self._arc.towards(flank) > OUTWARD:
                return flank, height
        return NO_FLANK, 0.0

    def _come_out(self, flank: int) -> bool:
        """Go through the skin from inside; return False if the arc does not cross it."""
        angle = self._arc.crossing(flank, self._arc.tip_angle, inward=False)
        if angle is None or not 0.0 <= (self._arc.tip_angle - angle) * self._arc.radius < SEARCH:
            return False
        passage = self._passages[-1]
        passage.exit = self._arc.at(angle)
        passage.exit_flank = flank
        passage.length = self._arc.radius * (angle - self._holds.angle(0))
        self.stage = THROUGH
        self._holds.hold(1, angle, passage.exit)
        self._write()
        self._go_through()
        return True

    def _go_through(self) -> None:
        """Follow a needle that is in at the entry and out at the exit."""
        start = self._holds.angle(0)
        end = self._holds.angle(1)
        length = self._arc.radius * (end - start)
        if self._arc.radius * (self._arc.tip_angle - end) < LEAVING:
            self._draw_back_in()
            return
        if self._arc.radius * start < LEAVING:
            self.stage = TRAILING
            self._front = max(length, SPACING)
            self._entry_anchor = self._holds.anchor(0)
            self._take_thread(self._entry_anchor, is_exit=False)
            self._trail()
            return
        half = 0.5 * self.forces.friction * max(length, 0.0)
        self._holds.rub(half, half)

    def _draw_back_in(self) -> None:
        """Follow a tip that was drawn back through its exit."""
        passage = self._passages[-1]
        passage.exit = elements.HIDDEN
        passage.exit_flank = NO_FLANK
        self.stage = INSIDE
        self._front = self._arc.radius * (self._arc.tip_angle - self._holds.angle(0))
        self._go_in()

    def _trail(self) -> None:
        """Follow a needle whose base is inside."""
        left = self._arc.radius * self._holds.angle(1)
        if left < LEAVING:
            self._take_thread(self._holds.anchor(1), is_exit=True)
            self._leave()
            return
        if left > self._front + LEAVING:
            self.stage = THROUGH
            self._holds.hold(0, (left - self._front) / self._arc.radius, self._entry_anchor)
            self._thread.drop()
            self._go_through()
            return
        self._holds.hold_middle(0, self._path, 1.0 - 0.5 * left / self._front)
        self._holds.rub(0.0, self.forces.friction * left)

    def _extend_path(self) -> None:
        """Append the tip's path since the last point, at equal distances."""
        path = self._path
        tip = self._arc.tip
        last = path[-1]
        distance = math.dist(last, tip)
        while distance >= SPACING and len(path) < PATH:
            share = SPACING / distance
            last = (
                last[0] + share * (tip[0] - last[0]),
                last[1] + share * (tip[1] - last[1]),
                last[2] + share * (tip[2] - last[2]),
            )
            path.append(last)
            distance -= SPACING

    def _follow_thread(self) -> None:
        """Let the thread move on through the places that hold it."""
        drawn = self._thread.follow()
        if drawn is not None:
            self.thread_drawn = drawn

    def _take_thread(self, anchor: Point, *, is_exit: bool) -> None:
        """Hold the thread behind the needle's base, with half of the bite's friction."""
        friction = 0.5 * self.forces.thread_friction * self._passages[-1].length
        self._thread.take(anchor, friction, is_exit=is_exit)

    def _leave(self) -> None:
        """End the bite: the needle is outside."""
        self._passages[-1].is_done = True
        self.stage = OUTSIDE
        self._path = []
        self._holds.release(0)
        self._holds.release(1)
        self._holds.rub(0.0, 0.0)
        self._write()

    def _count_tears(self, tears: int) -> None:
        """Count tears of the present or last bite."""
        if tears and self._passages:
            self.tears += tears
            self._passages[-1].tears += tears

    def _write(self) -> None:
        """Write to the model what can touch: the needle the skin, and the thread the flanks."""
        bits = self._model.geom_conaffinity
        bits[self._skin] = 0 if self.stage else SURFACES
        pierced = {
            flank // 2
            for passage in self._passages
            for flank in (passage.entry_flank, passage.exit_flank)
            if flank != NO_FLANK
        }
        for piece, geoms in enumerate(self._firm):
            for geom in geoms:
                firm = int(bits[geom]) & ~THREAD
                bits[geom] = firm if piece in pierced else firm | THREAD

    # -- state -------------------------------------------------------------------------------------

    def pack(self) -> list[float]:
        """Return everything that MuJoCo's own state lacks, as at most `SIZE` numbers."""
        values = [
            *(self.stage, self.tears, self.thread_drawn, self._front),
            *self._entry_anchor,
            *self._holds.pack(),
            *self._thread.pack(),
            len(self._passages),
        ]
        for passage in self._passages:
            values += passage.pack()
        values += [0.0] * (Passage.SIZE * (BITES - len(self._passages)))
        values.append(len(self._path))
        for point in self._path:
            values += point
        return values

    def unpack(self, values: Sequence[float]) -> None:
        """Restore what `pack` returned; MuJoCo's state must already be set."""
        self.stage = int(values[0])
        self.tears = int(values[1])
        self.thread_drawn = values[2]
        self._front = values[3]
        self._entry_anchor = _point(values, 4)
        at = 7
        self._holds.unpack(values[at : at + NeedleHolds.SIZE])
        at += NeedleHolds.SIZE
        self._thread.unpack(values[at : at + ThreadHolds.SIZE])
        at += ThreadHolds.SIZE
        count = int(values[at])
        at += 1
        self._passages = [
            Passage.unpack(values[at + index * Passage.SIZE :]) for index in range(count)
        ]
        at += Passage.SIZE * BITES
        self._path = [_point(values, at + 1 + 3 * index) for index in range(int(values[at]))]
        self._write()


def _point(values: Sequence[float], start: int) -> Point:
    return (values[start], values[start + 1], values[start + 2])


_STAGES = {INSIDE: Tissue._go_in, THROUGH: Tissue._go_through, TRAILING: Tissue._trail}
"""Stage → the method that follows the needle in it."""
