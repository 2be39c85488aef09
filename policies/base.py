"""The interface of every policy: features and proprioception in, an action out.

Interface:

* `Policy`: abstract torch module. `policy.act(features (B, F) float32 | None, agent_pos (B, 7)
  float32) -> (B, 7) float32` for use; `policy.loss(features, agent_pos, action)` for training.
* `Plugin(name, recipe, make)`: what a member file provides: its frozen recipe type and the function
  that builds an untrained policy, `make(recipe, visual)`.
* `Inputs`: the inputs of a policy.

Actions must not depend on how many envs are in a batch: `act` computes in float64 and rounds to
float32, which hides the order in which a matrix product was summed.
"""

import abc
import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from surgicai_vision.core import names
from surgicai_vision.core.config import (
    CLOCK_PERIOD,
    CLOCK_SIZE,
    FULL_SPEED,
    LATER,
    Pace,
    check_hidden,
)
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
"""Inputs that may be fed alongside the features: key → length."""
MOST_EPOCHS = 1_000_000
"""Maximum number of passes over the training frames."""
MOST_AVERAGED = 1_000
"""Maximum number of images that are averaged: a whole procedure."""
FARTHEST_SHIFT = 1_024
"""Maximum shift of a feature map [places]; no map is wider."""


@dataclass(frozen=True)
class Recipe:
    """Settings of a policy; the defaults are the paper's.

    Attributes:
        hidden: width of each hidden layer.
        batch_norm: put BatchNorm before each hidden layer.
        learning_rate: Adam's learning rate.
        weight_decay: decoupled weight decay (AdamW) [per step, times the learning rate].
        schedule: "constant", or "one_cycle": up to the learning rate over about the first third,
            then down to almost zero (Smith and Topin, Super-convergence, 2017).
        epochs: passes over the training frames; the checkpoint is that of the last one.
        batch_size: frames per step.
        split: "episode", or "transition" as in SurgicAI's released code (neighbouring frames
            leak).
        validation: share of the episodes (or transitions) held out of training.
        proprioception: also feed tip pose and jaw: of the active arm, or of both arms for a
            high-level policy.
        setpoint: also feed the offset of the set point from the measured pose (needs
            proprioception): an action moves the set point, and the tool lags behind it.
        clock: also feed the time since the subtask began (needs proprioception), for demonstrators
            whose actions depend on it; the clock is periodic, so `frame_stride` must not give all
            frames the same phase.
        progress_input: feed the progress of the subtask, as predicted by a high-level policy with
            `progress`, instead of the clock (`train --progress-from`; needs proprioception).
        map_head: head for feature maps: "softmax" (the position of each of 32 patterns),
            "convolutions", or "keypoints" (convolutions, then the position of each of 32 patterns).
        frame_stride: train only on every N-th frame of an episode, from its first: neighbours show
            nearly the same.
        privileged: feed only the 21 values of obs_type "state", goal included: an upper bound.
        join_views: treat the feature maps of all views as channels of one map, so that
            convolutions see both eyes at once; otherwise each view has its own head.
        proprioception_noise: noise on the measured poses in training, in standard deviations of
            each value; 0 adds none.
        map_shift: shift feature maps by up to this many places in training; 0 disables shifts.
        map_overlay: largest share of another frame's feature map that is laid over a map in
            training, from 0, which lays none over it, to below 0.5.
        instance_norm: standardise each channel of a feature map over its places, image by image
            (Ulyanov et al., Instance normalization, 2016): what a look adds to a channel
            everywhere, or multiplies it by, then does not reach the head.
        speed: share of each action that is executed, above 0 and at most 1; the clock runs as much
            slower. It does not affect what is learned (docs/evaluation.md); see `Pace`.
        jaw_speed, pinch_speed, clock_speed, retry_after: see `Pace`; they do not affect what is
            learned either.
        denoise: most successive images that are averaged wherever they stand still, when the policy
            acts (`evaluation.denoised_agent`); 1 leaves images as they are. It does not affect what
            is learned.
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
    map_overlay: float = field(default=0.0, metadata=LATER)
    instance_norm: bool = field(default=False, metadata=LATER)
    speed: float = field(default=1.0, metadata=LATER)
    jaw_speed: float = field(default=1.0, metadata=LATER)
    pinch_speed: float = field(default=1.0, metadata=LATER)
    clock_speed: float = field(default=1.0, metadata=LATER)
    retry_after: int = field(default=0, metadata=LATER)
    denoise: int = field(default=1, metadata=LATER)

    def __post_init__(self) -> None:
        check_finite(**{key: of for key, of in vars(self).items() if isinstance(of, float)})
        check_name("split", self.split, ("episode", "transition"))
        check_name("schedule", self.schedule, ("constant", "one_cycle"))
        check_name("map_head", self.map_head, ("softmax", "convolutions", "keypoints"))
        check_at_least(1, frame_stride=self.frame_stride, denoise=self.denoise)
        check_at_most(MOST_AVERAGED, denoise=self.denoise)
        check_hidden(self.hidden)
        check_at_most(MOST_EPOCHS, epochs=self.epochs)
        check_at_most(FARTHEST_SHIFT, map_shift=self.map_shift)
        if self.epochs < 1 or self.batch_size < 2:
            raise InputError(
                f"epochs is {self.epochs}, batch_size {self.batch_size}; at least 1 and 2."
            )
        check_positive(learning_rate=self.learning_rate)
        if self.setpoint and (self.privileged or not self.proprioception):
            raise InputError(
                "setpoint needs proprioception; switch proprioception on and privileged off."
            )
        if self.clock and (self.privileged or not self.proprioception):
            raise InputError(
                "clock needs proprioception; switch proprioception on and privileged off."
            )
        if self.clock and self.frame_stride % CLOCK_PERIOD == 0:
            raise InputError(
                f"frame_stride is {self.frame_stride}: the clock repeats every {CLOCK_PERIOD} "
                "steps, so it would have the same value in all training frames; use another "
                "stride, or clock=false."
            )
        if self.progress_input and (self.clock or self.privileged or not self.proprioception):
            raise InputError(
                "progress_input needs proprioception and replaces the clock; switch "
                "proprioception on, and clock and privileged off."
            )
        check_at_least(0, weight_decay=self.weight_decay)
        if not self.proprioception_noise >= 0 or self.map_shift < 0:
            raise InputError(
                f"proprioception_noise is {self.proprioception_noise}, map_shift {self.map_shift}; "
                "neither may be below 0."
            )
        if not 0 <= self.map_overlay < 0.5:
            raise InputError(
                f"map_overlay is {self.map_overlay}; give a share from 0 to below 0.5, so that a "
                "map still shows its own frame most."
            )
        if self.proprioception_noise and (self.privileged or not self.proprioception):
            raise InputError(
                "proprioception_noise needs proprioception; switch proprioception on and "
                "privileged off."
            )
        if not 0 <= self.validation < 1:
            raise InputError(f"validation is {self.validation}; give a share from 0 to below 1.")
        if self.retry_after and not self.clock:
            raise InputError(
                f"retry_after is {self.retry_after}, but the policy has no clock that could go on "
                "to the next attempt; leave it at 0, or give clock=true."
            )
        _ = self.pace

    @property
    def pace(self) -> Pace:
        """How fast a policy of this recipe acts."""
        return Pace(
            self.speed, self.jaw_speed, self.pinch_speed, self.clock_speed, self.retry_after
        )


@dataclass(frozen=True)
class Inputs:
    """The inputs of a policy.

    Attributes:
        visual: shape of each view's feature, in the order of the views: (dim,), (C, h, w) or (N,
            C); rows are flattened; empty without images.
        vector: keys of `VECTORS`: the inputs that follow the features, in this order; empty for
            features only.
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
        """Whether a state with the goal is fed, which no robot can report."""
        return not set(self.vector).isdisjoint(names.STATES_WITH_GOAL)

    @property
    def width(self) -> int:
        """Length of the vector fed alongside the features."""
        return sum(VECTORS[key] for key in self.vector)

    @property
    def features(self) -> int:
        """Length of the views' rows, concatenated."""
        return sum(math.prod(shape) for shape in self.visual)

    @property
    def dim(self) -> int:
        """Length of the concatenated input."""
        return self.features + self.width


def visual_shapes(recipe: Recipe, visual: Sequence[tuple[int, ...]]) -> tuple[tuple[int, ...], ...]:
    """Return the shape of each feature that gets its own head.

    Rows of maps are concatenated channel by channel, so joined rows already form one map.

    Args:
        recipe: only its `join_views` is used.
        visual: shape of each view's feature.

    Raises:
        InputError: views are to be joined, but their features are not maps of one size.
    """
    if not recipe.join_views or len(visual) < 2:
        return tuple(visual)
    if any(len(shape) != 3 or shape[1:] != visual[0][1:] for shape in visual):
        raise InputError(
            f"join_views needs feature maps of equal size; these are {tuple(visual)}. Use --pool "
            "spatial, or leave join_views out."
        )
    return ((sum(shape[0] for shape in visual), *visual[0][1:]),)


def fed_vector(recipe: Recipe) -> tuple[str, ...]:
    """Return the keys of `VECTORS` that a recipe feeds alongside the features."""
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
        name: the name by which users select it.
        recipe: frozen dataclass of its settings.
        make: (recipe, shape of each view's feature) → untrained policy.
        target: what it learns: a dataset's column, or one computed from columns:
            `names.STAGE`, `names.ACTION_CHUNK`.
        offsets: recipe → offsets of a chunk's actions, in control steps from the present one; None
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
        inputs: its inputs.
        input_mean: mean of each input over the training frames, (inputs.dim,).
        input_std: standard deviation of each, 1 where an input is constant.
        checkpoint: the checkpoint that a loaded policy was restored from.
        pace: how fast it acts, as its recipe has it.
        denoise: how many images it is shown the mean of, as its recipe has it.
        history: number of observations it sees, the present one last.
        averaging: largest decay of the moving average of its weights in training; the average is
            what is kept. 0 keeps the weights themselves.
        clip: gradient norm limit in training; 0 disables clipping.
    """

    pace: Pace = FULL_SPEED
    denoise: int = 1
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
        """Fit, before the first epoch, what gradients do not; does nothing by default.

        Args:
            target: the demonstrated answers in the training frames, (N, …).
        """

    def calibrate(self, answers: torch.Tensor, target: torch.Tensor) -> None:
        """Fit, after the last epoch, what gradients do not; does nothing by default.

        Args:
            answers: what `forward` returns for the frames held out, (N, n); N at least 1.
            target: the demonstrated answers there, (N, …).
        """

    @final
    def normalise(self, observed: torch.Tensor) -> torch.Tensor:
        """Return raw inputs (B, inputs.dim) standardised by the training frames' statistics."""
        return (observed - self.input_mean).div_(self.input_std)

    @final
    def act(
        self, features: NDArray[np.float32] | None, agent_pos: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return the answers to a batch of observations.

        Args:
            features: (B, `inputs.features`) float32, the views' rows, concatenated; None without
                views.
            agent_pos: (B, 7) float32, x y z [m] roll pitch yaw [rad] jaw [rad] of the active tip in
                its base; or the vector that `inputs.vector` names, if it differs.

        Returns:
            (B, 7) float32 in [-1, 1]; for a high-level policy (B, 5) logits, or (B, 6) with the
            progress last.

        Raises:
            InputError: the shapes differ from those trained on, or a value is not finite.
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
        """Return the copy used to act, on the CPU."""
        return copy.deepcopy(self).cpu().double()

    @final
    def train(self, mode: bool = True) -> "Policy":
        """Switch to training or evaluation mode; `act` then makes a new copy."""
        object.__setattr__(self, "_exact", None)
        super().train(mode)
        return self

    def load_state_dict(
        self, state_dict: Mapping[str, torch.Tensor], strict: bool = True, assign: bool = False
    ) -> tuple[list[str], list[str]]:
        """Load a state; `act` then makes a new copy.

        Returns:
            Missing and unexpected names, as torch returns them.
        """
        object.__setattr__(self, "_exact", None)
        names_left: tuple[list[str], list[str]] = super().load_state_dict(
            state_dict, strict, assign
        )
        return names_left

    def observed(
        self, features: NDArray[np.float32] | None, agent_pos: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """Return the checked inputs, concatenated, (B, inputs.dim) float64; see `act`."""
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
                f"{' + '.join(keys)} must be (batch, {wide}) with one row per image, got "
                f"{agent_pos.shape}."
            )
        if self.inputs.vector:
            parts.append(agent_pos)
        observed = np.concatenate(parts, axis=1).astype(np.float64)
        if not np.isfinite(observed).all():
            raise InputError("The policy was given an observation that is not finite.")
        return observed
