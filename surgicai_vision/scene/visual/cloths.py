"""Cloths: textures of drapes, trays and instruments, drawn from a generator.

A pattern is a function of (rng, size) that returns a tiling image (height, width, 3) uint8.
"""

import numpy as np

from surgicai_vision.scene.visual.fields import (
    Image,
    Size,
    cells,
    fractal,
    lines,
    noise,
    over,
    relief,
    shaded,
    spots,
    to_bytes,
)
from surgicai_vision.scene.visual.random_patterns import any_pattern
from surgicai_vision.scene.visual.tissues import darker, mixed

CLOTH_SIZE = (256, 256)
"""Height and width of a drape's texture [pixel], over 77 mm."""
PLATE_SIZE = (128, 128)
"""Height and width of the textures of tray and instruments [pixel]."""


def woven(rng: np.random.Generator, size: Size = CLOTH_SIZE) -> Image:
    """Draw a woven drape, green to blue."""
    base = mixed(rng, (44.0, 116.0, 104.0), (40.0, 92.0, 140.0))
    over_under = (np.arange(size[0]) % 4 < 2)[:, None] ^ (np.arange(size[1]) % 4 < 2)
    share = 0.5 * noise(rng, size, 8, 8) + 0.25 * over_under + 0.25 * noise(rng, size, 64, 64)
    return to_bytes(shaded(share.astype(np.float32), darker(base, 0.66), darker(base, 1.15)))


def fleece(rng: np.random.Generator, size: Size = CLOTH_SIZE) -> Image:
    """Draw a non-woven drape of bonded fibres, light blue, with a grid of bonds."""
    base = mixed(rng, (112.0, 158.0, 196.0), (92.0, 140.0, 176.0))
    fibres = np.maximum(lines(rng, size, 24, 24, 3), lines(rng, size, 32, 16, 3))
    image = shaded(fractal(rng, size, 4, 4, 4), darker(base, 0.84), darker(base, 1.08))
    image = image * (1 + 0.16 * fibres)[..., None]
    bonds = (np.arange(size[0]) % 16 < 3)[:, None] & (np.arange(size[1]) % 16 < 3)
    return to_bytes(image * (1 - 0.14 * bonds)[..., None])


def crepe(rng: np.random.Generator, size: Size = CLOTH_SIZE) -> Image:
    """Draw crinkled sterile paper, dull green or sand."""
    base = mixed(rng, (118.0, 150.0, 112.0), (176.0, 164.0, 132.0))
    crinkle = fractal(rng, size, 32, 12, 3)
    image = shaded(fractal(rng, size, 4, 4, 3), darker(base, 0.86), darker(base, 1.05))
    return to_bytes(image * (1 + 0.6 * relief(crinkle, 1.6))[..., None])


def varied(rng: np.random.Generator, size: Size = CLOTH_SIZE) -> Image:
    """Draw one of the cloths above, or a random pattern of random colours."""
    cloth = rng.integers(8)
    if cloth < 3:
        return (woven, fleece, crepe)[cloth](rng, size)
    return any_pattern(rng, size)


def towel(rng: np.random.Generator, size: Size = CLOTH_SIZE) -> Image:
    """Draw a white surgical towel of loops, with a coloured stripe."""
    base = mixed(rng, (206.0, 204.0, 196.0), (188.0, 196.0, 204.0))
    stripe = mixed(rng, (64.0, 84.0, 150.0), (150.0, 70.0, 80.0))
    shade, border = cells(rng, size, 64, 64)
    image = shaded(0.5 * shade + 0.5 * np.minimum(2 * border, 1), darker(base, 0.70), base)
    share = (np.abs(np.arange(size[1]) - 60) < 14).astype(np.float32) * np.ones(size, np.float32)
    return to_bytes(over(image, stripe, 0.6 * share))


def film(rng: np.random.Generator, size: Size = CLOTH_SIZE) -> Image:
    """Draw brown adhesive film with wrinkles that shine."""
    base = mixed(rng, (150.0, 96.0, 56.0), (122.0, 84.0, 62.0))
    image = shaded(fractal(rng, size, 3, 3, 3), darker(base, 0.72), darker(base, 1.10))
    image = over(image, (236.0, 214.0, 186.0), 0.5 * lines(rng, size, 5, 9, 6))
    return to_bytes(image * (1 + 0.5 * relief(fractal(rng, size, 6, 10, 2), 1.8))[..., None])


def checked(rng: np.random.Generator, size: Size = CLOTH_SIZE) -> Image:
    """Draw a reinforced drape: violet-grey with a grid of thick threads."""
    base = mixed(rng, (96.0, 84.0, 124.0), (84.0, 88.0, 104.0))
    image = shaded(fractal(rng, size, 8, 8, 3), darker(base, 0.82), darker(base, 1.08))
    grid = np.maximum(np.arange(size[0])[:, None] % 32 < 3, np.arange(size[1]) % 32 < 3)
    return to_bytes(over(image, (206.0, 202.0, 214.0), 0.45 * grid.astype(np.float32)))


def brushed(rng: np.random.Generator, size: Size = PLATE_SIZE) -> Image:
    """Draw brushed metal, nearly white, for a material's own colour to tint."""
    share = 0.8 * noise(rng, size, 128, 4) + 0.2 * noise(rng, size, 4, 4)
    return to_bytes(shaded(share, (196.0, 198.0, 200.0), (255.0, 255.0, 255.0)))


def scratched(rng: np.random.Generator, size: Size = PLATE_SIZE) -> Image:
    """Draw a worn surface: scratches and stains on near white."""
    image = shaded(fractal(rng, size, 3, 3, 4), (168.0, 160.0, 148.0), (255.0, 255.0, 255.0))
    image = over(image, (255.0, 255.0, 255.0), 0.6 * lines(rng, size, 3, 12, 6))
    image = over(image, (92.0, 84.0, 76.0), 0.5 * lines(rng, size, 8, 3, 6))
    return to_bytes(over(image, (110.0, 80.0, 60.0), 0.5 * spots(rng, size, 14, 2, 6)))


def pitted(rng: np.random.Generator, size: Size = PLATE_SIZE) -> Image:
    """Draw cast plastic: dimples and a few dried drops on near white."""
    image = shaded(noise(rng, size, 48, 48), (206.0, 206.0, 206.0), (255.0, 255.0, 255.0))
    return to_bytes(over(image, (120.0, 60.0, 56.0), 0.7 * spots(rng, size, 5, 2, 5)))


def tarnished(rng: np.random.Generator, size: Size = PLATE_SIZE) -> Image:
    """Draw heat colours of metal: straw, violet and blue over grey."""
    image = shaded(
        fractal(rng, size, 3, 3, 3),
        (176.0, 176.0, 214.0),
        (226.0, 206.0, 226.0),
        (255.0, 236.0, 196.0),
        (244.0, 244.0, 244.0),
    )
    return to_bytes(image * (1 - 0.2 * lines(rng, size, 6, 6, 5))[..., None])
