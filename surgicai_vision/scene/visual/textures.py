"""Textures: tissue and cloth, drawn from numbers alone, the same bytes on every machine.

Noise uses only seeded integers and sums and products of floats, which IEEE fixes to the last bit; a
sine or an exponential would differ between processors, and so would the scene's hash. The textures
reach MuJoCo as PNG files in memory, named by their content, so that the hash over the scene's XML
covers them.
"""

import hashlib
import struct
import zlib

import mujoco
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Field = NDArray[np.float64]


def add_texture(spec: mujoco.MjSpec, name: str, image: Image) -> None:
    """Add a 2-D texture (H, W, 3) uint8 to `spec`."""
    content = png(image)
    file = f"{name}_{hashlib.sha256(content).hexdigest()[:12]}.png"
    spec.assets = {**spec.assets, file: content}
    spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, file=file)


def tissue(height: int = 768, width: int = 384, seed: int = 1) -> Image:
    """Return wet tissue: pink, mottled, with two layers of fine vessels, (height, width, 3)."""
    rng = np.random.default_rng(seed)
    aspect = height // width
    mottle = 0.6 * noise(rng, height, width, 4 * aspect, 4) + 0.4 * noise(
        rng, height, width, 16 * aspect, 16
    )
    grain = noise(rng, height, width, height // 2, width // 2) - 0.5
    arteries = _filaments(rng, height, width, 6 * aspect, 6)
    capillaries = _filaments(rng, height, width, 20 * aspect, 20)
    image = _blend(np.array([224.0, 164.0, 152.0]), np.array([190.0, 108.0, 102.0]), mottle)
    image = _blend(image, np.array([150.0, 40.0, 52.0]), 0.42 * arteries)
    image = _blend(image, np.array([164.0, 52.0, 60.0]), 0.24 * capillaries)
    return _bytes(image + 14.0 * grain[..., None])


def cloth(size: int = 256, seed: int = 2) -> Image:
    """Return a woven surgical drape, (size, size, 3), that tiles."""
    rng = np.random.default_rng(seed)
    weft = (np.arange(size) % 4 < 2)[:, None]
    warp = (np.arange(size) % 4 < 2)[None, :]
    weave = np.where(weft ^ warp, 1.0, 0.0)
    shade = (
        0.5 * noise(rng, size, size, 8, 8) + 0.25 * weave + 0.25 * noise(rng, size, size, 64, 64)
    )
    return _bytes(_blend(np.array([22.0, 84.0, 96.0]), np.array([50.0, 128.0, 138.0]), shade))


def noise(rng: np.random.Generator, height: int, width: int, rows: int, columns: int) -> Field:
    """Return smooth noise in [0, 1), (height, width), with `rows` × `columns` knots; it tiles."""
    knots = rng.integers(0, 65536, size=(rows, columns)) / 65536.0
    first, second, share = _knots(height, rows)
    along = knots[first] * (1.0 - share)[:, None] + knots[second] * share[:, None]
    first, second, share = _knots(width, columns)
    field: Field = along[:, first] * (1.0 - share) + along[:, second] * share
    return field


def _knots(length: int, count: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Field]:
    """Return for each pixel the knots before and after it and the smooth share of the latter."""
    place = np.arange(length) * (count / length)
    first = place.astype(np.int64)
    fraction = place - first
    return first, (first + 1) % count, fraction * fraction * (3.0 - 2.0 * fraction)


def _filaments(rng: np.random.Generator, height: int, width: int, rows: int, columns: int) -> Field:
    """Return thin winding lines: 1 where smooth noise crosses its middle, 0 beside it."""
    octaves = ((0.6, 1), (0.28, 2), (0.12, 4))
    field = sum(
        weight * noise(rng, height, width, rows * fine, columns * fine) for weight, fine in octaves
    )
    folded: Field = 1.0 - np.abs(2.0 * field - 1.0)
    for _ in range(4):
        folded = folded * folded
    return folded


def _blend(low: Field, high: Field, share: Field) -> Field:
    """Return low + share (high - low) for each colour channel."""
    mixed: Field = low + share[..., None] * (high - low)
    return mixed


def _bytes(image: Field) -> Image:
    return np.clip(image + 0.5, 0.0, 255.0).astype(np.uint8)


def png(image: Image) -> bytes:
    """Return an (H, W, 3) image as a PNG file.

    It is stored without compression, so that its bytes depend on nothing else.
    """
    height, width, _ = image.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 0)), (b"IEND", b""))
    parts = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
