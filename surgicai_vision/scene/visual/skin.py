"""Tissue: the phantom's visible skin, drawn over the boxes that are its physics.

At each hole the skin lies on the faces of the boxes; between two hole pairs, whose gaps differ, it
runs straight where the boxes have a step of up to 0.5 mm. The holes are open, have walls, and show
a dark inside. A ring of ink marks each hole, as on a training phantom, or only those of the pair to
be sewn (`SceneConfig.ink`).
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.scene.holes import OPENING, PAIRS, SURFACE, Hole, HolePair
from surgicai_vision.scene.phantom import CREST, ORIGIN, SIZE, WALL, flank_height, piece_edges
from surgicai_vision.scene.visual.shapes import HIDDEN, VISIBLE, Mesh

Array = NDArray[np.float64]

LIFT = 0.00005
"""Height of the skin above the boxes [m], so that they never show through it."""
INK_LIFT = 0.0001
"""Height of the ink above the boxes [m]."""
INK_WIDTH = 0.0009
"""Width of the ring of ink [m]."""
FILLET = 0.0015
"""Length over which the ridge's foot is rounded [m]."""
RAMP = 0.0015
"""Length over which the ridge falls at its ends [m]."""
MARGIN = 0.0012
"""Length along the wound beside a hole where the skin still lies on the boxes [m]."""
BESIDE = 8
"""Points across the flat tissue on each side of the ridge; lighting is per point."""
FLAT_ROWS = 7
"""Rows of points in front of and behind the ridge."""
STRIP = 0.0005
"""Length of the row next to the ridge [m]."""


def add_skin(spec: mujoco.MjSpec, layout: str) -> None:
    """Add the meshes "skin" (textured) and "inside" of a layout to `spec`."""
    pairs = PAIRS[layout]
    _skin(pairs).add_to(spec, "skin")
    _inside(pairs).add_to(spec, "inside")


def add_ink(spec: mujoco.MjSpec, name: str, pairs: Sequence[HolePair]) -> None:
    """Add a mesh of rings of ink around the openings of `pairs` to `spec`."""
    _ink(pairs).add_to(spec, name)


def ink_of(number: int) -> str:
    """Return the name, of a mesh and a geom, of the ink around pair 1, 2, 3 or 4 alone."""
    return f"ink{number}"


def ink_geoms(model: mujoco.MjModel, layout: str) -> tuple[int, ...]:
    """Return the ids of the ink geoms, pair 1 first, in a model where each pair has its own."""
    numbers = range(1, len(PAIRS[layout]) + 1)
    return tuple(model.geom(ink_of(number)).id for number in numbers)


def show_ink(model: mujoco.MjModel, geoms: Sequence[int], pair: int) -> None:
    """Show the ink around one pair alone.

    Args:
        model: an env's own.
        geoms: what `ink_geoms` returned; if empty, nothing changes.
        pair: index of the pair, 0 to 3.
    """
    for index, geom in enumerate(geoms):
        model.geom_group[geom] = VISIBLE if index == pair else HIDDEN


def flank_line(hole: Hole, height: float, offset: float) -> Array:
    """Return foot, lower and upper edge of the hole, and top of one flank, (4, 2): x and z [m].

    Args:
        height: from the hole's centre to the top, along the flank [m].
        offset: outwards from the boxes [m].
    """
    along = hole.rotation[:, 0] * -math.copysign(1.0, hole.tilt)
    normal = hole.rotation[:, 2]
    drop = (hole.centre[2] - SURFACE) / along[2]
    steps = np.array([-drop, -OPENING / 2, OPENING / 2, height])
    points = np.asarray(hole.centre) + steps[:, None] * along + offset * normal
    points[0] -= along * (points[0, 2] - SURFACE) / along[2]
    return points[:, [0, 2]]


def crest_line(pair: HolePair, height: float, offset: float, count: int) -> Array:
    """Return `count` points over the ridge's top between the two flanks, (count, 2)."""
    tilt = abs(pair.entry.tilt)
    x = (pair.entry.centre[0] + pair.exit.centre[0]) / 2
    z = pair.entry.centre[2] + height * math.sin(tilt) - CREST * math.cos(tilt)
    angles = np.linspace(-tilt, tilt, count + 2)[1:-1]
    return np.array([x, z]) + (CREST + offset) * np.stack([np.sin(angles), np.cos(angles)], axis=1)


def _profile(pair: HolePair) -> Array:
    """Return the skin's section at one pair, (points, 2), from -x to +x."""
    height = flank_height(pair, pair.entry)
    left, right = (flank_line(hole, height, LIFT) for hole in (pair.entry, pair.exit))
    edge = SIZE[0] / 2
    sides = []
    for flank, end in ((left, ORIGIN[0] - edge), (right, ORIGIN[0] + edge)):
        foot = flank[0]
        above = flank[0] + (flank[1] - flank[0]) * FILLET / np.linalg.norm(flank[1] - flank[0])
        flat = np.linspace((end, SURFACE), (foot[0] + math.copysign(FILLET, end), SURFACE), BESIDE)
        share = np.linspace(0.0, 1.0, 5)[1:, None]
        fillet = (1 - share) ** 2 * flat[-1] + 2 * share * (1 - share) * foot + share**2 * above
        sides.append(np.concatenate([flat + np.array([0.0, LIFT]), fillet, flank[1:]]))
    return np.concatenate([sides[0], crest_line(pair, height, LIFT, 5), sides[1][::-1]])


LEFT_HOLE = BESIDE + 4
"""Column of a profile at which the entry hole begins; it ends at the next."""


def _rows(pairs: Sequence[HolePair], profiles: Sequence[Array]) -> list[tuple[float, Array, bool]]:
    """Return y [m], section and "a hole begins here" of each row, from +y to -y."""
    edges = piece_edges(tuple(pairs))
    rows = []
    for pair, profile in zip(pairs, profiles, strict=True):
        y = pair.entry.centre[1]
        reach = OPENING / 2 + MARGIN
        for shift, opens in (
            (reach, False),
            (OPENING / 2, True),
            (-OPENING / 2, False),
            (-reach, False),
        ):
            rows.append((y + shift, profile, opens))
    first = flattened(profiles[0])
    last = flattened(profiles[-1])
    far = [ORIGIN[1] + SIZE[1] / 2, ORIGIN[1] - SIZE[1] / 2]
    # A short strip beside the ridge's end keeps its slope out of the flat tissue's normals.
    head = [
        (y, first, False) for y in (*np.linspace(far[0], edges[0] + STRIP, FLAT_ROWS - 1), edges[0])
    ]
    tail = [
        (y, last, False)
        for y in (edges[-1], *np.linspace(edges[-1] - STRIP, far[1], FLAT_ROWS - 1))
    ]
    full = [(edges[0] - RAMP, profiles[0], False)], [(edges[-1] + RAMP, profiles[-1], False)]
    return head + full[0] + rows + full[1] + tail


def flattened(profile: Array) -> Array:
    """Return the section beyond the end of the ridge."""
    flat = profile.copy()
    flat[:, 1] = SURFACE + LIFT
    return flat


def _skin(pairs: tuple[HolePair, ...]) -> Mesh:
    """Return the outer surface without the openings.

    The texture runs along it without stretching.
    """
    rows = _rows(pairs, [_profile(pair) for pair in pairs])
    points = np.stack([np.insert(section, 1, y, axis=1) for y, section, _ in rows])
    steps = np.linalg.norm(np.diff(points, axis=1), axis=2)
    across = np.concatenate([np.zeros((len(rows), 1)), np.cumsum(steps, axis=1)], axis=1)
    across -= across.mean(axis=1, keepdims=True)
    coordinates = np.stack([across / SIZE[0], points[:, :, 1] / SIZE[1]], axis=2)
    keep = np.ones((len(rows) - 1, points.shape[1] - 1), bool)
    for index, (_, _, opens) in enumerate(rows[:-1]):
        if opens:
            keep[index, [LEFT_HOLE, -LEFT_HOLE - 1]] = False
    mesh = Mesh()
    mesh.add_grid(points, coordinates, keep)
    return mesh


def _inside(pairs: tuple[HolePair, ...]) -> Mesh:
    """Return what shows through the holes: the openings' walls, the flanks' inner faces."""
    mesh = Mesh()
    sections = []
    for pair in pairs:
        height = flank_height(pair, pair.entry)
        inner = [flank_line(hole, height, -WALL) for hole in (pair.entry, pair.exit)]
        outer = [flank_line(hole, height, LIFT) for hole in (pair.entry, pair.exit)]
        sections.append(
            np.concatenate([inner[0], crest_line(pair, height, -WALL, 1), inner[1][::-1]])
        )
        for near, far in zip(outer, inner, strict=True):
            _add_walls(mesh, near[1:3], far[1:3], pair.entry.centre[1])
    # Column 1 of `flank_line` is the lower edge of a hole: 1..2 on the left, 6..7 on the right of
    # nine points.
    rows = [
        (y, section, opens) for y, section, opens in _rows(pairs, sections)[FLAT_ROWS:-FLAT_ROWS]
    ]
    points = np.stack([np.insert(section, 1, y, axis=1) for y, section, _ in rows])
    keep = np.ones((len(rows) - 1, points.shape[1] - 1), bool)
    for index, (_, _, opens) in enumerate(rows[:-1]):
        if opens:
            keep[index, [1, -2]] = False
    mesh.add_grid(points[:, ::-1], keep=keep[:, ::-1])
    return mesh


def _add_walls(mesh: Mesh, near: Array, far: Array, y: float) -> None:
    """Add the four walls of one opening between its outer and inner edges.

    An edge is (2, 2): lower and upper x, z.
    """
    reach = OPENING / 2
    loop = ((0, -reach), (1, -reach), (1, reach), (0, reach), (0, -reach))
    grid = np.array(
        [[[edge[i, 0], y + shift, edge[i, 1]] for i, shift in loop] for edge in (near, far)]
    )
    # Visible from either side: the entry's order is the exit's reversed.
    mesh.add_grid(grid)
    mesh.add_grid(grid[:, ::-1])


def _ink(pairs: Sequence[HolePair]) -> Mesh:
    """Return a flat ring around every hole."""
    mesh = Mesh()
    reach = np.array([-OPENING / 2 - INK_WIDTH, -OPENING / 2, OPENING / 2, OPENING / 2 + INK_WIDTH])
    keep = np.ones((3, 3), bool)
    keep[1, 1] = False
    for pair in pairs:
        for hole in (pair.entry, pair.exit):
            across, along, normal = hole.rotation.T
            grid = (
                np.asarray(hole.centre)
                + reach[:, None, None] * across
                + reach[:, None] * along
                + INK_LIFT * normal
            )
            mesh.add_grid(grid, keep=keep)
    return mesh
