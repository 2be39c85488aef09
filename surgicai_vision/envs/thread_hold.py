"""Thread hold: soft tissue holds the thread where it goes in and where it comes out.

Each of the scene's `THREAD_HOLDS` equalities ties a point of one capsule of the thread to a slider.
Across the thread this is a spring. Along it the slider glides with the thread, with friction,
through an anchor in the tissue; the sliders of a bite's entry and exit glide by the same distance.
Once per control step the slider is put back into its anchor, and the held point moves back along
the thread by the same distance; at the end of a capsule the next one takes over at the same point.
So the thread passes through without jumps. The model contains what is tied to what, so `write` must
follow every change and every restored state.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import mujoco

from surgicai_vision.envs.ridge import Ridge
from surgicai_vision.scene import thread
from surgicai_vision.scene import tissue as elements
from surgicai_vision.scene.holes import Point

NOTHING = -1
"""The segment of a hold that holds nothing."""
NEAREST = 0.001
"""Smallest distance from the needle at which the thread is held [m]: a hold right at the joint
could not turn a thread that trails off the wrong way."""


@dataclass
class ThreadHold:
    """A place that may hold the thread.

    Attributes:
        segment: the capsule it holds, `NOTHING` if it holds none.
        offset: of the held point from that capsule's start [m].
        anchor: in the phantom's frame [m].
        is_exit: it is a bite's exit; the hold before it is the same bite's entry.
        friction: along the thread [N].
    """

    segment: int = NOTHING
    offset: float = 0.0
    anchor: Point = elements.HIDDEN
    is_exit: bool = False
    friction: float = 0.0

    SIZE: ClassVar[int] = 7
    """Number of values in a packed hold."""

    def pack(self) -> list[float]:
        """Return the hold as `SIZE` numbers."""
        return [self.segment, self.offset, *self.anchor, self.is_exit, self.friction]

    @classmethod
    def unpack(cls, values: Sequence[float]) -> "ThreadHold":
        """Return the hold packed as `SIZE` numbers."""
        return cls(
            segment=int(values[0]),
            offset=values[1],
            anchor=(values[2], values[3], values[4]),
            is_exit=bool(values[5]),
            friction=values[6],
        )


class ThreadHolds:
    """All places that hold the thread of one simulation; none if it has no thread.

    Args:
        model: the simulation's own copy of its model.
        data: the simulation's.
        ridge: the phantom's frame.
        segments: number of capsules of the thread.
    """

    SIZE: ClassVar[int] = elements.THREAD_HOLDS * ThreadHold.SIZE
    """Number of values in all packed holds."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, ridge: Ridge, segments: int):
        self._model = model
        self._data = data
        self._ridge = ridge
        self._bodies = [model.body(f"thread_{index}").id for index in range(segments)]
        self._pitch = thread.LENGTH / max(segments, 1)
        slots = range(elements.THREAD_HOLDS if segments else 0)
        self._equalities = [model.equality(f"thread_hold_{slot}").id for slot in slots]
        self._mocaps = [int(model.body(f"thread_hold_{slot}").mocapid[0]) for slot in slots]
        self._couplings = [model.equality(f"thread_bite_{slot}").id for slot in slots[:-1]]
        sliders = [model.joint(f"thread_slider_{slot}") for slot in slots]
        self._slides = [int(slider.qposadr[0]) for slider in sliders]
        self._dofs = [int(slider.dofadr[0]) for slider in sliders]
        self._holds = [ThreadHold() for _ in slots]
        self._springs: list[elements.Spring] = []

    def meet(self) -> None:
        """Adapt to a randomised model: the needle's mass, on which the thread's springs depend."""
        if not self._bodies:
            return
        weights = self._model.body_invweight0[:, 0]
        slider = float(weights[self._model.body("thread_slider_0").id])
        self._springs = [
            elements.thread_spring(float(weights[body]) + slider) for body in self._bodies
        ]

    def clear(self) -> None:
        """Let go of everything."""
        self._holds = [ThreadHold() for _ in self._holds]
        self.write()

    def take(self, anchor: Point, friction: float, *, is_exit: bool) -> None:
        """Hold the thread's beginning at an anchor; the oldest hold makes room.

        Args:
            anchor: in the phantom's frame [m].
            friction: along the thread [N].
            is_exit: it is a bite's exit; the entry then holds the thread straight behind it.
        """
        if not self._holds:
            return
        self._shift(ThreadHold(0, NEAREST, anchor, is_exit, friction), newest=True)
        entry = self._holds[-2]
        if is_exit and entry.segment != NOTHING:
            place = NEAREST + math.dist(entry.anchor, anchor)
            entry.segment = min(int(place / self._pitch), len(self._bodies) - 1)
            entry.offset = place - entry.segment * self._pitch
        self.write()

    def drop(self) -> None:
        """Release the newest hold."""
        if self._holds:
            self._shift(ThreadHold(), newest=False)
            self.write()

    def _shift(self, hold: ThreadHold, *, newest: bool) -> None:
        """Add a hold at one end of the list, and remove the one at the other end."""
        slides = [
            (float(self._data.qpos[slide]), float(self._data.qvel[dof]))
            for slide, dof in zip(self._slides, self._dofs, strict=True)
        ]
        turns = [self._data.mocap_quat[mocap].tolist() for mocap in self._mocaps]
        still = (0.0, 0.0)
        none = [1.0, 0.0, 0.0, 0.0]
        if newest:
            self._holds = [*self._holds[1:], hold]
            slides = [*slides[1:], still]
            turns = [*turns[1:], none]
        else:
            self._holds = [hold, *self._holds[:-1]]
            slides = [still, *slides[:-1]]
            turns = [none, *turns[:-1]]
        for slot, ((place, speed), turn) in enumerate(zip(slides, turns, strict=True)):
            self._data.qpos[self._slides[slot]] = place
            self._data.qvel[self._dofs[slot]] = speed
            self._data.mocap_quat[self._mocaps[slot]] = turn

    def follow(self) -> float | None:
        """Let the thread move on through the holds.

        Returns:
            The length of thread drawn out of the last exit [m]; None if no exit holds it.
        """
        drawn = None
        slides = [float(self._data.qpos[slide]) for slide in self._slides]
        for slot in range(len(self._holds) - 1):
            if self._is_bite(slot):
                slides[slot] = slides[slot + 1] = (slides[slot] + slides[slot + 1]) / 2
        for slot, (hold, slid) in enumerate(zip(self._holds, slides, strict=True)):
            if hold.segment == NOTHING:
                continue
            self._slide(hold, -slid)
            if hold.is_exit:
                drawn = hold.segment * self._pitch + hold.offset
            if hold.segment >= len(self._bodies):
                self._holds[slot] = ThreadHold()
            else:
                # The slider moves along the capsule.
                turn = self._data.xquat[self._bodies[hold.segment]]
                self._data.mocap_quat[self._mocaps[slot]] = turn
            self._data.qpos[self._slides[slot]] = 0.0
            self._write(slot)
        return drawn

    def _is_bite(self, slot: int) -> bool:
        """Return True if a hold and the next one are the entry and the exit of one bite."""
        entry = self._holds[slot]
        leave = self._holds[slot + 1]
        is_held = entry.segment != NOTHING and leave.segment != NOTHING
        return is_held and leave.is_exit and not entry.is_exit

    def _slide(self, hold: ThreadHold, way: float) -> None:
        """Move the held point along the thread by `way` [m]."""
        hold.offset += way
        if hold.offset > self._pitch:
            hold.segment += 1
            hold.offset = 0.0 if hold.segment >= len(self._bodies) else hold.offset - self._pitch
        elif hold.offset < 0.0 and hold.segment > 0:
            hold.segment -= 1
            hold.offset += self._pitch
        nearest = NEAREST if hold.segment == 0 else 0.0
        hold.offset = min(max(hold.offset, nearest), self._pitch)

    def write(self) -> None:
        """Write all holds to the model and the data."""
        for slot in range(len(self._holds)):
            self._write(slot)

    def _write(self, slot: int) -> None:
        """Write one hold to the model and the data."""
        model = self._model
        data = self._data
        hold = self._holds[slot]
        equality = self._equalities[slot]
        dof = self._dofs[slot]
        is_held = 0 <= hold.segment < len(self._bodies)
        data.eq_active[equality] = is_held
        for first in (slot - 1, slot):
            if 0 <= first < len(self._couplings):
                data.eq_active[self._couplings[first]] = self._is_bite(first)
        model.dof_frictionloss[dof] = hold.friction if is_held else 0.0
        if not is_held:
            data.mocap_pos[self._mocaps[slot]] = elements.HIDDEN
            data.qpos[self._slides[slot]] = 0.0
            data.qvel[dof] = 0.0
            return
        data.mocap_pos[self._mocaps[slot]] = self._ridge.to_world(hold.anchor)
        model.eq_obj1id[equality] = self._bodies[hold.segment]
        model.eq_data[equality, :6] = (0.0, 0.0, hold.offset, 0.0, 0.0, 0.0)
        model.eq_solref[equality], model.eq_solimp[equality] = self._springs[hold.segment]

    def pack(self) -> list[float]:
        """Return all holds as `SIZE` numbers."""
        values = [number for hold in self._holds for number in hold.pack()]
        return values + [0.0] * (self.SIZE - len(values))

    def unpack(self, values: Sequence[float]) -> None:
        """Restore what `pack` returned; MuJoCo's state must already be set."""
        size = ThreadHold.SIZE
        self._holds = [
            ThreadHold.unpack(values[slot * size : (slot + 1) * size])
            for slot in range(len(self._holds))
        ]
        # Sliders that hold nothing creep by the last bits; MuJoCo's state has them as they were.
        data = self._data
        places, speeds = data.qpos[self._slides].copy(), data.qvel[self._dofs].copy()
        self.write()
        data.qpos[self._slides] = places
        data.qvel[self._dofs] = speeds
