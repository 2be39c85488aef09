"""Commands: what a hand can say, and the protocol of whatever says it.

Axes are those of an image, as OpenCV has them: x right, y down, z away from the viewer, into the
image. A turn is about these axes by the right-hand rule: about x it tilts what points away upwards,
about y it swings it to the right, about z it rolls clockwise. In the tool's frame the viewer looks
out of the instrument: z points out between the jaws.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

Vector = tuple[float, float, float]

KEEP, DISCARD, STOP, START = "keep", "discard", "stop", "start"
JAW, VIEW = "jaw", "view"
EVENTS = (KEEP, DISCARD, STOP, START, JAW, VIEW)
"""What happens once a press: → ← Esc of `lerobot-record`, begin, open or close the jaw, lead with
the next view.
"""


@dataclass(frozen=True)
class Input:
    """What the hands do at one moment.

    Attributes:
        move: along x, y, z of the frame, each in [-1, 1].
        turn: about x, y, z of the frame, each in [-1, 1].
        jaw: opening (1) or closing (-1).
        fine: the fine modifier is held.
        events: what was pressed since the last moment, of `EVENTS`, in order.
    """

    move: Vector = (0.0, 0.0, 0.0)
    turn: Vector = (0.0, 0.0, 0.0)
    jaw: float = 0.0
    fine: bool = False
    events: tuple[str, ...] = ()

    @property
    def moves(self) -> bool:
        """Say whether anything is meant to move by what is held."""
        return any(self.move) or any(self.turn) or self.jaw != 0.0


class Device(Protocol):
    """Where inputs come from."""

    def poll(self) -> Input:
        """Return what the hands do now; each event is returned once."""


def merged(inputs: Iterable[Input]) -> Input:
    """Return several hands as one: motions add up to at most 1, events follow one another."""
    parts = tuple(inputs)
    rows = (
        zip(*((*part.move, *part.turn, part.jaw) for part in parts), strict=True)
        if parts
        else [(0.0,)] * 7
    )
    x, y, z, tilt, swing, roll, jaw = (min(max(sum(row), -1.0), 1.0) for row in rows)
    events = tuple(event for part in parts for event in part.events)
    fine = any(part.fine for part in parts)
    return Input((x, y, z), (tilt, swing, roll), jaw, fine, events)
