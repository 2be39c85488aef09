"""`linear`: actions are a linear function of features and proprioception."""

from typing import final

import torch
from torch import nn

from policies.base import ACTIONS, Inputs, Plugin, Policy, Recipe
from surgicai_vision.core import names


@final
class LinearPolicy(Policy):
    """One linear layer without an activation."""

    def __init__(self, recipe: Recipe, visual: tuple[tuple[int, ...], ...]):
        super().__init__(Inputs(visual, (names.STATE,) if recipe.proprioception else ()))
        self.layer = nn.Linear(self.inputs.dim, ACTIONS)

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return actions (B, 7) in [-1, 1] for normalised inputs (B, inputs.dim)."""
        return self.layer(observed).clamp(-1.0, 1.0)

    def loss(self, observed: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the mean squared error before the actions are clamped."""
        return nn.functional.mse_loss(self.layer(observed), target)


LINEAR = Plugin("linear", Recipe, LinearPolicy)
