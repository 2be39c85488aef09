"""Choosing: some frames of a dataset, as training and encoding read them; what `thinning` and
`subtask` share.
"""

import functools
from typing import Any

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, digest
from surgicai_vision.core.errors import InputError


class ChosenFrames:
    """Some frames of a dataset.

    Attributes:
        config, task, views, image_size: as the whole's.
        fps: frames a second, as the whole's.
        rows: which frames of the whole it holds, (N,) int64, rising.
        length: N.
    """

    def __init__(self, whole: Any, rows: np.ndarray, chosen: dict[str, Any]):
        """Choose `rows` of `whole`; `chosen` says in plain data which they are."""
        self._whole, self._chosen, self.rows = whole, chosen, rows
        self.config: TaskConfig = whole.config
        self.task: str = whole.task
        self.fps: int = getattr(whole, "fps", names.FPS)
        self.views, self.image_size, self.length = whole.views, whole.image_size, len(rows)

    @functools.cached_property
    def fingerprint(self) -> str:
        """sha256 (hex) over the whole's fingerprint and which frames were chosen."""
        return digest({"dataset": self._whole.fingerprint, **self._chosen})

    @property
    def episode_index(self) -> np.ndarray:
        """Episode of every frame, (N,) int64."""
        return np.asarray(self._whole.episode_index)[self.rows]

    def columns(self) -> dict[str, np.ndarray]:
        """Return every column that is no image, as `Dataset.columns`."""
        return {key: values[self.rows] for key, values in self._whole.columns().items()}

    def frames(self, view: str, start: int = 0, stop: int | None = None) -> Any:
        """Return the RGB images of a view, (stop - start, H, W, 3) uint8."""
        stop = self.length if stop is None else stop
        if not 0 <= start <= stop <= self.length:
            said = ", ".join(f"{key} {value}" for key, value in self._chosen.items())
            raise InputError(
                f"frames {start} to {stop} were asked; this part ({said}) has 0 to {self.length}."
            )
        rows = self.rows[start:stop]
        runs = np.split(
            rows, np.flatnonzero(np.diff(rows) != 1) + 1
        )  # what lies together is read at once, in order
        parts = [
            self._whole.frames(view, int(run[0]), int(run[-1]) + 1) for run in runs if len(run)
        ]
        return np.concatenate(parts) if parts else self._whole.frames(view, 0, 0)
