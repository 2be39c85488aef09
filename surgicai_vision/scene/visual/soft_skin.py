"""Soft skin: the visible skin of tissue that can be pierced; it follows what is done to it.

`add_soft_skin` adds closed skin with marks of ink instead of openings. `SoftSkin.shape` then writes
a `SkinState` into the meshes of the caller's own model; a `FrameRenderer` uploads them when they
have changed.
"""

import math

import mujoco
import numpy as np

from surgicai_vision.scene.holes import PAIRS, SURFACE
from surgicai_vision.scene.phantom import ORIGIN, SIZE
from surgicai_vision.scene.rotations import quaternion_to_matrix
from surgicai_vision.scene.visual.shapes import Mesh, show
from surgicai_vision.scene.visual.skin import LIFT
from surgicai_vision.scene.visual.skin_decals import Faces, Marks, Wounds
from surgicai_vision.scene.visual.skin_grid import SkinGrid
from surgicai_vision.scene.visual.skin_state import Array, Pull, SkinState, displaced

MATERIALS = {
    "skin": "tissue",
    "mark": "ink",
    "marks": "faded_ink",
    "wounds": "wound",
    "halos": "halo",
}
"""Mesh that `SoftSkin.shape` writes → its material."""
RESTING = 0.001
"""Reach of the lines around the marks while nothing touches the skin [m]."""


def add_soft_skin(spec: mujoco.MjSpec, body: mujoco.MjsBody, layout: str) -> None:
    """Add the skin, its marks and hidden wounds, and the sides of the flesh to the phantom."""
    drawing = _Drawing(layout)
    meshes = drawing.meshes(SkinState())
    for name, material in MATERIALS.items():
        points, normals = meshes[name]
        mesh = Mesh(points.tolist(), drawing.faces(name).tolist())
        if name == "skin":
            mesh.coordinates += drawing.grid.coordinates.tolist()
        mesh.add_to(spec, name)
        # MuJoCo's own normals would show every fine line.
        spec.mesh(name).usernormal = np.round(normals, 6).ravel().tolist()
        show(body, mujoco.mjtGeom.mjGEOM_MESH, material, meshname=name)
    _sides().add_to(spec, "flesh")
    show(body, mujoco.mjtGeom.mjGEOM_MESH, "flesh", meshname="flesh")


class SoftSkin:
    """Writes what the skin shows into a model.

    Args:
        model: the caller's own model of a scene with soft tissue.
        layout: the phantom's layout.
    """

    def __init__(self, model: mujoco.MjModel, layout: str):
        self._model = model
        self._drawing = _Drawing(layout)
        self.meshes = tuple(int(model.mesh(name).id) for name in MATERIALS)
        self._turns = [quaternion_to_matrix(model.mesh_quat[mesh]) for mesh in self.meshes]
        self._state: SkinState | None = None
        self._points: list[Array | None] = [None] * len(self.meshes)
        self._versions = [0] * len(self.meshes)

    @property
    def versions(self) -> tuple[int, ...]:
        """Return how often each mesh has been written."""
        return tuple(self._versions)

    def shape(self, state: SkinState) -> None:
        """Write the meshes of a state, except those that are there already."""
        if state == self._state:
            return
        meshes = self._drawing.meshes(state)
        for index, name in enumerate(MATERIALS):
            points, normals = meshes[name]
            before = self._points[index]
            if before is None or not np.array_equal(points, before):
                self._write(index, points, normals)
                self._points[index] = points
                self._versions[index] += 1
        start = int(self._model.mesh_texcoordadr[self.meshes[0]])
        coordinates = self._drawing.grid.coordinates
        self._model.mesh_texcoord[start : start + len(coordinates)] = coordinates
        self._state = state

    def _write(self, index: int, points: Array, normals: Array) -> None:
        """Write the points and normals of one mesh, in the frame that MuJoCo gave it."""
        model = self._model
        mesh = self.meshes[index]
        turn = self._turns[index]
        first = int(model.mesh_vertadr[mesh])
        model.mesh_vert[first : first + len(points)] = (points - model.mesh_pos[mesh]) @ turn
        first = int(model.mesh_normaladr[mesh])
        model.mesh_normal[first : first + len(normals)] = normals @ turn


class _Drawing:
    """Points and normals of every mesh in a state; the triangles never change."""

    def __init__(self, layout: str):
        self._pairs = PAIRS[layout]
        self.grid = SkinGrid(self._pairs)
        self._marks = Marks(self._pairs)
        self._wounds = Wounds(self._pairs)

    def meshes(self, state: SkinState) -> dict[str, tuple[Array, Array]]:
        """Return points [m] and unit normals of every mesh, (n, 3) each."""
        pair = self._pairs[state.pair]
        resting = [Pull(hole.centre, (0.0, 0.0, 0.0), RESTING) for hole in (pair.entry, pair.exit)]
        largest = sorted(state.pulls, key=lambda pull: -math.hypot(*pull.way))
        self.grid.gather(_apart([*largest, *resting]))
        skin = displaced(self.grid.points, state.pulls)
        pulls = state.pulls
        return {
            "skin": (skin, self.grid.normals(skin)),
            "mark": self._marks.draw(state.pair, pulls, chosen=True),
            "marks": self._marks.draw(state.pair, pulls, chosen=False),
            "wounds": self._wounds.draw(state.wounds, pulls, halo=False),
            "halos": self._wounds.draw(state.wounds, pulls, halo=True),
        }

    def faces(self, name: str) -> Faces:
        """Return the triangles of a mesh, (m, 3)."""
        if name == "skin":
            return self.grid.faces()
        if name in ("wounds", "halos"):
            return self._wounds.faces()
        return self._marks.faces(chosen=name == "mark")


def _apart(pulls: list[Pull]) -> list[Pull]:
    """Return the pulls without those near an earlier one."""
    kept: list[Pull] = []
    for pull in pulls:
        if all(math.dist(pull.place, other.place) > other.reach for other in kept):
            kept.append(pull)
    return kept


def _sides() -> Mesh:
    """Return the four sides of the phantom below the skin's edge."""
    x, y = (side / 2 for side in SIZE[:2])
    loop = np.array([(x, y), (x, -y), (-x, -y), (-x, y), (x, y)]) + ORIGIN
    heights = (SURFACE + LIFT, SURFACE - SIZE[2])
    mesh = Mesh()
    mesh.add_grid([[(*corner, height) for corner in loop] for height in heights])
    return mesh
