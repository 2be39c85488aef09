"""Hole crossing: did the needle go through both holes, in travel direction, inside the openings?

Two conditions must agree, so that tunnelling or teleporting never counts.

* In time: the tip crosses the entry's plane inwards, then the exit's plane outwards, each inside
  the opening; from then on the needle stays in the exit's opening until the whole of it is beyond;
  and the tip never moves further than `JUMP` in one control step.
* In space: the needle's arc crosses both planes inside the openings now.

In soft tissue, which has no openings, the tissue's own events decide (`envs.tissue`): the flank of
the entry is pierced, then that of the exit, then the needle is out.
"""

import math
from typing import TYPE_CHECKING, Protocol

from surgicai_vision.envs.task_state import TaskState
from surgicai_vision.scene.holes import OPENING, Hole, HolePair, Point
from surgicai_vision.scene.kinematics import Pose

if TYPE_CHECKING:
    from surgicai_vision.envs.tissue import Tissue

JUMP = 0.004
"""Furthest that the tip can move in one control step [m]: eight times the default step size."""
OUT = 3
"""`TaskState.holes_passed` of a needle whose base has left the exit as well."""
EJECTED = 5.0
"""A distance in one control step [m] that no fall explains: the contact solver shot the needle away
(250 m/s)."""


class NeedlePose(Protocol):
    """Where a needle is; `Simulation` measures it."""

    tissue: "Tissue | None"
    """The soft tissue it pierces, None in tissue with channels."""

    radius: float
    """Radius of the needle's arc [m]."""
    tip_angle: float
    """Angle of its tip [rad]."""

    def needle(self) -> Pose:
        """Return T_world_needle."""

    def needle_point(self, angle: float) -> Point:
        """Return the needle's point at `angle` [rad] in world [m]."""


def update(now: NeedlePose, state: TaskState, pair: HolePair) -> None:
    """Update `state.holes_passed` with the tip's move since the last control step."""
    before = state.needle_tip
    tip = now.needle_point(now.tip_angle)
    state.needle_tip = tip
    passed = state.holes_passed
    moved = math.dist(tip, before)
    if moved > JUMP:
        if passed != OUT:
            state.holes_passed = 0
        if moved > EJECTED:
            state.has_diverged = True
    elif now.tissue is not None:
        state.holes_passed = now.tissue.passed(pair)
    elif passed == 0:
        if crossing(before, tip, pair.entry, inward=True):
            state.holes_passed = 1
    elif passed == 1:
        if crossing(before, tip, pair.exit, inward=False):
            state.holes_passed = 2
        elif crossing(before, tip, pair.entry, inward=False):
            state.holes_passed = 0
    elif crossing(before, tip, pair.exit, inward=True):
        state.holes_passed = 1
    elif passed == 2 and not leaves(now, pair.exit):
        state.holes_passed = OUT if is_out(now, pair) else 0


def remember_tip(now: NeedlePose, state: TaskState) -> None:
    """Start tracking the needle's tip at its present position."""
    state.needle_tip = now.needle_point(now.tip_angle)


def crossing(before: Point, now: Point, hole: Hole, *, inward: bool) -> tuple[float, float] | None:
    """Return where the path from `before` to `now` crosses a hole's plane inside its opening.

    Args:
        before: where the path begins, in world [m].
        now: where it ends.
        hole: the hole.
        inward: True for paths into the tissue, False for paths out of it.

    Returns:
        (x, y) in the hole's frame [m], or None if the path does not cross the opening in this
        direction.
    """
    start = hole.height(before)
    end = hole.height(now)
    if not (start > 0.0 >= end if inward else start <= 0.0 < end):
        return None
    share = start / (start - end)
    return _in_opening(
        (
            before[0] + share * (now[0] - before[0]),
            before[1] + share * (now[1] - before[1]),
            before[2] + share * (now[2] - before[2]),
        ),
        hole,
    )


def in_both(now: NeedlePose, pair: HolePair) -> bool:
    """Return True if the needle lies in both openings."""
    return enters(now, pair.entry) and leaves(now, pair.exit)


def enters(now: NeedlePose, hole: Hole) -> bool:
    """Return True if the needle, from base to tip, crosses the opening inwards."""
    return _crosses(now, hole, inward=True)


def leaves(now: NeedlePose, hole: Hole) -> bool:
    """Return True if the needle, from base to tip, crosses the opening outwards."""
    return _crosses(now, hole, inward=False)


def is_out(now: NeedlePose, pair: HolePair) -> bool:
    """Return True if the whole needle, that is its lowest point, is beyond the exit's plane."""
    height, reach, phase = _heights(now, pair.exit)
    low = math.remainder(phase - math.pi / 2, 2 * math.pi)
    lowest = (
        -1.0
        if 0.0 <= low <= now.tip_angle
        else min(math.sin(-phase), math.sin(now.tip_angle - phase))
    )
    return height + reach * lowest > 0.0


def _crosses(now: NeedlePose, hole: Hole, *, inward: bool) -> bool:
    """Return True if the needle's arc crosses the opening; in closed form, as it runs every step.

    Along the arc the height over the plane is a + R (c sin θ - b cos θ) = a + reach sin(θ - φ); it
    rises through 0 at one angle and falls through it at another.
    """
    height, reach, phase = _heights(now, hole)
    if abs(height) >= reach:
        return False
    rising = math.asin(height / reach)
    angle = math.remainder(phase + (math.pi + rising if inward else -rising), 2 * math.pi)
    if not 0.0 <= angle <= now.tip_angle:
        return False
    return _in_opening(now.needle_point(angle), hole) is not None


def _heights(now: NeedlePose, hole: Hole) -> tuple[float, float, float]:
    """Return a [m], reach [m] and φ [rad] of the height of the needle's point at θ.

    The height over the hole's plane is a + reach sin(θ - φ).
    """
    u, v, w = hole.normal
    px, py, pz, r0, r1, _, r3, r4, _, r6, r7, _ = now.needle()
    b = u * r0 + v * r3 + w * r6
    c = u * r1 + v * r4 + w * r7
    return hole.height((px, py, pz)), now.radius * math.hypot(b, c), math.atan2(b, c)


def _in_opening(point: Point, hole: Hole) -> tuple[float, float] | None:
    """Return (x, y) in the hole's frame [m] of a point in its plane, or None outside the opening.

    Args:
        point: in world [m].
        hole: the hole.
    """
    x, y, _ = hole.local(point)
    return (x, y) if abs(x) < OPENING / 2 and abs(y) < OPENING / 2 else None
