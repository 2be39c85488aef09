"""Bite measures: where a stitch went in and out of the tissue, how deep, and at which angles.

A *bite* is one passage of the needle through the tissue. Two watches follow the needle's tip step
by step and give the same measures of the latest bite of an episode:

* `ChannelWatch`, tissue "channels": a bite begins where the tip passes inwards through the entry's
  opening and ends where it passes outwards through the exit's. The openings are squares with sides
  of `holes.OPENING`, so an error is at most half their diagonal, 2.7 mm.
* `SoftWatch`, tissue "soft": the tissue itself reports the bites (`envs.tissue`); they can begin
  and end anywhere.

The measures, each NaN if its part of the bite was not made in this episode (a start inside the
tissue comes with its own bite):

* `entry_error`, `exit_error`: from the bite's point to the mark (the hole's centre) [m].
* `length`: straight-line distance from entry to exit [m].
* `depth`: of the deepest point of the tip's path below that straight line, along world -z [m].
* `entry_angle`, `exit_angle`: between the needle's tangent at its tip and the skin's normal at the
  mark, when the tip goes in or out [rad]; 0 is perpendicular, as surgical textbooks recommend.
* `wrong_hole`: in channels, the tip went through an opening of another stitch, or through this exit
  from outside, and has not left through the right exit since. In soft tissue, the latest bite
  begins or ends nearer to another mark than to its own.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from surgicai_vision.envs import poses
from surgicai_vision.envs.bite import Bite
from surgicai_vision.envs.hole_crossing import JUMP, crossing
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.tissue import Tissue
from surgicai_vision.scene.holes import Hole, HolePair, Point


@dataclass(frozen=True)
class BiteMeasures:
    """Measures of one bite; see the module's docstring."""

    entry_error: float = math.nan
    exit_error: float = math.nan
    depth: float = math.nan
    length: float = math.nan
    entry_angle: float = math.nan
    exit_angle: float = math.nan
    wrong_hole: bool = False


class BiteWatch(Protocol):
    """Follows the needle's tip."""

    measures: BiteMeasures
    """Measures of the latest bite."""

    def update(self) -> None:
        """Read the state that a control step ended in."""


def watch_of(simulation: Simulation, pair: HolePair, others: Sequence[HolePair]) -> BiteWatch:
    """Return a watch that follows the tip of a simulation from its present state on.

    Args:
        simulation: the simulation.
        pair: the stitch's marks.
        others: the phantom's other pairs.
    """
    if simulation.tissue is None:
        return ChannelWatch(simulation, pair, others)
    return SoftWatch(simulation, simulation.tissue, pair, others)


def depth_under(entry: Point, leave: Point, path: Sequence[Point]) -> float:
    """Return how deep a path goes below the straight line from `entry` to `leave` [m].

    Measured along world -z over the points of the path that lie between the two along the line; at
    least 0.
    """
    way = [after - before for before, after in zip(entry, leave, strict=True)]
    square = sum(part * part for part in way)
    deepest = 0.0
    for point in path:
        offset = [now - before for before, now in zip(entry, point, strict=True)]
        share = sum(a * b for a, b in zip(way, offset, strict=True)) / square
        if 0.0 <= share <= 1.0:
            deepest = max(deepest, share * way[2] - offset[2])
    return deepest


def angle_to(direction: Point, needle_tangent: Point) -> float:
    """Return the angle between two unit vectors [rad]."""
    cosine = sum(a * b for a, b in zip(direction, needle_tangent, strict=True))
    return math.acos(max(-1.0, min(1.0, cosine)))


def tip_tangent(simulation: Simulation) -> Point:
    """Return the unit tangent of the needle at its tip, forwards, in world."""
    r0, r1, _, r3, r4, _, r6, r7, _ = poses.rotation(simulation.needle())
    along = math.sin(simulation.tip_angle)
    across = math.cos(simulation.tip_angle)
    return (r0 * along + r1 * across, r3 * along + r4 * across, r6 * along + r7 * across)


def _inwards(hole: Hole) -> Point:
    x, y, z = hole.normal
    return (-x, -y, -z)


def _in_world(hole: Hole, local: tuple[float, float]) -> Point:
    """Return a point of a hole's plane in world [m]."""
    first, second, _ = hole.axes
    x, y, z = (
        centre + local[0] * a + local[1] * b
        for centre, a, b in zip(hole.centre, first, second, strict=True)
    )
    return (x, y, z)


class ChannelWatch:
    """Follows the tip through open channels.

    Args:
        simulation: read from its present state on.
        pair: the stitch's holes.
        others: the phantom's other pairs.
    """

    def __init__(self, simulation: Simulation, pair: HolePair, others: Sequence[HolePair]):
        self.measures = BiteMeasures()
        self._simulation = simulation
        self._pair = pair
        self._others = others
        self._is_inside = simulation.task_state.holes_passed >= 1
        self._entry: Point | None = None
        self._path: list[Point] = []
        self._tip = simulation.needle_point(simulation.tip_angle)

    def update(self) -> None:
        """Read the state that a control step ended in."""
        before = self._tip
        self._tip = now = self._simulation.needle_point(self._simulation.tip_angle)
        if math.dist(before, now) <= JUMP:
            self._note_crossings(before, now)
        if self._is_inside:
            self._path.append(now)

    def _note_crossings(self, before: Point, now: Point) -> None:
        """Record where the tip went through the opening of any hole."""
        pair = self._pair
        entering = crossing(before, now, pair.entry, inward=True)
        leaving = crossing(before, now, pair.exit, inward=False)
        if entering is not None:
            self._enter(entering)
        elif leaving is not None and self._is_inside:
            self._leave(leaving)
        elif crossing(before, now, pair.entry, inward=False):
            self._is_inside = False
        elif not self._is_inside and crossing(before, now, pair.exit, inward=True):
            self.measures = replace(self.measures, wrong_hole=True)
        if any(
            crossing(before, now, hole, inward=True)
            for other in self._others
            for hole in (other.entry, other.exit)
        ):
            self.measures = replace(self.measures, wrong_hole=True)

    def _enter(self, place: tuple[float, float]) -> None:
        """Begin a bite; of the previous bite's measures only those of the entry are replaced."""
        hole = self._pair.entry
        self._is_inside = True
        self._entry = _in_world(hole, place)
        self._path = []
        self.measures = replace(
            self.measures,
            entry_error=math.hypot(*place),
            entry_angle=angle_to(_inwards(hole), tip_tangent(self._simulation)),
        )

    def _leave(self, place: tuple[float, float]) -> None:
        """End the bite."""
        hole = self._pair.exit
        leave = _in_world(hole, place)
        entry = self._entry
        self.measures = replace(
            self.measures,
            exit_error=math.hypot(*place),
            exit_angle=angle_to(hole.normal, tip_tangent(self._simulation)),
            depth=math.nan if entry is None else depth_under(entry, leave, self._path),
            length=math.nan if entry is None else math.dist(entry, leave),
            wrong_hole=False,
        )


class SoftWatch:
    """Follows the bites that soft tissue records.

    Args:
        simulation: read from its present state on.
        tissue: its tissue.
        pair: the stitch's marks.
        others: the phantom's other pairs.
    """

    def __init__(
        self,
        simulation: Simulation,
        tissue: Tissue,
        pair: HolePair,
        others: Sequence[HolePair],
    ):
        self.measures = BiteMeasures()
        self._simulation = simulation
        self._tissue = tissue
        self._pair = pair
        self._marks = [hole for each in (pair, *others) for hole in (each.entry, each.exit)]
        self._is_own = False
        self._began_wrong = False
        self._seen = self._latest()

    def update(self) -> None:
        """Read the state that a control step ended in."""
        before = self._seen
        now = self._seen = self._latest()
        if now is None:
            return
        if before is None or now.entry != before.entry:
            self._is_own = True
            self._enter(now)
        if now.exit is None:
            self.measures = replace(
                self.measures,
                exit_error=math.nan,
                exit_angle=math.nan,
                depth=math.nan,
                length=math.nan,
                wrong_hole=self._began_wrong,
            )
        elif before is None or now.exit != before.exit:
            self._leave(now, now.exit)

    def _latest(self) -> Bite | None:
        bites = self._tissue.bites
        return bites[-1] if bites else None

    def _enter(self, bite: Bite) -> None:
        """Begin a bite."""
        mark = self._nearest(bite.entry)
        self._began_wrong = mark is not self._pair.entry
        self.measures = BiteMeasures(
            entry_error=math.dist(bite.entry, self._pair.entry.centre),
            entry_angle=angle_to(_inwards(mark), tip_tangent(self._simulation)),
            wrong_hole=self._began_wrong,
        )

    def _leave(self, bite: Bite, leave: Point) -> None:
        """Record where the tip came out."""
        mark = self._nearest(leave)
        own = self._is_own
        self.measures = replace(
            self.measures,
            exit_error=math.dist(leave, self._pair.exit.centre),
            exit_angle=angle_to(mark.normal, tip_tangent(self._simulation)),
            depth=depth_under(bite.entry, leave, bite.path) if own else math.nan,
            length=math.dist(bite.entry, leave) if own else math.nan,
            wrong_hole=self._began_wrong or mark is not self._pair.exit,
        )

    def _nearest(self, point: Point) -> Hole:
        """Return the mark that is nearest to a point."""
        return min(self._marks, key=lambda mark: math.dist(mark.centre, point))
