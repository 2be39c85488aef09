"""Part of a dataset: its first episodes, so that the smaller of two parts lies within the larger.

part = first_episodes(open_dataset(Path("dataset")), 10)
part.length, part.columns(), part.fingerprint
"""

import functools
from typing import Any, final

import numpy as np

from surgicai_vision.core.config import TaskConfig, digest
from surgicai_vision.core.errors import InputError
from surgicai_vision.dataset.reader import Dataset


def first_episodes(dataset: Dataset, count: int) -> "DatasetPart":
    """Return the first `count` episodes of a dataset.

    Raises:
        InputError: fewer than one, or more than there are.
    """
    held = len(dataset.bounds())
    if not 1 <= count <= held:
        raise InputError(f"{count} demonstrations were asked; {dataset.path} holds {held}.")
    return DatasetPart(dataset, count)


@final
class DatasetPart:
    """The first episodes of a dataset, as training and encoding read it.

    Attributes:
        config, task, views, image_size: as the whole dataset's.
        episodes: number of episodes.
        length: number of frames.
    """

    def __init__(self, dataset: Dataset, episodes: int):
        self._whole, self.episodes = dataset, episodes
        self.config: TaskConfig = dataset.config
        self.task, self.views, self.image_size = dataset.task, dataset.views, dataset.image_size
        self.length = dataset.bounds()[episodes - 1][1]

    @property
    def rows(self) -> slice:
        """Which frames of the whole it holds."""
        return slice(0, self.length)

    @functools.cached_property
    def fingerprint(self) -> str:
        """sha256 (hex) over the whole's fingerprint and what is left of it."""
        return digest({"dataset": self._whole.fingerprint, "episodes": self.episodes})

    @property
    def episode_index(self) -> np.ndarray:
        """Episode of every frame, (N,) int64."""
        return self._whole.episode_index[: self.length]

    def columns(self) -> dict[str, np.ndarray]:
        """Return every column that is no image, as `Dataset.columns`."""
        return {key: values[: self.length] for key, values in self._whole.columns().items()}

    def frames(self, view: str, start: int = 0, stop: int | None = None) -> Any:
        """Return the RGB images of a view, (stop - start, H, W, 3) uint8."""
        stop = self.length if stop is None else stop
        if stop > self.length:
            raise InputError(
                f"frames {start} to {stop} were asked; this part has 0 to {self.length}."
            )
        return self._whole.frames(view, start, stop)
