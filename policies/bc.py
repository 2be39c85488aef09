"""`bc`: behaviour cloning, the paper's low-level policy.

The recipe `paper` (paper, Section 4 and appendix): an MLP of three hidden layers of 256, each preceded by
BatchNorm, ReLU between, Tanh at the end; mean squared error; Adam, 1e-3, 30 epochs, batches of 256; visual
features beside the active arm's tip pose and jaw; training and validation split by episode.

A global feature (the paper's) enters as it is; a feature map passes a trained spatial softmax, and tokens a
trained attention, before the MLP.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import final

import torch
from torch import nn

from policies.base import ACTIONS, Inputs, Plugin, Policy
from surgicai_vision.errors import InputError, check_name

POINTS = 32  # patterns of a spatial softmax (Levine et al., End-to-end visuomotor policies, JMLR 2016)


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
    """

    hidden: tuple[int, ...] = (256, 256, 256)
    batch_norm: bool = True
    learning_rate: float = 1e-3
    epochs: int = 30
    batch_size: int = 256
    split: str = "episode"
    validation: float = 0.1
    proprioception: bool = True

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


@final
class GlobalFeature(nn.Module):
    """A global feature, taken as it is."""

    def __init__(self, dim: int):
        super().__init__()
        self.dim = dim

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Return (B, dim) as given."""
        return rows


@final
class SpatialSoftmax(nn.Module):
    """A trained spatial softmax: where in the picture each of `POINTS` learned patterns lies, in [-1, 1]."""

    def __init__(self, channels: int, height: int, width: int):
        super().__init__()
        self.shape = (channels, height, width)
        self.dim = 2 * POINTS
        self.patterns = nn.Conv2d(channels, POINTS, 1)
        y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
        self.register_buffer("places", torch.stack([x.flatten(), y.flatten()], dim=1), persistent=False)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the expected x and y of each pattern, (B, 2 · POINTS), for flattened maps (B, C·h·w)."""
        scores = self.patterns(rows.unflatten(1, self.shape)).flatten(2).softmax(dim=2)
        return (scores @ self.places).flatten(1)


@final
class TokenAttention(nn.Module):
    """A trained attention over tokens: one learned query chooses what to average."""

    def __init__(self, tokens: int, channels: int):
        super().__init__()
        self.shape = (tokens, channels)
        self.dim = channels
        self.query = nn.Linear(channels, 1)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the weighted mean token (B, C) for flattened tokens (B, N·C)."""
        tokens = rows.unflatten(1, self.shape)
        return (self.query(tokens).softmax(dim=1) * tokens).sum(dim=1)


HEADS: Mapping[int, Callable[..., GlobalFeature | SpatialSoftmax | TokenAttention]] = {
    1: GlobalFeature,
    3: SpatialSoftmax,
    2: TokenAttention,
}
"""Number of axes of a view's feature → the layer that takes it in."""


def _head(shape: tuple[int, ...]) -> GlobalFeature | SpatialSoftmax | TokenAttention:
    """Return the first layer for a feature of `shape`."""
    if len(shape) not in HEADS:
        raise InputError(f"A feature of shape {shape} cannot be taken in; allowed are (dim,), (C, h, w) and (N, C).")
    return HEADS[len(shape)](*shape)


@final
class BCPolicy(Policy):
    """The MLP of behaviour cloning."""

    def __init__(self, recipe: BCRecipe, visual: tuple[tuple[int, ...], ...]):
        super().__init__(Inputs(visual, recipe.proprioception))
        heads = [_head(shape) for shape in visual]
        self.heads = nn.ModuleList(heads)
        layers: list[nn.Module] = []
        width = sum(head.dim for head in heads) + self.inputs.dim - self.inputs.features
        for hidden in recipe.hidden:
            layers += [nn.BatchNorm1d(width)] if recipe.batch_norm else []
            layers += [nn.Linear(width, hidden), nn.ReLU()]
            width = hidden
        self.layers = nn.Sequential(*layers, nn.Linear(width, ACTIONS), nn.Tanh())

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return actions (B, 7) in [-1, 1] for normalised inputs."""
        sizes = [math.prod(shape) for shape in self.inputs.visual]
        *rows, state = observed.split([*sizes, self.inputs.dim - self.inputs.features], dim=1)
        seen = [head(row) for head, row in zip(self.heads, rows, strict=True)]
        return self.layers(torch.cat([*seen, state], dim=1))

    def loss(self, observed: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Return the mean squared error of the actions."""
        return nn.functional.mse_loss(self(observed), action)


BC = Plugin("bc", BCRecipe, BCPolicy)
