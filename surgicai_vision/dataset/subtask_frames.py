"""One subtask's frames of a dataset of whole procedures, as a dataset of that subtask.

    part = subtask_of(open_dataset(Path("outputs/datasets/suture")), "insert")

A low-level policy of a chain is better trained on these than on demonstrations of the subtask
alone, which end at the first success: in a whole procedure the subtask goes on until it is finished
(`config.DWELL`), and it begins where the one before it left off.
"""

from dataclasses import replace
from typing import final

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.dataset.reader import Dataset
from surgicai_vision.dataset.subset import ChosenFrames


def subtask_of(dataset: Dataset, subtask: str) -> "SubtaskPart":
    """Return a subtask's frames.

    Raises:
        UnknownName: no subtask of that name.
        InputError: a dataset of a single subtask, or one in which this one does not occur.
    """
    check_name("subtask", subtask, names.SUBTASKS)
    if dataset.task != names.SUTURE:
        raise InputError(
            f"The dataset shows '{dataset.task}'; a subtask's frames are taken from '{names.SUTURE}'."
        )
    part = SubtaskPart(dataset, subtask)
    if not part.length:
        raise InputError(f"The dataset holds no frame of '{subtask}'.")
    return part


@final
class SubtaskPart(ChosenFrames):
    """A subtask's frames; its config is the whole's, with the subtask as its task and the subtask's
    step limit.
    """

    def __init__(self, dataset: Dataset, subtask: str):
        rows = np.flatnonzero(dataset.columns()[names.PHASE] == names.SUBTASKS.index(subtask))
        super().__init__(dataset, rows, {"subtask": subtask})
        self.task, limit = subtask, TaskConfig(subtask).max_steps
        self.config = replace(dataset.config, task=subtask, max_steps=limit)

    def columns(self) -> dict[str, np.ndarray]:
        """Return every column that is no image, as `Dataset.columns`; index and time count from its
        beginning.
        """
        columns = super().columns()
        first = np.searchsorted(self.episode_index, self.episode_index, side="left")
        return columns | {
            key: columns[key] - columns[key][first] for key in ("frame_index", "timestamp")
        }
