"""`imagenet-lite-early`: the first three stages of `imagenet-lite`, for `--pool spatial`.

A map of 28 × 28 places still says where a thin needle lies, which the last layer's 7 × 7 and a
global feature lose (docs/results/scene-0.1.md compares), at a third of the whole network's
arithmetic.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from encoders import packaged
from encoders.card import EncoderCard, Plugin
from encoders.state import map_network

if TYPE_CHECKING:
    from torch import nn

STAGES = 3
CHANNELS = 40

CARD = replace(
    packaged.CARD,
    name="imagenet-lite-early",
    architecture="timm tf_efficientnet_lite0, stem and the first three stages",
    dim=CHANNELS,
    batch=2,
    layers="the third stage (spatial, tokens), its mean over places (global)",
    note="Supervised on ImageNet-1k; not an encoder of the paper. Meant for pool 'spatial'.",
)


def early_of(network: "nn.Module") -> "nn.Module":
    """Return the first stages of timm's EfficientNet-Lite0.

    Returns:
        The network (B, 3, 224, 224) → (B, 40), with a map (B, 40, 28, 28).
    """
    blocks = list(network.get_submodule("blocks").children())[:STAGES]
    return map_network(network.get_submodule("conv_stem"), network.get_submodule("bn1"), *blocks)


def build(card: EncoderCard, path: Path | None) -> "tuple[EncoderCard, nn.Module]":
    """Build the network from the packaged file or from `path`."""
    card, network = packaged.build(card, path)
    return card, early_of(network)


IMAGENET_LITE_EARLY = Plugin(CARD, build)
