"""Passage: did the needle go through both holes, in travel direction, through the openings?

Tests that must agree, so that tunnelling or teleporting never counts. In time: the tip crosses the
entry's plane inwards, then the exit's plane outwards, each inside the opening; from then on the
needle stays in the exit's opening until the whole of it is beyond; and the tip never moves further
than `JUMP` in one control step. In space: the needle's polyline crosses both planes inside the
openings now.
"""

import math

from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.task_state import Memory
from surgicai_vision.scene import needle
from surgicai_vision.scene.holes import OPENING, Hole, HolePair

JUMP = 0.004
"""Furthest the tip can move in one control step [m]: eight times the default step size."""
OUT = 3.0
"""`Memory.passed` of a needle whose base has left the exit too."""
EJECTED = 5.0
"""A way in one control step [m] that no fall explains: the contact solver shot the needle away (250
m/s).
"""

Point = tuple[float, float, float]


def watch(simulation: Simulation, memory: Memory, pair: HolePair) -> None:
    """Update `memory.passed` with the tip's move since the last measurement."""
    now = simulation.needle_point(needle.TIP_ANGLE)
    before = (memory.tip_x, memory.tip_y, memory.tip_z)
    memory.tip_x, memory.tip_y, memory.tip_z = now
    if math.dist(now, before) > JUMP:
        memory.passed = memory.passed if memory.passed == OUT else 0.0
        if math.dist(now, before) > EJECTED:
            memory.diverged = 1.0
    elif memory.passed == 0.0 and _passes(before, now, pair.entry, inward=True):
        memory.passed = 1.0
    elif memory.passed == 1.0:
        if _passes(before, now, pair.exit, inward=False):
            memory.passed = 2.0
        elif _passes(before, now, pair.entry, inward=False):
            memory.passed = 0.0
    elif memory.passed >= 2.0:
        if _passes(before, now, pair.exit, inward=True):
            memory.passed = 1.0
        elif memory.passed == 2.0 and not leaves(simulation, pair.exit):
            memory.passed = OUT if is_out(simulation, pair) else 0.0


def remember_tip(simulation: Simulation, memory: Memory) -> None:
    """Start watching from the tip's present place."""
    memory.tip_x, memory.tip_y, memory.tip_z = simulation.needle_point(needle.TIP_ANGLE)


def in_both(simulation: Simulation, pair: HolePair) -> bool:
    """Say whether the needle lies in both openings now."""
    return enters(simulation, pair.entry) and leaves(simulation, pair.exit)


def enters(simulation: Simulation, hole: Hole) -> bool:
    """Say whether the needle, from base to tip, crosses the hole's plane inwards inside the opening
    now.
    """
    return _crosses(simulation, hole, inward=True)


def leaves(simulation: Simulation, hole: Hole) -> bool:
    """Say whether the needle, from base to tip, crosses the hole's plane outwards inside the
    opening now.
    """
    return _crosses(simulation, hole, inward=False)


def _crosses(simulation: Simulation, hole: Hole, *, inward: bool) -> bool:
    """Do what `holes.crossing` does on a fine polyline, in closed form for every control step.

    Along the arc the height over the plane is a + R (c sin θ - b cos θ) = a + reach sin(θ - φ); it
    rises through 0 at one angle and falls through it at one.
    """
    height, reach, phase = _heights(simulation, hole)
    if abs(height) >= reach:
        return False
    rising = math.asin(height / reach)
    angle = math.remainder(phase + (math.pi + rising if inward else -rising), 2 * math.pi)
    if not 0.0 <= angle <= needle.TIP_ANGLE:
        return False
    return _within(simulation.needle_point(angle), hole)


def is_out(simulation: Simulation, pair: HolePair) -> bool:
    """Say whether the whole needle is beyond the exit's plane: its lowest point is."""
    height, reach, phase = _heights(simulation, pair.exit)
    low = math.remainder(phase - math.pi / 2, 2 * math.pi)
    lowest = (
        -1.0
        if 0.0 <= low <= needle.TIP_ANGLE
        else min(math.sin(-phase), math.sin(needle.TIP_ANGLE - phase))
    )
    return height + reach * lowest > 0.0


def _heights(simulation: Simulation, hole: Hole) -> tuple[float, float, float]:
    """Return a [m], reach [m] and φ [rad]: a + reach sin(θ - φ) is the height of the needle's point
    at θ.
    """
    cosine, sine = hole.slope
    x, _, z = hole.centre
    px, _, pz, r0, r1, _, _, _, _, r6, r7, _ = simulation.needle()
    b, c = sine * r0 + cosine * r6, sine * r1 + cosine * r7
    return (
        sine * (px - x) + cosine * (pz - z),
        simulation.radius * math.hypot(b, c),
        math.atan2(b, c),
    )


def _within(point: Point, hole: Hole) -> bool:
    """Say whether a point of the hole's plane lies in the opening."""
    (cosine, sine), (x, y, z), (qx, qy, qz) = hole.slope, hole.centre, point
    return abs(cosine * (qx - x) - sine * (qz - z)) < OPENING / 2 and abs(qy - y) < OPENING / 2


def _passes(before: Point, now: Point, hole: Hole, inward: bool) -> bool:
    """Say whether the way from `before` to `now` crosses the hole's plane inside the opening."""
    cosine, sine = hole.slope
    x, _, z = hole.centre
    start, end = (
        sine * (before[0] - x) + cosine * (before[2] - z),
        sine * (now[0] - x) + cosine * (now[2] - z),
    )
    if not (start > 0.0 >= end if inward else start <= 0.0 < end):
        return False
    share = start / (start - end)
    at = (
        before[0] + share * (now[0] - before[0]),
        before[1] + share * (now[1] - before[1]),
        before[2] + share * (now[2] - before[2]),
    )
    return _within(at, hole)
