"""`clip`: OpenAI's CLIP image towers through open_clip (ViT-B/32 as in the released code; RN50).

The feature is the projected image embedding before it is scaled to unit length. OpenAI's own `.pt`
files are TorchScript archives, which `weights_only` cannot read; they are opened as such only when
their hash is the published one.
"""

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from encoders.card import EncoderCard, Plugin
from encoders.state import load_exactly, read_tensors
from surgicai_vision.core.errors import BadFile
from surgicai_vision.core.files import sha256_file

if TYPE_CHECKING:
    import torch
    from torch import nn

PREFIX = "visual."

CARD = EncoderCard(
    name="clip",
    architecture="open_clip ViT-B-32, QuickGELU",
    source="timm/vit_base_patch32_clip_224.openai",
    revision="a6f597a30f7b82c51704746581f9a4e41421e878",
    filename="open_clip_model.safetensors",
    sha256="e6d1bd7789aa45192b3bf90570a789b478bae1b74ebcce7eddd908e83a2b7c31",
    licence="MIT",
    offline=False,
    input_size=224,
    input_range=(0.0, 1.0),
    mean=(0.48145466, 0.4578275, 0.40821073),
    std=(0.26862954, 0.26130258, 0.27577711),
    interpolation="bicubic",
    dim=512,
    paper="Radford et al., CLIP, ICML 2021",
    layers="the projected image embedding (global)",
)
RN50 = replace(
    CARD,
    name="clip-rn50",
    architecture="open_clip RN50, QuickGELU",
    source="timm/resnet50_clip.openai",
    revision="ec3d92cf63a5f9d591f0d611b736895966c73076",
    sha256="da0baa37fb2211eee5729ab69ed587eb10d48f5b7076ceeed01552fc3d4cb4ee",
    dim=1024,
)

ARCHIVES = MappingProxyType(
    {
        "ViT-B-32.pt": "40d365715913c9da98579312b702a82c18be219cc2a73407c4526f58eba950af",
        "RN50.pt": "afeb0e10f9e5a86da6080e35cf09123aca3b358a0c3e3b6c78a7b63bc04b6762",
    }
)
"""OpenAI's TorchScript archives, filename → sha256."""


def build(card: EncoderCard, path: Path | None) -> "tuple[EncoderCard, nn.Module]":
    """Build the image tower; the text tower is left out."""
    import logging

    import open_clip
    import torch

    if path is None:
        raise BadFile(f"Encoder '{card.name}' needs a weights file.")
    tensors = {
        key.removeprefix(PREFIX): value.float()
        for key, value in _read(path).items()
        if key.startswith(PREFIX)
    }
    name = card.architecture.removeprefix("open_clip ").partition(",")[0]
    level = logging.root.level
    logging.root.setLevel(logging.ERROR)  # open_clip warns that it loads no weights; we load them
    try:
        with torch.random.fork_rng(devices=[]):
            network = open_clip.create_model(name, load_weights=False, force_quick_gelu=True).visual
    finally:
        logging.root.setLevel(level)
    load_exactly(network, tensors, path)
    return replace(card, sha256=sha256_file(path)), network


def _read(path: Path) -> "dict[str, torch.Tensor]":
    """Read a weights file, or one of OpenAI's archives by its hash."""
    import torch

    if path.suffix == ".pt" and sha256_file(path) in ARCHIVES.values():
        return dict(torch.jit.load(path, map_location="cpu").state_dict())
    return read_tensors(path)


CLIP = Plugin(CARD, build, MappingProxyType({"ViT-B-32.pt": ARCHIVES["ViT-B-32.pt"]}))
CLIP_RN50 = Plugin(RN50, build, MappingProxyType({"RN50.pt": ARCHIVES["RN50.pt"]}))
