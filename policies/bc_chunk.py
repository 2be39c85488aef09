"""`bc-chunk`: behaviour cloning that answers with the next actions instead of only the present one.

    surgicai-vision train --policy bc-chunk --recipe unmoved --change chunk=8 …

The network is that of `bc` with one answer per planned control step, and so is the loss: the mean
squared error of the actions, which are learned as they are. It plans anew at every step. What the
further actions are for: a robot on which actions take effect late executes the one that is due by
then (`ChunkRecipe.measure_delay`).
"""

from dataclasses import dataclass
from typing import final

import torch
from torch import nn

from policies.base import ACTIONS, Plugin, Recipe
from policies.chunks import ChunkPolicy, ChunkRecipe, planned_offsets
from policies.layers import mlp
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError


@dataclass(frozen=True)
class BCChunkRecipe(ChunkRecipe):
    """Settings of `bc-chunk`; see `ChunkRecipe` and `Recipe`."""

    batch_norm: bool = True
    chunk: int = 8
    execute: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.history != 1 or self.settings:
            raise InputError(
                f"history is {self.history}, settings {self.settings}; bc-chunk sees one "
                "observation, and its network has no settings of its own."
            )


@final
class BCChunkPolicy(ChunkPolicy):
    """The MLP of behaviour cloning, with an answer for each planned step."""

    def __init__(self, recipe: BCChunkRecipe, visual: tuple[tuple[int, ...], ...]):
        super().__init__(recipe, visual, "none")
        width = self.heads.dim + self.inputs.width
        self.network = mlp(recipe, width, self.chunk * ACTIONS)

    def plan_normalised(self, visual: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        """Return actions (B, chunk, 7) in [-1, 1]; see `ChunkPolicy`."""
        answers: torch.Tensor = self.network(torch.cat([visual, vector], dim=2).flatten(1)).tanh()
        return answers.view(-1, self.chunk, ACTIONS)

    def chunk_loss(
        self,
        visual: torch.Tensor,
        vector: torch.Tensor,
        actions: torch.Tensor,
        is_pad: torch.Tensor,
    ) -> torch.Tensor:
        """Return the mean squared error of the actions that the demonstrations have."""
        answers = self.plan_normalised(visual, vector)
        return nn.functional.mse_loss(answers[~is_pad], actions[~is_pad])


def _make(recipe: Recipe, visual: tuple[tuple[int, ...], ...]) -> BCChunkPolicy:
    """Return an untrained policy."""
    assert isinstance(recipe, BCChunkRecipe)
    return BCChunkPolicy(recipe, visual)


BC_CHUNK = Plugin("bc-chunk", BCChunkRecipe, _make, names.ACTION_CHUNK, planned_offsets)
