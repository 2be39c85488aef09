"""Subsets of a dataset: its first episodes, every n-th frame, or the frames of one subtask.

    subset = first_episodes(open_dataset(Path("outputs/datasets/grasp")), 10)
    subset = with_frame_stride(subset, 4)
    subset = of_subtask(open_dataset(Path("outputs/datasets/suture")), "insert")
    features = features.part(subset.rows, subset.fingerprint)       # of the whole's features

A smaller set of first episodes is contained in a larger one, so a learning curve adds episodes.

A frame stride pays off because neighbouring frames at 50 per second carry nearly the same
information, while every episode has the needle in another place. For the same encoding and training
time, few frames of many episodes teach more than all frames of few (docs/results/scene-0.1.md).

A low-level policy is better trained on a subtask's frames of whole procedures than on
demonstrations of the subtask alone, which end at the first success. In a whole procedure the
subtask continues until it is finished (`config.DWELL`), and begins where the previous one ended.
"""

import functools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, digest
from surgicai_vision.core.errors import InputError, check_at_least, check_name
from surgicai_vision.core.runs import first_of_group
from surgicai_vision.dataset.protocol import Dataset, episode_bounds


def first_episodes(dataset: Dataset, count: int) -> "DatasetSubset":
    """Return the episodes of the first `count` demonstrations of a dataset.

    Raises:
        InputError: fewer than one, or more than there are.
    """
    bounds = episode_bounds(dataset.demonstration_index)
    if not 1 <= count <= len(bounds):
        raise InputError(
            f"{count} demonstrations were requested; {dataset.path} holds {len(bounds)}."
        )
    return DatasetSubset(dataset, np.arange(bounds[count - 1][1]), {"episodes": count})


def with_frame_stride(dataset: Dataset, frame_stride: int) -> Dataset:
    """Return each episode's frames at the control steps 0, `frame_stride`, 2 · `frame_stride`, ….

    Columns keep their values: `frame_index` still counts the frames of the whole.

    Args:
        dataset: any dataset; returned unchanged if it already has this stride.
        frame_stride: control steps from frame to frame, at least 1.

    Raises:
        InputError: `frame_stride` is not a multiple of the stride the dataset was rendered with.
    """
    check_at_least(1, frame_stride=frame_stride)
    held = _held(dataset)
    if frame_stride % held:
        raise InputError(
            f"The recipe uses a frame every {frame_stride} steps; the dataset holds one every "
            f"{held} ('render-demos --frame-stride {held}'). Give a recipe with frame_stride: "
            f"{held}, or render all frames."
        )
    stride = frame_stride // held
    if stride == 1:
        return dataset
    position = np.arange(dataset.length) - first_of_group(dataset.episode_index)
    rows = np.flatnonzero(position % stride == 0)
    fps = max(dataset.fps // stride, 1)
    return DatasetSubset(dataset, rows, {"frame_stride": stride}, fps=fps)


def _held(dataset: Dataset) -> int:
    """Return the control steps from frame to frame; a subset's `fps` is rounded."""
    if isinstance(dataset, DatasetSubset):
        return _held(dataset.whole) * dataset.stride
    return names.FPS // dataset.fps


def of_subtask(dataset: Dataset, subtask: str) -> "DatasetSubset":
    """Return a subtask's frames of a dataset of whole procedures, as a dataset of that subtask.

    The task of its configuration is the subtask, with the subtask's step limit. `frame_index` and
    `timestamp` count from the beginning of each visit, a run of frames of one phase in one episode
    of the whole dataset, also if `dataset` has only some of its frames. A procedure that returns to
    a subtask (`demos.recovery_expert`) visits it more than once, and the policy then restarts its
    clock.

    Raises:
        UnknownName: no subtask of that name.
        InputError: a dataset of a single subtask, or one in which this subtask does not occur.
    """
    check_name("subtask", subtask, names.SUBTASKS)
    if dataset.task != names.SUTURE:
        raise InputError(
            f"The dataset shows '{dataset.task}'; a subtask's frames are taken from "
            f"'{names.SUTURE}'."
        )
    phase = dataset.columns()[names.PHASE]
    rows = np.flatnonzero(phase == names.SUBTASKS.index(subtask))
    if not len(rows):
        raise InputError(f"The dataset holds no frame of '{subtask}'.")
    limit = TaskConfig(subtask).max_steps
    config = replace(dataset.config, task=subtask, max_steps=limit)
    since = _since_visit(dataset, rows)
    return DatasetSubset(dataset, rows, {"subtask": subtask}, config=config, added=since)


def _since_visit(dataset: Dataset, rows: NDArray[np.int64]) -> dict[str, NDArray[np.generic]]:
    """Return `frame_index` and `timestamp` of some rows, counted from their visit's beginning."""
    whole = whole_of(dataset)
    places = rows_in_whole(dataset)[rows]
    columns = whole.columns()
    first = first_of_visit(np.asarray(columns[names.PHASE]), np.asarray(whole.episode_index))
    return {
        key: np.subtract(columns[key][places], columns[key][first[places]])
        for key in ("frame_index", "timestamp")
    }


def whole_of(dataset: Dataset) -> Dataset:
    """Return the dataset that a subset was selected from, or a whole dataset itself."""
    while isinstance(dataset, DatasetSubset):
        dataset = dataset.whole
    return dataset


def rows_in_whole(dataset: Dataset) -> NDArray[np.int64]:
    """Return the rows of a dataset's frames in the dataset of `whole_of`, (N,)."""
    rows = np.arange(dataset.length)
    while isinstance(dataset, DatasetSubset):
        rows = dataset.rows[rows]
        dataset = dataset.whole
    return rows


def first_of_visit(
    phase: NDArray[np.generic], episode_index: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return for every frame the position of the first frame of its visit, (N,) int64.

    Args:
        phase: (N,) phase of every frame.
        episode_index: (N,) their episodes. A visit is a run of frames of one phase and episode.
    """
    begins = np.ones(len(phase), dtype=bool)
    begins[1:] = (phase[1:] != phase[:-1]) | (np.diff(episode_index) != 0)
    first: NDArray[np.int64] = np.flatnonzero(begins)[np.cumsum(begins) - 1]
    return first


@final
class DatasetSubset:
    """Some frames of a dataset; itself a `Dataset`.

    Attributes:
        whole: the dataset it is selected from.
        rows: which frames of the whole it holds, (N,) int64, ascending.
        path, views, policy_views, image_size: those of the whole.
        config: configuration of the task.
        task: name of the task.
        fps: frames per second of simulated time, rounded down, at least 1.
        length: N.
        stride: every how many frames of the whole it holds one.
    """

    def __init__(
        self,
        whole: Dataset,
        rows: NDArray[np.int64],
        selection: Mapping[str, str | int],
        *,
        config: TaskConfig | None = None,
        fps: int | None = None,
        added: Mapping[str, NDArray[np.generic]] | None = None,
    ):
        """Select `rows` of `whole`.

        Args:
            whole: the dataset to select from.
            rows: (N,) int64, ascending.
            selection: describes the selected frames as plain data; part of the fingerprint.
            config: configuration of the task; the whole's by default.
            fps: frames per second; the whole's by default.
            added: columns that the whole does not have, or has with other values, (N,) or (N, n);
                `selection` must describe them.
        """
        self.whole = whole
        self._selection = dict(selection)
        self._added = dict(added or {})
        self.rows = rows
        self.path: Path = whole.path
        self.config = config or whole.config
        self.task = self.config.task if config else whole.task
        self.views = whole.views
        self.policy_views = whole.policy_views
        self.image_size = whole.image_size
        self.fps = fps or whole.fps
        self.length = len(rows)
        self.stride = int(self._selection.get("frame_stride", 1))

    @functools.cached_property
    def fingerprint(self) -> str:
        """Hash (hex) of the whole's fingerprint and the selection."""
        return digest({"dataset": self.whole.fingerprint, **self._selection})

    @functools.cached_property
    def episode_index(self) -> NDArray[np.int64]:
        """Episode of every frame, (N,) int64."""
        return np.asarray(self.whole.episode_index)[self.rows]

    @functools.cached_property
    def demonstration_index(self) -> NDArray[np.int64]:
        """Demonstration of every frame, (N,) int64."""
        return np.asarray(self.whole.demonstration_index)[self.rows]

    def bounds(self) -> list[tuple[int, int]]:
        """Return (first frame, frame after the last) of every episode."""
        return episode_bounds(self.episode_index)

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """Return every column that is not an image, (N,) or (N, n), by its key."""
        columns = {key: values[self.rows] for key, values in self.whole.columns().items()}
        return columns | self._added

    def frames(self, view: str, start: int = 0, stop: int | None = None) -> NDArray[np.uint8]:
        """Return the images of one of the `policy_views`, (stop - start, H, W, 3) uint8 RGB."""
        stop = self.length if stop is None else stop
        if not 0 <= start <= stop <= self.length:
            selection = ", ".join(f"{key} {value}" for key, value in self._selection.items())
            raise InputError(
                f"frames {start} to {stop} were requested; this subset ({selection}) has 0 to "
                f"{self.length}."
            )
        rows = self.rows[start:stop]
        # Neighbouring frames are read together, in order.
        runs = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
        parts = [self.whole.frames(view, int(run[0]), int(run[-1]) + 1) for run in runs if len(run)]
        return np.concatenate(parts) if parts else self.whole.frames(view, 0, 0)
