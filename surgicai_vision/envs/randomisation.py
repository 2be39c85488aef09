"""Randomisation: what differs from episode to episode besides the start.

`draw` gives one episode's numbers, `apply` writes them into an env's own copy of the model. The
numbers are part of the whole state, so a restored state looks and moves as it did. All axes are
drawn whichever are on: turning one on leaves the others as they were.
"""

import dataclasses
import math
from itertools import accumulate, pairwise
from types import MappingProxyType

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.cameras import other_cameras
from surgicai_vision.core.config import RandomisationConfig
from surgicai_vision.scene import Scene, needle
from surgicai_vision.scene.holes import Hole, HolePair
from surgicai_vision.scene.rotations import (
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotvec_to_matrix,
)

Array = NDArray[np.float64]
Draws = tuple[float, ...]

RIGS = (
    ("front", "front_right", "front_psm1", "front_psm2"),
    ("back", "back_psm1", "back_psm2"),
    ("wrist_psm1",),
    ("wrist_psm2",),
)
"""Cameras that move as one, about the first; those that follow the jaws are shifted with them, and
see them still. A camera of another distribution takes the draw of "front", about its own place.
"""
TISSUE = ("tissue", "flesh")
"""Materials of one tint."""
SURROUNDINGS = ("drape", "tray")
"""Materials of another tint."""
JOINT_ERROR = (math.radians(5.0), math.radians(5.0), 0.005)
"""Largest error of an arm's first three joints [rad, rad, m] (surgical robotics challenge)."""

UNITS = MappingProxyType(
    {
        "light": (1.0,) * 3,
        "colour": (1.0,) * 6,
        "camera_shift": (1e-3,) * 3 * len(RIGS),
        "camera_turn": (math.radians(1.0),) * 3 * len(RIGS),
        "camera_fovy": (1.0,) * len(RIGS),
        "needle_thickness": (1.0,),
        "friction": (1.0,),
        "phantom_shift": (1e-3,) * 2,
        "kinematic_error": JOINT_ERROR * len(names.ARMS),
        "needle_size": (1.0,),
    }
)
"""Axis → what a magnitude of 1 is in each of its numbers (fractions, m, rad; the field of view in
degrees).
"""
DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0", "actuator_acc0")
"""What MuJoCo derives from masses and places."""
_EDGES = tuple(accumulate((len(unit) for unit in UNITS.values()), initial=0))
_PLACES = {
    axis: slice(start, end) for axis, (start, end) in zip(UNITS, pairwise(_EDGES), strict=True)
}
SIZE = _EDGES[-1]
"""Numbers of one episode."""
NOTHING: Draws = (0.0,) * SIZE


def draw(config: RandomisationConfig, rng: np.random.Generator) -> Draws:
    """Draw one episode's numbers, `SIZE` of them."""
    values: list[float] = []
    for axis, unit in UNITS.items():
        values += (rng.uniform(-1.0, 1.0, len(unit)) * unit * getattr(config, axis)).tolist()
    return tuple(value + 0.0 for value in values)  # no -0.0


def report(config: RandomisationConfig, draws: Draws) -> dict[str, Array | int]:
    """Return axis → drawn numbers of the axes that are on, for `info["randomisation"]`."""
    drawn: dict[str, Array | int] = {
        axis: np.array(draws[_PLACES[axis]]) for axis in config.on if axis in UNITS
    }
    return drawn | ({"latency": config.latency} if config.latency else {})


def joint_offsets(draws: Draws) -> dict[str, Draws]:
    """Return arm → error of its six joints, empty where there is none."""
    values = draws[_PLACES["kinematic_error"]]
    if not any(values):
        return {}
    return {
        arm: (*values[3 * index : 3 * index + 3], 0.0, 0.0, 0.0)
        for index, arm in enumerate(names.ARMS)
    }


def needle_radius(draws: Draws) -> float:
    """Return the radius of the needle's arc [m]."""
    return needle.RADIUS * (1.0 + draws[_PLACES["needle_size"]][0])


def shifted(pair: HolePair, draws: Draws) -> HolePair:
    """Return where a hole pair is when the phantom is shifted."""
    x, y = draws[_PLACES["phantom_shift"]]

    def moved(hole: Hole) -> Hole:
        return dataclasses.replace(
            hole, centre=(hole.centre[0] + x, hole.centre[1] + y, hole.centre[2])
        )

    return HolePair(moved(pair.entry), moved(pair.exit))


def apply(scene: Scene, model: mujoco.MjModel, draws: Draws) -> None:
    """Write one episode's numbers into `model`, a copy of the scene's own, which is only read."""
    source = scene.model
    numbers = {axis: np.array(draws[place]) for axis, place in _PLACES.items()}
    _light(source, model, 1.0 + numbers["light"])
    _tint(source, model, 1.0 + numbers["colour"].reshape(2, 3))
    shifts = numbers["camera_shift"].reshape(-1, 3)
    turns = numbers["camera_turn"].reshape(-1, 3)
    for cameras, shift, turn, fovy in zip(RIGS, shifts, turns, numbers["camera_fovy"], strict=True):
        _aim(source, model, cameras, shift, turn, fovy)
    for name in other_cameras():
        _aim(source, model, (name,), shifts[0], turns[0], numbers["camera_fovy"][0])
    size, thickness = (
        1.0 + float(numbers[axis][0]) for axis in ("needle_size", "needle_thickness")
    )
    _shape_needle(source, model, scene.needle_geoms, size, thickness)
    model.geom_friction[:] = source.geom_friction * (1.0 + float(numbers["friction"][0]))
    phantom = source.body("phantom").id
    model.body_pos[phantom] = source.body_pos[phantom] + [*numbers["phantom_shift"], 0.0]


def _light(source: mujoco.MjModel, model: mujoco.MjModel, factors: Array) -> None:
    """Scale the head light and the two lamps."""
    for kind in ("ambient", "diffuse", "specular"):
        getattr(model.vis.headlight, kind)[:] = getattr(source.vis.headlight, kind) * factors[0]
        getattr(model, f"light_{kind}")[:] = getattr(source, f"light_{kind}") * factors[1:, None]


def _tint(source: mujoco.MjModel, model: mujoco.MjModel, factors: Array) -> None:
    """Scale the colours of the tissue and of its surroundings."""
    for materials, factor in zip((TISSUE, SURROUNDINGS), factors, strict=True):
        for name in materials:
            index = source.material(name).id
            model.mat_rgba[index, :3] = np.clip(source.mat_rgba[index, :3] * factor, 0.0, 1.0)


def _aim(
    source: mujoco.MjModel,
    model: mujoco.MjModel,
    cameras: tuple[str, ...],
    shift: Array,
    turn: Array,
    fovy: float,
) -> None:
    """Shift a rig of cameras [m], turn it [rad] and widen its view [deg].

    It turns about its first camera, in the axes of what carries it.

    Where a rig's first camera sees so much more, the others see more by the same factor.
    """
    first = source.camera(cameras[0]).id
    rotation = rotvec_to_matrix(turn)
    pivot = source.cam_pos[first]
    for name in cameras:
        index = source.camera(name).id
        model.cam_pos[index] = pivot + rotation @ (source.cam_pos[index] - pivot) + shift
        model.cam_quat[index] = matrix_to_quaternion(
            rotation @ quaternion_to_matrix(source.cam_quat[index])
        )
        model.cam_fovy[index] = source.cam_fovy[index] * (1.0 + fovy / source.cam_fovy[first])


def _shape_needle(
    source: mujoco.MjModel, model: mujoco.MjModel, geoms: range, size: float, thickness: float
) -> None:
    """Scale the needle's arc and thickness: what collides, its bounds, and what is drawn."""
    of = slice(geoms.start, geoms.stop)
    body = source.body("needle").id
    radius = source.geom_size[of, 0] * thickness
    half = source.geom_size[of, 1] * size
    model.geom_size[of, 0] = radius
    model.geom_size[of, 1] = half
    model.geom_pos[of] = source.geom_pos[of] * size
    model.geom_rbound[of] = radius + half
    model.geom_aabb[of, 3:] = np.stack([radius, radius, radius + half], axis=1)
    tree = slice(source.body_bvhadr[body], source.body_bvhadr[body] + source.body_bvhnum[body])
    grown = max(0.0, float((radius - source.geom_size[of, 0] * size).max()))
    model.bvh_aabb[tree] = source.bvh_aabb[tree] * size
    model.bvh_aabb[tree, 3:] += grown
    _weigh_needle(source, model, body, size)
    mesh = source.mesh("needle").id
    of = slice(source.mesh_vertadr[mesh], source.mesh_vertadr[mesh] + source.mesh_vertnum[mesh])
    turn = quaternion_to_matrix(source.mesh_quat[mesh])
    origin = source.mesh_pos[mesh]
    points = source.mesh_vert[of] @ turn.T + origin
    angles = np.clip(np.arctan2(points[:, 1], -points[:, 0]), 0.0, needle.TIP_ANGLE)
    line = np.stack(
        [-needle.RADIUS * np.cos(angles), needle.RADIUS * np.sin(angles), np.zeros_like(angles)],
        axis=1,
    )
    model.mesh_vert[of] = (line * size + (points - line) * thickness - origin) @ turn


def _weigh_needle(source: mujoco.MjModel, model: mujoco.MjModel, body: int, size: float) -> None:
    """Scale mass and inertia with the arc's length, and derive MuJoCo's constants anew.

    What is fixed to the needle moves with it.
    """
    model.body_mass[body] = source.body_mass[body] * size
    model.body_inertia[body] = source.body_inertia[body] * size**3
    model.body_ipos[body] = source.body_ipos[body] * size
    for sites in np.flatnonzero(source.site_bodyid == body):
        model.site_pos[sites] = source.site_pos[sites] * size
    for thread in np.flatnonzero(source.body_parentid == body):
        model.body_pos[thread] = source.body_pos[thread] * size
    if size == 1.0:
        for name in DERIVED:
            getattr(model, name)[:] = getattr(source, name)
        return
    extent = source.stat.extent
    centre = source.stat.center.copy()
    mujoco.mj_setConst(model, mujoco.MjData(model))
    # They place the cameras' near and far planes.
    model.stat.extent = extent
    model.stat.center[:] = centre
