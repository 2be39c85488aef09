"""Sheet: what every axis does to an image, from strength 0 to 1, for people to judge.

Axes that no image shows, such as latency, are left out.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surgicai_vision import envs
from surgicai_vision.core.cameras import camera_number
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.corruption import CORRUPTIONS, Moment
from surgicai_vision.evaluation.robustness.axes import AXES, shifted_config

Image = NDArray[np.uint8]
UNSEEN = ("latency",)
"""Axes that change no image of a start."""


def axis_names() -> tuple[str, ...]:
    """Return the axes that an image can show."""
    return tuple(name for name in AXES if name not in UNSEEN)


def axis_images(
    config: TaskConfig,
    axis: str,
    view: str,
    seed: int,
    size: int,
    quality: str,
    strengths: Sequence[float],
) -> list[Image]:
    """Return the start of an episode at each strength of an axis, (size, size, 3) uint8 each.

    Args:
        config: the task.
        axis: a key of `AXES`.
        view: the camera or the crop.
        seed: of the start.
        size: height and width [pixel].
        quality: of `scene.rendering.QUALITIES`.
        strengths: each from 0 to 1.
    """
    images = []
    for strength in strengths:
        env = envs.make(shifted_config(config, AXES[axis], strength), obs_type="state")
        env.reset(seed=seed)
        image = env.image(view, (size, size), quality=quality).astype(np.uint8, copy=False)
        env.close()
        moment = Moment(seed, 0, camera_number(view))
        for kind in AXES[axis].images:
            image = CORRUPTIONS[kind](image, strength, moment)
        images.append(image)
    return images
