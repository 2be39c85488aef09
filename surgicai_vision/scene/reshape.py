"""Reshape: a needle of another shape in a compiled model.

`reshape_needle(source, model, shape)` writes into `model` what MuJoCo compiles for a needle of
`shape`: the colliding capsules with their bounds, mass and inertia, and the mesh that is drawn. It
also moves what sits on the needle along the arc: sites, and the first body of the thread. For this
a needle alone is compiled (2 ms), so the numbers are MuJoCo's own, whatever the shape.
"""

import functools
import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.scene import needle
from surgicai_vision.scene.needle import NeedleShape
from surgicai_vision.scene.visual import materials

OF_GEOM = ("geom_size", "geom_pos", "geom_quat", "geom_rbound", "geom_aabb")
OF_BODY = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_sameframe")
MESH = "needle"
"""Name of the mesh that is drawn."""
OF_MESH = ("mesh_pos", "mesh_quat")
OF_VERTICES = ("mesh_vert", "mesh_normal")


@functools.lru_cache(maxsize=4)
def _compiled(shape: NeedleShape) -> mujoco.MjModel:
    """Return a model that holds nothing but a needle of `shape`."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.autolimits = True
    spec.add_material(name="needle")
    needle.add_needle(spec, {}, shape)
    materials.dress_needle(spec, shape)
    return spec.compile()


def reshape_needle(source: mujoco.MjModel, model: mujoco.MjModel, shape: NeedleShape) -> None:
    """Give the needle of `model` another shape; the caller updates MuJoCo's derived constants.

    Args:
        source: the scene's own model, which is only read.
        model: a copy of it, whose needle may have any shape.
        shape: the new one.
    """
    alone = source if shape == needle.OWN_SHAPE else _compiled(shape)
    there = alone.body("needle").id
    here = source.body("needle").id
    for name in OF_BODY:
        getattr(model, name)[here] = getattr(alone, name)[there]
    _copy_geoms(alone, there, model, here)
    _copy_mesh(alone, model)
    _move_along(source, model, here, shape)


def needle_vertices(model: mujoco.MjModel) -> NDArray[np.float32]:
    """Return the vertices of the needle's drawn mesh as a view, (n, 3) [m]; none without one."""
    mesh = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_MESH, MESH)
    if mesh < 0:
        return np.zeros((0, 3), np.float32)
    first = model.mesh_vertadr[mesh]
    vertices: NDArray[np.float32] = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    return vertices


def _copy_geoms(alone: mujoco.MjModel, there: int, model: mujoco.MjModel, here: int) -> None:
    """Copy the needle's geoms, and the tree of their bounds, from body `there` to body `here`."""
    number = alone.body_geomnum[there]
    assert number == model.body_geomnum[here]
    first = alone.body_geomadr[there]
    start = model.body_geomadr[here]
    for name in OF_GEOM:
        getattr(model, name)[start : start + number] = getattr(alone, name)[first : first + number]
    nodes = alone.body_bvhnum[there]
    assert nodes == model.body_bvhnum[here]
    taken = slice(alone.body_bvhadr[there], alone.body_bvhadr[there] + nodes)
    given = slice(model.body_bvhadr[here], model.body_bvhadr[here] + nodes)
    for name in ("bvh_aabb", "bvh_child", "bvh_depth"):
        getattr(model, name)[given] = getattr(alone, name)[taken]
    leaves = alone.bvh_nodeid[taken]
    model.bvh_nodeid[given] = np.where(leaves < 0, leaves, leaves - first + start)


def _copy_mesh(alone: mujoco.MjModel, model: mujoco.MjModel) -> None:
    """Copy the drawn mesh; it has the same number of vertices whatever the shape."""
    there = alone.mesh(MESH).id
    here = model.mesh(MESH).id
    for name in OF_MESH:
        getattr(model, name)[here] = getattr(alone, name)[there]
    for name, kind in zip(OF_VERTICES, ("vert", "normal"), strict=True):
        first = getattr(alone, f"mesh_{kind}adr")[there]
        start = getattr(model, f"mesh_{kind}adr")[here]
        number = getattr(alone, f"mesh_{kind}num")[there]
        assert number == getattr(model, f"mesh_{kind}num")[here]
        getattr(model, name)[start : start + number] = getattr(alone, name)[first : first + number]


def _move_along(
    source: mujoco.MjModel, model: mujoco.MjModel, body: int, shape: NeedleShape
) -> None:
    """Move what sits on the arc to the same share of the new arc."""
    size = shape.radius / needle.RADIUS
    share = shape.tip_angle / needle.TIP_ANGLE
    for site in np.flatnonzero(source.site_bodyid == body):
        x, y, z = source.site_pos[site]
        angle = math.atan2(y, -x) * share
        radius = math.hypot(x, y) * size
        model.site_pos[site] = (-radius * math.cos(angle), radius * math.sin(angle), z)
        if size == share == 1.0:
            model.site_pos[site] = source.site_pos[site]
    for child in np.flatnonzero(source.body_parentid == body):  # the thread, at the base
        model.body_pos[child] = source.body_pos[child] * size
