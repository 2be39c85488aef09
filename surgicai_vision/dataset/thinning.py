"""Thinning: every so-manieth frame of each episode, as a dataset of its own.

    part = thinned(open_dataset(Path("dataset")), 4)

Neighbouring frames of 50 a second say nearly the same, while every episode brings a needle that lies elsewhere: for
the same time of encoding and training, few frames of many episodes teach more than all frames of few
(docs/results/best.md). Columns keep their values: `frame_index` still counts the whole's frames.
"""

import functools
from typing import Any, final

import numpy as np

from surgicai_vision import names
from surgicai_vision.config import TaskConfig, digest
from surgicai_vision.errors import InputError


def thinned(dataset: Any, every: int) -> Any:
    """Return the frames of the control steps 0, `every`, 2 · `every` … of each episode.

    Args:
        dataset: an opened dataset, or a part of one; itself where it holds no others.
        every: control steps from frame to frame, at least 1.

    Raises:
        InputError: the dataset was rendered with fewer frames.
    """
    if every < 1:
        raise InputError(f"every is {every}; it must be at least 1.")
    held = names.FPS // getattr(dataset, "fps", names.FPS)
    if every % held:
        raise InputError(
            f"The recipe takes a frame every {every} steps; the dataset holds one every {held} ('render-demos --every "
            f"{held}'). Give a recipe with every: {held}, or render all frames."
        )
    return dataset if every == held else ThinnedPart(dataset, every // held)


@final
class ThinnedPart:
    """Some frames of each episode, as training and encoding read them.

    Attributes:
        config, task, views, image_size, path: as the whole's.
        length: number of frames.
    """

    def __init__(self, dataset: Any, every: int):
        self._whole, self._every = dataset, every
        index = np.asarray(dataset.episode_index)
        first = np.searchsorted(index, index, side="left")
        self._rows = np.flatnonzero((np.arange(len(index)) - first) % every == 0)
        self.config: TaskConfig = dataset.config
        self.task, self.views, self.image_size = dataset.task, dataset.views, dataset.image_size
        self.path = getattr(dataset, "path", None)
        self.length = len(self._rows)

    @property
    def rows(self) -> np.ndarray:
        """Which frames of the whole it holds, (N,) int64."""
        return self._rows

    @functools.cached_property
    def fingerprint(self) -> str:
        """sha256 (hex) over the whole's fingerprint and `every`."""
        return digest({"dataset": self._whole.fingerprint, "every": self._every})

    @property
    def episode_index(self) -> np.ndarray:
        """Episode of every frame, (N,) int64."""
        return np.asarray(self._whole.episode_index)[self._rows]

    def bounds(self) -> list[tuple[int, int]]:
        """Return (first frame, frame after the last) of every episode."""
        starts = np.unique(self.episode_index, return_index=True)[1].tolist()
        return list(zip(starts, [*starts[1:], self.length], strict=True))

    def columns(self) -> dict[str, np.ndarray]:
        """Return every column that is no picture, as `Dataset.columns`."""
        return {key: values[self._rows] for key, values in self._whole.columns().items()}

    def frames(self, view: str, start: int = 0, stop: int | None = None) -> Any:
        """Return the RGB pictures of a view, (stop - start, H, W, 3) uint8."""
        stop = self.length if stop is None else stop
        if not 0 <= start <= stop <= self.length:
            raise InputError(f"frames {start} to {stop} were asked; every {self._every}th are 0 to {self.length}.")
        rows = self._rows[start:stop].tolist()
        if not rows:
            return self._whole.frames(view, 0, 0)
        return np.concatenate([self._whole.frames(view, row, row + 1) for row in rows])
