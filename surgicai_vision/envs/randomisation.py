"""Randomisation: what differs from episode to episode besides the start.

`draw` returns one episode's numbers, `apply` writes them into an env's own copy of the model. The
numbers are part of the whole state, so a restored state looks and moves as it did. All axes are
always drawn, so turning one on leaves the others as they were.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise
from types import MappingProxyType

import mujoco
import numpy as np
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import ANY, NEEDLE_ARCS, RANDOMISATION_LIMITS, RandomisationConfig
from surgicai_vision.core.errors import InputError, check_name, shown
from surgicai_vision.envs import looks
from surgicai_vision.envs.placement import SLIDE, Placement
from surgicai_vision.scene import Scene, needle
from surgicai_vision.scene.holes import PAIRS
from surgicai_vision.scene.needle import NeedleShape
from surgicai_vision.scene.reshape import reshape_needle
from surgicai_vision.scene.rotations import (
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotvec_to_matrix,
)
from surgicai_vision.scene.visual import appearance, distractors
from surgicai_vision.scene.visual.appearance import Appearance
from surgicai_vision.scene.visual.distractors import Litter
from surgicai_vision.scene.visual.skin import show_ink

Array = NDArray[np.float64]
Draws = tuple[float, ...]

RIGS = (
    ("front", "front_right"),
    ("back",),
    ("wrist_psm1",),
    ("wrist_psm2",),
    ("endo_left", "endo_right"),
)
"""Cameras that move as one, about the first. A camera of another distribution takes the draw of
"front", about its own position. A crop is cut from its camera's image where the nominal calibration
puts it, without regard to the move.
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
        "phantom_turn": (math.radians(1.0),),
        "robot_start": (1e-3,) * 3 * len(names.ARMS),
    }
)
"""Axis → what a magnitude of 1 means for each of its numbers (fractions, m, rad; the field of view
in degrees).
"""
TIP_ANGLES = MappingProxyType(
    dict(zip(NEEDLE_ARCS, (math.radians(degrees) for degrees in (120, 135, 180)), strict=True))
)
"""Arc of the needle → angle of its tip [rad]."""
CHOICES = ("pair", "needle_arc")
"""Axes that are a choice, one number each: the pair that is sewn, 1 to 4, or 0 for the scene's own;
the angle of the needle's tip beyond that of the scene's own needle [rad]."""
LOOKS = MappingProxyType({"appearance": 2, "appearance_shift": 3, "distractors": 2})
"""Purely visual axis → how many numbers it has: family and seed; share, family and seed; count and
seed."""
STAND = ("phantom", "tray")
"""Bodies that the phantom's placement moves; in the scene's own model they are at the origin."""
DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0", "actuator_acc0")
"""What MuJoCo derives from masses and positions."""
_SIZES = {
    **{axis: len(unit) for axis, unit in UNITS.items()},
    **dict.fromkeys(CHOICES, 1),
    **LOOKS,
}
_EDGES = tuple(accumulate(_SIZES.values(), initial=0))
_PLACES = {
    axis: slice(start, end) for axis, (start, end) in zip(_SIZES, pairwise(_EDGES), strict=True)
}
SIZE = _EDGES[-1]
"""How many numbers an episode has."""
NOTHING: Draws = (0.0,) * SIZE
ROUNDING = 1e-6
"""How far beyond its bounds a number stored in fewer than 64 bits may be."""
WHOLE = ("pair", "appearance", "distractors")
"""Axes whose numbers are whole: choices, counts and seeds."""
_MOST = {
    "pair": (4.0,),
    "needle_arc": (max(TIP_ANGLES.values()) - TIP_ANGLES[NEEDLE_ARCS[0]],),
    "appearance": (len(names.APPEARANCES), appearance.SEEDS - 1),
    "appearance_shift": (1.0, len(names.APPEARANCES), appearance.SEEDS - 1),
    "distractors": (distractors.MOST, appearance.SEEDS - 1),
}
"""Axis without negative numbers → the largest value of each number."""
_BOUNDS = {axis: (np.zeros(len(most)), np.array(most)) for axis, most in _MOST.items()} | {
    axis: (
        -RANDOMISATION_LIMITS[axis] * np.array(unit),
        RANDOMISATION_LIMITS[axis] * np.array(unit),
    )
    for axis, unit in UNITS.items()
}
"""Axis → the smallest and the largest value of each of its numbers."""


def draw(config: RandomisationConfig, rng: np.random.Generator) -> Draws:
    """Draw one episode's numbers, `SIZE` of them."""
    values: list[float] = []
    for axis, unit in UNITS.items():
        values += (rng.uniform(-1.0, 1.0, len(unit)) * unit * getattr(config, axis)).tolist()
    pair = int(rng.integers(1, 5))
    # Always one random number, so that later draws do not depend on the choice.
    arc = config.arcs[int(rng.integers(len(NEEDLE_ARCS))) % len(config.arcs)]
    values += [pair if config.pair == ANY else 0, TIP_ANGLES[arc] - TIP_ANGLES[NEEDLE_ARCS[0]]]
    values += looks.draw_appearance(config, rng).numbers
    values += looks.draw_litter(config, rng).numbers
    return tuple(value + 0.0 for value in values)  # no -0.0


def with_numbers(draws: Draws, given: Mapping[str, Sequence[float]]) -> Draws:
    """Return `draws` with the numbers of some axes replaced.

    Args:
        draws: one episode's numbers.
        given: axis → its numbers, as `report` returns them.

    Raises:
        UnknownName: no such axis.
        InputError: not as many numbers as the axis has, or one beyond the axis's limit.
    """
    values = list(draws)
    for axis, numbers in given.items():
        place = _PLACES[check_name("axis of randomisation", axis, _PLACES)]
        values[place] = _checked(axis, numbers)
    return tuple(values)


def checked(draws: Draws) -> Draws:
    """Return one episode's numbers, `SIZE` of them, or refuse numbers that no episode can have.

    Raises:
        InputError: naming the axis and what is allowed.
    """
    return with_numbers(NOTHING, {axis: draws[place] for axis, place in _PLACES.items()})


def _checked(axis: str, numbers: object) -> list[float]:
    """Return an axis's numbers, or refuse numbers that no episode can have."""
    try:
        given = np.array(numbers, dtype=np.float64)
    except (TypeError, ValueError):
        given = np.full(1, np.nan)
    if given.ndim != 1 or not np.isfinite(given).all():
        raise InputError(
            f"randomisation: {axis} is {shown(numbers)}; give a list of {_SIZES[axis]} finite "
            "numbers."
        )
    if len(given) != _SIZES[axis]:
        raise InputError(
            f"randomisation: {axis} takes {_SIZES[axis]} numbers; {len(given)} are given."
        )
    least, most = _BOUNDS[axis]
    beyond = np.flatnonzero((given < least - ROUNDING) | (given > most + ROUNDING))
    if len(beyond):
        at = beyond[0]
        raise InputError(
            f"randomisation: {axis} has {given[at]:g}; allowed: {least[at]:g} to {most[at]:g}."
        )
    if axis in WHOLE and (given != np.round(given)).any():
        raise InputError(f"randomisation: {axis} is {shown(numbers)}; give whole numbers.")
    values: list[float] = given.tolist()
    return values


def report(config: RandomisationConfig, draws: Draws) -> dict[str, Array | int]:
    """Return axis → drawn numbers of the axes that are on, for `info["randomisation"]`."""
    drawn: dict[str, Array | int] = {
        axis: np.array(draws[_PLACES[axis]]) for axis in config.on if axis in _PLACES
    }
    return drawn | ({"latency": config.latency} if config.latency else {})


def generator(rng: np.random.Generator) -> np.random.Generator:
    """Return the generator of an episode's numbers, whose start `rng` draws.

    It is one of its own, so that a start is the same whatever is randomised, and evaluations can be
    paired.
    """
    return rng.spawn(1)[0]


def drawn(config: RandomisationConfig, seed: int) -> dict[str, Array | int]:
    """Return what `info["randomisation"]` is after an env's `reset(seed=seed)`, without the env."""
    rng, _ = np_random(seed)
    return report(config, draw(config, generator(rng)))


def arc_name(beyond: float) -> str:
    """Return the arc (`NEEDLE_ARCS`) of a number of the axis `needle_arc` [rad]."""
    angle = TIP_ANGLES[NEEDLE_ARCS[0]] + beyond
    return min(TIP_ANGLES, key=lambda arc: abs(TIP_ANGLES[arc] - angle))


def joint_offsets(draws: Draws) -> dict[str, Draws]:
    """Return arm → error of its six joints, empty if there is none."""
    values = draws[_PLACES["kinematic_error"]]
    if not any(values):
        return {}
    return {
        arm: (*values[3 * index : 3 * index + 3], 0.0, 0.0, 0.0)
        for index, arm in enumerate(names.ARMS)
    }


def needle_shape(draws: Draws) -> NeedleShape:
    """Return the shape of the needle."""
    return NeedleShape(
        needle.RADIUS * (1.0 + draws[_PLACES["needle_size"]][0]),
        needle.TIP_ANGLE + draws[_PLACES["needle_arc"]][0],
        needle.BODY_RADIUS * (1.0 + draws[_PLACES["needle_thickness"]][0]),
    )


def placement(scene: Scene, draws: Draws) -> Placement:
    """Return where the phantom lies and which pair is sewn."""
    pairs = PAIRS[scene.config.layout]
    drawn = int(draws[_PLACES["pair"]][0])
    pair = (drawn or scene.config.hole_pair) - 1
    beyond = pairs[0].entry.centre[1] - pairs[pair].entry.centre[1]
    x, y = draws[_PLACES["phantom_shift"]]
    (turn,) = draws[_PLACES["phantom_turn"]]
    return Placement(pair, SLIDE * beyond if drawn else 0.0, (x, y), turn)


def start_shift(draws: Draws, arm: str) -> Array:
    """Return how far an arm's tip starts from its home, (3,) [m, world]."""
    first = 3 * names.ARMS.index(arm)
    return np.array(draws[_PLACES["robot_start"]][first : first + 3])


def apply(scene: Scene, model: mujoco.MjModel, draws: Draws) -> None:
    """Write one episode's numbers into `model`, a copy of the scene's own, which is only read."""
    source = scene.model
    numbers = {axis: np.array(draws[place]) for axis, place in _PLACES.items()}
    shown = Appearance.of_numbers(*numbers["appearance"], *numbers["appearance_shift"])
    appearance.apply(source, model, shown)
    _light(model, 1.0 + numbers["light"])
    _tint(model, 1.0 + numbers["colour"].reshape(2, 3))
    distractors.scatter(source, model, Litter.of_numbers(*numbers["distractors"]))
    shifts = numbers["camera_shift"].reshape(-1, 3)
    turns = numbers["camera_turn"].reshape(-1, 3)
    for cameras, shift, turn, fovy in zip(RIGS, shifts, turns, numbers["camera_fovy"], strict=True):
        _aim(source, model, cameras, shift, turn, fovy)
    for name in scene.other_cameras:
        _aim(source, model, (name,), shifts[0], turns[0], numbers["camera_fovy"][0])
    appearance.carry_spot(model)
    model.geom_friction[:] = source.geom_friction * (1.0 + float(numbers["friction"][0]))
    _place_phantom(scene, model, placement(scene, draws))
    shape = needle_shape(draws)
    reshape_needle(source, model, shape)
    if shape == needle.OWN_SHAPE:
        for name in DERIVED:
            getattr(model, name)[:] = getattr(source, name)
        return
    mujoco.mj_setConst(model, mujoco.MjData(model))
    # Extent and centre set the cameras' near and far planes.
    model.stat.extent = source.stat.extent
    model.stat.center[:] = source.stat.center


def _place_phantom(scene: Scene, model: mujoco.MjModel, where: Placement) -> None:
    """Move the phantom, the tray it stands in and the distractors; ink the pair to sew."""
    source = scene.model
    poses = dict.fromkeys(STAND, where.T_world_phantom) | {distractors.BODY: where.T_world_bed}
    for name, pose in poses.items():
        body = source.body(name).id
        model.body_pos[body] = source.body_pos[body] + pose[:3, 3]
        model.body_quat[body] = matrix_to_quaternion(pose[:3, :3])
    show_ink(model, scene.ink_geoms, where.pair)


def _light(model: mujoco.MjModel, factors: Array) -> None:
    """Scale an appearance's headlight, together with the endoscope's own, and its two lamps."""
    lamps = np.append(factors[1:], factors[0])[:, None]
    for kind in ("ambient", "diffuse", "specular"):
        getattr(model.vis.headlight, kind)[:] *= factors[0]
        getattr(model, f"light_{kind}")[:] *= lamps


def _tint(model: mujoco.MjModel, factors: Array) -> None:
    """Scale an appearance's colours of the tissue and of its surroundings."""
    for materials, factor in zip((TISSUE, SURROUNDINGS), factors, strict=True):
        for name in materials:
            colour = model.material(name).rgba
            colour[:3] = np.clip(colour[:3] * factor, 0.0, 1.0)


def _aim(
    source: mujoco.MjModel,
    model: mujoco.MjModel,
    cameras: tuple[str, ...],
    shift: Array,
    turn: Array,
    fovy: float,
) -> None:
    """Shift a rig of cameras [m], turn it [rad] and widen its view [deg].

    It turns about its first camera, in the axes of the body that carries it.

    The views of its other cameras widen by the same factor as the first one's.
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
