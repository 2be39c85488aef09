"""Training data: columns, the split into training and validation, batches, statistics of inputs."""

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import clock
from surgicai_vision.core.errors import check_name
from surgicai_vision.core.runs import first_of_group
from surgicai_vision.dataset.protocol import Dataset
from surgicai_vision.training.visits import stages

if TYPE_CHECKING:
    from policies.base import Recipe

Columns = Mapping[str, NDArray[np.generic]]


def column(dataset: Dataset, key: str) -> NDArray[np.generic]:
    """Return a training column: a recorded one, or one computed from them.

    Raises:
        UnknownName: the dataset has no such column.
        InputError: the column cannot be computed from this dataset's frames.
    """
    columns = dataset.columns()
    if key in COMPUTED:
        return COMPUTED[key](columns, np.asarray(dataset.episode_index))
    return columns[check_name("column", key, columns)]


def _clock(columns: Columns, episode_index: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return `names.CLOCK`, (N, 3) float32."""
    steps = np.rint(np.asarray(columns["timestamp"]) * names.FPS)
    return clock(steps).astype(np.float32)


COMPUTED: Mapping[str, Callable[[Columns, NDArray[np.int64]], NDArray[np.generic]]] = (
    MappingProxyType({names.CLOCK: _clock, names.STAGE: stages})
)
"""Computed column → function (columns, (N,) episode of every frame) → (N, n) values."""


def split(
    episode_index: NDArray[np.int64],
    recipe: "Recipe",
    seed: int,
    demonstration_index: NDArray[np.int64] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.int64], tuple[int, ...]]:
    """Split the frames into training and validation; variants of a frame stay together.

    Args:
        episode_index: (N,) episode of every frame.
        recipe: its `split` ("episode" or "transition") and `validation` (share held out) are used.
        seed: seed of the random draw.
        demonstration_index: (N,) demonstration of every frame, where several episodes show one;
            by default each episode is its own demonstration.

    Returns:
        Training rows, validation rows (both sorted int64), and the episodes held out (whole ones
        only). At least one episode is held out when the share is above 0 and there are two or more.
    """
    generator = np.random.default_rng(seed)
    shown = episode_index if demonstration_index is None else demonstration_index
    unit = shown if recipe.split == "episode" else _first_variants(episode_index, shown)
    units = np.unique(unit)
    count = round(recipe.validation * len(units))
    if recipe.validation > 0:
        count = min(max(count, 1), len(units) - 1)
    held = np.sort(generator.permutation(units)[:count])
    belongs = np.isin(unit, held)
    episodes = np.unique(episode_index[belongs]) if recipe.split == "episode" else ()
    return np.flatnonzero(~belongs), np.flatnonzero(belongs), tuple(map(int, episodes))


def _first_variants(
    episode_index: NDArray[np.int64], demonstration_index: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the row of every frame's counterpart in its demonstration's first variant, (N,)."""
    position = np.arange(len(episode_index)) - first_of_group(episode_index)
    return first_of_group(demonstration_index) + position


def cuts(count: int, size: int) -> list[int]:
    """Return the batches' first rows for `count` rows; a single last row joins the batch before."""
    starts = list(range(0, count, size))
    return starts[:-1] if len(starts) > 1 and count - starts[-1] == 1 else starts


def over_places(
    mean: torch.Tensor, std: torch.Tensor, visual: Sequence[tuple[int, ...]]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Give all places of a feature map their channel's statistics.

    This keeps a place that hardly changes from being amplified.

    Args:
        mean: (inputs,) means of the inputs, the views' rows first.
        std: (inputs,) their standard deviations.
        visual: shape of each view's feature; only maps (C, h, w) are changed.
    """
    mean = mean.clone()
    std = std.clone()
    at = 0
    for shape in visual:
        size = math.prod(shape)
        if len(shape) == 3:
            mean_map = mean[at : at + size].view(shape)
            std_map = std[at : at + size].view(shape)
            channel = mean_map.mean((1, 2), keepdim=True)
            squares = (std_map**2 + mean_map**2).mean((1, 2), keepdim=True)
            std_map.copy_((squares - channel**2).clamp(min=0).sqrt().expand(shape))
            mean_map.copy_(channel.expand(shape))
        at += size
    return mean, std
