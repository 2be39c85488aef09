"""`random`: the paper's control, a randomly initialised ResNet-50.

The same seed gives the same network. The initialisation is torchvision's (He normal, fan out;
BatchNorm at scale 1 and shift 0). timm's default would start the last BatchNorm of each block at
scale 0, which switches every residual branch off.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from encoders.card import EncoderCard, Plugin
from surgicai_vision.core.errors import InputError

if TYPE_CHECKING:
    from torch import nn

SEED = 0

CARD = EncoderCard(
    name="random",
    architecture="timm resnet50, zero_init_last=False",
    source="seed",
    revision=str(SEED),
    filename=None,
    sha256=None,
    licence="MIT",
    offline=True,
    input_size=224,
    input_range=(0.0, 1.0),
    mean=(0.485, 0.456, 0.406),
    std=(0.229, 0.224, 0.225),
    interpolation="bilinear",
    dim=2048,
    paper="SurgicAI, NeurIPS 2024, Table 2 (random)",
    layers="layer4 (spatial, tokens), its mean over places (global)",
    note="Never trained. Its weights hash is recorded with every checkpoint.",
)


def build(card: EncoderCard, path: Path | None) -> "tuple[EncoderCard, nn.Module]":
    """Build the network from its seed; the global random state is left as it was."""
    import timm
    import torch

    if path is not None:
        raise InputError(
            f"Encoder 'random' takes no weights file, got {path}; leave --weights out."
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(card.revision))
        network = timm.create_model("resnet50", num_classes=0, zero_init_last=False)
    return card, network


RANDOM = Plugin(CARD, build)
