"""`bc`: behaviour cloning, the paper's low-level policy.

The recipe `paper` (paper, Section 4 and appendix): an MLP of three hidden layers of 256, each
preceded by BatchNorm, ReLU between, Tanh at the end; mean squared error; Adam, 1e-3, 30 epochs,
batches of 256; visual features with the active arm's tip pose and jaw; training and validation
split by episode.

With `goal_loss` in its recipe it also learns to tell where the goal lies. An action is mostly a
full step, whatever the distance, so actions alone say little about a few degrees or tenths of a
millimetre; the goal says them in every frame (docs/training.md).
"""

from typing import final

import torch
from torch import nn

from policies.base import ACTIONS, Inputs, Plugin, Policy, Recipe, fed_vector
from policies.layers import FeatureMLP, GoalMLP
from surgicai_vision.core import names

SMALLEST_STD = 1e-6
"""A part of the goal that varies less [m, or of a unit vector] is divided by this."""


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


@final
class GoalBCPolicy(Policy):
    """The MLP of behaviour cloning that also tells where the goal lies.

    Attributes:
        goal_mean: mean of `names.GOAL_IN_TIP` over the training frames, (9,).
        goal_std: standard deviation of each part, (9,).
    """

    auxiliary = names.GOAL_IN_TIP
    goal_mean: torch.Tensor
    goal_std: torch.Tensor

    def __init__(self, recipe: Recipe, visual: tuple[tuple[int, ...], ...]):
        super().__init__(Inputs(visual, fed_vector(recipe)))
        self.weight = recipe.goal_loss
        self.network = GoalMLP(recipe, self.inputs, ACTIONS, names.GOAL_IN_TIP_SIZE)
        self.register_buffer("goal_mean", torch.zeros(names.GOAL_IN_TIP_SIZE))
        self.register_buffer("goal_std", torch.ones(names.GOAL_IN_TIP_SIZE))

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return actions (B, 7) in [-1, 1] for normalised inputs."""
        answers: torch.Tensor = self.network(observed)[0]
        return answers.tanh()

    def measure(self, target: torch.Tensor) -> None:
        """Store mean and standard deviation of the goal."""
        goal = target[:, ACTIONS:].double()
        self.goal_mean.copy_(goal.mean(0))
        self.goal_std.copy_(goal.std(0).clamp_min(SMALLEST_STD))

    def loss(self, observed: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the mean squared error of the actions plus the weighted one of the goal.

        Args:
            observed: normalised inputs (B, inputs.dim).
            target: actions and goal, (B, 16). The goal's error counts in standard deviations.
        """
        action, goal = target.split([ACTIONS, names.GOAL_IN_TIP_SIZE], dim=1)
        answers, told = self.network(observed)
        meant = (goal - self.goal_mean) / self.goal_std
        error = nn.functional.mse_loss(told, meant)
        return nn.functional.mse_loss(answers.tanh(), action) + self.weight * error


def _make(recipe: Recipe, visual: tuple[tuple[int, ...], ...]) -> Policy:
    """Return the policy that a recipe asks for."""
    return GoalBCPolicy(recipe, visual) if recipe.goal_loss else BCPolicy(recipe, visual)


BC = Plugin("bc", Recipe, _make)
