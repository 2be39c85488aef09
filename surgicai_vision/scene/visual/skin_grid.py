"""Skin grid: the closed skin of soft tissue, as a grid with a fixed number of points.

The grid runs over two coordinates: y along the wound, and a running number across. Between the few
lines that its form needs, the skin is flat. More lines gather around pulls, so that a dent is
smooth wherever it is.
"""

import itertools

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.scene.holes import SURFACE, HolePair, Point
from surgicai_vision.scene.phantom import ORIGIN, SIZE, flank_height, piece_edges
from surgicai_vision.scene.visual.skin import (
    FILLET,
    LIFT,
    MARGIN,
    RAMP,
    STRIP,
    crest_line,
    flank_line,
    flattened,
)
from surgicai_vision.scene.visual.skin_state import Array, Pull

BESIDE = 6
"""Points across the flat tissue on each side of the ridge."""
ROUND = 3
"""Points of the fillet at the ridge's foot."""
OVER = 5
"""Points over the crest."""
FLAT_ROWS = 5
"""Rows of points in front of and behind the ridge."""
FINE = (-2.0, -1.3, -0.8, -0.45, -0.15, 0.15, 0.45, 0.8, 1.3, 2.0)
"""Offsets of the lines around a pull, in multiples of its reach."""
FOCI = 2
"""How many pulls get their own lines across the skin; the lines along it are those of the largest
pull. Entry and exit of a stitch share them."""


class SkinGrid:
    """The grid of one layout; `gather` lays its lines and sets their `points` and `coordinates`.

    Args:
        pairs: the layout's hole pairs.
    """

    def __init__(self, pairs: tuple[HolePair, ...]):
        self._rows, self._sections = _form(pairs)
        steps = np.linalg.norm(np.diff(np.insert(self._sections, 1, 0.0, axis=2), axis=1), axis=2)
        across = np.concatenate([np.zeros((len(self._rows), 1)), np.cumsum(steps, axis=1)], axis=1)
        self._across = (across - across.mean(axis=1, keepdims=True)) / SIZE[0]
        self._columns = np.arange(self._sections.shape[1], dtype=np.float64)
        self._places: tuple[tuple[Point, float], ...] = ()

    def gather(self, pulls: list[Pull]) -> None:
        """Lay the fine lines around `pulls`: at least `FOCI` of them, the largest first."""
        places = tuple((pull.place, pull.reach) for pull in pulls[:FOCI])
        if places == self._places:
            return
        self._places = places
        fine = np.array(FINE)
        across = [self._nearby(pull.place, fine * pull.reach) for pull in pulls[:FOCI]]
        along = np.clip(pulls[0].place[1] + fine * pulls[0].reach, self._rows[-1], self._rows[0])
        self._u = np.sort(np.concatenate([self._columns, *across]))
        self._y = np.sort(np.concatenate([self._rows, along]))[::-1]
        self.points = self._at(self._sections).reshape(-1, 3)
        u = self._interpolated(self._across)
        y = np.broadcast_to(self._y[:, None] / SIZE[1], u.shape)
        self.coordinates = np.stack([u, y], axis=2).reshape(-1, 2)

    def faces(self) -> NDArray[np.int64]:
        """Return the triangles, (m, 3)."""
        shape = (len(self._y), len(self._u))
        numbers = np.arange(shape[0] * shape[1]).reshape(shape)
        a, b = numbers[:-1, :-1].ravel(), numbers[1:, :-1].ravel()
        c, d = numbers[1:, 1:].ravel(), numbers[:-1, 1:].ravel()
        return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])

    def normals(self, points: Array) -> Array:
        """Return unit normals (n, 3): the area-weighted mean of the four quads around a point."""
        grid = points.reshape(len(self._y), len(self._u), 3)
        quads = np.cross(grid[1:, 1:] - grid[:-1, :-1], grid[:-1, 1:] - grid[1:, :-1])
        total = np.zeros_like(grid)
        for rows, columns in itertools.product((slice(None, -1), slice(1, None)), repeat=2):
            total[rows, columns] += quads
        return unit(total.reshape(-1, 3))

    def _nearby(self, place: Point, offsets: Array) -> Array:
        """Return the running numbers of points at given distances across from a place."""
        section = self._interpolated_section(place[1])
        steps = np.diff(section, axis=0)
        offset = np.array([place[0], place[2]]) - section[:-1]
        share = np.clip((offset * steps).sum(axis=1) / (steps**2).sum(axis=1), 0.0, 1.0)
        nearest = int(np.argmin(np.linalg.norm(offset - share[:, None] * steps, axis=1)))
        sizes = np.linalg.norm(steps, axis=1)
        lengths = np.concatenate([[0.0], np.cumsum(sizes)])
        best = lengths[nearest] + share[nearest] * sizes[nearest]
        numbers: Array = np.interp(best + offsets, lengths, self._columns)
        return numbers

    def _interpolated_section(self, y: float) -> Array:
        """Return the section at y, (columns, 2)."""
        rising = self._rows[::-1]
        after = int(np.clip(np.searchsorted(rising, y), 1, len(rising) - 1))
        share = float(np.clip((y - rising[after - 1]) / (rising[after] - rising[after - 1]), 0, 1))
        sections = self._sections[::-1]
        section: Array = (1 - share) * sections[after - 1] + share * sections[after]
        return section

    def _at(self, sections: Array) -> Array:
        """Return the grid's points, (rows, columns, 3)."""
        x, z = (self._interpolated(sections[:, :, axis]) for axis in (0, 1))
        y = np.broadcast_to(self._y[:, None], x.shape)
        return np.stack([x, y, z], axis=2)

    def _interpolated(self, values: Array) -> Array:
        """Return values given on the form's lines (rows, columns), interpolated to all lines."""
        first = np.minimum(self._u.astype(np.int64), values.shape[1] - 2)
        share = self._u - first
        wide = values[:, first] * (1 - share) + values[:, first + 1] * share
        rising = self._rows[::-1]
        after = np.clip(np.searchsorted(rising, self._y), 1, len(rising) - 1)
        span = rising[after] - rising[after - 1]
        part = ((self._y - rising[after - 1]) / span)[:, None]
        turned = wide[::-1]
        both: Array = turned[after - 1] * (1 - part) + turned[after] * part
        return both


def _form(pairs: tuple[HolePair, ...]) -> tuple[Array, Array]:
    """Return the rows' y, descending, (rows,) and sections, (rows, columns, 2): x and z [m]."""
    sections = [_section(pair) for pair in pairs]
    edges = piece_edges(pairs)
    ends = (ORIGIN[1] + SIZE[1] / 2, ORIGIN[1] - SIZE[1] / 2)
    rows: list[tuple[float, Array]] = []
    first = flattened(sections[0])
    rows += [(y, first) for y in np.linspace(ends[0], edges[0] + STRIP, FLAT_ROWS)]
    rows += [(edges[0], first), (edges[0] - RAMP, sections[0])]
    for pair, section in zip(pairs, sections, strict=True):
        y = pair.entry.centre[1]
        rows += [(y + MARGIN, section), (y - MARGIN, section)]
    last = flattened(sections[-1])
    rows += [(edges[-1] + RAMP, sections[-1]), (edges[-1], last)]
    rows += [(y, last) for y in np.linspace(edges[-1] - STRIP, ends[1], FLAT_ROWS)]
    return np.array([y for y, _ in rows]), np.stack([section for _, section in rows])


def _section(pair: HolePair) -> Array:
    """Return the skin's section at one pair, (columns, 2), from -x to +x."""
    height = flank_height(pair, pair.entry)
    sides = []
    for hole, sign in ((pair.entry, -1.0), (pair.exit, 1.0)):
        line = flank_line(hole, height, LIFT)
        foot = line[0]
        step = (line[-1] - foot) / np.linalg.norm(line[-1] - foot)
        above = foot + FILLET * step
        end = ORIGIN[0] + sign * SIZE[0] / 2
        flat = np.linspace((end, SURFACE), (foot[0] + sign * FILLET, SURFACE), BESIDE)
        share = np.linspace(0.0, 1.0, ROUND + 1)[1:, None]
        fillet = (1 - share) ** 2 * flat[-1] + 2 * share * (1 - share) * foot + share**2 * above
        sides.append(np.concatenate([flat + np.array([0.0, LIFT]), fillet, line[-1:]]))
    return np.concatenate([sides[0], crest_line(pair, height, LIFT, OVER), sides[1][::-1]])


def unit(vectors: Array) -> Array:
    """Return the vectors scaled to length 1, or pointing upwards where they have none."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    units: Array = np.where(length > 1e-15, vectors / np.maximum(length, 1e-15), (0.0, 0.0, 1.0))
    return units
