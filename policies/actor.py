"""`actor`: what reinforcement and offline learning leave behind: the actor, without its critics.

An MLP with ReLU between its layers on a state with the goal: the relative features of the env
(`surgicai_vision.envs.relative`) or the 21 values of obs_type "state"; the mean action, squashed by
a tanh or clipped. The algorithm and its settings stand in the recipe as data, so that a checkpoint
says how it was trained. `surgicai-vision train --algo` makes them; as a policy of `train --policy`
it is cloned from the 21 values of a dataset.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

import torch
from torch import nn

from policies.base import ACTIONS, Inputs, Plugin, Policy, Recipe
from policies.layers import FeatureMLP
from surgicai_vision.core import names
from surgicai_vision.core.config import JSON
from surgicai_vision.core.errors import InputError, check_name

VECTORS = {"relative": names.RELATIVE_STATE, "state": names.PRIVILEGED_STATE}
"""`ActorRecipe.observation` → what it is fed."""
SQUASHES = ("tanh", "clip")


@dataclass(frozen=True)
class ActorRecipe(Recipe):
    """Settings of an actor.

    Attributes:
        batch_norm: BatchNorm before each hidden layer; the libraries' actors have none.
        observation: "relative" or "state".
        squash: how a mean becomes an action: "tanh", or "clip" (PPO's Gaussian).
        algo: the algorithm that trained it; "" where it was cloned from a dataset.
        settings: what the algorithm was run with, as data.
    """

    batch_norm: bool = False
    observation: str = "state"
    squash: str = "tanh"
    algo: str = ""
    settings: dict[str, JSON] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_name("observation", self.observation, VECTORS)
        check_name("squash", self.squash, SQUASHES)


@final
class Actor(Policy):
    """The MLP of an actor."""

    def __init__(self, recipe: Recipe, visual: tuple[tuple[int, ...], ...]):
        assert isinstance(recipe, ActorRecipe)
        super().__init__(Inputs(visual, VECTORS[recipe.observation]))
        self.network = FeatureMLP(recipe, self.inputs, ACTIONS)
        self.squash = recipe.squash

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return actions (B, 7) in [-1, 1] for normalised inputs."""
        means: torch.Tensor = self.network(observed)
        return means.tanh() if self.squash == "tanh" else means.clamp(-1.0, 1.0)

    def loss(self, observed: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the mean squared error of the actions (B, 7)."""
        return nn.functional.mse_loss(self(observed), target)

    @torch.no_grad()
    def take(self, layers: Sequence[nn.Linear], mean: torch.Tensor, std: torch.Tensor) -> None:
        """Take the weights of a library's actor.

        Args:
            layers: its linear layers, in order; ReLU stands between them.
            mean: what is removed from each input, (inputs.dim,).
            std: what each is then divided by.

        Raises:
            InputError: another number of layers, or layers of another size.
        """
        ours = [layer for layer in self.network.layers if isinstance(layer, nn.Linear)]
        sizes = [tuple(layer.weight.shape) for layer in ours]
        given = [tuple(layer.weight.shape) for layer in layers]
        if sizes != given:
            raise InputError(f"The actor has layers of {sizes}, got {given}.")
        for own, other in zip(ours, layers, strict=True):
            own.weight.copy_(other.weight)
            own.bias.copy_(other.bias)
        self.input_mean.copy_(mean)
        self.input_std.copy_(std)


ACTOR = Plugin("actor", ActorRecipe, Actor)
