"""Thread hold: soft tissue holds the thread where it goes in and where it comes out.

Each of the scene's `THREAD_HOLDS` equalities ties a point of one capsule of the thread to an
anchor, by a soft spring. Along the thread, once a control step,
the point slides as far as the force exceeds the friction; at the capsule's end the next capsule
takes over at the same place. What is tied to what is in the model, so `write` follows every change
and every restored state.
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
"""The segment of a hold that holds none."""


AHEAD = 1.5
"""A held point slides this much further than the force asks for: the thread goes on sliding until
the next control step, and the force should be right in the middle of that time."""


@dataclass
class ThreadHold:
    """A place that may hold the thread.

    Attributes:
        segment: the capsule it holds, `NOTHING` where it holds none.
        offset: of the held point from that capsule's start [m].
        anchor: in the phantom's frame [m].
        is_exit: it is the last bite's exit.
    """

    segment: int = NOTHING
    offset: float = 0.0
    anchor: Point = elements.HIDDEN
    is_exit: bool = False

    SIZE: ClassVar[int] = 6
    """Numbers of a packed hold."""

    def pack(self) -> list[float]:
        """Return the hold as `SIZE` numbers."""
        return [self.segment, self.offset, *self.anchor, self.is_exit]

    @classmethod
    def unpack(cls, values: Sequence[float]) -> "ThreadHold":
        """Return the hold of `SIZE` numbers."""
        return cls(
            segment=int(values[0]),
            offset=values[1],
            anchor=(values[2], values[3], values[4]),
            is_exit=bool(values[5]),
        )


class ThreadHolds:
    """All places that hold the thread of one simulation; none where it has no thread.

    Args:
        model: the simulation's own copy of its model.
        data: the simulation's.
        ridge: the phantom's frame.
        segments: capsules of the thread.
    """

    SIZE: ClassVar[int] = elements.THREAD_HOLDS * ThreadHold.SIZE
    """Numbers of all packed holds."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        ridge: Ridge,
        segments: int,
    ):
        self._model = model
        self._data = data
        self._ridge = ridge
        self._bodies = [model.body(f"thread_{index}").id for index in range(segments)]
        self._pitch = thread.LENGTH / max(segments, 1)
        names = [f"thread_hold_{slot}" for slot in range(elements.THREAD_HOLDS if segments else 0)]
        self._equalities = [model.equality(name).id for name in names]
        self._mocaps = [int(model.body(name).mocapid[0]) for name in names]
        self._holds = [ThreadHold() for _ in names]
        self._springs: list[elements.Spring] = []

    def meet(self) -> None:
        """Follow a randomised model: the needle's mass, on which the thread's springs depend."""
        weights = self._model.body_invweight0
        self._springs = [elements.thread_spring(float(weights[body, 0])) for body in self._bodies]

    def clear(self) -> None:
        """Let go of everything."""
        self._holds = [ThreadHold() for _ in self._holds]
        self.write()

    def take(self, anchor: Point, *, is_exit: bool) -> None:
        """Hold the thread's beginning at an anchor; the oldest hold makes room."""
        if self._holds:
            for hold in self._holds:
                hold.is_exit = False
            self._holds = [*self._holds[1:], ThreadHold(0, 0.0, anchor, is_exit)]
            self.write()

    def drop(self) -> None:
        """Let go of what was taken last."""
        if self._holds:
            self._holds = [ThreadHold(), *self._holds[:-1]]
            self.write()

    def follow(self, friction: float) -> float | None:
        """Let the thread slide through the holds.

        Args:
            friction: largest force along the thread at each hold [N].

        Returns:
            The thread drawn out of the last bite's exit [m]; None where it holds no thread.
        """
        drawn = None
        slack = friction / elements.THREAD_STIFFNESS
        for slot, hold in enumerate(self._holds):
            if hold.segment == NOTHING:
                continue
            stretch = self._stretch(hold)
            if abs(stretch) > slack:
                self._slide(hold, AHEAD * (stretch - math.copysign(slack, stretch)))
                self._write(slot)
            if hold.is_exit:
                drawn = hold.segment * self._pitch + hold.offset
            if hold.segment >= len(self._bodies):
                self._holds[slot] = ThreadHold()
        return drawn

    def _stretch(self, hold: ThreadHold) -> float:
        """Return how far the anchor is from the held point, along the thread [m]."""
        body = self._bodies[hold.segment]
        x, y, z = self._ridge.to_world(hold.anchor)
        px, py, pz = self._data.xpos[body].tolist()
        _, _, a, _, _, b, _, _, c = self._data.xmat[body].tolist()
        along: float = a * (x - px) + b * (y - py) + c * (z - pz)
        return along - hold.offset

    def _slide(self, hold: ThreadHold, way: float) -> None:
        """Move the held point along the thread by `way` [m]."""
        hold.offset += way
        if hold.offset > self._pitch:
            hold.segment += 1
            hold.offset = 0.0 if hold.segment >= len(self._bodies) else hold.offset - self._pitch
        elif hold.offset < 0.0 and hold.segment > 0:
            hold.segment -= 1
            hold.offset += self._pitch
        hold.offset = min(max(hold.offset, 0.0), self._pitch)

    def write(self) -> None:
        """Write all holds to the model and the data."""
        for slot in range(len(self._holds)):
            self._write(slot)

    def _write(self, slot: int) -> None:
        """Write one hold to the model and the data."""
        hold = self._holds[slot]
        equality = self._equalities[slot]
        is_held = 0 <= hold.segment < len(self._bodies)
        self._data.eq_active[equality] = is_held
        place = self._ridge.to_world(hold.anchor) if is_held else elements.HIDDEN
        self._data.mocap_pos[self._mocaps[slot]] = place
        if is_held:
            model = self._model
            model.eq_obj1id[equality] = self._bodies[hold.segment]
            model.eq_data[equality, :6] = (0.0, 0.0, hold.offset, 0.0, 0.0, 0.0)
            model.eq_solref[equality], model.eq_solimp[equality] = self._springs[hold.segment]

    def pack(self) -> list[float]:
        """Return all holds as `SIZE` numbers."""
        values = [number for hold in self._holds for number in hold.pack()]
        return values + [0.0] * (self.SIZE - len(values))

    def unpack(self, values: Sequence[float]) -> None:
        """Take what `pack` returned; MuJoCo's state must be set already."""
        size = ThreadHold.SIZE
        self._holds = [
            ThreadHold.unpack(values[slot * size : (slot + 1) * size])
            for slot in range(len(self._holds))
        ]
        self.write()
