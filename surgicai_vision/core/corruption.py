"""Corruption: smoke, blur and noise on a rendered image.

A corruption is `change(image, strength, moment) -> image` of (height, width, 3) uint8. It
depends only on the image, the strength, the start seed, the step and the view, so an episode looks
the same in any batch and process. At strength 0 the image is unchanged.

Datasets can be rendered with it (`core.variants`, `render-demos --corruption`), and agents can be
evaluated with it (`evaluation.robustness`); the env, its rewards and its films stay clean.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

BLUR = 1 / 56
"""Standard deviation of the blur at strength 1, as a share of the image's height: 4 px at 224."""
NOISE = 64.0
"""Standard deviation of the noise at strength 1 [grey levels of 255]."""
SMOKE_COLOUR = (196.0, 198.0, 202.0)
"""Colour of thick smoke, a cool grey [grey levels of 255]."""
SMOKE_THIN, SMOKE_THICK = 0.4, 0.9
"""Opacity of the smoke at strength 1 where it is thinnest and thickest."""
SMOKE_KNOTS, SMOKE_DRIFT = 5, 1 / 200
"""Clouds across an image, and their drift per control step [image widths]: a width in 4 s."""


@dataclass(frozen=True)
class Moment:
    """When and where an image was taken.

    Attributes:
        seed: start seed.
        step: step in the episode.
        view: index of the view.
        part: share of the image's height that its viewer looks at, if crops are cut from it: the
            blur is that of an image which shows this part alone.
    """

    seed: int
    step: int
    view: int
    part: float = 1.0


def blur(image: Image, strength: float, moment: Moment) -> Image:
    """Return the image out of focus."""
    import cv2

    sigma = strength * BLUR * moment.part * image.shape[0]
    if sigma == 0:
        return image
    changed: Image = cv2.GaussianBlur(image, (0, 0), sigma)
    return changed


def noise(image: Image, strength: float, moment: Moment) -> Image:
    """Return the image with Gaussian noise, drawn anew for every image."""
    rng = np.random.default_rng((moment.seed, moment.step, moment.view))
    grain = rng.standard_normal(image.shape, dtype=np.float32)
    return _bytes(image + np.float32(strength * NOISE) * grain)


def smoke(image: Image, strength: float, moment: Moment) -> Image:
    """Return the image behind drifting smoke; each start and view has its own clouds."""
    height, width = image.shape[:2]
    field = _clouds(moment.seed, moment.view, height, width)
    field = np.roll(field, round(moment.step * SMOKE_DRIFT * width), axis=1)
    opacity = np.float32(strength) * (SMOKE_THIN + (SMOKE_THICK - SMOKE_THIN) * field)[..., None]
    return _bytes(image + opacity * (np.array(SMOKE_COLOUR, np.float32) - image))


def _clouds(seed: int, view: int, height: int, width: int) -> NDArray[np.float32]:
    """Return smooth noise from 0 to 1, (height, width), that tiles horizontally.

    It is bilinear between random knots.
    """
    knots = np.random.default_rng((seed, view)).random(
        (SMOKE_KNOTS + 1, SMOKE_KNOTS), dtype=np.float32
    )
    rows, columns = np.arange(height) * SMOKE_KNOTS / height, np.arange(width) * SMOKE_KNOTS / width
    row, column = rows.astype(int), columns.astype(int)
    down, right = (rows - row).astype(np.float32)[:, None], (columns - column).astype(np.float32)
    next_column = (column + 1) % SMOKE_KNOTS
    upper = knots[row][:, column] * (1 - right) + knots[row][:, next_column] * right
    lower = knots[row + 1][:, column] * (1 - right) + knots[row + 1][:, next_column] * right
    smooth: NDArray[np.float32] = upper * (1 - down) + lower * down
    return smooth


def _bytes(values: NDArray[np.generic]) -> Image:
    rounded: Image = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return rounded


Change = Callable[[Image, float, Moment], Image]
"""(image, strength, moment) → the corrupted image."""
CORRUPTIONS: Mapping[str, Change] = MappingProxyType({"smoke": smoke, "blur": blur, "noise": noise})
"""Name → corruption, in the order in which they are applied to an image."""


def spoilt(image: Image, strengths: Mapping[str, float], moment: Moment) -> Image:
    """Return an image after several corruptions: name → strength, in the order of application."""
    for kind, strength in strengths.items():
        image = CORRUPTIONS[kind](image, strength, moment)
    return image
