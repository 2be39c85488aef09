"""Tissues: one texture per pattern, drawn from a generator.

A pattern is a function of (rng, size) that returns an image (height, width, 3) uint8. Everything
that varies within one is drawn from the generator, so a seed gives the same bytes everywhere
(`scene.visual.fields`). Widths and lengths in pixels are for `TISSUE_SIZE`, 0.22 mm per pixel. The
glints are highlights of small relief that is not in the mesh; they stay where they are when the
camera moves.
"""

import numpy as np

from surgicai_vision.scene.visual.fields import (
    Colour,
    Field,
    Image,
    Size,
    cells,
    fractal,
    glints,
    lines,
    noise,
    over,
    relief,
    shaded,
    spots,
    to_bytes,
    trees,
)

TISSUE_SIZE = (768, 384)
"""Height and width of the tissue's texture [pixel], over 173 × 80 mm."""


def mixed(rng: np.random.Generator, first: Colour, second: Colour) -> Colour:
    """Return a colour between two."""
    share = rng.uniform()
    red, green, blue = (a + share * (b - a) for a, b in zip(first, second, strict=True))
    return red, green, blue


def darker(colour: Colour, factor: float) -> Colour:
    """Return a colour with every channel scaled."""
    red, green, blue = colour
    return factor * red, factor * green, factor * blue


def silicone(rng: np.random.Generator, size: Size = TISSUE_SIZE) -> Image:
    """Draw a training pad: one colour, faint casting marks, specks of pigment, no vessels."""
    base = mixed(rng, (222.0, 186.0, 164.0), (214.0, 160.0, 148.0))
    share = 0.7 * fractal(rng, size, 4, 2, 3) + 0.3 * noise(rng, size, 256, 128)
    image = shaded(share, darker(base, 0.90), darker(base, 1.05))
    image = over(image, darker(base, 0.72), 0.5 * spots(rng, size, int(rng.integers(20, 90)), 1, 2))
    image = over(image, darker(base, 1.12), 0.35 * lines(rng, size, 3, 2, 6))
    return to_bytes(image)


def mucosa(rng: np.random.Generator, size: Size = TISSUE_SIZE) -> Image:
    """Draw moist pink mucosa with a net of capillaries and small highlights."""
    base = mixed(rng, (222.0, 138.0, 132.0), (204.0, 104.0, 104.0))
    blood = mixed(rng, (150.0, 34.0, 46.0), (128.0, 26.0, 48.0))
    image = shaded(fractal(rng, size, 10, 5, 4), darker(base, 0.80), darker(base, 1.14))
    net = int(rng.integers(9, 16))
    image = over(image, blood, 0.55 * lines(rng, size, 2 * net, net, 5))
    image = over(image, blood, 0.7 * trees(rng, size, int(rng.integers(3, 8)), 240, 1.6))
    image = image * (1 + 0.3 * relief(fractal(rng, size, 48, 24, 2), 2.0))[..., None]
    return to_bytes(_wet(rng, image, size, 14, float(rng.uniform(0.5, 0.9))))


def skin(rng: np.random.Generator, size: Size = TISSUE_SIZE) -> Image:
    """Draw skin, light to dark, with creases, pores, freckles and now and then an old scar."""
    tone = rng.uniform()
    light = mixed(rng, (238.0, 196.0, 172.0), (224.0, 174.0, 142.0))
    base = tuple(a + tone * (b - a) for a, b in zip(light, (112.0, 72.0, 54.0), strict=True))
    base = (base[0], base[1], base[2])
    image = shaded(fractal(rng, size, 6, 3, 4), darker(base, 0.88), darker(base, 1.08))
    _, border = cells(rng, size, 140, 70)
    furrows = np.clip(1 - 3 * border, 0, 1)
    image = image * (1 - float(rng.uniform(0.08, 0.18)) * furrows)[..., None]
    image = image * (1 - 0.10 * lines(rng, size, 20, 10, 4))[..., None]
    image = image * (1 - 0.16 * spots(rng, size, 1500, 1, 1))[..., None]
    freckles = spots(rng, size, int(rng.integers(0, 70)), 1, 4)
    image = over(image, darker(base, 0.62), 0.6 * freckles)
    scars = trees(rng, size, int(rng.integers(0, 3)), 80, 2.6, 0.06, 0.5)
    image = over(image, _pale(base), 0.6 * scars)
    return to_bytes(image)


def muscle(rng: np.random.Generator, size: Size = TISSUE_SIZE) -> Image:
    """Draw muscle: red fibres across the wound in bundles, with pale fascia between them."""
    base = mixed(rng, (164.0, 64.0, 58.0), (138.0, 46.0, 48.0))
    sway = (56 * noise(rng, size, 4, 4)).astype(np.int64)
    rows = (np.arange(size[0])[:, None] + sway) % size[0]
    columns = np.arange(size[1])
    bundles = fractal(rng, size, 52, 3, 2)[rows, columns]
    fibres = noise(rng, size, 384, 12)[rows, columns]
    image = shaded(0.6 * bundles + 0.4 * fibres, darker(base, 0.62), base, darker(base, 1.30))
    fascia = lines(rng, size, 18, 2, 5)[rows, columns]
    image = over(image, (222.0, 184.0, 170.0), float(rng.uniform(0.35, 0.65)) * fascia)
    image = over(image, (96.0, 18.0, 34.0), 0.6 * trees(rng, size, 3, 220, 1.5, 0.15))
    return to_bytes(_wet(rng, image, size, 18, float(rng.uniform(0.5, 0.9))))


def fat(rng: np.random.Generator, size: Size = TISSUE_SIZE) -> Image:
    """Draw yellow fat in lobules with thin red vessels."""
    base = mixed(rng, (236.0, 196.0, 104.0), (228.0, 176.0, 112.0))
    count = int(rng.integers(9, 15))
    sway = (24 * fractal(rng, size, 24, 12, 2)).astype(np.int64)
    rows = (np.arange(size[0])[:, None] + sway) % size[0]
    columns = (np.arange(size[1]) + sway) % size[1]
    shade, border = (field[rows, columns] for field in cells(rng, size, 2 * count, count))
    plump = np.minimum(1.7 * border, 1)
    plump = plump * (2 - plump)
    tone = 0.35 * shade + 0.35 * plump + 0.3 * fractal(rng, size, 32, 16, 3)
    image = shaded(tone, darker(base, 0.76), base, darker(base, 1.12))
    image = over(image, (214.0, 128.0, 84.0), 0.55 * (1 - plump) * (1 - plump))
    image = image * (1 + 0.35 * relief(plump, 0.7))[..., None]
    image = over(image, (168.0, 40.0, 44.0), 0.75 * trees(rng, size, 7, 250, 1.5, 0.2))
    return to_bytes(_wet(rng, image, size, 18, float(rng.uniform(0.5, 0.8))))


def liver(rng: np.random.Generator, size: Size = TISSUE_SIZE) -> Image:
    """Draw liver: dark red-brown, smooth, in small lobules, with broad highlights."""
    base = mixed(rng, (120.0, 50.0, 40.0), (98.0, 38.0, 38.0))
    shade, border = cells(rng, size, 108, 54)
    share = 0.5 * fractal(rng, size, 6, 3, 3) + 0.3 * shade + 0.2 * np.minimum(2 * border, 1)
    image = shaded(share, darker(base, 0.70), base, darker(base, 1.35))
    pale = fractal(rng, size, 8, 4, 3)
    patches = np.clip(5 * (pale - np.float32(rng.uniform(0.58, 0.70))), 0, 1)
    image = over(image, (158.0, 104.0, 66.0), 0.5 * patches)
    return to_bytes(_wet(rng, image, size, 12, float(rng.uniform(0.5, 0.8))))


def bowel(rng: np.random.Generator, size: Size = TISSUE_SIZE) -> Image:
    """Draw bowel: pale grey-pink serosa in folds, with vessels that branch across it."""
    base = mixed(rng, (226.0, 186.0, 178.0), (208.0, 172.0, 168.0))
    folds = noise(rng, size, int(rng.integers(12, 20)), 2)
    share = 0.55 * folds + 0.45 * fractal(rng, size, 8, 8, 4)
    image = shaded(share, darker(base, 0.74), base, darker(base, 1.08))
    image = image * (1 + 0.5 * relief(folds, 6.0))[..., None]
    veins = trees(rng, size, int(rng.integers(6, 10)), 330, 2.4, 0.12, 1.0)
    image = over(image, (112.0, 62.0, 104.0), 0.65 * veins)
    arteries = trees(rng, size, int(rng.integers(8, 13)), 300, 1.6, 0.14, 1.0)
    image = over(image, (188.0, 46.0, 50.0), 0.75 * arteries)
    return to_bytes(_wet(rng, image, size, 16, float(rng.uniform(0.6, 1.0))))


def scar(rng: np.random.Generator, size: Size = TISSUE_SIZE) -> Image:
    """Draw a scarred field: white plates and strands on inflamed red, and dark spots of cautery."""
    base = mixed(rng, (188.0, 92.0, 88.0), (170.0, 84.0, 96.0))
    white = mixed(rng, (232.0, 216.0, 200.0), (220.0, 206.0, 204.0))
    image = shaded(fractal(rng, size, 8, 4, 4), darker(base, 0.70), darker(base, 1.20))
    plates = np.clip(6 * (fractal(rng, size, 10, 5, 3) - np.float32(0.5)), 0, 1)
    strands = np.maximum(lines(rng, size, 8, 4, 4), lines(rng, size, 16, 8, 4))
    image = over(image, white, 0.75 * plates)
    image = over(image, white, 0.7 * strands)
    image = image * (1 + 0.4 * relief(np.maximum(plates, strands), 0.5))[..., None]
    burns = spots(rng, size, int(rng.integers(8, 22)), 3, 9)
    image = over(image, (92.0, 62.0, 40.0), np.minimum(0.9 * burns, 0.6))
    image = over(image, (34.0, 24.0, 22.0), 0.9 * burns * burns * burns)
    return to_bytes(_wet(rng, image, size, 14, float(rng.uniform(0.3, 0.6))))


def _wet(rng: np.random.Generator, image: Field, size: Size, knots: int, strength: float) -> Field:
    """Return an image with highlights, in wet patches, of a relief of `knots` waves across."""
    shine = glints(fractal(rng, size, 2 * knots, knots, 2), 0.55 * knots / size[1])
    pools = np.clip(4 * (fractal(rng, size, 8, 4, 2) - np.float32(0.5)), 0, 1)
    return over(image, (255.0, 250.0, 246.0), np.float32(strength) * shine * pools)


def _pale(colour: Colour) -> Colour:
    """Return a colour halfway to white."""
    red, green, blue = colour
    return 0.5 * red + 118.0, 0.5 * green + 112.0, 0.5 * blue + 108.0
