"""Training data: the split into training and validation, batches, statistics of the inputs."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import clock

if TYPE_CHECKING:
    from policies.base import Recipe


def with_clock(
    columns: dict[str, NDArray[np.generic]], vector: str | None
) -> dict[str, NDArray[np.generic]]:
    """Return the columns, with `names.CLOCKED_STATE` (N, 10) where `vector` asks for it."""
    if vector != names.CLOCKED_STATE:
        return columns
    steps = np.rint(np.asarray(columns["timestamp"]) * names.FPS)
    return {
        **columns,
        vector: np.concatenate([columns[names.STATE], clock(steps)], axis=1, dtype=np.float32),
    }


def split(
    episode_index: NDArray[np.int64], recipe: "Recipe", seed: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], tuple[int, ...]]:
    """Split the frames into training and validation.

    Args:
        episode_index: (N,) episode of every frame.
        recipe: its `split` ("episode" or "transition") and `validation` (share held out) count.
        seed: of the draw.

    Returns:
        Training rows, validation rows (both sorted int64), and the episodes held out (whole ones
        only). At least one episode is held out when the share is above 0 and there are two or more.
    """
    generator = np.random.default_rng(seed)
    units = np.unique(episode_index) if recipe.split == "episode" else np.arange(len(episode_index))
    count = round(recipe.validation * len(units))
    if recipe.validation > 0 and len(units) > 1:
        count = min(max(count, 1), len(units) - 1)
    held = np.sort(generator.permutation(units)[:count])
    belongs = np.isin(episode_index, held) if recipe.split == "episode" else np.isin(units, held)
    episodes = tuple(int(index) for index in held) if recipe.split == "episode" else ()
    return np.flatnonzero(~belongs), np.flatnonzero(belongs), episodes


def cuts(count: int, size: int) -> list[int]:
    """Return where the batches of `count` rows begin; a last batch of one joins the one before."""
    starts = list(range(0, count, size))
    return starts[:-1] if len(starts) > 1 and count - starts[-1] == 1 else starts


def over_places(
    mean: torch.Tensor, std: torch.Tensor, visual: Sequence[tuple[int, ...]]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Give all places of a feature map their channel's statistics.

    A place that hardly changes is not amplified so.

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
