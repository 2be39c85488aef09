"""`bc-chunk`: behaviour cloning that answers with the next actions instead of only the present one.

    surgicai-vision train --policy bc-chunk --recipe unmoved --change chunk=8 …
    surgicai-vision train --policy bc-chunk --recipe unmoved --change members=4 …

The network is that of `bc` with one answer per planned control step, and so is the loss: the mean
squared error of the actions, which are learned as they are. It plans anew at every step. What the
further actions are for: a robot on which actions take effect late executes the one that is due by
then (`ChunkRecipe.measure_delay`).

With `members` it is an ensemble (Lakshminarayanan et al., Simple and scalable predictive
uncertainty estimation using deep ensembles, NeurIPS 2017): so many networks see the same frames,
begin from other weights and learn side by side, each by its own errors, and the plan is the mean of
theirs.
"""

from dataclasses import dataclass, field
from typing import final

import torch
from torch import nn

from policies.base import ACTIONS, Plugin, Recipe
from policies.chunks import ChunkPolicy, ChunkRecipe, planned_offsets
from policies.layers import mlp
from surgicai_vision.core import names
from surgicai_vision.core.config import LATER
from surgicai_vision.core.errors import InputError, check_at_least, check_at_most

MOST_MEMBERS = 100
"""Maximum networks of an ensemble."""


@dataclass(frozen=True)
class BCChunkRecipe(ChunkRecipe):
    """Settings of `bc-chunk`; see `ChunkRecipe` and `Recipe`.

    Attributes:
        members: networks that are trained side by side; their mean is executed.
    """

    batch_norm: bool = True
    chunk: int = 8
    execute: int = 1
    members: int = field(default=1, metadata=LATER)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.history != 1 or self.settings:
            raise InputError(
                f"history is {self.history}, settings {self.settings}; bc-chunk sees one "
                "observation, and its network has no settings of its own."
            )
        check_at_least(1, members=self.members)
        check_at_most(MOST_MEMBERS, members=self.members)


@final
class BCChunkPolicy(ChunkPolicy):
    """The MLPs of behaviour cloning, with an answer for each planned step."""

    def __init__(self, recipe: BCChunkRecipe, visual: tuple[tuple[int, ...], ...]):
        super().__init__(recipe, visual, "none", recipe.members)
        self._seen_by_each = self.heads.dim // recipe.members
        width = self._seen_by_each + self.inputs.width
        self.network = mlp(recipe, width, self.chunk * ACTIONS)
        # The first member's layers have the names of a policy without others.
        self.others = nn.ModuleList(
            mlp(recipe, width, self.chunk * ACTIONS) for _ in range(1, recipe.members)
        )

    def plan_normalised(self, visual: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        """Return actions (B, chunk, 7) in [-1, 1]; see `ChunkPolicy`."""
        return self._answers(visual, vector).mean(0)

    def chunk_loss(
        self,
        visual: torch.Tensor,
        vector: torch.Tensor,
        actions: torch.Tensor,
        is_pad: torch.Tensor,
    ) -> torch.Tensor:
        """Return the mean squared error of the actions that the demonstrations have.

        In training it is the mean of the members' errors, otherwise the error of their mean.
        """
        answers = self._answers(visual, vector)
        if not self.training:
            answers = answers.mean(0, keepdim=True)
        demonstrated = actions[~is_pad].expand(len(answers), -1, -1)
        return nn.functional.mse_loss(answers[:, ~is_pad], demonstrated)

    def _answers(self, visual: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        """Return each member's actions, (members, B, chunk, 7) in [-1, 1]."""
        networks = [self.network, *self.others]
        fed = vector.flatten(1)
        seen = visual.flatten(1).unflatten(1, (len(networks), self._seen_by_each))
        rows = [
            network(torch.cat([seen[:, member], fed], dim=1)).tanh()
            for member, network in enumerate(networks)
        ]
        answers: torch.Tensor = torch.stack(rows).unflatten(2, (self.chunk, ACTIONS))
        return answers


def _make(recipe: Recipe, visual: tuple[tuple[int, ...], ...]) -> BCChunkPolicy:
    """Return an untrained policy."""
    assert isinstance(recipe, BCChunkRecipe)
    return BCChunkPolicy(recipe, visual)


BC_CHUNK = Plugin("bc-chunk", BCChunkRecipe, _make, names.ACTION_CHUNK, planned_offsets)
