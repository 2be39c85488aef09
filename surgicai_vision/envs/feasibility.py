"""Feasibility: refuse what geometry forbids before an env is made, and say why.

`refuse_impossible(config, through)` checks the extremes of what a task's randomisation may draw:

* Room for PSM2's jaws at the end of the insertion, and for the needle's tip when its base comes out
  (`geometry`): for every pair that may be sewn, with the smallest needle of every arc.
* Reach: the joints of both arms along the needle's whole path, with nominal grasps, for the extreme
  placements of the phantom. (A start whose own, imperfect grasp is out of reach is drawn again.)
* View: if the phantom's placement varies, both holes stay in the images of `VIEWS`.

Within the limits of `core.config`, layout `simple` with instrument 400006 passes the last two
checks for every draw: the limits were chosen for this (`tests/envs/test_feasibility.py`).
"""

import functools
import itertools
import math
from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.config import (
    ANY,
    RandomisationConfig,
    SceneConfig,
    TaskConfig,
)
from surgicai_vision.core.errors import InputError, UnreachablePose
from surgicai_vision.core.names import PSM1, PSM2
from surgicai_vision.envs.geometry import Stitch, grasp_in_needle
from surgicai_vision.envs.placement import SLIDE, Placement
from surgicai_vision.envs.randomisation import TIP_ANGLES
from surgicai_vision.envs.reach import extraction, insertion, joints_along
from surgicai_vision.envs.starts import GRASP_ANGLES
from surgicai_vision.scene import build_scene, needle
from surgicai_vision.scene.holes import PAIRS, HolePair, Point

Matrix = NDArray[np.float64]

VIEWS = ("front", "endo_left", "endo_right")
"""The cameras in whose images the holes must stay: the endoscopes."""


def refuse_impossible(config: TaskConfig, through: bool) -> None:
    """Refuse a task if geometry forbids something that may be drawn for it.

    Args:
        config: the task.
        through: True if the needle is driven through the tissue; else only the view is checked.

    Raises:
        InputError: naming the obstacle and what is allowed instead.
    """
    if through:
        _refuse_narrow(config)
    axes = config.randomisation
    moves = bool(axes.phantom_shift or axes.phantom_turn)
    if moves:
        _refuse_hidden(config.scene, axes)
    if through and (moves or axes.pair or axes.needle_arc):
        _refuse_unreachable(config.scene, axes)


def _pairs(scene: SceneConfig, axes: RandomisationConfig) -> tuple[int, ...]:
    """Return the indices of the pairs that may be sewn."""
    return (0, 1, 2, 3) if axes.pair == ANY else (scene.hole_pair - 1,)


# -- room for the jaws -----------------------------------------------------------------------------


def has_room(pair: HolePair, radius: float, tip_angle: float = needle.TIP_ANGLE) -> bool:
    """Return True if a needle can be driven through a pair with PSM2's jaws outside the entry."""
    return pair.gap < 2 * radius and Stitch.of(pair, radius, tip_angle).possible


def largest_size(pair: HolePair, tip_angle: float) -> float:
    """Return the largest `needle_size` at which the smallest needle can still be driven through.

    Returns:
        A share of the radius, rounded down to thousandths; negative if the scene's own radius is
        too small.
    """
    low = -1.0  # twice the radius
    high = 0.5
    while high - low > 1e-4:
        middle = (low + high) / 2
        if has_room(pair, needle.RADIUS * (1.0 - middle), tip_angle):
            low = middle
        else:
            high = middle
    return math.floor(low * 1e3) / 1e3


def _refuse_narrow(config: TaskConfig) -> None:
    """Refuse pairs whose holes are too far apart for the smallest needle that may be drawn."""
    axes = config.randomisation
    layout = config.scene.layout
    for index, arc in itertools.product(_pairs(config.scene, axes), axes.arcs):
        pair = PAIRS[layout][index]
        smallest = needle.RADIUS * (1.0 - axes.needle_size)
        if has_room(pair, smallest, TIP_ANGLES[arc]):
            if Stitch.of(pair, smallest, TIP_ANGLES[arc]).comes_out:
                continue
            raise InputError(
                f"randomisation: a needle of {arc} circle makes '{config.task}' impossible in "
                f"layout '{layout}': when its base leaves the exit of pair {index + 1}, its tip "
                "has reached the flank. Allowed: a shorter needle_arc, or a smaller needle_size."
            )
        allowed = largest_size(pair, TIP_ANGLES[arc])
        why = (
            f"the holes of pair {index + 1} are {pair.gap * 1e3:.1f} mm apart, too far for this "
            "needle"
        )
        if allowed >= 0:
            limit = min(
                largest_size(PAIRS[layout][one], TIP_ANGLES[other])
                for one, other in itertools.product(_pairs(config.scene, axes), axes.arcs)
            )
            raise InputError(
                f"randomisation: needle_size {axes.needle_size} makes '{config.task}' impossible "
                f"in layout '{layout}': {why}, an arc of {arc} circle, at its smallest: PSM2's "
                "jaws would meet the entry (see surgicai_vision.envs.geometry). The largest "
                f"needle_size here is {max(limit, 0.0)}."
            )
        raise InputError(
            f"'{config.task}' is not possible in layout '{layout}': {why} (see "
            "surgicai_vision.envs.geometry). Allowed there: grasp, place. "
            "All tasks: simple, 3dmed_straight."
        )


# -- view and reach --------------------------------------------------------------------------------


def corners(scene: SceneConfig, axes: RandomisationConfig) -> Iterator[Placement]:
    """Yield the phantom's extreme placements with each pair that may be sewn."""
    shift = axes.phantom_shift / 1e3
    turn = math.radians(axes.phantom_turn)
    for index in _pairs(scene, axes):
        rows = PAIRS[scene.layout]
        beyond = rows[0].entry.centre[1] - rows[index].entry.centre[1]
        slide = SLIDE * beyond if axes.pair == ANY else 0.0
        signs = itertools.product((-1.0, 1.0), repeat=3)
        for x, y, angle in signs:
            yield Placement(index, slide, (x * shift, y * shift), angle * turn)


def _placed(scene: SceneConfig, where: Placement) -> HolePair:
    return where.placed_pair(PAIRS[scene.layout][where.pair])


@functools.lru_cache(maxsize=32)
def _refuse_hidden(scene: SceneConfig, axes: RandomisationConfig) -> None:
    """Refuse placements of the phantom at which a hole leaves the endoscope's image."""
    for where in corners(scene, axes):
        pair = _placed(scene, where)
        for view, hole in itertools.product(VIEWS, (pair.entry, pair.exit)):
            if in_view(scene, view, hole.centre):
                continue
            x, y = where.shift
            raise InputError(
                f"randomisation: with the phantom shifted by {x * 1e3:.1f}, {y * 1e3:.1f} mm and "
                f"turned by {math.degrees(where.turn):.1f}° pair {where.pair + 1} is outside the "
                f"image of camera '{view}'. Allowed: a smaller phantom_shift or phantom_turn, "
                "hole_pair 1 or 2, or pair: any, for which the phantom slides under the endoscope."
            )


@functools.lru_cache(maxsize=32)
def _camera(scene: SceneConfig, view: str) -> tuple[Matrix, Matrix, float]:
    """Return a camera's position (3,), rotation (3, 3) and tangent of half its field of view."""
    model = build_scene(scene).model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    index = model.camera(view).id
    half = math.tan(math.radians(model.cam_fovy[index]) / 2)
    return data.cam_xpos[index].copy(), data.cam_xmat[index].reshape(3, 3).copy(), half


def in_view(scene: SceneConfig, view: str, point: Point) -> bool:
    """Return True if a point of the world is in the square image of a camera."""
    place, rotation, half = _camera(scene, view)
    x, y, z = rotation.T @ (np.asarray(point) - place)
    return bool(max(abs(x), abs(y)) < -z * half)


@functools.lru_cache(maxsize=32)
def _refuse_unreachable(scene: SceneConfig, axes: RandomisationConfig) -> None:
    """Refuse placements of the phantom at which an arm cannot follow the needle's path."""
    sizes = sorted({1.0 - axes.needle_size, 1.0 + axes.needle_size})
    angles = [TIP_ANGLES[arc] for arc in axes.arcs]
    for where, size, tip_angle in itertools.product(corners(scene, axes), sizes, angles):
        stitch = Stitch.of(_placed(scene, where), needle.RADIUS * size, tip_angle)
        low, high = (
            grasp_in_needle(PSM2, angle, radius=stitch.radius)
            for angle in stitch.grasps(*GRASP_ANGLES)
        )
        taken = grasp_in_needle(PSM1, stitch.handoff_angle, radius=stitch.radius)
        for arm, way in (
            (PSM2, insertion(stitch, low)),
            (PSM2, insertion(stitch, high)),
            (PSM1, extraction(stitch, taken)),
        ):
            try:
                joints_along(arm, way, scene.instrument)
            except UnreachablePose as error:
                x, y = where.shift
                raise InputError(
                    f"randomisation: with the phantom shifted by {x * 1e3:.1f}, {y * 1e3:.1f} mm "
                    f"and turned by {math.degrees(where.turn):.1f}° {arm} cannot sew pair "
                    f"{where.pair + 1} with a needle of {stitch.radius * 1e3:.1f} mm radius and "
                    f"{math.degrees(tip_angle):.0f}°: {error} Allowed: a smaller phantom_turn, "
                    "phantom_shift or needle_size, or a shorter needle_arc."
                ) from error
