"""Contact sheet: images of states for reports: coloured, encoded, and in a grid."""

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import files, names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.envs import make
from surgicai_vision.scene.rendering import Frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Image = NDArray[np.uint8]

PALETTE = np.array(
    [
        (22, 27, 34),
        (222, 150, 130),
        (255, 214, 10),
        (120, 200, 120),
        (88, 166, 255),
        (188, 140, 255),
    ],
    np.uint8,
)
"""RGB of each of `names.PARTS` in a coloured segmentation."""

BEYOND = 1.0
"""Depth [m] from which a pixel is background; the scene is 0.2 m deep."""
LETTERS = 7.0
"""Letters of a sheet's title that fit into each inch of its width."""


class Draw(Protocol):
    """Draws a state of an env, as `get_state` returns it."""

    def __call__(self, state: NDArray[np.float64], view: str, modality: str = names.RGB) -> Image:
        """Return an RGB image (size, size, 3); depth and segmentation are coloured."""


@contextmanager
def state_renderer(config: TaskConfig, size: int, quality: str = "high") -> Iterator[Draw]:
    """Yield a function that draws states of a task's env."""
    env = make(config, obs_type="state")
    env.reset(seed=0)

    def image(state: NDArray[np.float64], view: str, modality: str = names.RGB) -> Image:
        env.set_state_vector(state)
        return coloured(env.image(view, (size, size), modality, quality), modality)

    try:
        yield image
    finally:
        env.close()


def start_images(
    config: TaskConfig, views: Sequence[str], seeds: Sequence[int], size: int, quality: str
) -> list[Image]:
    """Return images of episode starts, (size, size, 3) each: every view of each seed in turn."""
    env = make(config, obs_type="state")
    images = []
    for seed in seeds:
        env.reset(seed=seed)
        for view in views:
            frame = env.image(view, (size, size), names.RGB, quality)
            images.append(coloured(frame, names.RGB))
    env.close()
    return images


def coloured(frame: Frame, modality: str) -> Image:
    """Return a frame as RGB (H, W, 3): depth by a colour map, segmentation by a palette."""
    if modality == names.RGB:
        return frame.astype(np.uint8, copy=False)
    if modality == names.SEGMENTATION:
        parts: Image = PALETTE[frame[..., 0]]
        return parts
    import cv2

    depth = frame.astype(np.float32, copy=False)
    near, far = depth_range(depth)
    scaled = np.clip((depth[..., 0] - near) / max(far - near, 1e-6), 0, 1)
    rgb: Image = cv2.applyColorMap((255 * (1 - scaled)).astype(np.uint8), cv2.COLORMAP_TURBO)[
        ..., ::-1
    ].copy()
    rgb[depth[..., 0] >= BEYOND] = PALETTE[0]
    return rgb


def depth_range(frame: NDArray[np.float32]) -> tuple[float, float]:
    """Return the range of depths [m] that the colour map covers.

    It goes from the 2nd to the 90th percentile of the depths nearer than `BEYOND`.
    """
    inside = frame[frame < BEYOND]
    if not inside.size:
        return 0.0, BEYOND
    low, high = np.percentile(inside, (2, 90))
    return float(low), float(high)


def sheet(
    rows: Sequence[tuple[str, Sequence[Image]]], columns: Sequence[str], title: str
) -> "Figure":
    """Return a matplotlib figure: a grid of images with a name for each row and column.

    A title that is wider than the grid is wrapped.
    """
    from matplotlib.figure import Figure

    width = 2.1 * len(columns) + 1.0
    lines = textwrap.wrap(title, int(LETTERS * width))
    height = 2.1 * len(rows) + 0.6 + 0.2 * max(len(lines), 1)
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle("\n".join(lines), fontsize=13, fontweight="bold")
    axes = figure.subplots(len(rows), len(columns), squeeze=False)
    for (name, images), line in zip(rows, axes, strict=True):
        for image, axis in zip(images, line, strict=True):
            axis.imshow(image)
            axis.set_xticks([])
            axis.set_yticks([])
            for edge in axis.spines.values():
                edge.set_visible(False)
        line[0].set_ylabel(name, fontsize=11)
    for column, axis in zip(columns, axes[0], strict=True):
        axis.set_title(column, fontsize=10)
    return figure


def write(figure: "Figure", path: Path, dpi: int) -> None:
    """Write a sheet atomically: a kill leaves the old file; the suffix selects the format."""
    with files.whole_file(path) as temporary:
        figure.savefig(temporary, dpi=dpi)


def jpeg(image: Image, quality: int = 85) -> bytes:
    """Return an RGB image as JPEG."""
    return _encoded(image, ".jpg", [1, quality])  # 1 is cv2.IMWRITE_JPEG_QUALITY


def png(image: Image) -> bytes:
    """Return an RGB image as PNG."""
    return _encoded(image, ".png", [])


def decoded(content: bytes) -> Image:
    """Return a JPEG or PNG as RGB (H, W, 3)."""
    import cv2

    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image[..., ::-1], np.uint8)


def _encoded(image: Image, suffix: str, options: list[int]) -> bytes:
    import cv2

    done, buffer = cv2.imencode(suffix, np.ascontiguousarray(image[..., ::-1]), options)
    assert done
    return bytes(buffer)
