"""`actor`: what reinforcement and offline learning leave behind: the actor, without its critics.

An MLP with ReLU between its layers on a state with the goal: the relative features of the env
(`surgicai_vision.envs.relative`) or the 21 values of obs_type "state"; the mean action, squashed by
a tanh or clipped. The algorithm and its settings stand in the recipe as data, so that a checkpoint
says how it was trained. `surgicai-vision train --algo` makes them; as a policy of `train --policy`
it is cloned from the 21 values of a dataset.

`bcq` is the policy of batch-constrained Q-learning (Fujimoto et al., ICML 2019, arXiv:1812.02900):
a decoder draws actions as the demonstrations have them, a second network shifts each a little, and
the critic says which is taken. The draws are made once and stored with the weights, so that it too
is a function of what it sees.
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
        super().__init__(Inputs(visual, (VECTORS[recipe.observation],)))
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
        _copy([layer for layer in self.network.layers if isinstance(layer, nn.Linear)], layers)
        self.input_mean.copy_(mean)
        self.input_std.copy_(std)


DRAWS = 100
"""Actions that `bcq` chooses from (the paper)."""
LATENT = 2 * ACTIONS
"""Size of a draw (the authors' code, and d3rlpy)."""
LATENT_LIMIT = 0.5
"""Draws are clipped to ± this (the same)."""
FLEXIBILITY = 0.05
"""Largest shift of a drawn action (the paper's Φ)."""


@final
class BatchConstrained(Policy):
    """The policy of BCQ: decoder, shift, critic and the draws."""

    draws: torch.Tensor

    def __init__(self, recipe: Recipe, visual: tuple[tuple[int, ...], ...]):
        assert isinstance(recipe, ActorRecipe)
        super().__init__(Inputs(visual, (VECTORS[recipe.observation],)))
        size = self.inputs.dim
        self.decoder = _mlp(size + LATENT, recipe.hidden, ACTIONS)
        self.shift = _mlp(size + ACTIONS, recipe.hidden, ACTIONS)
        self.critic = _mlp(size + ACTIONS, recipe.hidden, 1)
        self.register_buffer("draws", torch.zeros(DRAWS, LATENT))

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return the actions (B, 7) that the critic values most, for normalised inputs."""
        rows = observed.repeat_interleave(DRAWS, dim=0)
        drawn = self.decoder(torch.cat([rows, self.draws.repeat(len(observed), 1)], dim=1))
        shift = FLEXIBILITY * self.shift(torch.cat([rows, drawn], dim=1)).tanh()
        actions = (drawn + shift).clamp(-1.0, 1.0)
        values = self.critic(torch.cat([rows, actions], dim=1)).view(len(observed), DRAWS)
        best = values.argmax(dim=1)
        chosen: torch.Tensor = actions.view(len(observed), DRAWS, ACTIONS)[
            torch.arange(len(observed)), best
        ]
        return chosen

    def loss(self, observed: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the mean squared error of the actions (B, 7)."""
        return nn.functional.mse_loss(self(observed), target)

    @torch.no_grad()
    def take(
        self, layers: Sequence[Sequence[nn.Linear]], mean: torch.Tensor, std: torch.Tensor
    ) -> None:
        """Take the weights of a library's decoder, shift and critic, and make the draws.

        Args:
            layers: the linear layers of each, in order.
            mean: what is removed from each input, (inputs.dim,).
            std: what each is then divided by.
        """
        for own, given in zip((self.decoder, self.shift, self.critic), layers, strict=True):
            _copy([layer for layer in own if isinstance(layer, nn.Linear)], given)
        self.input_mean.copy_(mean)
        self.input_std.copy_(std)
        generator = torch.Generator().manual_seed(0)
        drawn = torch.randn(self.draws.shape, generator=generator)
        self.draws.copy_(drawn.clamp(-LATENT_LIMIT, LATENT_LIMIT))


def _mlp(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Return linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ReLU()]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


def _copy(own: Sequence[nn.Linear], given: Sequence[nn.Linear]) -> None:
    """Copy weights layer by layer.

    Raises:
        InputError: another number of layers, or layers of another size.
    """
    sizes = [tuple(layer.weight.shape) for layer in own]
    others = [tuple(layer.weight.shape) for layer in given]
    if sizes != others:
        raise InputError(f"The policy has layers of {sizes}, got {others}.")
    for layer, other in zip(own, given, strict=True):
        layer.weight.copy_(other.weight)
        layer.bias.copy_(other.bias)


BCQ = Plugin("bcq", ActorRecipe, BatchConstrained)
ACTOR = Plugin("actor", ActorRecipe, Actor)
