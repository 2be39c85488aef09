"""Inputs: what a person can command at one moment, and the protocol of an input device.

Axes are those of an image, as in OpenCV: x right, y down, z away from the viewer, into the image.
Turns about these axes follow the right-hand rule: for a tool that points away, a turn about x tilts
it upwards, one about y swings it to the right, and one about z rolls it clockwise. In the tool's
frame the view is along the instrument: z points out between the jaws.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

Vector = tuple[float, float, float]

KEEP = "keep"
DISCARD = "discard"
STOP = "stop"
START = "start"
JAW = "jaw"
VIEW = "view"
EVENTS = (KEEP, DISCARD, STOP, START, JAW, VIEW)
"""What happens once per press: → ← Esc as in `lerobot-record`, start, open or close the jaw, lead
with the next view."""


@dataclass(frozen=True)
class Input:
    """What a person commands at one moment.

    Attributes:
        move: along x, y, z of the frame, each in [-1, 1].
        turn: about x, y, z of the frame, each in [-1, 1].
        jaw: opening (1) or closing (-1).
        fine: the fine modifier is held.
        events: which of `EVENTS` were pressed since the last input, in order.
    """

    move: Vector = (0.0, 0.0, 0.0)
    turn: Vector = (0.0, 0.0, 0.0)
    jaw: float = 0.0
    fine: bool = False
    events: tuple[str, ...] = ()

    @property
    def is_moving(self) -> bool:
        """Return True if a motion of the tool or the jaw is held."""
        return any(self.move) or any(self.turn) or self.jaw != 0.0


class Device(Protocol):
    """A source of inputs."""

    def poll(self) -> Input:
        """Return the current input; each event is returned once."""


def merge(inputs: Iterable[Input]) -> Input:
    """Return several inputs as one: motions are added and limited to 1, events concatenated."""
    sums = [0.0] * 7
    fine = False
    events: list[str] = []
    for one in inputs:
        for axis, value in enumerate((*one.move, *one.turn, one.jaw)):
            sums[axis] += value
        fine = fine or one.fine
        events += one.events
    x, y, z, tilt, swing, roll, jaw = (min(max(value, -1.0), 1.0) for value in sums)
    return Input((x, y, z), (tilt, swing, roll), jaw, fine, tuple(events))
