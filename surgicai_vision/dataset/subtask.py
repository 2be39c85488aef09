"""One subtask's frames of a dataset of whole procedures, as a dataset of that subtask.

    part = subtask_of(open_dataset(Path("outputs/datasets/suture")), "insert")

A low-level policy of a chain is better trained on these than on demonstrations of the subtask alone, which end at the
first success: in a whole procedure the subtask goes on until it is finished (`envs.suture.DWELL`), and it begins where
the one before it left off.
"""

import functools
from dataclasses import replace
from typing import Any, final

import numpy as np

from surgicai_vision import names
from surgicai_vision.config import TaskConfig, digest
from surgicai_vision.dataset.reading import Dataset
from surgicai_vision.errors import InputError, check_name


def subtask_of(dataset: Dataset, subtask: str) -> "SubtaskPart":
    """Return a subtask's frames.

    Raises:
        UnknownName: no subtask of that name.
        InputError: a dataset of a single subtask, or one in which this one does not occur.
    """
    check_name("subtask", subtask, names.SUBTASKS)
    if dataset.task != names.SUTURE:
        raise InputError(f"The dataset shows '{dataset.task}'; a subtask's frames are taken from '{names.SUTURE}'.")
    part = SubtaskPart(dataset, subtask)
    if not part.length:
        raise InputError(f"The dataset holds no frame of '{subtask}'.")
    return part


@final
class SubtaskPart:
    """A subtask's frames, as training and encoding read them.

    Attributes:
        config: the whole's, with the subtask as its task and the subtask's step limit.
        task, views, image_size: as a dataset's.
        length: number of frames.
    """

    def __init__(self, dataset: Dataset, subtask: str):
        self._whole, self.task = dataset, subtask
        self._rows = np.flatnonzero(dataset.columns()[names.PHASE] == names.SUBTASKS.index(subtask))
        limit = TaskConfig(subtask).max_steps
        self.config: TaskConfig = replace(dataset.config, task=subtask, max_steps=limit)
        self.views, self.image_size, self.length = dataset.views, dataset.image_size, len(self._rows)

    @property
    def rows(self) -> np.ndarray:
        """Which frames of the whole it holds, (N,) int64."""
        return self._rows

    @functools.cached_property
    def fingerprint(self) -> str:
        """sha256 (hex) over the whole's fingerprint and the subtask."""
        return digest({"dataset": self._whole.fingerprint, "subtask": self.task})

    @property
    def episode_index(self) -> np.ndarray:
        """Episode of every frame, (N,) int64."""
        return self._whole.episode_index[self._rows]

    def columns(self) -> dict[str, np.ndarray]:
        """Return every column that is no picture, as `Dataset.columns`; index and time count from its beginning."""
        columns = {key: values[self._rows] for key, values in self._whole.columns().items()}
        first = np.searchsorted(self.episode_index, self.episode_index, side="left")
        return columns | {key: columns[key] - columns[key][first] for key in ("frame_index", "timestamp")}

    def frames(self, view: str, start: int = 0, stop: int | None = None) -> Any:
        """Return the RGB pictures of a view, (stop - start, H, W, 3) uint8."""
        stop = self.length if stop is None else stop
        if not 0 <= start <= stop <= self.length:
            raise InputError(f"frames {start} to {stop} were asked; '{self.task}' has 0 to {self.length}.")
        rows = self._rows[start:stop]
        runs = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)  # one an episode: read in order, which is fast
        parts = [self._whole.frames(view, int(run[0]), int(run[-1]) + 1) for run in runs if len(run)]
        return np.concatenate(parts) if parts else self._whole.frames(view, 0, 0)
