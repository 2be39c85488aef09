"""Skin decals: marks of ink and wounds, thin meshes that lie on soft skin and move with it."""

import math

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.scene.holes import SURFACE, Hole, HolePair, Point
from surgicai_vision.scene.phantom import ORIGIN, piece_edges
from surgicai_vision.scene.visual.skin import LIFT
from surgicai_vision.scene.visual.skin_state import Array, Pull, Wound, displaced

Faces = NDArray[np.int64]

MARK_LIFT = 0.00006
"""Height of the ink above the skin [m]."""
WOUND_LIFT = 0.00012
"""Height of wounds above the skin [m]; the reddened skin around them lies halfway between."""
RISE = 0.12
"""Further lift of ink and wounds, per displacement of the skin: between its lines the drawn skin is
flat, and would hide points that follow the bell exactly."""
ARM = (0.0014, 0.0022)
"""Half the length of a mark's two strokes [m]: of other pairs, and of the pair to be sewn."""
STROKE = (0.00025, 0.0004)
"""Half of their width [m]."""
STROKE_PARTS = 8
"""Parts of a stroke, which bends with the skin."""
WOUNDS = 16
"""How many wounds can be shown: two for each bite that soft tissue remembers."""
WOUND = 0.00045
"""Half of a puncture's width [m]: the needle's (`needle.BODY_RADIUS`)."""
HALO = 1.9
"""Size of the reddened skin around a wound, in multiples of the wound's."""
RAGGED = (1.0, 0.86, 1.1, 0.9, 1.15, 0.95, 0.84, 1.08, 0.92, 1.12, 0.88, 1.04)
"""Distances of a wound's rim from its middle, in multiples of its size."""
PARKED = (ORIGIN[0], ORIGIN[1], SURFACE - 0.02)
"""Where unused wounds are hidden, inside the phantom [m]."""


class Marks:
    """Crosses of ink at the holes of a layout.

    Args:
        pairs: the layout's hole pairs.
    """

    def __init__(self, pairs: tuple[HolePair, ...]):
        self._pairs = pairs
        # By kind, pair by pair: points and normals.
        self._points = [[_crosses(pair, kind) for pair in pairs] for kind in (0, 1)]
        size = len(self._points[0][0]) // 2
        self._normals = [
            np.repeat([pair.entry.normal, pair.exit.normal], size, axis=0) for pair in pairs
        ]

    def faces(self, *, chosen: bool) -> Faces:
        """Return the triangles of the pair to be sewn, or of the others, (m, 3)."""
        pairs = 1 if chosen else len(self._pairs) - 1
        part = 2 * np.arange(STROKE_PARTS)[:, None]
        one = np.concatenate([part + np.array([0, 2, 3]), part + np.array([0, 3, 1])])
        points = 2 * (STROKE_PARTS + 1)
        return np.concatenate([one + points * index for index in range(4 * pairs)])

    def draw(self, pair: int, pulls: tuple[Pull, ...], *, chosen: bool) -> tuple[Array, Array]:
        """Return points and normals, (n, 3) each; `pair` is the index of the one to be sewn."""
        shown = [pair] if chosen else [index for index in range(len(self._pairs)) if index != pair]
        points = np.concatenate([self._points[chosen][index] for index in shown])
        return _lifted(points, pulls), np.concatenate([self._normals[index] for index in shown])


class Wounds:
    """Wounds on the flanks of a layout.

    Args:
        pairs: the layout's hole pairs.
    """

    def __init__(self, pairs: tuple[HolePair, ...]):
        self._pairs = pairs
        self._edges = piece_edges(pairs)
        nothing = (np.zeros((0, 3)), np.zeros((0, 3)))
        self._kept: list[tuple[tuple[Wound, ...] | None, tuple[Array, Array]]] = [
            (None, nothing),
            (None, nothing),
        ]

    def faces(self) -> Faces:
        """Return the triangles of all wounds, (m, 3)."""
        sides = len(RAGGED)
        rim = np.arange(sides)
        one = np.stack([np.zeros(sides, np.int64), 1 + rim, 1 + (rim + 1) % sides], axis=1)
        return np.concatenate([one + (sides + 1) * index for index in range(WOUNDS)])

    def draw(
        self, wounds: tuple[Wound, ...], pulls: tuple[Pull, ...], *, halo: bool
    ) -> tuple[Array, Array]:
        """Return points and normals, (n, 3) each, of the wounds or of the halos around them.

        The latest `WOUNDS` are shown; unused ones are hidden.
        """
        points, normals = self._whole(wounds[-WOUNDS:], halo)
        return _lifted(points, pulls), normals

    def _whole(self, wounds: tuple[Wound, ...], halo: bool) -> tuple[Array, Array]:
        """Return points and normals on undeformed skin; those of the last wounds are cached."""
        if self._kept[halo][0] == wounds:
            return self._kept[halo][1]
        size = HALO if halo else 1.0
        lift = LIFT + ((MARK_LIFT + WOUND_LIFT) / 2 if halo else WOUND_LIFT)
        spare = np.insert(_rim(size, 0.0), 2, 0.0, axis=1) + PARKED
        points = [spare] * WOUNDS
        normals = np.tile((0.0, 0.0, 1.0), (WOUNDS * len(spare), 1))
        for index, wound in enumerate(wounds):
            hole = self._plane(wound.start)
            points[index] = _decal(hole, wound, size, lift)
            normals[index * len(spare) : (index + 1) * len(spare)] = hole.normal
        drawn = (np.concatenate(points), normals)
        self._kept[halo] = (wounds, drawn)
        return drawn

    def _plane(self, point: Point) -> Hole:
        """Return the hole whose flank a point is on."""
        piece = 0
        while piece < len(self._edges) - 2 and point[1] < self._edges[piece + 1]:
            piece += 1
        pair = self._pairs[piece]
        return min((pair.entry, pair.exit), key=lambda hole: abs(hole.height(point)))


def _crosses(pair: HolePair, kind: int) -> Array:
    """Return the points of a cross at each hole of a pair, (n, 3)."""
    along = np.linspace(-ARM[kind], ARM[kind], STROKE_PARTS + 1)
    sides = np.array([-STROKE[kind], STROKE[kind]])
    x, y = (axis.ravel() for axis in np.meshgrid(along, sides, indexing="ij"))
    return np.concatenate(
        [
            _on_plane(hole, *stroke, LIFT + MARK_LIFT)
            for hole in (pair.entry, pair.exit)
            for stroke in ((x, y), (-y, x))
        ]
    )


def _rim(size: float, length: float) -> Array:
    """Return a wound's middle and rim in its plane, (n, 2) [m]: across and along.

    Args:
        size: as a multiple of a wound's.
        length: half of the distance along which it is torn [m].
    """
    angles = np.arange(len(RAGGED)) * (2 * math.pi / len(RAGGED))
    rim = np.array(RAGGED) if size == 1.0 else np.ones(len(RAGGED))
    circle = rim[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    flat: Array = np.concatenate([np.zeros((1, 2)), circle]) * WOUND * size
    return flat * (1.0, 1.0 + length / WOUND)


def _decal(hole: Hole, wound: Wound, size: float, lift: float) -> Array:
    """Return the points of one wound on undeformed skin, (n, 3)."""
    start = np.array(hole.local(wound.start)[:2])
    end = np.array(hole.local(wound.end)[:2])
    half = (end - start) / 2
    length = float(np.linalg.norm(half))
    along = half / length if length else np.array([0.0, 1.0])
    across = np.array([along[1], -along[0]])
    rim = _rim(size, length)
    x, y = ((start + end) / 2 + rim[:, :1] * across + rim[:, 1:] * along).T
    return _on_plane(hole, x, y, lift)


def _lifted(points: Array, pulls: tuple[Pull, ...]) -> Array:
    """Return the displaced points of ink or wounds, a little above the skin that is drawn."""
    taken = displaced(points, pulls)
    taken[:, 2] += RISE * np.linalg.norm(taken - points, axis=1)
    return taken


def _on_plane(hole: Hole, x: Array, y: Array, lift: float) -> Array:
    """Return points of a hole's plane in the phantom's frame, (n, 3)."""
    first, second, normal = (np.array(axis) for axis in hole.axes)
    points: Array = np.array(hole.centre) + x[:, None] * first + y[:, None] * second + lift * normal
    return points
