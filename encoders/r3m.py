"""`r3m`: ResNets trained on Ego4D with time contrast and language (Nair et al., CoRL 2022).

R3M takes images in 0–255, divides by 255 and normalises with ImageNet's statistics itself; the card
expresses this as a mean and a standard deviation in units of 0–255.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from encoders.card import EncoderCard, Plugin
from encoders.state import load_exactly, read_tensors
from surgicai_vision.core.errors import BadFile
from surgicai_vision.core.files import sha256_file

if TYPE_CHECKING:
    from torch import nn

PREFIX = "convnet."

CARD = EncoderCard(
    name="r3m",
    architecture="timm resnet50",
    source="surajnair/r3m-50",
    revision="31f0eac",
    filename="pytorch_model.bin",
    sha256="eb7cfd6b5309310738e47da21091faa38c361f6581ce62cd5247eb5b1a14da8a",
    licence="MIT",
    offline=False,
    input_size=224,
    input_range=(0.0, 255.0),
    mean=(0.485 * 255, 0.456 * 255, 0.406 * 255),
    std=(0.229 * 255, 0.224 * 255, 0.225 * 255),
    interpolation="bilinear",
    dim=2048,
    paper="Nair et al., R3M, CoRL 2022",
    layers="layer4 (spatial, tokens), its mean over places (global)",
)


def build(card: EncoderCard, path: Path | None) -> "tuple[EncoderCard, nn.Module]":
    """Build the network from an R3M file; its language and reward heads are left out."""
    import timm

    if path is None:
        raise BadFile(f"Encoder '{card.name}' needs a weights file.")
    named = {key.removeprefix("module."): value for key, value in read_tensors(path).items()}
    tensors = {
        key.removeprefix(PREFIX): value for key, value in named.items() if key.startswith(PREFIX)
    }
    network = timm.create_model(card.architecture.removeprefix("timm "), num_classes=0)
    load_exactly(network, {k: v for k, v in tensors.items() if not k.startswith("fc.")}, path)
    return replace(card, sha256=sha256_file(path)), network


def _smaller(depth: int) -> EncoderCard:
    """Card of R3M with a ResNet of `depth` layers."""
    return replace(
        CARD,
        name=f"r3m-{depth}",
        architecture=f"timm resnet{depth}",
        source=f"surajnair/r3m-{depth}",
        revision="main",
        sha256=None,
        dim=512,
    )


R3M = Plugin(CARD, build)
R3M_34 = Plugin(_smaller(34), build)
R3M_18 = Plugin(_smaller(18), build)
