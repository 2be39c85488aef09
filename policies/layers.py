"""Layers that the policies share: the head of each kind of feature, and the paper's MLP.

A global feature (the paper's) enters the MLP as it is. A feature map first passes through a trained
spatial softmax, trained convolutions or both, tokens through a trained attention.
"""

import math
from collections.abc import Callable, Mapping
from typing import final

import torch
from torch import nn

from policies.base import Inputs, Recipe, visual_shapes
from surgicai_vision.core.errors import InputError

POINTS = 32
"""Patterns of a spatial softmax (Levine et al., End-to-end visuomotor policies, JMLR 2016)."""
WIDTH = 32
"""Channels of the trained convolutions over a map."""
FLAT = 0.05
"""Variance that instance normalisation adds to each channel's own.

Inputs have variance 1 over all images and places. Without this, the noise of a channel that shows
nothing in an image would be scaled up to that variance.
"""


@final
class GlobalFeature(nn.Module):
    """A head that passes a global feature on unchanged."""

    def __init__(self, dim: int):
        super().__init__()
        self.dim = dim

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Return (B, dim) as given."""
        return rows


@final
class SpatialSoftmax(nn.Module):
    """A trained spatial softmax: the image position of each of `POINTS` learned patterns."""

    places: torch.Tensor

    def __init__(self, channels: int, height: int, width: int):
        super().__init__()
        self.shape = (channels, height, width)
        self.dim = 2 * POINTS
        self.patterns = nn.Conv2d(channels, POINTS, 1)
        self.register_buffer("places", _places(height, width), persistent=False)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the expected position of each pattern for flattened maps (B, C·h·w).

        Returns:
            (B, 2 · POINTS): x and y in [-1, 1].
        """
        return _expected(self.patterns(rows.unflatten(1, self.shape)), self.places)


def _places(height: int, width: int) -> torch.Tensor:
    """Return x and y in [-1, 1] of each place of a map, row by row, (height · width, 2)."""
    y, x = torch.meshgrid(
        torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij"
    )
    return torch.stack([x.flatten(), y.flatten()], dim=1)


def _expected(scores: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Return the expected place of each pattern, (B, 2 · POINTS), from scores (B, POINTS, h, w)."""
    expected: torch.Tensor = scores.flatten(2).softmax(dim=2) @ places
    return expected.flatten(1)


def _halved(
    shape: tuple[int, int, int], smallest: int
) -> tuple[list[nn.Module], tuple[int, int, int]]:
    """Return trained convolutions that halve a map, and the shape (C, h, w) of what is left.

    Args:
        shape: (C, h, w) of the map.
        smallest: it is halved until neither side has more places than this.
    """
    channels, height, width = shape
    layers: list[nn.Module] = []
    while max(height, width) > smallest:
        layers += [nn.Conv2d(channels, WIDTH, 3, stride=2, padding=1), nn.ReLU()]
        channels = WIDTH
        height = (height + 1) // 2
        width = (width + 1) // 2
    return layers, (channels, height, width)


@final
class MapConvolutions(nn.Module):
    """Trained convolutions over a map, reduced to `FEATURES` numbers.

    The map is halved until at most 7 × 7 places are left. Convolutions see the needle's arc as a
    whole, whereas a softmax's 1 × 1 patterns see one place at a time.
    """

    FEATURES = 64
    SMALLEST = 7

    def __init__(self, channels: int, height: int, width: int):
        super().__init__()
        self.shape = (channels, height, width)
        self.dim = self.FEATURES
        layers, (channels, height, width) = _halved(self.shape, self.SMALLEST)
        self.layers = nn.Sequential(
            *layers, nn.Flatten(), nn.Linear(channels * height * width, self.FEATURES), nn.ReLU()
        )

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Return (B, `FEATURES`) for flattened maps (B, C·h·w)."""
        # The convolution would copy a slice of wider rows, and again in the backward pass.
        numbers: torch.Tensor = self.layers(rows.unflatten(1, self.shape).contiguous())
        return numbers


@final
class Keypoints(nn.Module):
    """Trained convolutions over a map, then the position of each of `POINTS` patterns.

    The map is halved until at most 14 × 14 places are left. Unlike those of a spatial softmax, its
    patterns see the needle's arc as a whole; unlike numbers of convolutions, positions of its tip
    and of a hole mean the same for a needle of another size (docs/results/unmoved-trials.md).
    """

    SMALLEST = 14
    places: torch.Tensor

    def __init__(self, channels: int, height: int, width: int):
        super().__init__()
        self.shape = (channels, height, width)
        self.dim = 2 * POINTS
        layers, (channels, height, width) = _halved(self.shape, self.SMALLEST)
        layers += [nn.Conv2d(channels, WIDTH, 3, padding=1), nn.ReLU()]
        self.patterns = nn.Sequential(*layers, nn.Conv2d(WIDTH, POINTS, 3, padding=1))
        self.register_buffer("places", _places(height, width), persistent=False)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the expected position of each pattern for flattened maps (B, C·h·w).

        Returns:
            (B, 2 · POINTS): x and y in [-1, 1].
        """
        # The convolution would copy a slice of wider rows, and again in the backward pass.
        return _expected(self.patterns(rows.unflatten(1, self.shape).contiguous()), self.places)


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
        weights: torch.Tensor = self.query(tokens).softmax(dim=1)
        mean: torch.Tensor = (weights * tokens).sum(dim=1)
        return mean


Head = GlobalFeature | SpatialSoftmax | MapConvolutions | Keypoints | TokenAttention
MAP_HEADS: Mapping[str, Callable[..., Head]] = {
    "softmax": SpatialSoftmax,
    "convolutions": MapConvolutions,
    "keypoints": Keypoints,
}
"""`Recipe.map_head` → the head for a feature map."""


def _head(shape: tuple[int, ...], map_head: str) -> Head:
    """Return the head for a feature of `shape`."""
    heads: Mapping[int, Callable[..., Head]] = {
        1: GlobalFeature,
        2: TokenAttention,
        3: MAP_HEADS[map_head],
    }
    if len(shape) not in heads:
        raise InputError(
            f"A feature of shape {shape} cannot be used; allowed are (dim,), (C, h, w) and (N, C)."
        )
    return heads[len(shape)](*shape)


def _normalised(rows: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
    """Return flattened maps with each channel standardised over its places.

    Args:
        rows: (B, C·h·w).
        shape: (C, h, w); rows of any other feature are returned as they are.
    """
    if len(shape) != 3:
        return rows
    return nn.functional.instance_norm(rows.unflatten(1, shape), eps=FLAT).flatten(1)


class _Heads(nn.Module):
    """The head of each feature.

    Args:
        recipe: its `join_views`, `map_head` and `instance_norm` are used.
        inputs: the layout of the inputs.
        sets: how many heads each feature gets, for as many networks side by side.

    Attributes:
        inputs: the layout of the inputs.
        sets: how many heads each feature has.
        shapes: shape of each feature that has its own heads.
        dim: length of the heads' output, 0 without images.
        instance_norm: whether the heads see maps after instance normalisation.
    """

    def __init__(self, recipe: Recipe, inputs: Inputs, sets: int = 1):
        super().__init__()
        self.inputs = inputs
        self.sets = sets
        self.shapes = visual_shapes(recipe, inputs.visual)
        self.instance_norm = recipe.instance_norm
        heads = [_head(shape, recipe.map_head) for _ in range(sets) for shape in self.shapes]
        self.heads = nn.ModuleList(heads)
        self.dim = sum(head.dim for head in heads)

    def outputs(self, observed: torch.Tensor) -> tuple[list[torch.Tensor], torch.Tensor]:
        """Return each head's output, (B, head.dim), and the vector fed with the features, (B, n).

        The outputs of the first set of heads come first.

        Args:
            observed: normalised inputs (B, inputs.dim).
        """
        sizes = [math.prod(shape) for shape in self.shapes]
        *rows, vector = observed.split([*sizes, self.inputs.width], dim=1)
        if self.instance_norm:
            rows = [_normalised(row, of) for row, of in zip(rows, self.shapes, strict=True)]
        fed = rows * self.sets
        return [head(row) for head, row in zip(self.heads, fed, strict=True)], vector


@final
class FeatureHeads(_Heads):
    """Only the head of each feature, for policies that add their own network."""

    def forward(self, observed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the heads' output, (B, dim), and the vector fed with the features, (B, n).

        Args:
            observed: normalised inputs (B, inputs.dim).
        """
        seen, vector = self.outputs(observed)
        return torch.cat(seen, dim=1) if seen else vector[:, :0], vector


def mlp(recipe: Recipe, width: int, answers: int) -> nn.Sequential:
    """Return the paper's layers, each preceded by BatchNorm: (B, width) → (B, answers)."""
    layers: list[nn.Module] = []
    for hidden in recipe.hidden:
        layers += [nn.BatchNorm1d(width)] if recipe.batch_norm else []
        layers += [nn.Linear(width, hidden), nn.ReLU()]
        width = hidden
    return nn.Sequential(*layers, nn.Linear(width, answers))


@final
class FeatureMLP(_Heads):
    """The paper's network on features and a vector.

    Attributes:
        width: length of the heads' output concatenated with the vector.
    """

    def __init__(self, recipe: Recipe, inputs: Inputs, answers: int):
        super().__init__(recipe, inputs)
        self.width = self.dim + inputs.width
        self.layers = mlp(recipe, self.width, answers)

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return (B, answers) for normalised inputs (B, inputs.dim)."""
        answers: torch.Tensor = self.layers(self.seen(observed))
        return answers

    def seen(self, observed: torch.Tensor) -> torch.Tensor:
        """Return the heads' output concatenated with the vector, (B, width)."""
        seen, vector = self.outputs(observed)
        return torch.cat([*seen, vector], dim=1)
