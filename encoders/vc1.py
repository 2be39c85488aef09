"""`vc1`: VC-1, a masked autoencoder's ViT-B/16 of egocentric video (non-commercial weights).

VC-1 resizes to 256 and crops to 224; here the whole image is resized to 224, so that no part of a
view is cut off. The feature is the class token after the last norm.
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

CARD = EncoderCard(
    name="vc1",
    architecture="timm vit_base_patch16_224, class token",
    source="facebook/vc1-base",
    revision="main",
    filename="pytorch_model.bin",
    sha256=None,
    licence="CC-BY-NC-4.0",
    offline=False,
    input_size=224,
    input_range=(0.0, 1.0),
    mean=(0.485, 0.456, 0.406),
    std=(0.229, 0.224, 0.225),
    interpolation="bicubic",
    dim=768,
    paper=(
        "Majumdar et al., Where are we in the search for an Artificial Visual Cortex?, NeurIPS 2023"
    ),
    layers="class and patch tokens after the last norm (tokens), the class token (global)",
    note="No centre crop: the whole image is resized.",
)


def build(card: EncoderCard, path: Path | None) -> "tuple[EncoderCard, nn.Module]":
    """Build the encoder of the autoencoder; its mask token and decoder are left out."""
    import timm

    if path is None:
        raise BadFile(f"Encoder '{card.name}' needs a weights file.")
    tensors = {
        key: value
        for key, value in read_tensors(path).items()
        if key != "mask_token" and not key.startswith(("decoder", "head."))
    }
    network = timm.create_model("vit_base_patch16_224", num_classes=0, global_pool="token")
    load_exactly(network, tensors, path)
    return replace(card, sha256=sha256_file(path)), network


VC1 = Plugin(CARD, build)
