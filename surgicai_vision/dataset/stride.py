"""Thinning: every so-manieth frame of each episode, as a dataset of its own.

    part = thinned(open_dataset(Path("dataset")), 4)

Neighbouring frames of 50 a second say nearly the same, while every episode brings a needle that
lies elsewhere: for the same time of encoding and training, few frames of many episodes teach more
than all frames of few (docs/results/best.md). Columns keep their values: `frame_index` still counts
the whole's frames.
"""

from typing import Any, final

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.dataset.subset import ChosenFrames


def thinned(dataset: Any, frame_stride: int) -> Any:
    """Return the frames of the control steps 0, `frame_stride`, 2 · `frame_stride` … of each
    episode.

    Args:
        dataset: an opened dataset, or a part of one; itself where it holds no others.
        frame_stride: control steps from frame to frame, at least 1.

    Raises:
        InputError: the dataset was rendered with fewer frames.
    """
    if frame_stride < 1:
        raise InputError(f"frame_stride is {frame_stride}; it must be at least 1.")
    held = names.FPS // getattr(dataset, "fps", names.FPS)
    if frame_stride % held:
        raise InputError(
            f"The recipe takes a frame every {frame_stride} steps; the dataset holds one every {held} ('render-demos --frame-stride "
            f"{held}'). Give a recipe with frame_stride: {held}, or render all frames."
        )
    return dataset if frame_stride == held else ThinnedPart(dataset, frame_stride // held)


@final
class ThinnedPart(ChosenFrames):
    """Some frames of each episode; `path` is the whole's."""

    def __init__(self, dataset: Any, frame_stride: int):
        index = np.asarray(dataset.episode_index)
        first = np.searchsorted(index, index, side="left")
        super().__init__(
            dataset,
            np.flatnonzero((np.arange(len(index)) - first) % frame_stride == 0),
            {"frame_stride": frame_stride},
        )
        self.path = getattr(dataset, "path", None)
        self.fps //= frame_stride

    def bounds(self) -> list[tuple[int, int]]:
        """Return (first frame, frame after the last) of every episode."""
        starts = np.unique(self.episode_index, return_index=True)[1].tolist()
        return list(zip(starts, [*starts[1:], self.length], strict=True))
