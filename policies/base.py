"""What every policy is: features and proprioception in, an action out.

Interface:

* `Policy`: abstract torch module. `policy.act(features (B, F) float32 | None, agent_pos (B, 7)
  float32) -> (B, 7) float32` for use; `policy.loss(features, agent_pos, action)` for training.
* `Plugin(name, recipe, make)`: what a member file offers: its frozen recipe type and the function
  that builds an untrained policy, `make(recipe, visual)`.
* `Inputs`: what a policy is fed.

Actions must not depend on how many environments are asked at once: `act` computes in float64 and
rounds to float32, which hides the order in which a matrix product was summed.
"""

import abc
import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from surgicai_vision.core import names
from surgicai_vision.core.config import CLOCK_PERIOD, CLOCK_SIZE
from surgicai_vision.core.errors import (
    InputError,
    check_at_least,
    check_at_most,
    check_finite,
    check_name,
    check_positive,
)

if TYPE_CHECKING:
    from surgicai_vision.training.checkpoint import Checkpoint

ACTIONS = len(names.ACTION_NAMES)
VECTORS: Mapping[str, int] = MappingProxyType(
    {
        names.STATE: len(names.STATE_NAMES),
        names.SETPOINT: len(names.SETPOINT_NAMES),
        names.CLOCK: CLOCK_SIZE,
        names.PROGRESS: 1,
        names.BOTH_ARMS: len(names.BOTH_ARMS_NAMES),
        names.PRIVILEGED_STATE: len(names.PRIVILEGED_NAMES),
        names.RELATIVE_STATE: len(names.RELATIVE_NAMES),
    }
)
"""What may be fed beside features: key → length."""
WIDEST = 65_536
"""Most units of a hidden layer; the policies that come with the product have 256."""
MOST_EPOCHS = 1_000_000
"""Most passes over the training frames."""
FARTHEST_SHIFT = 1_024
"""Farthest a feature map is moved [places]; no map is wider."""


@dataclass(frozen=True)
class Recipe:
    """Settings of a policy; the defaults are the paper's.

    Attributes:
        hidden: width of each hidden layer.
        batch_norm: put BatchNorm before each hidden layer.
        learning_rate: Adam's.
        weight_decay: decoupled weight decay (AdamW) [per step, times the learning rate].
        schedule: "constant", or "one_cycle": up to the learning rate over the first third, then
            down to nothing (Smith and Topin, Super-convergence, 2017).
        epochs: passes over the training frames; the last one is the checkpoint.
        batch_size: frames per step.
        split: "episode", or "transition" as in SurgicAI's released code (neighbouring frames
            leak).
        validation: share of the episodes (or transitions) held out of training.
        proprioception: feed tip pose and jaw too: the active arm's, for a high-level policy both
            arms'.
        setpoint: feed how far the set point lies from the measured pose as well (needs
            proprioception): an action moves the set point, and the tool lags behind it.
        clock: feed the time since the subtask began as well (needs proprioception), for
            demonstrators that act by it; its hand must be seen in more than one place
            (`frame_stride`).
        progress_input: feed how far the subtask is, as a high-level policy with `progress` says it,
            in the place of the clock (`train --progress-from`; needs proprioception).
        map_head: what takes in a feature map: "softmax" (where each of 32 patterns lies) or
            "convolutions".
        frame_stride: train on each N-th frame of an episode alone, from its first: neighbours show
            nearly the same.
        privileged: feed the 21 values of obs_type "state", goal included, in place of all else:
            an upper bound.
        join_views: take in the feature maps of all views as channels of one map, so that
            convolutions see both eyes at once; else each view has a head of its own.
        proprioception_noise: noise on the measured poses in training, in standard deviations of
            each value; 0 is none.
        map_shift: move feature maps by up to so many places in training; 0 does not.
    """

    hidden: tuple[int, ...] = (256, 256, 256)
    batch_norm: bool = True
    learning_rate: float = 1e-3
    weight_decay: float = 0.0
    schedule: str = "constant"
    epochs: int = 30
    batch_size: int = 256
    split: str = "episode"
    validation: float = 0.1
    proprioception: bool = True
    setpoint: bool = False
    clock: bool = False
    progress_input: bool = False
    map_head: str = "softmax"
    frame_stride: int = 1
    privileged: bool = False
    join_views: bool = False
    proprioception_noise: float = 0.0
    map_shift: int = 0

    def __post_init__(self) -> None:
        check_finite(**{key: of for key, of in vars(self).items() if isinstance(of, float)})
        check_name("split", self.split, ("episode", "transition"))
        check_name("schedule", self.schedule, ("constant", "one_cycle"))
        check_name("map_head", self.map_head, ("softmax", "convolutions"))
        check_at_least(1, frame_stride=self.frame_stride)
        if not self.hidden or min(self.hidden) < 1:
            raise InputError(
                f"hidden is {self.hidden}; give at least one layer of width 1 or more."
            )
        check_at_most(WIDEST, **{"the widest layer of hidden": max(self.hidden)})
        check_at_most(MOST_EPOCHS, epochs=self.epochs)
        check_at_most(FARTHEST_SHIFT, map_shift=self.map_shift)
        if self.epochs < 1 or self.batch_size < 2:
            raise InputError(
                f"epochs is {self.epochs}, batch_size {self.batch_size}; at least 1 and 2."
            )
        check_positive(learning_rate=self.learning_rate)
        if self.setpoint and (self.privileged or not self.proprioception):
            raise InputError("setpoint goes with proprioception; switch it on, and privileged off.")
        if self.clock and (self.privileged or not self.proprioception):
            raise InputError("clock goes with proprioception; switch it on, and privileged off.")
        if self.clock and self.frame_stride % CLOCK_PERIOD == 0:
            raise InputError(
                f"frame_stride is {self.frame_stride}: the clock's hand goes round in "
                f"{CLOCK_PERIOD} steps and would stand still in all frames trained on; take "
                "another stride, or clock=false."
            )
        if self.progress_input and (self.clock or self.privileged or not self.proprioception):
            raise InputError(
                "progress_input goes with proprioception, in the place of the clock; switch "
                "proprioception on, clock and privileged off."
            )
        check_at_least(0, weight_decay=self.weight_decay)
        if not self.proprioception_noise >= 0 or self.map_shift < 0:
            raise InputError(
                f"proprioception_noise is {self.proprioception_noise}, map_shift {self.map_shift}; "
                "neither may be below 0."
            )
        if self.proprioception_noise and (self.privileged or not self.proprioception):
            raise InputError(
                "proprioception_noise goes with proprioception; switch it on, and privileged off."
            )
        if not 0 <= self.validation < 1:
            raise InputError(f"validation is {self.validation}; give a share from 0 to below 1.")


@dataclass(frozen=True)
class Inputs:
    """What a policy is fed.

    Attributes:
        visual: shape of each view's feature, in the order of the views: (dim,), (C, h, w) or (N,
            C); rows are flattened; empty without images.
        vector: keys of `VECTORS`, what is fed beside the features, one after the other; empty for
            the features alone.
    """

    visual: tuple[tuple[int, ...], ...]
    vector: tuple[str, ...] = (names.STATE,)

    def __post_init__(self) -> None:
        if not self.visual and not self.vector:
            raise InputError(
                "A policy needs at least one view or proprioception; this one would be blind."
            )
        if self.visual and self.knows_goal:
            raise InputError(
                "A policy with images may not see the privileged state; give one or the other."
            )

    @property
    def knows_goal(self) -> bool:
        """Whether it is fed a state with the goal, which no robot tells."""
        return not set(self.vector).isdisjoint(names.STATES_WITH_GOAL)

    @property
    def width(self) -> int:
        """Length of what is fed beside the features."""
        return sum(VECTORS[key] for key in self.vector)

    @property
    def features(self) -> int:
        """Length of the views' rows side by side."""
        return sum(math.prod(shape) for shape in self.visual)

    @property
    def dim(self) -> int:
        """Length of the concatenated input."""
        return self.features + self.width


def visual_shapes(recipe: Recipe, visual: Sequence[tuple[int, ...]]) -> tuple[tuple[int, ...], ...]:
    """Return the shape of each feature that a head of its own takes in.

    Rows of maps lie side by side, channel after channel: joined they are one map already.

    Args:
        recipe: its `join_views` counts.
        visual: shape of each view's feature.

    Raises:
        InputError: views are to be joined whose features are not maps of one size.
    """
    if not recipe.join_views or len(visual) < 2:
        return tuple(visual)
    if any(len(shape) != 3 or shape[1:] != visual[0][1:] for shape in visual):
        raise InputError(
            f"join_views is for feature maps of one size; these are {tuple(visual)}. Take "
            "--pool spatial, or leave join_views out."
        )
    return ((sum(shape[0] for shape in visual), *visual[0][1:]),)


def fed_vector(recipe: Recipe) -> tuple[str, ...]:
    """Return what a recipe feeds beside the features, keys of `VECTORS`."""
    if recipe.privileged:
        return (names.PRIVILEGED_STATE,)
    fed = {
        names.STATE: recipe.proprioception,
        names.SETPOINT: recipe.setpoint,
        names.CLOCK: recipe.clock,
        names.PROGRESS: recipe.progress_input,
    }
    return tuple(key for key, is_fed in fed.items() if is_fed)


@dataclass(frozen=True)
class Plugin:
    """A member of the family.

    Attributes:
        name: the name users give.
        recipe: frozen dataclass of its settings.
        make: (recipe, shape of each view's feature) → untrained policy.
        target: what it learns: a dataset's column, or one that is computed of columns:
            `names.STAGE`, `names.ACTION_CHUNK`.
        offsets: recipe → which actions a chunk holds, in control steps from the present one; None
            for a policy that learns no chunks.
    """

    name: str
    recipe: type[Recipe]
    make: Callable[[Recipe, tuple[tuple[int, ...], ...]], "Policy"]
    target: str = names.ACTION
    offsets: Callable[[Recipe], range] | None = None


class Policy(nn.Module, abc.ABC):
    """Base of all policies: holds the statistics of its inputs and normalises them itself.

    Attributes:
        inputs: what it is fed.
        input_mean: mean of each input over the training frames, (inputs.dim,).
        input_std: standard deviation of each, 1 where an input is constant.
        checkpoint: what a policy that was loaded was restored from.
        history: observations that it sees, the present one last.
        averaging: largest decay of the moving average of its weights in training, which is what
            is kept; 0 keeps the weights themselves.
        clip: largest norm of a gradient in training; 0 clips none.
    """

    history: int = 1
    averaging: float = 0.0
    clip: float = 0.0
    checkpoint: "Checkpoint"
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
        """Return actions or logits (B, n) for normalised inputs (B, inputs.dim)."""

    @abc.abstractmethod
    def loss(self, observed: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the loss (scalar) for normalised inputs and demonstrated answers (B, …)."""

    def measure(self, target: torch.Tensor) -> None:
        """Fit before the first epoch what gradients of the loss do not; nothing by default.

        Args:
            target: what is demonstrated in the training frames, (N, …).
        """

    def calibrate(self, answers: torch.Tensor, target: torch.Tensor) -> None:
        """Fit after the last epoch what gradients do not; nothing by default.

        Args:
            answers: what `forward` returns for the frames held out, (N, n); N at least 1.
            target: what was demonstrated there, (N, …).
        """

    @final
    def normalise(self, observed: torch.Tensor) -> torch.Tensor:
        """Return raw inputs (B, inputs.dim) with the training frames' mean and variance removed."""
        return (observed - self.input_mean).div_(self.input_std)

    @final
    def act(
        self, features: NDArray[np.float32] | None, agent_pos: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return the answers to a batch of observations.

        Args:
            features: (B, `inputs.features`) float32, the views' rows side by side; None without
                views.
            agent_pos: (B, 7) float32, x y z [m] roll pitch yaw [rad] jaw [rad] of the active tip in
                its base; the vector of `inputs.vector` where that is another.

        Returns:
            (B, 7) float32 in [-1, 1]; of a high-level policy (B, 5) logits, or (B, 6) with the
            progress last.

        Raises:
            InputError: arrays of other shapes than the policy was trained on, or not finite.
        """
        observed = self.observed(features, agent_pos)
        exact = self._exact
        if exact is None:
            exact = self._copy_to_act().eval().requires_grad_(False)
            # Not a submodule: it must not enter the state dict.
            object.__setattr__(self, "_exact", exact)
        with torch.inference_mode():
            answers: torch.Tensor = exact(exact.normalise(torch.from_numpy(observed)))
        return np.asarray(answers.float().numpy(), np.float32)

    def _copy_to_act(self) -> "Policy":
        """Return the copy that acts, on the CPU."""
        return copy.deepcopy(self).cpu().double()

    @final
    def train(self, mode: bool = True) -> "Policy":
        """Switch to training or evaluation; the copy that acts is made again later."""
        object.__setattr__(self, "_exact", None)
        super().train(mode)
        return self

    def observed(
        self, features: NDArray[np.float32] | None, agent_pos: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """Return checked inputs side by side, (B, inputs.dim) float64; see `act`."""
        agent_pos = np.asarray(agent_pos)
        parts = [] if features is None else [np.asarray(features)]
        width = parts[0].shape[1:] if parts else (0,)
        if width != (self.inputs.features,):
            raise InputError(
                f"The policy was trained on features of {self.inputs.visual}, got {width}."
            )
        keys = self.inputs.vector or (names.STATE,)
        wide = sum(VECTORS[key] for key in keys)
        if agent_pos.shape[1:] != (wide,) or (parts and len(parts[0]) != len(agent_pos)):
            raise InputError(
                f"{' + '.join(keys)} must be (batch, {wide}) with one row an image, "
                f"got {agent_pos.shape}."
            )
        if self.inputs.vector:
            parts.append(agent_pos)
        observed = np.concatenate(parts, axis=1).astype(np.float64)
        if not np.isfinite(observed).all():
            raise InputError("The policy was given an observation that is not finite.")
        return observed
