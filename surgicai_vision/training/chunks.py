"""Chunks: the actions around each frame, as a column of a dataset.

    timeline = timeline_of(whole)               # every control step's action
    dataset = with_chunks(with_frame_stride(whole, 5), timeline, range(0, 25))
    dataset.columns()[names.ACTION_CHUNK]       # (N, 25, 8) float32

The last of the eight values is 1 where the demonstration has no such step; the action of its
nearest step is repeated there, as in LeRobot's `action_is_pad`. A chunk ends with its episode and,
in a whole procedure, with its subtask, after which another arm acts.

Frames may be sparse, but actions are those of every control step. A dataset rendered with
`--frame-stride` holds only its frames' actions. The rest is read from its demonstrations, which
are identified by their hash.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.dataset.protocol import Dataset
from surgicai_vision.dataset.reader import RenderedDataset
from surgicai_vision.dataset.subset import DatasetSubset, rows_in_whole, whole_of
from surgicai_vision.demos.store import demos_digest, list_demos, read_demo

BESIDE = "demos"
"""Folder next to a sweep's dataset that holds its demonstrations."""


@dataclass(frozen=True)
class Timeline:
    """The actions of every control step of a dataset's demonstrations.

    Attributes:
        action: (M, 7) float32.
        first: (M,) first step of each step's run (one subtask of one demonstration).
        last: (M,) last step of that run.
        step: (L,) the step of each frame of the dataset as it was rendered.
    """

    action: NDArray[np.float32]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    step: NDArray[np.int64]


def timeline_of(dataset: Dataset, demos: Sequence[Path] = ()) -> Timeline:
    """Return the timeline of a dataset, or of the whole dataset that it was selected from.

    Args:
        dataset: any dataset.
        demos: the folders of its demonstrations, in the order in which they were rendered, for one
            that was rendered with fewer frames; by default the folder next to it, as in a sweep.

    Raises:
        InputError: frames were left out, and the demonstrations are missing or different ones.
    """
    root = whole_of(dataset)
    if root.fps == root.config.steps_per_second:
        columns = root.columns()
        phase = columns.get(names.PHASE)
        index = np.asarray(root.episode_index)
        runs = _runs(index, np.zeros(len(index)) if phase is None else np.asarray(phase))
        action = np.asarray(columns[names.ACTION], np.float32)
        return Timeline(action, *runs, np.arange(root.length))
    return _from_demos(root, demos or [root.path.parent / BESIDE])


def _from_demos(dataset: Dataset, folders: Sequence[Path]) -> Timeline:
    """Return the timeline of a dataset whose demonstrations lie in `folders`."""
    need = (
        f"{dataset.path} holds {dataset.fps} frames per second, and a policy that plans chunks "
        f"learns from the action of every step, {dataset.config.steps_per_second} per second"
    )
    try:
        paths = [path for folder in folders for path in list_demos(folder)]
    except (BadFile, InputError) as error:
        raise InputError(f"{need}; name its demonstrations with --demos DIR ({error})") from None
    if not isinstance(dataset, RenderedDataset) or (
        demos_digest(paths) != dataset.meta["demos_digest"]
    ):
        given = ", ".join(map(str, folders))
        raise InputError(
            f"{need}; {given}: other demonstrations than the dataset's. Give all of its own with "
            "--demos DIR[,DIR], in the order in which they were rendered."
        )
    shown = [read_demo(path) for path in paths]
    lengths = np.array([len(demo) for demo in shown])
    begins = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    runs = _runs(
        np.repeat(np.arange(len(shown)), lengths), np.concatenate([demo.phase for demo in shown])
    )
    seconds = np.asarray(dataset.columns()["timestamp"], np.float64)
    control_steps = np.rint(seconds * names.FPS).astype(np.int64)
    within = control_steps // dataset.config.action_repeat
    step = begins[np.asarray(dataset.demonstration_index)] + within
    return Timeline(np.concatenate([demo.action for demo in shown]), *runs, step)


def with_chunks(dataset: Dataset, timeline: Timeline, offsets: Sequence[int]) -> DatasetSubset:
    """Return a dataset with the column `names.ACTION_CHUNK`, (N, T, 8) float32.

    Args:
        dataset: any frames of the dataset that `timeline` belongs to.
        timeline: from `timeline_of`.
        offsets: (T,) offsets of a chunk's actions, in control steps from the present one.
    """
    present = timeline.step[rows_in_whole(dataset)]
    wanted = present[:, None] + np.asarray(offsets, np.int64)
    held = np.clip(wanted, timeline.first[present, None], timeline.last[present, None])
    is_pad = (wanted != held).astype(np.float32)
    chunks = np.concatenate([timeline.action[held], is_pad[..., None]], axis=2)
    return DatasetSubset(
        dataset,
        np.arange(dataset.length),
        {"chunks": " ".join(map(str, offsets))},
        added={names.ACTION_CHUNK: chunks},
    )


def _runs(
    episode: NDArray[np.generic], phase: NDArray[np.generic]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first and the last step of each step's run, (M,) each.

    Args:
        episode: (M,) episode of each step.
        phase: (M,) its subtask.
    """
    breaks = (np.diff(episode) != 0) | (np.diff(phase) != 0)
    starts = np.concatenate([[0], np.flatnonzero(breaks) + 1])
    ends = np.concatenate([starts[1:] - 1, [len(episode) - 1]])
    run = np.cumsum(np.concatenate([[0], breaks]))
    return starts[run].astype(np.int64), ends[run].astype(np.int64)


def earlier_rows(dataset: Dataset, moments: int, spacing: int) -> NDArray[np.int64]:
    """Return the rows of the frames that a policy with a history sees, (N, moments) int64.

    The present frame is the last; at the start of a run the first frame is repeated.

    Args:
        dataset: its frames are evenly spaced within a run.
        moments: number of observations that the policy sees.
        spacing: control steps from one frame of a run to the next.
    """
    index = np.asarray(dataset.episode_index)
    times = np.rint(np.asarray(dataset.columns()["timestamp"], np.float64) * names.FPS)
    breaks = (np.diff(index) != 0) | (np.diff(times) != spacing)
    starts = np.concatenate([[0], np.flatnonzero(breaks) + 1])
    first = starts[np.cumsum(np.concatenate([[0], breaks]))]
    wanted = np.arange(len(index))[:, None] - np.arange(moments)[::-1]
    rows: NDArray[np.int64] = np.maximum(wanted, first[:, None]).astype(np.int64)
    return rows
