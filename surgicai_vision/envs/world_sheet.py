"""World sheet: every needle and the phantom's placements as rows of images, for visual inspection.

`needle_rows` shows the start of a grasp with every radius, arc and thickness; `placement_rows` the
start of an insertion in every pair with the phantom at the extremes of its placement.
"""

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.config import (
    ANY,
    NEEDLE_ARCS,
    RANDOMISATION_LIMITS,
    RandomisationConfig,
    SceneConfig,
    TaskConfig,
)
from surgicai_vision.envs import make
from surgicai_vision.envs.randomisation import TIP_ANGLES
from surgicai_vision.scene.cameras import extrinsics, intrinsics

Image = NDArray[np.uint8]
Rows = list[tuple[str, list[Image]]]
Numbers = Mapping[str, Sequence[float]]

CLOSE = 3
"""How many times larger than its cut-out the image of a needle is rendered."""
SIGNS = (-1.0, 0.0, 1.0)


def needle_rows(
    scene: SceneConfig, view: str, seed: int, size: int, quality: str
) -> tuple[Rows, list[str]]:
    """Return (size, size, 3) images of lying needles and the names of the columns.

    Each row is a radius; its columns are all thicknesses of all arcs.

    Args:
        scene: the scene.
        view: the camera.
        seed: of the start.
        size: height and width of a cut-out about the needle [pixel].
        quality: of `scene.rendering.QUALITIES`.
    """
    limits = {axis: RANDOMISATION_LIMITS[axis] for axis in ("needle_size", "needle_thickness")}
    axes = RandomisationConfig(
        needle_size=limits["needle_size"],
        needle_thickness=limits["needle_thickness"],
        needle_arc=ANY,
    )
    kinds = list(itertools.product(NEEDLE_ARCS, SIGNS))
    rows = []
    for sign in SIGNS:
        shapes = [
            {
                "needle_size": [sign * limits["needle_size"]],
                "needle_thickness": [other * limits["needle_thickness"]],
                "needle_arc": [TIP_ANGLES[arc] - TIP_ANGLES[NEEDLE_ARCS[0]]],
            }
            for arc, other in kinds
        ]
        config = TaskConfig("grasp", scene, randomisation=axes)
        images = [_close(config, given, view, seed, size, quality) for given in shapes]
        rows.append((_percent("radius", sign * limits["needle_size"]), images))
    thickness = limits["needle_thickness"]
    return rows, [f"{arc} circle, {_percent('thickness', sign * thickness)}" for arc, sign in kinds]


def placement_rows(
    scene: SceneConfig, view: str, seed: int, size: int, quality: str
) -> tuple[Rows, list[str]]:
    """Return (size, size, 3) images of the phantom's placements and the names of the columns.

    Each row is a pair that is sewn; its columns are the phantom's own place and the extremes.
    """
    shift = RANDOMISATION_LIMITS["phantom_shift"]
    turn = RANDOMISATION_LIMITS["phantom_turn"]
    axes = RandomisationConfig(phantom_shift=shift, phantom_turn=turn, pair=ANY)
    config = TaskConfig("insert", scene, randomisation=axes)
    places = [(0.0, 0.0, 0.0), *itertools.product((-1.0, 1.0), repeat=3)]
    rows = []
    for pair in range(1, 5):
        images = []
        for x, y, angle in places:
            given = {
                "pair": [float(pair)],
                "phantom_shift": [x * shift / 1e3, y * shift / 1e3],
                "phantom_turn": [angle * math.radians(turn)],
            }
            images.append(_image(config, given, view, seed, (size, size), quality))
        rows.append((f"pair {pair}", images))
    columns = [f"{x * shift:+.0f}, {y * shift:+.0f} mm, {a * turn:+.0f}°" for x, y, a in places]
    return rows, columns


def _percent(what: str, share: float) -> str:
    return f"{what} {share:+.0%}" if share else f"own {what}"


def _image(
    config: TaskConfig, given: Numbers, view: str, seed: int, size: tuple[int, int], quality: str
) -> Image:
    """Return an image of an episode's start with given randomisation numbers."""
    env = make(config)
    env.reset(seed=seed, options={"randomisation": given})
    image: Image = env.image(view, size, quality=quality).astype(np.uint8)
    env.close()
    return image


def _close(
    config: TaskConfig, given: Numbers, view: str, seed: int, size: int, quality: str
) -> Image:
    """Return a cut-out about the needle at an episode's start."""
    env = make(config)
    env.reset(seed=seed, options={"randomisation": given})
    whole = CLOSE * size
    image: Image = env.image(view, (whole, whole), quality=quality).astype(np.uint8)
    pose = np.linalg.inv(extrinsics(env.model, env.data, view))
    middle = env.simulation.needle_point(env.simulation.tip_angle / 2)
    u, v, depth = intrinsics(env.model, view, whole, whole) @ (pose @ [*middle, 1.0])[:3]
    env.close()
    column, row = (min(max(round(value / depth) - size // 2, 0), whole - size) for value in (u, v))
    return image[row : row + size, column : column + size]
