"""`imagenet-lite-smooth`: `imagenet-lite-early` behind a Gaussian, for noisy cameras.

The first convolutions of a network respond to edges, and mistake a camera's pixel noise for them.
The Gaussian of 1.5 px divides the noise's standard deviation by five (2 √π · 1.5) but keeps the
edges of a needle, which is about five pixels thick in a crop. docs/results/unmoved.md has results.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from encoders.card import EncoderCard, Plugin
from encoders.packaged import EARLY_CARD, build_behind

if TYPE_CHECKING:
    from torch import nn

SIGMA = 1.5
"""Standard deviation of the Gaussian [px of 224]."""
RADIUS = 5
"""Half width of its kernel [px]: what lies beyond holds less than .001 of its weight."""

CARD = replace(
    EARLY_CARD,
    name="imagenet-lite-smooth",
    architecture=f"Gaussian of {SIGMA} px, {EARLY_CARD.architecture}",
    note="Supervised on ImageNet-1k; not an encoder of the paper. Pool 'spatial'; noisy cameras.",
)


def smoothing() -> "list[nn.Module]":
    """Return a Gaussian down the image and one across it, (B, 3, H, W) → (B, 3, H, W)."""
    import torch
    from torch import nn

    places = torch.arange(-RADIUS, RADIUS + 1, dtype=torch.float32)
    weights = torch.exp(-0.5 * (places / SIGMA) ** 2)
    weights /= weights.sum()
    layers: list[nn.Module] = []
    for shape in ((2 * RADIUS + 1, 1), (1, 2 * RADIUS + 1)):
        layer = nn.Conv2d(
            3,
            3,
            shape,
            padding=(shape[0] // 2, shape[1] // 2),
            padding_mode="reflect",
            groups=3,
            bias=False,
        )
        with torch.no_grad():
            layer.weight.copy_(weights.reshape(1, 1, *shape).expand_as(layer.weight))
        layers.append(layer)
    return layers


def build(card: EncoderCard, path: Path | None) -> "tuple[EncoderCard, nn.Module]":
    """Build the network (B, 3, 224, 224) → (B, 40), with a map (B, 40, 28, 28)."""
    return build_behind(smoothing(), card, path)


IMAGENET_LITE_SMOOTH = Plugin(CARD, build)
