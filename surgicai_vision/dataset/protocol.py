"""What every dataset offers to encoding, probing, training and evaluation.

`reader.RenderedDataset` and `subset.DatasetSubset` implement this protocol; functions that read a
dataset name it in their signatures.
"""

from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.runs import runs_of


class Dataset(Protocol):
    """Frames of episodes of one task, numbered 0 … `length` - 1 over all episodes."""

    @property
    def path(self) -> Path:
        """Folder of the rendered dataset; for a subset, that of the whole."""

    @property
    def task(self) -> str:
        """Name of the task, one of `core.tasks.task_names()`."""

    @property
    def config(self) -> TaskConfig:
        """Configuration of the task."""

    @property
    def views(self) -> tuple[str, ...]:
        """Cameras, in the order of the dataset's columns."""

    @property
    def policy_views(self) -> tuple[str, ...]:
        """What `frames` shows: the views, and their depth views if depth was rendered."""

    @property
    def image_size(self) -> int:
        """Side of the square images [px]."""

    @property
    def fps(self) -> int:
        """Frames per second of simulated time."""

    @property
    def length(self) -> int:
        """Number of frames N."""

    @property
    def fingerprint(self) -> str:
        """Hash (hex) of everything the frames and columns depend on."""

    @property
    def episode_index(self) -> NDArray[np.int64]:
        """Episode of every frame, (N,) int64, ascending."""

    @property
    def demonstration_index(self) -> NDArray[np.int64]:
        """Demonstration of every frame, (N,) int64, ascending; several episodes may show one."""

    def bounds(self) -> list[tuple[int, int]]:
        """Return (first frame, frame after the last) of every episode."""

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """Return every column that is not an image, (N,) or (N, n), by its key."""

    def frames(self, view: str, start: int = 0, stop: int | None = None) -> NDArray[np.uint8]:
        """Return the images of one of the `policy_views`, (stop - start, H, W, 3) uint8 RGB."""


def episode_bounds(episode_index: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return (first frame, frame after the last) of every episode in `episode_index`, (N,)."""
    return runs_of(episode_index)
