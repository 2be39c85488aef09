"""Random patterns: noise of any fineness and colour, and tissues in colours that they do not have.

A policy that has seen three cloths fails over a fourth, so `cloths.varied` and the `random_`
families draw what no real surface looks like (docs/looks.md). Nothing in these patterns is straight
or regular, as the stripe and the check of two held-out cloths are.
"""

import numpy as np

from surgicai_vision.scene.visual.fields import (
    Colour,
    Image,
    Pattern,
    Size,
    fractal,
    lines,
    over,
    relief,
    shaded,
    spots,
    to_bytes,
)
from surgicai_vision.scene.visual.tissues import TISSUE_SIZE, mixed

KEPT = 0.6
"""Share of the random tissues that keep the pattern of a real one."""
BRIGHTEST = (110.0, 250.0)
"""Bounds of the strongest channel of a random tissue's mean colour, 0 to 255: dark ink shows on the
darkest."""


def any_pattern(rng: np.random.Generator, size: Size) -> Image:
    """Draw a random pattern of random colours, (height, width, 3) uint8; it tiles.

    It is noise of any fineness, stretched along one axis or not, soft or cut into patches; over it
    there may be winding lines, spots and creases.
    """
    first, second, third = (any_colour(rng) for _ in range(3))
    rows, columns = (2 ** rng.integers(1, 6, 2)).tolist()
    share = fractal(rng, size, rows, columns, int(rng.integers(1, 4)))
    steep = np.float32((1, 2, 4, 16)[rng.integers(4)])
    share = np.clip(steep * (share - np.float32(0.5)) + np.float32(0.5), 0, 1)
    image = shaded(share, first, mixed(rng, first, second))
    rows, columns = rng.integers(3, 20, 2).tolist()
    if rng.uniform() < 0.6:
        thread = lines(rng, size, rows, columns, int(rng.integers(3, 6)))
        image = over(image, third, np.float32(rng.uniform(0.2, 1.0)) * thread)
    if rng.uniform() < 0.3:
        image = over(image, second, spots(rng, size, int(rng.integers(5, 60)), 2, 8))
    if rng.uniform() < 0.5:
        crease = fractal(rng, size, rows, columns, 2)
        image = image * (1 + np.float32(rng.uniform(0.2, 0.8)) * relief(crease, 1.6))[..., None]
    return to_bytes(image)


def any_colour(rng: np.random.Generator) -> Colour:
    """Draw a colour: a grey of any brightness, with any tint."""
    grey = rng.uniform(0.0, 255.0)
    tint = rng.uniform(0.0, 1.0)
    red, green, blue = (grey + tint * (rng.uniform(0.0, 255.0, 3) - grey)).tolist()
    return red, green, blue


def any_tissue(pattern: Pattern, rng: np.random.Generator, size: Size = TISSUE_SIZE) -> Image:
    """Draw a tissue's pattern, or a random one in its place, in a random colour and contrast."""
    drawn = (pattern if rng.uniform() < KEPT else any_pattern)(rng, size)
    # A sum of integers is exact, so that every machine finds the same mean.
    mean = drawn.reshape(-1, 3).sum(axis=0, dtype=np.int64) / (size[0] * size[1])
    colour = np.array(any_colour(rng)) + 1.0  # black has no direction to be scaled along
    colour *= rng.uniform(*BRIGHTEST) / colour.max()
    contrast = rng.uniform(0.5, 1.5)
    image = colour + contrast * (colour.max() / max(mean.max(), 1.0)) * (drawn - mean)
    return to_bytes(image.astype(np.float32))
