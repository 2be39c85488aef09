"""`bc`: behaviour cloning, the paper's low-level policy.

The recipe `paper` (paper, Section 4 and appendix): an MLP of three hidden layers of 256, each
preceded by BatchNorm, ReLU between, Tanh at the end; mean squared error; Adam, 1e-3, 30 epochs,
batches of 256; visual features with the active arm's tip pose and jaw; training and validation
split by episode.
"""

from typing import final

import torch
from torch import nn

from policies.base import ACTIONS, Inputs, Plugin, Policy, Recipe, fed_vector
from policies.layers import FeatureMLP


@final
class BCPolicy(Policy):
    """The MLP of behaviour cloning."""

    def __init__(self, recipe: Recipe, visual: tuple[tuple[int, ...], ...]):
        super().__init__(Inputs(visual, fed_vector(recipe)))
        self.network = FeatureMLP(recipe, self.inputs, ACTIONS)

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return actions (B, 7) in [-1, 1] for normalised inputs."""
        answers: torch.Tensor = self.network(observed)
        return answers.tanh()

    def loss(self, observed: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the mean squared error of the actions (B, 7)."""
        return nn.functional.mse_loss(self(observed), target)


BC = Plugin("bc", Recipe, BCPolicy)
