"""Bite: one passage of the needle through soft tissue, as others read it and as it is stored."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from surgicai_vision.scene.holes import Point
from surgicai_vision.scene.tissue import HIDDEN

NO_FLANK = -1
"""The exit flank of a bite without an exit."""
SIDES = ("entry", "exit")
"""The two flanks of the ridge, named after the holes that the layouts have there."""


@dataclass(frozen=True)
class Bite:
    """One passage of the needle through the tissue, in world, for the phantom's present placement.

    Attributes:
        entry: where the needle went in, on the undeformed skin [m].
        exit: where it came out [m]; None before that, and if the needle was drawn back.
        entry_side: the flank it went in through, "entry" or "exit".
        exit_side: the flank it came out through; "" before that.
        entry_piece: piece of the ridge at the entry, 1 to 4: that of the hole pair there.
        exit_piece: the same for the exit; 0 before that.
        depth: largest depth of the tip below the nearer flank so far [m].
        length: length of the needle's arc in the tissue when the tip was furthest [m].
        tears: how often the tissue tore during this bite.
        is_done: the needle has left the tissue.
        path: points of the tip's path through the tissue [m]; for the present passage only.
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
class Passage:
    """A bite as `Tissue` stores it: in the phantom's frame, flanks by their index in `Ridge`.

    `entry_now` and `exit_now` are where the pierced points lie after the tissue gave way; the other
    fields are as in `Bite`.
    """

    entry: Point
    entry_flank: int
    exit: Point = HIDDEN
    exit_flank: int = NO_FLANK
    depth: float = 0.0
    length: float = 0.0
    tears: int = 0
    is_done: bool = False
    entry_now: Point = HIDDEN
    exit_now: Point = HIDDEN

    SIZE: ClassVar[int] = 18
    """Number of values in a packed passage."""

    @property
    def is_out(self) -> bool:
        """Return True if the tip came out of the tissue again."""
        return self.exit_flank != NO_FLANK

    def pack(self) -> list[float]:
        """Return the passage as `SIZE` numbers."""
        return [
            *self.entry,
            self.entry_flank,
            *self.exit,
            self.exit_flank,
            self.depth,
            self.length,
            self.tears,
            self.is_done,
            *self.entry_now,
            *self.exit_now,
        ]

    @classmethod
    def unpack(cls, values: Sequence[float]) -> "Passage":
        """Return the passage packed as `SIZE` numbers."""
        return cls(
            entry=(values[0], values[1], values[2]),
            entry_flank=int(values[3]),
            exit=(values[4], values[5], values[6]),
            exit_flank=int(values[7]),
            depth=values[8],
            length=values[9],
            tears=int(values[10]),
            is_done=bool(values[11]),
            entry_now=(values[12], values[13], values[14]),
            exit_now=(values[15], values[16], values[17]),
        )
