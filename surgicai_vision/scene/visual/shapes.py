"""Shapes: triangle meshes from sections and grids, for what is only seen.

Coordinates are rounded to a nanometre: the last bits of a sine differ between processors, and the
scene's hash must not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
VISIBLE = 1
HIDDEN = 4
"""Geom groups: drawn and not drawn."""


@dataclass
class Mesh:
    """Triangles under construction; either all points have a texture coordinate or none has."""

    points: list[Sequence[float]] = field(default_factory=list)
    faces: list[Sequence[int]] = field(default_factory=list)
    coordinates: list[Sequence[float]] = field(default_factory=list)

    def add_grid(
        self, points: ArrayLike, coordinates: ArrayLike | None = None, keep: ArrayLike | None = None
    ) -> None:
        """Add a grid of points (rows, columns, 3) [m].

        It is visible from the side to which rows × columns points.

        Args:
            coordinates: of the texture, (rows, columns, 2).
            keep: which quads to add, (rows - 1, columns - 1) bool; all by default.
        """
        grid = np.asarray(points, dtype=np.float64)
        rows, columns, _ = grid.shape
        first = len(self.points)
        self.points += grid.reshape(-1, 3).tolist()
        if coordinates is not None:
            self.coordinates += np.asarray(coordinates, dtype=np.float64).reshape(-1, 2).tolist()
        wanted = np.ones((rows - 1, columns - 1), bool) if keep is None else np.asarray(keep)
        for row, column in zip(*np.nonzero(wanted), strict=True):
            corner = first + int(row) * columns + int(column)
            below = corner + columns
            self.faces += [(corner, below, below + 1), (corner, below + 1, corner + 1)]

    def join(self, other: "Mesh") -> None:
        """Add the triangles of another mesh."""
        first = len(self.points)
        self.points += other.points
        self.faces += [[first + index for index in face] for face in other.faces]
        self.coordinates += other.coordinates

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add the mesh to `spec`. It needs no volume, as it has no mass."""
        mesh = spec.add_mesh(name=name)
        mesh.uservert = np.round(self.points, 9).ravel().tolist()
        mesh.userface = [index for face in self.faces for index in face]
        if self.coordinates:
            mesh.usertexcoord = np.round(self.coordinates, 6).ravel().tolist()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def loft(sections: ArrayLike) -> Mesh:
    """Return the closed surface through sections (n, sides, 3) [m].

    Each runs anticlockwise, seen from the last.
    """
    rings = np.asarray(sections, dtype=np.float64)
    mesh = Mesh()
    closed = np.concatenate([rings, rings[:, :1]], axis=1)
    mesh.add_grid(closed[:, ::-1])
    for ring, flip in ((rings[0], -1), (rings[-1], 1)):
        first = len(mesh.points)
        sides = len(ring)
        mesh.points += ring.tolist()
        mesh.faces += [(first, first + 1 + i, first + 2 + i)[::flip] for i in range(sides - 2)]
    return mesh


def tube(centres: ArrayLike, radii: ArrayLike, normal: ArrayLike, sides: int = 8) -> Mesh:
    """Return a round tube along a plane curve.

    Args:
        centres: points of the curve (n, 3) [m].
        radii: at each point (n,) [m].
        normal: unit normal of the curve's plane (3,).
        sides: corners of a section.
    """
    curve = np.asarray(centres, dtype=np.float64)
    upright = np.asarray(normal, dtype=np.float64)
    tangents = np.gradient(curve, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.cross(upright, tangents)
    angles = np.arange(sides) * (2 * np.pi / sides)
    spokes = across[:, None] * np.cos(angles)[:, None] + upright * np.sin(angles)[:, None]
    return loft(curve[:, None] + spokes * np.asarray(radii)[:, None, None])


def bar(sections: Sequence[tuple[float, float, float, float]]) -> Mesh:
    """Return a straight bar along z through rectangles [m].

    A rectangle is (z, lowest y, highest y, half of the width in x).
    """
    corners = [
        [(-w, low, z), (w, low, z), (w, high, z), (-w, high, z)] for z, low, high, w in sections
    ]
    return loft(corners)


def block(centre: Sequence[float], half: Sequence[float]) -> Mesh:
    """Return a box along the axes, given its centre and the halves of its sides [m]."""
    x, y, z = half
    mesh = bar([(-z, -y, y, x), (z, -y, y, x)])
    mesh.points = (np.array(mesh.points) + centre).tolist()
    return mesh


def rod(start: Sequence[float], end: Sequence[float], radius: float, sides: int = 12) -> Mesh:
    """Return a round rod between two points [m]."""
    axis = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    angles = np.arange(sides)[:, None] * (2 * np.pi / sides)
    circle = radius * (across * np.cos(angles) + np.cross(axis, across) * np.sin(angles))
    return loft([circle + start, circle + end])


def show(body: mujoco.MjsBody, shape: mujoco.mjtGeom, material: str, **place: object) -> None:
    """Add a geom to `body` that is only seen: it does not collide and has no mass."""
    body.add_geom(
        type=shape, material=material, contype=0, conaffinity=0, mass=0.0, group=VISIBLE, **place
    )


def hide(body: mujoco.MjsBody, keep: str = "") -> None:
    """Hide a body's physical geoms in images, except one whose name ends with `keep`."""
    for geom in body.geoms:
        if not (keep and geom.name.endswith(keep)):
            geom.group = HIDDEN
