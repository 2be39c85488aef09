"""Rules that an episode of ours must follow, for checking a dataset and repairing a broken one."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.dataset import schema

MOVED = 0.001
"""If an arm or needle moves further than this between two frames [m], the image must change."""


def episode_problems(
    number: int, columns: Mapping[str, NDArray[np.generic]], fps: float
) -> Iterator[str]:
    """Yield what is wrong with the order, the end and the seed of one episode.

    Args:
        number: its index in the dataset.
        columns: its rows of `schema.COLUMNS`, `frame_index` and `timestamp`.
        fps: frames per second.
    """
    count = len(columns["frame_index"])
    steps = np.arange(count)
    if not np.array_equal(columns["frame_index"], steps):
        yield f"episode {number}: frame_index is not 0, 1, 2, …"
    if not np.allclose(columns["timestamp"], steps / fps, atol=1e-4):
        yield f"episode {number}: timestamp is not frame_index / {fps:g}."
    if not np.array_equal(columns[names.DONE], steps == count - 1):
        yield f"episode {number}: {names.DONE} is not true at exactly its last frame."
    if len(np.unique(columns[names.SEED])) != 1:
        yield f"episode {number}: its frames have different seeds."


def number_problems(columns: Mapping[str, NDArray[np.generic]]) -> Iterator[str]:
    """Yield which columns hold numbers that are not finite, or actions outside [-1, 1]."""
    for key in (key for key in columns if key in schema.COLUMNS or schema.is_calibration(key)):
        finite = np.isfinite(columns[key].astype(np.float64)).reshape(len(columns[key]), -1)
        wrong = ~finite.all(axis=1)
        if wrong.any():
            first = wrong.argmax()
            yield f"{key}: {wrong.sum()} frames with numbers that are not finite, first {first}."
    if len(columns[names.ACTION]) and np.nanmax(np.abs(columns[names.ACTION])) > 1.0:
        yield f"{names.ACTION}: values outside [-1, 1]."


class ImageWatch:
    """Checks one episode's images of one column, in order.

    Args:
        key: the column.
        size: side of its images [px].
        views: the dataset's cameras.
        rows: the episode's columns.
        lossless: not from a video, whose encoder may repeat an image unchanged.
    """

    def __init__(
        self,
        key: str,
        size: int,
        views: Sequence[str],
        rows: Mapping[str, NDArray[np.generic]],
        lossless: bool = True,
    ):
        # A moving camera may not see what moved, and a part's outline can stay the same.
        still = [view for view in views if view in names.FIXED_CAMERAS]
        self._watched = lossless and key in {
            name(view) for view in still for name in (names.image_key, names.depth_key)
        }
        self._shown = np.concatenate(
            [rows[names.STATE][:, :3], rows[names.NEEDLE_POSE][:, :3]], axis=1
        )
        self._size = size
        self._last = self._shown[0]
        self._before: NDArray[np.uint8 | np.float32] | None = None

    def problem(self, index: int, frame: NDArray[np.uint8 | np.float32]) -> str:
        """Return what is wrong with the episode's frame `index`, or ""."""
        problem = image_problem(frame, self._size)
        if self._before is not None and np.array_equal(frame, self._before):
            if self._watched and np.abs(self._shown[index] - self._last).max() > MOVED:
                problem = problem or "identical to the previous image, although something moved"
        else:
            self._before = frame
            self._last = self._shown[index]
        return problem


def image_problem(frame: NDArray[np.uint8 | np.float32], size: int) -> str:
    """Return what is wrong with a single image, or ""."""
    if frame.shape[:2] != (size, size):
        return f"it is {frame.shape[0]} × {frame.shape[1]}, not {size} × {size}"
    if frame.dtype == np.float32 and not (np.isfinite(frame).all() and frame.min() > 0.0):
        return "depth that is not finite and positive"
    highest = frame.max()
    if frame.min() == highest:
        return "black" if highest == 0 else "a single colour"
    return ""
