"""Tissue: what happens in soft tissue during an episode; `scene.tissue` has its forces.

`Simulation.tissue` is a `Tissue` where the scene's tissue is "soft", else None. What others read:

* `bite -> Bite | None`: the needle's present passage, None while it is outside.
* `bites -> tuple[Bite, ...]`: the passages of this episode, the present one last; `BITES` at most,
  the oldest are forgotten.
* `stage`: `OUTSIDE`, `INSIDE` (the skin is pierced and the tip is in), `THROUGH` (the tip is out
  again), `TRAILING` (the needle's base has gone in).
* `tears`: how often the tissue tore in this episode.
* `force_on_needle() -> (3,)`: force of the tissue on the needle in world [N].
* `thread_drawn`: thread that was drawn out of the last bite's exit [m].
* `passed(pair) -> int`: what `TaskState.holes_passed` is.

Once a control step, before positions are computed for it, `update` looks where the needle is:

* Outside, a tip that dents the skin deeper than its puncture force allows, pointing inwards, goes
  through: the needle's contact with the ridge ends, and the first hold takes the needle's point in
  the skin. Its friction grows with the embedded length; a tip that advances also cuts.
* Inside, the second hold takes the shaft in the middle of the way the tip cut, so that the shaft
  cannot swing. A tip that lifts the skin from inside goes through at the force for the way out: the
  second hold takes the needle's point there. Any flank will do, the one of the entry too.
* When the base goes in, the first hold moves to the middle of the way that is left. When it comes
  out the bite is done. A needle that is drawn back goes through the same stages in reverse.
* A hold is an elastic spring up to the yield force; beyond it a part of the displacement stays
  (isotropic hardening). At the tear force the tissue tears: the anchor follows until the yield
  force is left, and `tears` counts.
* The thread is held where it goes in, and where it comes out, by holds whose place on the thread
  slides when the force along it exceeds the friction.

Geometry is in the phantom's frame, in plain floats: the phantom may be shifted and turned about z.
Everything is packed into MuJoCo's user data, so a state restored in the middle of an insertion goes
on bit for bit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.envs.hole_crossing import OUT
from surgicai_vision.scene import Scene, needle, phantom, thread
from surgicai_vision.scene import tissue as elements
from surgicai_vision.scene.compose import SURFACES, THREAD
from surgicai_vision.scene.holes import PAIRS, SURFACE, HolePair, Point

OUTSIDE, INSIDE, THROUGH, TRAILING = range(4)
"""Stages of the needle's passage; see the module's docstring."""
SIDES = ("entry", "exit")
"""The two flanks of the ridge, by the holes that the layouts have there."""
NO_FLANK = -1

BITES = 8
"""Passages that are remembered."""
PATH = 100
"""Points of the present passage that are remembered: 50 mm, more than any needle is long."""
SPACING = 0.0005
"""Between two points of the way the tip cut [m]."""
STEEP = 0.5
"""Cosine of the angle to the inward normal up to which a tip pierces: 60°; flatter it slides."""
OUTWARD = 0.2
"""Cosine of the angle to the outward normal up to which a tip pierces from inside: 78°."""
DEEPEST = elements.THICKNESS
"""A tip deeper than this [m] did not come through the skin."""
SEARCH = 0.005
"""How far from the tip along the arc the skin can be where it is pierced [m]."""
FRONT = 0.0001
"""A tip that is this near to its furthest way [m] is cutting."""
LEAVING = 0.0002
"""Embedded length [m] below which the needle is out."""
EMBEDDED = 0.0005
"""Depth of the tip [m] from which a needle that is put somewhere is inside the tissue."""
BEHIND = math.radians(60.0)
"""How far the arc is continued beyond the needle's base to find where it went in [rad]."""

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


@dataclass(frozen=True)
class Bite:
    """One passage of the needle through the tissue, in world, at the present place of the phantom.

    Attributes:
        entry: where it went in, on the undeformed skin [m].
        exit: where it came out [m]; None before, and of a needle that was drawn back.
        entry_side: the flank it went in through, "entry" or "exit".
        exit_side: the flank it came out through; "" before.
        entry_piece: piece of the ridge at the entry, 1 to 4: that of the hole pair there.
        exit_piece: the same of the exit; 0 before.
        depth: deepest place of the tip under the nearer flank so far [m].
        length: length of the way that the tip cut [m].
        tears: how often the tissue tore in it.
        is_done: the needle has left it.
        path: points of the tip's way through the tissue [m]; of the present passage alone.
    """

    entry: Point
    exit: Point | None
    entry_side: str
    exit_side: str
    entry_piece: int
    exit_piece: int
    depth: float
    length: float
    tears: int
    is_done: bool
    path: tuple[Point, ...] = ()


@dataclass
class _Passage:
    """A bite as it is kept: in the phantom's frame, flanks by their index."""

    entry: Point
    exit: Point
    entry_flank: int
    exit_flank: int
    depth: float
    length: float
    tears: int
    is_done: bool

    SIZE = 12

    def pack(self) -> list[float]:
        """Return the passage as `SIZE` numbers."""
        return [
            *self.entry,
            *self.exit,
            self.entry_flank,
            self.exit_flank,
            self.depth,
            self.length,
            self.tears,
            self.is_done,
        ]

    @classmethod
    def unpack(cls, values: Sequence[float]) -> "_Passage":
        """Return the passage of `SIZE` numbers."""
        return cls(
            entry=(values[0], values[1], values[2]),
            exit=(values[3], values[4], values[5]),
            entry_flank=int(values[6]),
            exit_flank=int(values[7]),
            depth=values[8],
            length=values[9],
            tears=int(values[10]),
            is_done=bool(values[11]),
        )


class _Flank(NamedTuple):
    """The plane of one flank in the phantom's frame: height = nx·x + nz·z - level."""

    nx: float
    nz: float
    level: float


@dataclass
class _ThreadHold:
    """A place that holds the thread.

    Attributes:
        segment: the capsule it holds, NO_FLANK where it holds none.
        offset: from that capsule's start [m].
        anchor: in the phantom's frame [m].
        yielded: displacement that stayed [m].
        is_exit: it is a bite's exit.
    """

    segment: int = NO_FLANK
    offset: float = 0.0
    anchor: Point = elements.HIDDEN
    yielded: float = 0.0
    is_exit: bool = False

    SIZE = 7

    def pack(self) -> list[float]:
        """Return the hold as `SIZE` numbers."""
        return [self.segment, self.offset, *self.anchor, self.yielded, self.is_exit]

    @classmethod
    def unpack(cls, values: Sequence[float]) -> "_ThreadHold":
        """Return the hold of `SIZE` numbers."""
        return cls(
            segment=int(values[0]),
            offset=values[1],
            anchor=(values[2], values[3], values[4]),
            yielded=values[5],
            is_exit=bool(values[6]),
        )


_HEAD = 20
SIZE = _HEAD + 1 + BITES * _Passage.SIZE + elements.THREAD_HOLDS * _ThreadHold.SIZE + 1 + 3 * PATH
"""Numbers of a packed state; `Simulation` says where they stand in the user data."""


class Tissue:
    """The soft tissue of one simulation; see the module's docstring.

    Args:
        scene: a scene with soft tissue.
        model: the simulation's own copy of its model; bits, friction and holds are written to it.
        data: the simulation's.
    """

    def __init__(self, scene: Scene, model: mujoco.MjModel, data: mujoco.MjData):
        config = scene.config
        self.forces = elements.FORCES[config.tissue_forces]
        self._model = model
        self._data = data
        self._pairs = PAIRS[config.layout]
        self._edges = phantom.piece_edges(self._pairs)
        self._flanks = [
            _flank(hole.centre, hole.tilt)
            for pair in self._pairs
            for hole in (pair.entry, pair.exit)
        ]
        self._top = max(
            pair.entry.centre[2] + pair.gap * abs(math.tan(pair.entry.tilt)) for pair in self._pairs
        )
        self._free = scene.needle_qpos.start
        self._needle_geoms = scene.needle_geoms
        self._phantom_id = model.body("phantom").id
        self._scratch: mujoco.MjData | None = None
        self._look_up(config.thread)
        self.meet(needle.RADIUS, needle.TIP_ANGLE)
        self.clear()

    def _look_up(self, segments: int) -> None:
        """Find the elements in the model."""
        model = self._model
        joints = [model.joint(f"carrier_{index}") for index in range(2)]
        self._hinge = [int(joint.qposadr[0]) for joint in joints]
        self._dof = [int(joint.dofadr[0]) for joint in joints]
        self._site = [model.site(f"carrier_{index}").id for index in range(2)]
        self._carrier = [model.body(f"carrier_{index}").id for index in range(2)]
        self._equality = [model.equality(f"hold_{index}").id for index in range(2)]
        self._mocap = [int(model.body(f"hold_{index}").mocapid[0]) for index in range(2)]
        pieces = range(1, len(self._pairs) + 1)
        self._skin = [
            model.geom(name).id
            for piece in pieces
            for name in (
                elements.skin_name("entry", piece),
                elements.skin_name("exit", piece),
                elements.crest_skin_name(piece),
            )
        ]
        self._boxes = [geom for geom in self._skin if "crest" not in model.geom(geom).name]
        self._firm = [
            [
                model.geom(name).id
                for name in (
                    f"phantom_entry{piece}",
                    f"phantom_exit{piece}",
                    f"phantom_crest{piece}",
                )
            ]
            for piece in pieces
        ]
        self._segments = segments
        self._pitch = thread.LENGTH / max(segments, 1)
        self._thread = [model.body(f"thread_{index}").id for index in range(segments)]
        slots = range(elements.THREAD_HOLDS if segments else 0)
        self._thread_equality = [model.equality(f"thread_hold_{index}").id for index in slots]
        self._thread_mocap = [int(model.body(f"thread_hold_{index}").mocapid[0]) for index in slots]

    def meet(self, radius: float, tip_angle: float) -> None:
        """Follow a randomised model: the phantom's place and the needle's size and mass.

        Args:
            radius: of the needle's arc [m].
            tip_angle: of its tip [rad].
        """
        model = self._model
        self._radius = radius
        self._tip_angle = tip_angle
        x, y, z = model.body_pos[self._phantom_id].tolist()
        w, _, _, k = model.body_quat[self._phantom_id].tolist()
        self._shift = (x, y, z)
        self._turn = (w * w - k * k, 2.0 * w * k)
        weights = model.body_invweight0[:, 0]
        forces = self.forces
        solref, solimp = elements.spring(
            forces.skin_stiffness, float(weights[model.body("needle").id])
        )
        model.geom_solref[self._boxes] = solref
        model.geom_solimp[self._boxes] = solimp
        for site, body, equality in zip(self._site, self._carrier, self._equality, strict=True):
            model.site_pos[site] = (-radius, 0.0, 0.0)
            solref, solimp = elements.spring(forces.lateral_stiffness, float(weights[body]))
            model.eq_solref[equality] = solref
            model.eq_solimp[equality] = solimp
        self._thread_springs = [
            elements.spring(forces.lateral_stiffness, float(weights[body])) for body in self._thread
        ]

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

    def _shown(self, passage: _Passage, path: Sequence[Point]) -> Bite:
        """Return a passage in world."""
        is_out = passage.exit_flank != NO_FLANK
        return Bite(
            entry=self.to_world(passage.entry),
            exit=self.to_world(passage.exit) if is_out else None,
            entry_side=SIDES[passage.entry_flank % 2],
            exit_side=SIDES[passage.exit_flank % 2] if is_out else "",
            entry_piece=passage.entry_flank // 2 + 1,
            exit_piece=passage.exit_flank // 2 + 1 if is_out else 0,
            depth=passage.depth,
            length=passage.length,
            tears=passage.tears,
            is_done=passage.is_done,
            path=tuple(self.to_world(point) for point in path),
        )

    def passed(self, pair: HolePair) -> int:
        """Return how many flanks of a stitch the needle passed in the direction of travel.

        0 to 2, and `hole_crossing.OUT` when it has left through the second. How near to the marks
        is not asked here; a bite through another piece of the ridge counts for another pair.
        """
        if not self._passages:
            return 0
        passage = self._passages[-1]
        first = SIDES.index("entry" if pair.entry.tilt < 0.0 else "exit")
        if passage.entry_flank % 2 != first:
            return 0
        is_out = passage.exit_flank != NO_FLANK and passage.exit_flank % 2 != first
        if self.stage == OUTSIDE:
            return OUT if is_out else 0
        return 2 if is_out else 1

    def force_on_needle(self) -> NDArray[np.float64]:
        """Return the force of the tissue on the needle in world, (3,) [N].

        Of the skin's contacts and of the two holds, computed on data of its own: the simulation
        goes on as if nobody had asked.
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
            if bodies[other if is_first else one] == self._phantom_id:
                mujoco.mj_contactForce(self._model, data, index, wrench)
                # MuJoCo's force is that on the second geom.
                sign = -1.0 if is_first else 1.0
                force += sign * (data.contact[index].frame.reshape(3, 3).T @ wrench[:3])
        return force

    def hold_force(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """Return the force of the two holds on the needle, (3,) [N]; `data` has its forces."""
        rows = data.efc_type[: data.nefc] == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        held = rows & np.isin(data.efc_id[: data.nefc], self._equality)
        force: NDArray[np.float64] = data.efc_force[: data.nefc][held].reshape(-1, 3).sum(axis=0)
        return force

    # -- stages ------------------------------------------------------------------------------------

    def clear(self) -> None:
        """Forget everything: the needle is outside of whole tissue."""
        self.stage = OUTSIDE
        self.tears = 0
        self.thread_drawn = 0.0
        self._passages: list[_Passage] = []
        self._path: list[Point] = []
        self._front = 0.0
        self._anchors: list[Point] = [elements.HIDDEN, elements.HIDDEN]
        self._set: Point = (0.0, 0.0, 0.0)
        self._yielded = [0.0, 0.0]
        self._entry_anchor: Point = elements.HIDDEN
        self._friction = (0.0, 0.0)
        self._holds = [_ThreadHold() for _ in self._thread_equality]
        self._write()
        for index in range(2):
            self._release(index)
        for slot in range(len(self._holds)):
            self._release_thread(slot)

    def update(self) -> None:
        """Follow the needle and the thread; to be called when positions have just changed."""
        self._find_needle()
        if self.stage == OUTSIDE:
            self._try_entry()
        else:
            _STAGES[self.stage](self)
            if self.stage != OUTSIDE:
                self._yield()
        if self._segments:
            self._follow_thread()

    def embed(self) -> None:
        """Begin anew with a needle that was put where it is: in the tissue or outside.

        A needle whose arc leads through the tissue has pierced it along that arc, and pulls at
        nothing.
        """
        self.clear()
        self._find_needle()
        found = self._embedded_arc()
        if found is None:
            return
        into, out_of, start, end = found
        passage = _Passage(self._at(start), elements.HIDDEN, into, NO_FLANK, 0.0, 0.0, 0, False)
        self._passages = [passage]
        self._front = self._radius * (end - start)
        steps = int(self._front / SPACING)
        self._path = [self._at(start + SPACING / self._radius * step) for step in range(steps + 1)]
        passage.depth = max(-self._height(point) for point in self._path)
        passage.length = self._front
        self.stage = INSIDE
        self._hold(0, max(start, 0.0), passage.entry)
        self._entry_anchor = passage.entry
        if out_of != NO_FLANK:
            passage.exit = self._at(end)
            passage.exit_flank = out_of
            self.stage = THROUGH
            self._hold(1, end, passage.exit)
        self._write()
        self.update()

    def _try_entry(self) -> None:
        """Pierce the skin where the tip presses hard enough."""
        tip = self._at(self._tip_angle)
        piece = self._piece(tip)
        if tip[2] > self._top or tip[2] < SURFACE or piece < 0:
            return
        dent = self.forces.dent_in
        heights = [self._over(flank, tip) for flank in (2 * piece, 2 * piece + 1)]
        if max(heights) >= 0.0:
            return
        for flank, height in zip((2 * piece, 2 * piece + 1), heights, strict=True):
            if -DEEPEST < height < -dent and self._towards(flank) < -STEEP:
                angle = self._crossing(flank, self._tip_angle, inward=True)
                if angle is not None and 0.0 <= (self._tip_angle - angle) * self._radius < SEARCH:
                    self._pierce(flank, angle, -height)
                    return

    def _pierce(self, flank: int, angle: float, depth: float) -> None:
        """Go through the skin of `flank` with the needle's point at `angle` [rad] in it."""
        entry = self._at(angle)
        length = self._radius * (self._tip_angle - angle)
        self._passages.append(
            _Passage(entry, elements.HIDDEN, flank, NO_FLANK, depth, length, 0, False)
        )
        del self._passages[:-BITES]
        self.stage = INSIDE
        self._front = length
        self._path = [entry]
        self._extend_path()
        self._set = (0.0, 0.0, 0.0)
        self._yielded = [0.0, 0.0]
        self._entry_anchor = entry
        self._hold(0, angle, entry)
        self._rub(self.forces.friction * length + self.forces.cutting, 0.0)
        self._write()

    def _go_in(self) -> None:
        """Follow a needle whose tip is inside."""
        forces = self.forces
        passage = self._passages[-1]
        tip = self._at(self._tip_angle)
        length = self._radius * (self._tip_angle - self._angle(0))
        flank = passage.entry_flank
        if length < LEAVING or (
            self._over(flank, tip) > LEAVING and self._towards(flank) < OUTWARD
        ):
            self._leave()
            return
        is_cutting = length > self._front - FRONT
        if length > self._front:
            self._front = length
            self._extend_path()
            passage.depth = max(passage.depth, -self._height(tip))
            passage.length = length
        resistance = forces.friction * length
        if is_cutting:
            resistance += forces.cutting
            piece = max(self._piece(tip), 0)
            for leaving in (2 * piece, 2 * piece + 1):
                height = self._over(leaving, tip)
                if height > 0.0 and self._towards(leaving) > OUTWARD:
                    if height >= forces.dent_out and self._come_out(leaving):
                        return
                    resistance += min(forces.skin_stiffness * height, forces.puncture_out)
        self._hold_middle(1, 0.5 * min(length / self._front, 1.0))
        self._rub(resistance, 0.0)

    def _come_out(self, flank: int) -> bool:
        """Go through the skin from inside; return False where the arc does not cross it."""
        angle = self._crossing(flank, self._tip_angle, inward=False)
        if angle is None or not 0.0 <= (self._tip_angle - angle) * self._radius < SEARCH:
            return False
        passage = self._passages[-1]
        passage.exit = self._at(angle)
        passage.exit_flank = flank
        passage.length = self._radius * (angle - self._angle(0))
        self.stage = THROUGH
        self._yielded[1] = 0.0
        self._hold(1, angle, passage.exit)
        self._write()
        self._go_through()
        return True

    def _go_through(self) -> None:
        """Follow a needle that is in at the entry and out at the exit."""
        start = self._angle(0)
        end = self._angle(1)
        length = self._radius * (end - start)
        if self._radius * (self._tip_angle - end) < LEAVING:
            self._draw_back_in()
            return
        if self._radius * start < LEAVING:
            self.stage = TRAILING
            self._front = max(length, SPACING)
            self._entry_anchor = self._anchors[0]
            self._set = (0.0, 0.0, 0.0)
            self._yielded[0] = 0.0
            self._release(0)
            self._hold_thread(self._entry_anchor, is_exit=False)
            self._trail()
            return
        half = 0.5 * self.forces.friction * max(length, 0.0)
        self._rub(half, half)

    def _draw_back_in(self) -> None:
        """Follow a tip that was drawn back through its exit."""
        passage = self._passages[-1]
        passage.exit = elements.HIDDEN
        passage.exit_flank = NO_FLANK
        self.stage = INSIDE
        self._front = self._radius * (self._tip_angle - self._angle(0))
        self._set = (0.0, 0.0, 0.0)
        self._yielded[1] = 0.0
        self._release(1)
        self._go_in()

    def _trail(self) -> None:
        """Follow a needle whose base is inside."""
        left = self._radius * self._angle(1)
        if left < LEAVING:
            self._hold_thread(self._anchors[1], is_exit=True)
            self._leave()
            return
        if left > self._front + LEAVING:
            self.stage = THROUGH
            self._yielded[0] = 0.0
            self._hold(0, (left - self._front) / self._radius, self._entry_anchor)
            self._drop_thread()
            self._go_through()
            return
        self._hold_middle(0, 1.0 - 0.5 * left / self._front)
        self._rub(0.0, self.forces.friction * left)

    def _leave(self) -> None:
        """End the bite: the needle is outside."""
        self._passages[-1].is_done = True
        self.stage = OUTSIDE
        self._path = []
        self._release(0)
        self._release(1)
        self._rub(0.0, 0.0)
        self._write()

    # -- holds -------------------------------------------------------------------------------------

    def _hold(self, index: int, angle: float, anchor: Point) -> None:
        """Hold the needle's point at `angle` [rad] at an anchor, by friction along the arc."""
        data = self._data
        data.qpos[self._hinge[index]] = angle
        data.qvel[self._dof[index]] = 0.0
        data.eq_active[self._equality[index]] = 1
        self._move_anchor(index, anchor)

    def _hold_middle(self, index: int, share: float) -> None:
        """Hold the shaft at a share of the way the tip cut, free to slide."""
        path = self._path
        if len(path) < 4:
            self._release(index)
            return
        place = share * (len(path) - 1)
        low = min(int(place), len(path) - 2)
        part = place - low
        a = path[low]
        b = path[low + 1]
        x, y, z = self._set
        anchor = (
            a[0] + part * (b[0] - a[0]) + x,
            a[1] + part * (b[1] - a[1]) + y,
            a[2] + part * (b[2] - a[2]) + z,
        )
        if self._data.eq_active[self._equality[index]]:
            self._move_anchor(index, anchor)
        else:
            self._hold(index, self._angle_of(anchor), anchor)

    def _move_anchor(self, index: int, anchor: Point) -> None:
        self._anchors[index] = anchor
        self._data.mocap_pos[self._mocap[index]] = self.to_world(anchor)

    def _release(self, index: int) -> None:
        """Let the needle go."""
        self._data.eq_active[self._equality[index]] = 0
        self._data.mocap_pos[self._mocap[index]] = elements.HIDDEN

    def _rub(self, first: float, second: float) -> None:
        """Set the friction of the two held points along the arc [N]."""
        self._friction = (first, second)
        friction = self._model.dof_frictionloss
        friction[self._dof[0]] = first * self._radius
        friction[self._dof[1]] = second * self._radius

    def _yield(self) -> None:
        """Let anchors give way to forces beyond the yield force."""
        for index in range(2):
            if not self._data.eq_active[self._equality[index]]:
                continue
            ax, ay, az = anchor = self._anchors[index]
            x, y, z = held = self._at(self._angle(index))
            way, self._yielded[index] = self._give_way(
                math.dist(anchor, held), self._yielded[index]
            )
            if way > 0.0:
                dx, dy, dz = way * (x - ax), way * (y - ay), way * (z - az)
                if (self.stage == INSIDE and index == 1) or (self.stage == TRAILING and index == 0):
                    sx, sy, sz = self._set
                    self._set = (sx + dx, sy + dy, sz + dz)
                self._move_anchor(index, (ax + dx, ay + dy, az + dz))

    def _give_way(self, distance: float, yielded: float) -> tuple[float, float]:
        """Return the share of `distance` by which an anchor gives way; count a tear.

        Args:
            distance: of what is held from its anchor [m].
            yielded: displacement that stayed so far [m].

        Returns:
            The share, and the displacement that has stayed now [m].
        """
        forces = self.forces
        excess = forces.lateral_stiffness * distance - forces.yield_force
        if excess <= forces.hardening * yielded:
            return 0.0, yielded
        if excess + forces.yield_force > forces.tear_force:
            self._count_tear()
            return excess / forces.lateral_stiffness / distance, 0.0
        way = (excess - forces.hardening * yielded) / (forces.lateral_stiffness + forces.hardening)
        return way / distance, yielded + way

    def _count_tear(self) -> None:
        self.tears += 1
        if self._passages:
            self._passages[-1].tears += 1

    def _write(self) -> None:
        """Write to the model what touches what: the needle the skin, the thread the flanks."""
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

    # -- thread ------------------------------------------------------------------------------------

    def _hold_thread(self, anchor: Point, *, is_exit: bool) -> None:
        """Hold the thread's beginning at an anchor; the oldest hold makes room."""
        if not self._segments:
            return
        self._release_thread(0)
        self._holds.append(self._holds.pop(0))
        self._holds[-1] = _ThreadHold(0, 0.0, anchor, 0.0, is_exit)
        if is_exit:
            self.thread_drawn = 0.0
        for slot in range(len(self._holds)):
            self._write_thread(slot)

    def _drop_thread(self) -> None:
        """Let the thread go where the needle's base came out of the entry again."""
        if self._segments:
            self._release_thread(len(self._holds) - 1)
            self._holds.insert(0, self._holds.pop())
            for slot in range(len(self._holds)):
                self._write_thread(slot)

    def _release_thread(self, slot: int) -> None:
        self._holds[slot] = _ThreadHold()
        self._write_thread(slot)

    def _write_thread(self, slot: int) -> None:
        """Write one hold of the thread to the model and the data."""
        hold = self._holds[slot]
        equality = self._thread_equality[slot]
        is_held = hold.segment != NO_FLANK
        self._data.eq_active[equality] = is_held
        mocap = self._thread_mocap[slot]
        self._data.mocap_pos[mocap] = self.to_world(hold.anchor) if is_held else elements.HIDDEN
        if is_held:
            model = self._model
            model.eq_obj1id[equality] = self._thread[hold.segment]
            model.eq_data[equality, :6] = (0.0, 0.0, hold.offset, 0.0, 0.0, 0.0)
            solref, solimp = self._thread_springs[hold.segment]
            model.eq_solref[equality] = solref
            model.eq_solimp[equality] = solimp

    def _follow_thread(self) -> None:
        """Let the thread slide through its holds where the force along it exceeds the friction."""
        forces = self.forces
        slack = forces.thread_friction * 0.5 * self._thread_length() / forces.lateral_stiffness
        for slot, hold in enumerate(self._holds):
            if hold.segment == NO_FLANK:
                continue
            body = self._thread[hold.segment]
            x, y, z = self.to_world(hold.anchor)
            px, py, pz = self._data.xpos[body].tolist()
            matrix = self._data.xmat[body].tolist()
            dx, dy, dz = x - px, y - py, z - pz
            along = matrix[2] * dx + matrix[5] * dy + matrix[8] * dz
            stretch = along - hold.offset
            beside = math.sqrt(max(dx * dx + dy * dy + dz * dz - along * along, 0.0))
            way, hold.yielded = self._give_way(beside, hold.yielded)
            if way > 0.0:
                hold.anchor = self.to_phantom(
                    (
                        x - way * (dx - along * matrix[2]),
                        y - way * (dy - along * matrix[5]),
                        z - way * (dz - along * matrix[8]),
                    )
                )
            if abs(stretch) > slack:
                self._slide(slot, hold, stretch - math.copysign(slack, stretch))
            elif way > 0.0:
                self._write_thread(slot)

    def _thread_length(self) -> float:
        """Return the length of thread inside the last bite [m]."""
        return self._passages[-1].length if self._passages else 0.0

    def _slide(self, slot: int, hold: _ThreadHold, way: float) -> None:
        """Move a hold along the thread by `way` [m]."""
        hold.offset += way
        if hold.offset > self._pitch:
            hold.segment += 1
            hold.offset -= self._pitch
        elif hold.offset < 0.0 and hold.segment > 0:
            hold.segment -= 1
            hold.offset += self._pitch
        hold.offset = min(max(hold.offset, 0.0), self._pitch)
        is_end = hold.segment >= self._segments
        if hold.is_exit and slot == len(self._holds) - 1:
            drawn = hold.segment * self._pitch + (0.0 if is_end else hold.offset)
            self.thread_drawn = drawn
        if is_end:
            self._release_thread(slot)
        else:
            self._write_thread(slot)

    # -- geometry ----------------------------------------------------------------------------------

    def to_world(self, point: Point) -> Point:
        """Return a point of the phantom's frame in world [m]."""
        x, y, z = point
        c, s = self._turn
        px, py, pz = self._shift
        return (c * x - s * y + px, s * x + c * y + py, z + pz)

    def to_phantom(self, point: Point) -> Point:
        """Return a point of the world in the phantom's frame [m]."""
        c, s = self._turn
        px, py, pz = self._shift
        x, y, z = point[0] - px, point[1] - py, point[2] - pz
        return (c * x + s * y, c * y - s * x, z)

    def _find_needle(self) -> None:
        """Read the needle's centre and the two axes of its plane, in the phantom's frame."""
        x, y, z, w, i, j, k = self._data.qpos[self._free : self._free + 7].tolist()
        ux, uy, uz = 1 - 2 * (j * j + k * k), 2 * (i * j + w * k), 2 * (i * k - w * j)
        vx, vy, vz = 2 * (i * j - w * k), 1 - 2 * (i * i + k * k), 2 * (j * k + w * i)
        c, s = self._turn
        px, py, pz = self._shift
        dx, dy = x - px, y - py
        self._centre = (c * dx + s * dy, c * dy - s * dx, z - pz)
        self._u = (c * ux + s * uy, c * uy - s * ux, uz)
        self._v = (c * vx + s * vy, c * vy - s * vx, vz)

    def _at(self, angle: float) -> Point:
        """Return the needle's point at `angle` [rad]."""
        along = -self._radius * math.cos(angle)
        across = self._radius * math.sin(angle)
        x, y, z = self._centre
        u, v = self._u, self._v
        return (
            x + along * u[0] + across * v[0],
            y + along * u[1] + across * v[1],
            z + along * u[2] + across * v[2],
        )

    def _angle(self, index: int) -> float:
        """Return the needle's angle at which it is held [rad]."""
        angle: float = self._data.qpos.item(self._hinge[index])
        return angle

    def _angle_of(self, point: Point) -> float:
        """Return the angle of the needle's point nearest to a point [rad]."""
        dx, dy, dz = (a - b for a, b in zip(point, self._centre, strict=True))
        u, v = self._u, self._v
        return math.atan2(v[0] * dx + v[1] * dy + v[2] * dz, -(u[0] * dx + u[1] * dy + u[2] * dz))

    def _piece(self, point: Point) -> int:
        """Return the index of the ridge's piece at a point's y, -1 beyond the ridge's ends."""
        y = point[1]
        edges = self._edges
        if y > edges[0] or y < edges[-1]:
            return -1
        piece = 0
        while y < edges[piece + 1]:
            piece += 1
        return piece

    def _over(self, flank: int, point: Point) -> float:
        """Return the height of a point over a flank's plane [m]."""
        nx, nz, level = self._flanks[flank]
        return nx * point[0] + nz * point[2] - level

    def _height(self, point: Point) -> float:
        """Return the height of a point over the ridge: negative inside [m]."""
        piece = max(self._piece(point), 0)
        return max(self._over(2 * piece, point), self._over(2 * piece + 1, point))

    def _towards(self, flank: int) -> float:
        """Return the cosine of the angle between the tip's direction and a flank's normal."""
        nx, nz, _ = self._flanks[flank]
        sine = math.sin(self._tip_angle)
        cosine = math.cos(self._tip_angle)
        u, v = self._u, self._v
        towards: float = nx * (sine * u[0] + cosine * v[0]) + nz * (sine * u[2] + cosine * v[2])
        return towards

    def _crossing(self, flank: int, near: float, *, inward: bool) -> float | None:
        """Return the angle [rad], nearest to `near`, at which the arc crosses a flank's plane.

        Along the arc the height over the plane is a + reach sin(θ - φ); it rises through 0 at one
        angle and falls through it at one. None where the circle does not meet the plane.
        """
        nx, nz, _ = self._flanks[flank]
        height = self._over(flank, self._centre)
        u, v = self._u, self._v
        b = nx * u[0] + nz * u[2]
        c = nx * v[0] + nz * v[2]
        reach = self._radius * math.hypot(b, c)
        if abs(height) >= reach:
            return None
        rising = math.asin(height / reach)
        phase = math.atan2(b, c)
        angle = phase + (math.pi + rising if inward else -rising)
        return near + math.remainder(angle - near, 2.0 * math.pi)

    def _extend_path(self) -> None:
        """Append the tip's way since the last point, at equal distances."""
        path = self._path
        tip = self._at(self._tip_angle)
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

    def _embedded_arc(self) -> tuple[int, int, float, float] | None:
        """Return where the needle lies in the tissue, or None where it does not.

        Entry flank, exit flank (`NO_FLANK` where the tip is inside), and the angles [rad] of both
        ends of the embedded part: of the passage nearest to the tip.
        """
        step = 0.0005 / self._radius
        angle = self._tip_angle
        while angle > 0.0 and not self._is_inside(self._at(angle)):
            angle -= step
        if angle <= 0.0:
            return None
        out_of = NO_FLANK
        end = self._tip_angle
        if angle < end:
            out_of = self._flank_above(self._at(angle + step))
            crossing = self._crossing(out_of, angle, inward=False) if out_of != NO_FLANK else None
            if crossing is None:
                return None
            end = crossing
        elif self._height(self._at(end)) > -EMBEDDED:
            return None
        while angle > -BEHIND and self._is_inside(self._at(angle)):
            angle -= step
        into = self._flank_above(self._at(angle))
        start = self._crossing(into, angle, inward=True) if into != NO_FLANK else None
        if start is None or (end - start) * self._radius < EMBEDDED:
            return None
        return into, out_of, start, end

    def _is_inside(self, point: Point) -> bool:
        """Return True if a point is in the ridge."""
        return point[2] > SURFACE and self._piece(point) >= 0 and self._height(point) < 0.0

    def _flank_above(self, point: Point) -> int:
        """Return the flank that a point is outside of, `NO_FLANK` where it left another way."""
        piece = self._piece(point)
        if piece < 0 or point[2] < SURFACE:
            return NO_FLANK
        first, second = self._over(2 * piece, point), self._over(2 * piece + 1, point)
        return 2 * piece + (0 if first > second else 1) if max(first, second) >= 0.0 else NO_FLANK

    # -- state -------------------------------------------------------------------------------------

    def pack(self) -> list[float]:
        """Return everything but what MuJoCo's own state has, as at most `SIZE` numbers."""
        values = [
            *(self.stage, self.tears, self.thread_drawn, self._front),
            *self._anchors[0],
            *self._anchors[1],
            *self._set,
            *self._yielded,
            *self._entry_anchor,
            *self._friction,
            len(self._passages),
        ]
        for passage in self._passages:
            values += passage.pack()
        values += [0.0] * (_Passage.SIZE * (BITES - len(self._passages)))
        for hold in self._holds:
            values += hold.pack()
        values += [0.0] * (_ThreadHold.SIZE * (elements.THREAD_HOLDS - len(self._holds)))
        values.append(len(self._path))
        for point in self._path:
            values += point
        return values

    def unpack(self, values: Sequence[float]) -> None:
        """Take what `pack` returned; MuJoCo's state must be set already."""
        self.stage = int(values[0])
        self.tears = int(values[1])
        self.thread_drawn = values[2]
        self._front = values[3]
        self._anchors = [_point(values, 4), _point(values, 7)]
        self._set = _point(values, 10)
        self._yielded = [values[13], values[14]]
        self._entry_anchor = _point(values, 15)
        self._friction = (values[18], values[19])
        at = _HEAD + 1
        self._passages = [
            _Passage.unpack(values[start : start + _Passage.SIZE])
            for start in range(at, at + _Passage.SIZE * int(values[_HEAD]), _Passage.SIZE)
        ]
        at += _Passage.SIZE * BITES
        self._holds = [
            _ThreadHold.unpack(values[at + index * _ThreadHold.SIZE :][: _ThreadHold.SIZE])
            for index in range(len(self._thread_equality))
        ]
        at += _ThreadHold.SIZE * elements.THREAD_HOLDS
        self._path = [_point(values, at + 1 + 3 * index) for index in range(int(values[at]))]
        self._rub(*self._friction)
        self._write()
        for slot in range(len(self._holds)):
            self._write_thread(slot)


_STAGES = {INSIDE: Tissue._go_in, THROUGH: Tissue._go_through, TRAILING: Tissue._trail}


def _point(values: Sequence[float], start: int) -> Point:
    return (values[start], values[start + 1], values[start + 2])


def _flank(centre: Point, tilt: float) -> _Flank:
    """Return the plane through a hole's centre, normal to its axis."""
    nx = math.sin(tilt)
    nz = math.cos(tilt)
    return _Flank(nx, nz, nx * centre[0] + nz * centre[2])
