"""`random-conv`: four convolutions that were never trained, for `--pool spatial`.

A map of 28 × 28 places preserves where things are, which a global feature loses, at a fiftieth of a
ResNet-50's arithmetic. Random filters followed by a trained selection of their responses are an old
and strong baseline for images from one scene (Jarrett et al., What is the best multi-stage
architecture for object recognition?, 2009).
"""

from pathlib import Path
from typing import TYPE_CHECKING

from encoders.card import EncoderCard, Plugin
from encoders.state import map_network
from surgicai_vision.core.errors import InputError

if TYPE_CHECKING:
    from torch import nn

SEED = 0
WIDTHS = (24, 32, 48, 48)
KERNELS = (5, 3, 3, 3)
STRIDES = (2, 2, 2, 1)

CARD = EncoderCard(
    name="random-conv",
    architecture="four convolutions with ReLU, strides 2 2 2 1",
    source="seed",
    revision=str(SEED),
    filename=None,
    sha256=None,
    licence="MIT",
    offline=True,
    input_size=224,
    input_range=(0.0, 255.0),
    mean=(127.0, 127.0, 127.0),
    std=(64.0, 64.0, 64.0),
    interpolation="bilinear",
    dim=WIDTHS[-1],
    paper="not one of SurgicAI's",
    layers="the fourth convolution (spatial, tokens), its mean over places (global)",
    note=(
        "Never trained; meant for pool 'spatial'. "
        "Its weights hash is recorded with every checkpoint."
    ),
)


def network_from(seed: int) -> "nn.Module":
    """Build the network; the global random state stays as it was.

    Returns:
        The network (B, 3, 224, 224) → (B, 48), with a map (B, 48, 28, 28).
    """
    import torch
    from torch import nn

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers: list[nn.Module] = []
        channels = 3
        for width, kernel, stride in zip(WIDTHS, KERNELS, STRIDES, strict=True):
            layer = nn.Conv2d(channels, width, kernel, stride, kernel // 2)
            nn.init.kaiming_normal_(layer.weight)
            torch.nn.init.constant_(layer.get_parameter("bias"), 0.0)
            layers += [layer, nn.ReLU()]
            channels = width
    return map_network(*layers)


def build(card: EncoderCard, path: Path | None) -> "tuple[EncoderCard, nn.Module]":
    """Build the network from its seed."""
    if path is not None:
        raise InputError(
            f"Encoder 'random-conv' takes no weights file, got {path}; leave --weights out."
        )
    return card, network_from(int(card.revision))


RANDOM_CONV = Plugin(CARD, build)
