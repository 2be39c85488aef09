"""`residual`: a frozen behaviour-cloning policy and a small correction of its actions.

    action = clip(cloned + bound · tanh(correction), -1, 1)

The correction is an MLP. Its input is the output of the frozen policy's image heads, the vector fed
with the images, and the action that the frozen policy would take. Its last layer starts at zero, so
that an untrained correction changes nothing (Silver et al., Residual policy learning, 2018,
arXiv:1812.06298). `surgicai-vision train --residual-on` trains it by reinforcement learning with a
sparse reward, as ResiP does on action chunks (Ankile et al., From imitation to refinement, 2024,
arXiv:2407.16677); with `train --policy` both parts are cloned together.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from policies.base import ACTIONS, Inputs, Plugin, Policy, Recipe, fed_vector
from policies.layers import FeatureMLP
from surgicai_vision.core.config import JSON
from surgicai_vision.core.errors import InputError

SMALLEST_STD = 1e-3
"""Inputs of the correction that vary less are divided by this."""


@dataclass(frozen=True)
class ResidualRecipe(Recipe):
    """Settings of the frozen policy, and of the correction.

    Attributes:
        bound: largest correction of each element of an action.
        correction: width of each hidden layer of the correction.
        algo: the algorithm that trained it; "" where it was cloned.
        settings: the algorithm's settings, as data.
    """

    bound: float = 0.3
    correction: tuple[int, ...] = (256, 256)
    algo: str = ""
    settings: dict[str, JSON] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.bound <= 1:
            raise InputError(f"bound is {self.bound}; it must be above 0 and at most 1.")
        if not self.correction or min(self.correction) < 1:
            raise InputError(
                f"correction is {self.correction}; give at least one layer of width 1."
            )


@final
class Residual(Policy):
    """The frozen policy and its correction; see the module's docstring.

    Attributes:
        sight: length of the correction's input.
        sight_mean: mean of each element of that input, (sight,).
        sight_std: standard deviation of each, (sight,).
    """

    sight_mean: torch.Tensor
    sight_std: torch.Tensor

    def __init__(self, recipe: Recipe, visual: tuple[tuple[int, ...], ...]):
        assert isinstance(recipe, ResidualRecipe)
        super().__init__(Inputs(visual, fed_vector(recipe)))
        self.network = FeatureMLP(recipe, self.inputs, ACTIONS)
        self.bound = recipe.bound
        self.sight = width = self.network.width + ACTIONS
        self.register_buffer("sight_mean", torch.zeros(width))
        self.register_buffer("sight_std", torch.ones(width))
        layers: list[nn.Module] = []
        for hidden in recipe.correction:
            layers += [nn.Linear(width, hidden), nn.ReLU()]
            width = hidden
        last = nn.Linear(width, ACTIONS)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.correction = nn.Sequential(*layers, last)

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return actions (B, 7) in [-1, 1] for normalised inputs."""
        sight = self.look(observed)
        moved = self.correction((sight - self.sight_mean) / self.sight_std).tanh()
        actions: torch.Tensor = (sight[:, -ACTIONS:] + self.bound * moved).clamp(-1.0, 1.0)
        return actions

    def look(self, observed: torch.Tensor) -> torch.Tensor:
        """Return the correction's input, (B, sight), for normalised inputs.

        Its last seven values are the frozen policy's action.
        """
        seen = self.network.seen(observed)
        return torch.cat([seen, self.network.layers(seen).tanh()], dim=1)

    def loss(self, observed: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the mean squared error of the actions (B, 7)."""
        return nn.functional.mse_loss(self(observed), target)

    @torch.no_grad()
    def take_base(self, base: Policy) -> None:
        """Copy the weights and the input statistics of the policy to be corrected.

        Args:
            base: a behaviour-cloning policy, `bc`; its tensors have the same names as this one's.
        """
        self.load_state_dict({**self.state_dict(), **base.state_dict()})

    @torch.no_grad()
    def take_correction(self, layers: Sequence[nn.Linear]) -> None:
        """Copy the weights of a library's actor, given as its linear layers in order."""
        own = [layer for layer in self.correction if isinstance(layer, nn.Linear)]
        for layer, given in zip(own, layers, strict=True):
            layer.weight.copy_(given.weight)
            layer.bias.copy_(given.bias)

    @torch.no_grad()
    def standardise(self, sights: NDArray[np.float32]) -> None:
        """Set mean and standard deviation from recorded inputs of the correction, (n, sight)."""
        values = sights.astype(np.float64)
        std = np.maximum(values.std(axis=0), SMALLEST_STD)
        self.sight_mean.copy_(torch.from_numpy(values.mean(axis=0)))
        self.sight_std.copy_(torch.from_numpy(std))

    def exact(self) -> "Residual":
        """Return a copy in double precision, in which `act` computes."""
        return copy.deepcopy(self).cpu().double().eval().requires_grad_(False)


RESIDUAL = Plugin("residual", ResidualRecipe, Residual)
