"""Ridge: where the phantom's tissue is, and where a needle's arc meets it, in plain floats.

Everything is in the phantom's frame, in which the layouts are given; the phantom may be shifted and
turned about z. Flanks are numbered: 2 × piece is that of the entry, 2 × piece + 1 that of the exit.
The crest is treated as sharp: the two flanks continue until they meet.
"""

import math
from collections.abc import Sequence

from surgicai_vision.envs.bite import NO_FLANK
from surgicai_vision.scene import needle, phantom
from surgicai_vision.scene.holes import PAIRS, SURFACE, Point

STEP = 0.0005
"""Step of the search along an arc that was put into the tissue [m]."""
EMBEDDED = 0.0005
"""Depth of the tip [m] from which a needle that was put in place counts as inside the tissue."""
BEHIND = math.radians(60.0)
"""How far the arc is continued beyond the needle's base to find where it went in [rad]."""


class Ridge:
    """The ridge of one layout.

    Args:
        layout: a key of `holes.PAIRS`.
    """

    def __init__(self, layout: str):
        pairs = PAIRS[layout]
        self._edges = phantom.piece_edges(pairs)
        self._planes: list[tuple[float, float, float]] = []
        for pair in pairs:
            for hole in (pair.entry, pair.exit):
                nx = math.sin(hole.tilt)
                nz = math.cos(hole.tilt)
                self._planes.append((nx, nz, nx * hole.centre[0] + nz * hole.centre[2]))
        self.top = max(
            pair.entry.centre[2] + pair.gap / 2 * math.tan(abs(pair.entry.tilt)) for pair in pairs
        )
        """A height [m] above the whole ridge."""
        self.put((0.0, 0.0, 0.0), 0.0)

    def put(self, place: Point, turn: float) -> None:
        """Put the phantom's frame at a place in world [m], turned about z [rad]."""
        self._place = place
        self._turn = (math.cos(turn), math.sin(turn))

    def to_world(self, point: Point) -> Point:
        """Return a point of the phantom's frame in world [m]."""
        x, y, z = point
        c, s = self._turn
        px, py, pz = self._place
        return (c * x - s * y + px, s * x + c * y + py, z + pz)

    def to_phantom(self, point: Point) -> Point:
        """Return a point of the world in the phantom's frame [m]."""
        px, py, pz = self._place
        x, y, z = point
        return self.direction((x - px, y - py, z - pz))

    def direction(self, vector: Point) -> Point:
        """Return a direction of the world in the phantom's frame."""
        c, s = self._turn
        x, y, z = vector
        return (c * x + s * y, c * y - s * x, z)

    def piece(self, point: Point) -> int:
        """Return the index of the piece at a point's y, -1 beyond the ridge's ends."""
        y = point[1]
        edges = self._edges
        return -1 if y > edges[0] or y < edges[-1] else self.nearest_piece(point)

    def nearest_piece(self, point: Point) -> int:
        """Return the index of the piece at a point's y; beyond an end, that of the last piece."""
        y = point[1]
        edges = self._edges
        piece = 0
        while piece < len(edges) - 2 and y < edges[piece + 1]:
            piece += 1
        return piece

    def normal(self, flank: int) -> tuple[float, float]:
        """Return x and z of a flank's outward normal; its y is 0."""
        nx, nz, _ = self._planes[flank]
        return nx, nz

    def over(self, flank: int, point: Point) -> float:
        """Return the height of a point over a flank's plane [m]."""
        nx, nz, level = self._planes[flank]
        return nx * point[0] + nz * point[2] - level

    def height(self, point: Point) -> float:
        """Return the height of a point over the nearer flank: negative inside [m]."""
        flank = 2 * self.nearest_piece(point)
        return max(self.over(flank, point), self.over(flank + 1, point))

    def is_inside(self, point: Point) -> bool:
        """Return True if a point is in the ridge, above the flat tissue."""
        return point[2] > SURFACE and self.piece(point) >= 0 and self.height(point) < 0.0

    def flank_above(self, point: Point) -> int:
        """Return the flank that a point is outside of, `NO_FLANK` if it left elsewhere."""
        piece = self.piece(point)
        if piece < 0 or point[2] < SURFACE:
            return NO_FLANK
        first = self.over(2 * piece, point)
        second = self.over(2 * piece + 1, point)
        if max(first, second) < 0.0:
            return NO_FLANK
        return 2 * piece + (0 if first > second else 1)


class NeedleArc:
    """The needle's arc in the phantom's frame.

    Args:
        ridge: gives the phantom's frame and surface.
    """

    def __init__(self, ridge: Ridge):
        self._ridge = ridge
        self.radius = needle.RADIUS
        self.tip_angle = needle.TIP_ANGLE
        self._centre: Point = (0.0, 0.0, 0.0)
        self._u: Point = (1.0, 0.0, 0.0)
        self._v: Point = (0.0, 1.0, 0.0)

    def read(self, pose: Sequence[float]) -> None:
        """Set the arc from the needle's position [m] and quaternion (w, x, y, z) in world."""
        x, y, z, w, i, j, k = pose
        direction = self._ridge.direction
        self._centre = self._ridge.to_phantom((x, y, z))
        self._u = direction(
            (1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j + w * k), 2.0 * (i * k - w * j))
        )
        self._v = direction(
            (2.0 * (i * j - w * k), 1.0 - 2.0 * (i * i + k * k), 2.0 * (j * k + w * i))
        )

    def at(self, angle: float) -> Point:
        """Return the needle's point at `angle` [rad]."""
        along = -self.radius * math.cos(angle)
        across = self.radius * math.sin(angle)
        x, y, z = self._centre
        u = self._u
        v = self._v
        return (
            x + along * u[0] + across * v[0],
            y + along * u[1] + across * v[1],
            z + along * u[2] + across * v[2],
        )

    @property
    def tip(self) -> Point:
        """Return the needle's tip."""
        return self.at(self.tip_angle)

    def nearest(self, point: Point) -> float:
        """Return the angle of the needle's point nearest to a point [rad], in (-π/2, 3π/2]."""
        dx, dy, dz = (a - b for a, b in zip(point, self._centre, strict=True))
        u = self._u
        v = self._v
        along = -(u[0] * dx + u[1] * dy + u[2] * dz)
        across = v[0] * dx + v[1] * dy + v[2] * dz
        # From the middle of the range, so that no angle of a needle is near the cut.
        return math.pi / 2 - math.atan2(along, across)

    def towards(self, flank: int) -> float:
        """Return the cosine of the angle between the tip's direction and a flank's normal."""
        nx, nz = self._ridge.normal(flank)
        sine = math.sin(self.tip_angle)
        cosine = math.cos(self.tip_angle)
        u = self._u
        v = self._v
        return nx * (sine * u[0] + cosine * v[0]) + nz * (sine * u[2] + cosine * v[2])

    def crossing(self, flank: int, near: float, *, inward: bool) -> float | None:
        """Return the angle [rad], nearest to `near`, at which the arc crosses a flank's plane.

        Along the arc the height over the plane is a + reach sin(θ - φ); it rises through 0 at one
        angle and falls through it at another. None if the circle does not meet the plane.
        """
        nx, nz = self._ridge.normal(flank)
        u = self._u
        v = self._v
        b = nx * u[0] + nz * u[2]
        c = nx * v[0] + nz * v[2]
        height = self._ridge.over(flank, self._centre)
        reach = self.radius * math.hypot(b, c)
        if abs(height) >= reach:
            return None
        rising = math.asin(height / reach)
        phase = math.atan2(b, c)
        angle = phase + (math.pi + rising if inward else -rising)
        return near + math.remainder(angle - near, 2.0 * math.pi)

    def embedded(self) -> tuple[int, int, float, float] | None:
        """Return where the arc lies in the tissue, or None if it does not.

        Returns:
            Entry flank, exit flank (`NO_FLANK` if the tip is inside), and the angles [rad] of both
            ends of the embedded part, for the passage nearest to the tip. If the needle's base is
            inside, the entry lies beyond the base.
        """
        ridge = self._ridge
        step = STEP / self.radius
        angle = self.tip_angle
        while angle > 0.0 and not ridge.is_inside(self.at(angle)):
            angle -= step
        if angle <= 0.0:
            return None
        out_of = NO_FLANK
        end = self.tip_angle
        if angle < end:
            out_of = ridge.flank_above(self.at(angle + step))
            crossing = self.crossing(out_of, angle, inward=False) if out_of != NO_FLANK else None
            if crossing is None:
                return None
            end = crossing
        elif ridge.height(self.at(end)) > -EMBEDDED:
            return None
        while angle > -BEHIND and ridge.is_inside(self.at(angle)):
            angle -= step
        into = ridge.flank_above(self.at(angle))
        start = self.crossing(into, angle, inward=True) if into != NO_FLANK else None
        if start is None or (end - start) * self.radius < EMBEDDED:
            return None
        return into, out_of, start, end
