"""`actor`: the actor that reinforcement or offline learning produces, without its critics.

An MLP with ReLU between its layers. Its input is a state with the goal: the relative features of
the env (`surgicai_vision.envs.relative`) or the 21 values of obs_type "state". Its output is the
mean action, squashed by a tanh or clipped. The recipe holds the algorithm and its settings as data,
so that a checkpoint records how it was trained. `surgicai-vision train --algo` trains actors; with
`train --policy` an actor is cloned from the 21 values of a dataset.

`bcq` is the policy of batch-constrained Q-learning (Fujimoto et al., ICML 2019, arXiv:1812.02900):
a decoder samples actions like those of the demonstrations, a second network shifts each slightly,
and the critic chooses one. The latent samples are drawn once and stored with the weights, so that
this policy, too, is a deterministic function of its input.
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
"""`ActorRecipe.observation` → key of the actor's input."""
SQUASHES = ("tanh", "clip")


@dataclass(frozen=True)
class ActorRecipe(Recipe):
    """Settings of an actor.

    Attributes:
        batch_norm: BatchNorm before each hidden layer; the libraries' actors have none.
        observation: "relative" or "state".
        squash: how a mean becomes an action: "tanh", or "clip" (PPO's Gaussian).
        algo: the algorithm that trained it; "" where it was cloned from a dataset.
        settings: the algorithm's settings, as data.
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
        """Copy the weights of a library's actor.

        Args:
            layers: its linear layers, in order, with ReLU between them.
            mean: mean subtracted from each input, (inputs.dim,).
            std: standard deviation each is then divided by.

        Raises:
            InputError: the number or the sizes of the layers differ.
        """
        _copy([layer for layer in self.network.layers if isinstance(layer, nn.Linear)], layers)
        self.input_mean.copy_(mean)
        self.input_std.copy_(std)


DRAWS = 100
"""Number of actions that `bcq` chooses from (as in the paper)."""
LATENT = 2 * ACTIONS
"""Length of a latent sample (as in the authors' code and in d3rlpy)."""
LATENT_LIMIT = 0.5
"""Latent samples are clipped to ± this (same sources)."""
FLEXIBILITY = 0.05
"""Largest shift of a sampled action (the paper's Φ)."""


@final
class BatchConstrained(Policy):
    """The policy of BCQ: decoder, shift network, critic and stored latent samples."""

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
        """Copy the weights of a library's decoder, shift network and critic; draw the samples.

        Args:
            layers: the linear layers of each, in order.
            mean: mean subtracted from each input, (inputs.dim,).
            std: standard deviation each is then divided by.
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
        InputError: the number or the sizes of the layers differ.
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
