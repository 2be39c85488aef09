"""`bc`: behaviour cloning, the paper's low-level policy.

The recipe `paper` (paper, Section 4 and appendix): an MLP of three hidden layers of 256, each preceded by
BatchNorm, ReLU between, Tanh at the end; mean squared error; Adam, 1e-3, 30 epochs, batches of 256; visual
features beside the active arm's tip pose and jaw; training and validation split by episode.
"""

from dataclasses import dataclass
from typing import final

import torch
from torch import nn

from policies.base import ACTIONS, Inputs, Plugin, Policy
from surgicai_vision.errors import InputError, check_name


@dataclass(frozen=True)
class BCRecipe:
    """Settings of behaviour cloning; the defaults are the paper's.

    Attributes:
        hidden: width of each hidden layer.
        batch_norm: put BatchNorm before each hidden layer.
        learning_rate: Adam's.
        epochs: passes over the training frames; the last one is the checkpoint.
        batch_size: frames per step.
        split: "episode", or "transition" as the released code did (neighbouring frames leak).
        validation: share of the episodes (or transitions) held out of training.
        proprioception: feed the active arm's tip pose and jaw too.
        action_noise: half-width of the uniform noise evaluation adds to the translation action; 0 in the
            paper, 0.1 (R3M), 0.4 (CLIP), 0.5 (ImageNet) in the released code.
    """

    hidden: tuple[int, ...] = (256, 256, 256)
    batch_norm: bool = True
    learning_rate: float = 1e-3
    epochs: int = 30
    batch_size: int = 256
    split: str = "episode"
    validation: float = 0.1
    proprioception: bool = True
    action_noise: float = 0.0

    def __post_init__(self) -> None:
        check_name("split", self.split, ("episode", "transition"))
        if not self.hidden or min(self.hidden) < 1:
            raise InputError(f"hidden is {self.hidden}; give at least one layer of width 1 or more.")
        if self.epochs < 1 or self.batch_size < 2:
            raise InputError(f"epochs is {self.epochs}, batch_size {self.batch_size}; at least 1 and 2.")
        if not self.learning_rate > 0:
            raise InputError(f"learning_rate is {self.learning_rate}; it must be above 0.")
        if not 0 <= self.validation < 1:
            raise InputError(f"validation is {self.validation}; give a share from 0 to below 1.")
        if self.action_noise < 0:
            raise InputError(f"action_noise is {self.action_noise}; it must not be negative.")


@final
class BCPolicy(Policy):
    """The MLP of behaviour cloning."""

    def __init__(self, recipe: BCRecipe, visual: tuple[int, ...]):
        super().__init__(Inputs(tuple(visual), recipe.proprioception))
        layers: list[nn.Module] = []
        width = self.inputs.dim
        for hidden in recipe.hidden:
            layers += [nn.BatchNorm1d(width)] if recipe.batch_norm else []
            layers += [nn.Linear(width, hidden), nn.ReLU()]
            width = hidden
        self.layers = nn.Sequential(*layers, nn.Linear(width, ACTIONS), nn.Tanh())

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return actions (B, 7) in [-1, 1] for normalised inputs."""
        return self.layers(observed)

    def loss(self, observed: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Return the mean squared error of the actions."""
        return nn.functional.mse_loss(self(observed), action)


BC = Plugin("bc", BCRecipe, BCPolicy)
