"""What every policy is: features and proprioception in, an action out.

Interface:

* `Policy`: abstract torch module. `policy.act(features (B, F) float32 | None, agent_pos (B, 7) float32)
  -> (B, 7) float32` for use; `policy.loss(features, agent_pos, action)` for training.
* `Plugin(name, recipe, make)`: what a member file offers: its frozen recipe type and the function that
  builds an untrained policy, `make(recipe, visual)`.
* `Inputs`: what a policy is fed.

Actions must not depend on how many environments are asked at once: `act` computes in float64 and rounds to
float32, which hides the order in which a matrix product was summed.
"""

import abc
import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import torch
from torch import nn

from surgicai_vision import names
from surgicai_vision.errors import InputError

ACTIONS = len(names.ACTION_NAMES)
STATES = len(names.STATE_NAMES)


@dataclass(frozen=True)
class Inputs:
    """What a policy is fed.

    Attributes:
        visual: shape of each view's feature, in the order of the views: (dim,), (C, h, w) or (N, C);
            rows are flattened; empty without pictures.
        proprioception: True when the active arm's tip pose and jaw (7) are fed too.
    """

    visual: tuple[tuple[int, ...], ...]
    proprioception: bool = True

    def __post_init__(self) -> None:
        if not self.visual and not self.proprioception:
            raise InputError("A policy needs at least one view or proprioception; this one would be blind.")

    @property
    def features(self) -> int:
        """Length of the views' rows side by side."""
        return sum(math.prod(shape) for shape in self.visual)

    @property
    def dim(self) -> int:
        """Length of the concatenated input."""
        return self.features + STATES * self.proprioception


@dataclass(frozen=True)
class Plugin:
    """A member of the family.

    Attributes:
        name: the name users give.
        recipe: frozen dataclass of its settings.
        make: (recipe, shape of each view's feature) → untrained policy.
    """

    name: str
    recipe: type
    make: Callable[[Any, tuple[tuple[int, ...], ...]], "Policy"]


class Policy(nn.Module, abc.ABC):
    """Base of all policies: holds the statistics of its inputs and normalises them itself.

    Attributes:
        inputs: what it is fed.
        input_mean: mean of each input over the training frames, (inputs.dim,).
        input_std: standard deviation of each, 1 where an input is constant.
    """

    input_mean: torch.Tensor
    input_std: torch.Tensor

    def __init__(self, inputs: Inputs):
        super().__init__()
        self.inputs = inputs
        self.register_buffer("input_mean", torch.zeros(inputs.dim))
        self.register_buffer("input_std", torch.ones(inputs.dim))
        self._exact: Policy | None = None

    @abc.abstractmethod
    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return actions (B, 7) in [-1, 1] for normalised inputs (B, inputs.dim)."""

    @abc.abstractmethod
    def loss(self, observed: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Return the training loss (scalar) for normalised inputs and demonstrated actions (B, 7)."""

    @final
    def normalise(self, observed: torch.Tensor) -> torch.Tensor:
        """Return raw inputs (B, inputs.dim) with zero mean and unit variance over the training frames."""
        return (observed - self.input_mean) / self.input_std

    @final
    def act(self, features: np.ndarray | None, agent_pos: np.ndarray) -> np.ndarray:
        """Return actions for a batch of observations.

        Args:
            features: (B, `inputs.features`) float32, the views' rows side by side; None without views.
            agent_pos: (B, 7) float32, x y z [m] roll pitch yaw [rad] jaw [rad] of the active tip in its base.

        Returns:
            (B, 7) float32 in [-1, 1].

        Raises:
            InputError: arrays of other shapes than the policy was trained on, or not finite.
        """
        observed = self._observed(features, agent_pos)
        exact = self._exact
        if exact is None:
            exact = copy.deepcopy(self).double().eval().requires_grad_(False)
            object.__setattr__(self, "_exact", exact)  # not a submodule: it must not enter the state dict
        with torch.inference_mode():
            return exact(exact.normalise(torch.from_numpy(observed))).float().numpy()

    @final
    def train(self, mode: bool = True) -> "Policy":
        """Switch to training or evaluation; the copy that acts is made anew afterwards."""
        object.__setattr__(self, "_exact", None)
        super().train(mode)
        return self

    def _observed(self, features: np.ndarray | None, agent_pos: np.ndarray) -> np.ndarray:
        """Check the inputs and lay them side by side, (B, inputs.dim) float64."""
        agent_pos = np.asarray(agent_pos)
        parts = [] if features is None else [np.asarray(features)]
        width = parts[0].shape[1:] if parts else (0,)
        if width != (self.inputs.features,):
            raise InputError(f"The policy was trained on features of {self.inputs.visual}, got {width}.")
        if agent_pos.ndim != 2 or agent_pos.shape[1] != STATES or (parts and len(parts[0]) != len(agent_pos)):
            raise InputError(f"agent_pos must be (batch, {STATES}) with one row a picture, got {agent_pos.shape}.")
        if self.inputs.proprioception:
            parts.append(agent_pos)
        observed = np.concatenate(parts, axis=1).astype(np.float64)
        if not np.isfinite(observed).all():
            raise InputError("The policy was given an observation that is not finite.")
        return observed
