"""Fields: seeded noise, cells, lines and relief, from which the textures of every look are made.

A field is (height, width) float32, mostly in [0, 1], and tiles: its last row continues in its
first. Only random integers, sums, products, quotients and square roots are used, each fixed by IEEE
to the last bit and taken element by element, so that a seed gives the same bytes on every machine.
A sine or an exponential differs between processors.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

BIRTH = 0.016
"""Branches of a vessel per pixel of its length."""

Image = NDArray[np.uint8]
Field = NDArray[np.float32 | np.float64]
Size = tuple[int, int]
"""Height and width [pixel]."""
Pattern = Callable[[np.random.Generator, Size], Image]
"""What draws a texture."""
Colour = tuple[float, float, float]
"""Red, green, blue, each 0 to 255."""


def noise(rng: np.random.Generator, size: Size, rows: int, columns: int) -> Field:
    """Return smooth noise in [0, 1) with `rows` × `columns` knots."""
    knots = (rng.integers(0, 65536, (rows, columns)) / 65536.0).astype(np.float32)
    first, second, share = _knots(size[0], rows)
    along = knots[first] * (1 - share)[:, None] + knots[second] * share[:, None]
    first, second, share = _knots(size[1], columns)
    field: Field = along[:, first] * (1 - share) + along[:, second] * share
    return field


def fractal(
    rng: np.random.Generator, size: Size, rows: int, columns: int, octaves: int = 4
) -> Field:
    """Return the weighted mean of `octaves` noises, each twice as fine as the last, in [0, 1)."""
    total = np.zeros(size, np.float32)
    weight = 1.0 / (2.0 - 2.0 ** (1 - octaves))
    for octave in range(octaves):
        total += np.float32(weight) * noise(rng, size, rows << octave, columns << octave)
        weight /= 2.0
    return total


def lines(rng: np.random.Generator, size: Size, rows: int, columns: int, thin: int = 4) -> Field:
    """Return winding lines, 1 where noise crosses its middle, their width halved `thin` times."""
    field = fractal(rng, size, rows, columns, 3)
    folded: Field = 1 - np.abs(2 * field - 1)
    for _ in range(thin):
        folded = folded * folded
    return folded


def cells(rng: np.random.Generator, size: Size, rows: int, columns: int) -> tuple[Field, Field]:
    """Return cells around `rows` × `columns` scattered points.

    The first field is a random shade of each cell, the second 0 on the border between two of them
    and about 1 in their middles. Both are drawn at half the resolution.
    """
    height, width = size[0] // 2, size[1] // 2
    place = rng.integers(0, 65536, (2, rows, columns)).astype(np.float32) / 65536
    shades = rng.integers(0, 65536, (rows, columns)).astype(np.float32) / 65536
    y = np.arange(height, dtype=np.float32) * np.float32(rows / height)
    x = np.arange(width, dtype=np.float32) * np.float32(columns / width)
    row, column = y.astype(np.int64), x.astype(np.int64)
    nearest: Field = np.full((height, width), 99, np.float32)
    second: Field = nearest.copy()
    shade: Field = np.zeros((height, width), np.float32)
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            cell = np.ix_((row + down) % rows, (column + across) % columns)
            dy = (row + down - y)[:, None].astype(np.float32) + place[0][cell]
            dx = (column + across - x).astype(np.float32) + place[1][cell]
            distance = dy * dy + dx * dx
            closer = distance < nearest
            second = np.where(closer, nearest, np.minimum(second, distance))
            shade = np.where(closer, shades[cell], shade)
            nearest = np.minimum(nearest, distance)
    border = np.minimum(np.sqrt(second) - np.sqrt(nearest), 1)
    return _doubled(shade), _doubled(border)


def trees(
    rng: np.random.Generator,
    size: Size,
    count: int,
    steps: int,
    width: float,
    wander: float = 0.25,
    along: float | None = None,
) -> Field:
    """Return branching vessels: 1 in their middle, 0 beside them.

    Args:
        rng: decides their courses.
        size: of the field [pixel].
        count: number of trees.
        steps: length of a stem [pixel].
        width: half of a stem's width [pixel].
        wander: how much a step turns.
        along: share of the row direction in a stem's first direction: 1 runs across the image, 0
            along it; a random direction by default.
    """
    field = np.zeros(size, np.float32)
    waiting = []
    for _ in range(count):
        row, column = (rng.uniform(0.0, 1.0, 2) * size).tolist()
        down, right = rng.uniform(-1.0, 1.0, 2).tolist()
        if along is not None:
            sign = 1.0 if down > 0 else -1.0
            down, right = sign * (1.0 - along), sign * along
        waiting.append((row, column, down, right, steps, width))
    stamps: dict[int, list[tuple[int, int]]] = {}
    while waiting:
        row, column, down, right, left, thick = waiting.pop()
        turns = rng.uniform(-wander, wander, left).tolist()
        births = rng.uniform(0.0, 1.0, left).tolist()
        for step, (turn, birth) in enumerate(zip(turns, births, strict=True)):
            down, right = down - turn * right, right + turn * down
            length = math.sqrt(down * down + right * right) or 1.0
            down /= length
            right /= length
            row += down
            column += right
            radius = max(2, int(2.0 * thick * (1.0 - 0.6 * step / left)))
            stamps.setdefault(radius, []).append((int(row), int(column)))
            if birth < BIRTH and thick > 0.6 and len(waiting) < 60:
                side = 0.8 if birth < BIRTH / 2 else -0.8
                heading = (down - side * right, right + side * down)
                waiting.append((row, column, *heading, max(8, left - step) * 2 // 3, 0.62 * thick))
    for radius, points in stamps.items():
        _stamp(field, np.array(points), radius)
    return field


def _stamp(field: Field, points: NDArray[np.int64], radius: int) -> None:
    """Raise a soft disc of `radius` [half pixel] at each point (n, 2)."""
    reach = radius // 2 + 1
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            far = 4.0 * (dy * dy + dx * dx) / (radius + 1) ** 2
            if far < 1.0:
                rows = (points[:, 0] + dy) % field.shape[0]
                columns = (points[:, 1] + dx) % field.shape[1]
                field[rows, columns] = np.maximum(field[rows, columns], np.float32(1.0 - far))


def spots(rng: np.random.Generator, size: Size, count: int, smallest: int, largest: int) -> Field:
    """Return soft round spots of radii between `smallest` and `largest` [pixel]."""
    field = np.zeros(size, np.float32)
    places = rng.integers(0, 1 << 20, (count, 2))
    radii = rng.integers(smallest, largest + 1, count)
    for radius in range(smallest, largest + 1):
        chosen = places[radii == radius]
        if len(chosen):
            _stamp(field, chosen % size, 2 * radius)
    return field


def relief(height: Field, depth: float) -> Field:
    """Return the change in brightness (around 0) of a surface lit from the upper left.

    Args:
        height: of the surface.
        depth: of the relief; 1 gives the difference of neighbouring pixels.
    """
    shade: Field = np.float32(depth) * (height - np.roll(np.roll(height, 2, axis=0), 2, axis=1))
    return np.clip(shade, -1, 1)


def glints(height: Field, wet: float) -> Field:
    """Return highlights of a wet surface, 0 to 1: where its slope mirrors one direction.

    `wet` is the slope's tolerance, between neighbours of the field.
    """
    down = np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0)
    right = np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)
    slope = np.float32(wet)
    off = (down - slope) ** 2 + (right - slope) ** 2
    shine: Field = np.clip(1 - off / (slope * slope * np.float32(0.5)), 0, 1)
    return shine * shine


def shaded(share: Field, *colours: Colour) -> Field:
    """Return colours (height, width, 3) along a ramp; the first is where `share` is 0."""
    ramp = np.array(colours, np.float32)
    place = np.clip(share, 0, 1) * np.float32(len(ramp) - 1)
    first = np.minimum(place.astype(np.int64), len(ramp) - 2)
    mixed: Field = ramp[first] + (place - first).astype(np.float32)[..., None] * (
        ramp[first + 1] - ramp[first]
    )
    return mixed


def over(image: Field, colour: Colour, share: Field) -> Field:
    """Return the image with `share` of a colour laid over it."""
    painted: Field = image + share[..., None] * (np.array(colour, np.float32) - image)
    return painted


def to_bytes(image: Field) -> Image:
    """Return an image of 0 to 255 as uint8."""
    return np.clip(image + np.float32(0.5), 0, 255).astype(np.uint8)


def _knots(length: int, count: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Field]:
    """Return for each pixel the knots before and after it and the smooth share of the latter."""
    place = np.arange(length) * (count / length)
    first = place.astype(np.int64)
    fraction = place - first
    share: Field = (fraction * fraction * (3.0 - 2.0 * fraction)).astype(np.float32)
    return first, (first + 1) % count, share


def _doubled(field: Field) -> Field:
    """Return a field of twice the resolution, smoothed between its pixels."""
    rows: Field = np.repeat(field, 2, axis=0)
    rows[1::2] = (field + np.roll(field, -1, axis=0)) / 2
    wide: Field = np.repeat(rows, 2, axis=1)
    wide[:, 1::2] = (rows + np.roll(rows, -1, axis=1)) / 2
    return wide
