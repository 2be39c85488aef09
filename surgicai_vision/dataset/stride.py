"""Thinning: every so-manieth frame of each episode, as a dataset of its own.

    part = thinned(open_dataset(Path("dataset")), 4)

Neighbouring frames of 50 a second say nearly the same, while every episode brings a needle that lies elsewhere: for
the same time of encoding and training, few frames of many episodes teach more than all frames of few
(docs/results/best.md). Columns keep their values: `frame_index` still counts the whole's frames.
"""

from typing import Any, final

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.dataset.subset import ChosenFrames


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
class ThinnedPart(ChosenFrames):
    """Some frames of each episode; `path` is the whole's."""

    def __init__(self, dataset: Any, every: int):
        index = np.asarray(dataset.episode_index)
        first = np.searchsorted(index, index, side="left")
        super().__init__(dataset, np.flatnonzero((np.arange(len(index)) - first) % every == 0), {"every": every})
        self.path = getattr(dataset, "path", None)
        self.fps //= every

    def bounds(self) -> list[tuple[int, int]]:
        """Return (first frame, frame after the last) of every episode."""
        starts = np.unique(self.episode_index, return_index=True)[1].tolist()
        return list(zip(starts, [*starts[1:], self.length], strict=True))
