"""The common base of policies that plan several actions at a time.

A chunk is what `plan` returns: the actions of the present and the next `chunk - 1` control steps.
The first `execute` of them are executed, then the policy plans again. With `ensemble` every action
is the weighted mean over all chunks that contain its step (Zhao et al., Learning fine-grained
bimanual manipulation with low-cost hardware, RSS 2023, Algorithm 2).

Interface:

* `ChunkRecipe`: a recipe with the planning horizon.
* `ChunkPolicy`: abstract. `policy.plan(features (B, h, F) | None, vectors (B, h, n), seed)` →
  (B, chunk, 7) in [-1, 1], for observations of `history` moments h, the present one last.
* A member implements `plan_normalised` and `chunk_loss`. It gets actions normalised over the
  training frames in the way of LeRobot's normalisers, "mean_std" or "min_max" (to [-1, 1]), or as
  they are ("none").

`surgicai_vision.training.chunks` builds the column of chunks;
`surgicai_vision.evaluation.chunk_agent` executes chunks. Members: `bc-chunk`, and LeRobot's `act`,
`diffusion` and `vqbet`, from the distribution `lerobot_env_surgicai`.
"""

import abc
import copy
import json
from dataclasses import dataclass, field
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray

from policies.base import ACTIONS, Inputs, Policy, Recipe, fed_vector
from policies.layers import FeatureHeads
from surgicai_vision.core.config import JSON, LATER
from surgicai_vision.core.errors import InputError, check_at_least, check_at_most, check_name, shown

NORMALISATIONS = ("mean_std", "min_max", "none")
MOST_PLANNED = 1_000
"""Maximum actions of a chunk, moments of a history and samples per plan: a whole procedure."""
SMALLEST_RANGE = 1e-6
"""An action that varies less counts as constant, and only its offset is removed."""


@dataclass(frozen=True)
class ChunkRecipe(Recipe):
    """Settings of a policy that plans chunks.

    Attributes:
        chunk: actions planned at a time [control steps].
        execute: how many of them are executed before the next plan.
        history: number of observations seen, the present one last, `frame_stride` control steps
            apart.
        samples: chunks that a sampling policy draws per plan; their mean is executed.
        ensemble: average overlapping chunks with the weights exp(-ensemble · i), i = 0 for the
            oldest; None executes only the newest.
        measure_delay: measure how late actions take effect, and execute of each plan the action
            that is due by then (`evaluation.delay`); needs a chunk longer than the delay.
        ema: largest decay of the moving average of the weights; 0 keeps the last weights.
        clip_gradient: gradient norm limit; 0 disables clipping.
        minutes: train for as many epochs as fit into this many minutes of one core, instead of
            `epochs`; 0 uses `epochs`.
        settings: fields of the network's own configuration.
    """

    batch_norm: bool = False
    chunk: int = 25
    execute: int = 10
    history: int = 1
    samples: int = 1
    ensemble: float | None = None
    ema: float = 0.0
    clip_gradient: float = 0.0
    minutes: float = 0.0
    settings: dict[str, JSON] = field(default_factory=dict)
    measure_delay: bool = field(default=False, metadata=LATER)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.execute <= self.chunk:
            raise InputError(f"execute is {self.execute}; allowed: 1 to chunk, {self.chunk}.")
        check_at_least(1, history=self.history, samples=self.samples)
        check_at_most(MOST_PLANNED, chunk=self.chunk, history=self.history, samples=self.samples)
        if not 0 <= self.ema < 1:
            raise InputError(f"ema is {self.ema}; allowed: 0 to below 1.")
        if not (self.clip_gradient >= 0 and self.minutes >= 0):
            raise InputError(
                f"clip_gradient is {self.clip_gradient}, minutes {self.minutes}; at least 0."
            )
        for name, value in self.settings.items():
            if not _is_plain(value):
                raise InputError(f"settings: {name} is {shown(value)}; give plain, finite data.")
        if not self.proprioception and not self.privileged:
            raise InputError("A policy that plans chunks needs proprioception; keep it on.")


def planned_offsets(recipe: Recipe) -> range:
    """Return the offsets of a chunk's actions that begin with the present one."""
    assert isinstance(recipe, ChunkRecipe)
    return range(recipe.chunk)


def _is_plain(value: object) -> bool:
    """Return True for what JSON can hold; a YAML file may also hold dates and infinite numbers."""
    try:
        json.dumps(value, allow_nan=False, sort_keys=True)  # keys of several types have no order
    except (TypeError, ValueError):
        return False
    return True


class ChunkPolicy(Policy, abc.ABC):
    """Base of the policies that plan chunks.

    Args:
        recipe: its settings.
        visual: shape of each view's feature.
        normalisation: how actions are normalised, one of `NORMALISATIONS`.
        sets: how many heads each feature gets, for as many networks side by side.

    Attributes:
        chunk, execute, samples, ensemble, measure_delay: as in the recipe.
        spacing: control steps from one observation of the history to the next.
        heads: the heads for the features.
    """

    action_centre: torch.Tensor
    action_scale: torch.Tensor

    def __init__(
        self,
        recipe: ChunkRecipe,
        visual: tuple[tuple[int, ...], ...],
        normalisation: str,
        sets: int = 1,
    ):
        super().__init__(Inputs(visual, fed_vector(recipe)))
        check_name("normalisation", normalisation, NORMALISATIONS)
        self.history = recipe.history
        self.averaging = recipe.ema
        self.clip = recipe.clip_gradient
        self.chunk = recipe.chunk
        self.execute = recipe.execute
        self.samples = recipe.samples
        self.ensemble = recipe.ensemble
        self.measure_delay = recipe.measure_delay
        self.spacing = recipe.frame_stride
        self.heads = FeatureHeads(recipe, self.inputs, sets)
        self._normalisation = normalisation
        self.register_buffer("action_centre", torch.zeros(ACTIONS))
        self.register_buffer("action_scale", torch.ones(ACTIONS))

    @abc.abstractmethod
    def plan_normalised(self, visual: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        """Return normalised actions (B, at least chunk, 7), from the present step on.

        Args:
            visual: output of the heads, (B, history, heads.dim).
            vector: the inputs other than features, normalised, (B, history, n).
        """

    @abc.abstractmethod
    def chunk_loss(
        self,
        visual: torch.Tensor,
        vector: torch.Tensor,
        actions: torch.Tensor,
        is_pad: torch.Tensor,
    ) -> torch.Tensor:
        """Return the loss (scalar).

        Args:
            visual, vector: as in `plan_normalised`.
            actions: demonstrated and normalised, (B, T, 7), at the plug-in's `offsets`.
            is_pad: (B, T) bool: where the demonstration has no such step.
        """

    def measure(self, target: torch.Tensor) -> None:
        """Store the statistics of the actions over the training frames; target (N, T, 8)."""
        if self._normalisation == "none":
            return
        actions = target[..., :ACTIONS][target[..., ACTIONS] == 0].double()
        if self._normalisation == "mean_std":
            centre = actions.mean(0)
            scale = actions.std(0, correction=0)
        else:
            low = actions.amin(0)
            high = actions.amax(0)
            centre = (low + high) / 2
            scale = (high - low) / 2
        self.action_centre.copy_(centre)
        self.action_scale.copy_(torch.where(scale > SMALLEST_RANGE, scale, torch.ones_like(scale)))

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return the first planned actions (B, 7) for normalised inputs (B, [history,] dim)."""
        with torch.random.fork_rng(devices=_cuda_of(observed)):
            torch.manual_seed(0)
            return self._chunks(observed)[:, 0]

    def loss(self, observed: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the loss for normalised inputs (B, [history,] dim) and chunks (B, T, 8)."""
        visual, vector = self._seen(observed)
        actions = (target[..., :ACTIONS] - self.action_centre) / self.action_scale
        return self.chunk_loss(visual, vector, actions, target[..., ACTIONS] > 0)

    @final
    @torch.inference_mode()
    def plan(
        self,
        features: NDArray[np.float32] | None,
        vectors: NDArray[np.float32],
        seed: int,
    ) -> NDArray[np.float32]:
        """Return the chunks of a batch of histories.

        Args:
            features: (B, history, `inputs.features`); None without views.
            vectors: (B, history, n), the inputs that `inputs.vector` names.
            seed: seed of the draws of a sampling policy.

        Returns:
            (B, chunk, 7) float32 in [-1, 1].

        Raises:
            InputError: the shapes differ from those trained on, or a value is not finite.
        """
        if vectors.shape[1:2] != (self.history,):
            raise InputError(
                f"The policy sees {self.history} observations at a time, got vectors of "
                f"{vectors.shape}."
            )
        flat = self.observed(
            None if features is None else features.reshape(-1, features.shape[-1]),
            vectors.reshape(-1, vectors.shape[-1]),
        )
        observed = torch.from_numpy(flat).to(self.input_mean).unflatten(0, (-1, self.history))
        with torch.random.fork_rng(devices=_cuda_of(self.input_mean)):
            torch.manual_seed(seed)
            chunks = self._chunks(self.normalise(observed))
        return np.asarray(chunks.cpu().numpy(), np.float32)

    def _chunks(self, observed: torch.Tensor) -> torch.Tensor:
        """Return chunks (B, chunk, 7) in [-1, 1] for normalised inputs (B, [history,] dim)."""
        visual, vector = self._seen(observed.to(self.input_mean.dtype))
        drawn = self.plan_normalised(
            visual.repeat_interleave(self.samples, 0), vector.repeat_interleave(self.samples, 0)
        )
        planned: torch.Tensor = drawn.unflatten(0, (-1, self.samples)).mean(1)
        actions = planned[:, : self.chunk] * self.action_scale + self.action_centre
        return actions.clamp(-1.0, 1.0)

    def _seen(self, observed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the heads' output and the vector, both (B, history, …)."""
        if observed.ndim == 2:  # a single moment, repeated as its own history
            observed = observed[:, None].expand(-1, self.history, -1)
        visual, vector = self.heads(observed.flatten(0, 1))
        moments = observed.shape[:2]
        return visual.unflatten(0, moments), vector.unflatten(0, moments)

    def _copy_to_act(self) -> Policy:
        """Return the copy used to act, in training precision: samplers support no other."""
        return copy.deepcopy(self).cpu()


def _cuda_of(tensor: torch.Tensor) -> list[torch.device]:
    """Return the CUDA devices whose random state a computation on `tensor` draws from."""
    return [tensor.device] if tensor.device.type == "cuda" else []
