"""`dinov2`, `siglip2` and `timm:<name>`: any timm network with its own weights and statistics.

`timm:<name>` takes the card from timm's own table, the licence included; the feature is timm's
pooled output without a classifier.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from encoders.card import EncoderCard, Plugin
from encoders.state import DAMAGED
from surgicai_vision.core.errors import BadFile, UnknownName
from surgicai_vision.core.files import sha256_file

if TYPE_CHECKING:
    from torch import nn

PREFIX = "timm:"

DINOV2_CARD = EncoderCard(
    name="dinov2",
    architecture="timm vit_small_patch14_dinov2.lvd142m",
    source="timm/vit_small_patch14_dinov2.lvd142m",
    revision="4610ca143709d58a633b6397a74412c2c3842454",
    filename="model.safetensors",
    sha256="04d27f3400d059fc0cfd7d17dd1909a75bf3ea8fb3eeb48b97cb99e57ee20081",
    licence="Apache-2.0",
    offline=False,
    input_size=224,
    input_range=(0.0, 1.0),
    mean=(0.485, 0.456, 0.406),
    std=(0.229, 0.224, 0.225),
    interpolation="bicubic",
    dim=384,
    paper="Oquab et al., DINOv2, TMLR 2024",
    layers="class and patch tokens after the last norm (tokens), the class token (global)",
    note="Position embeddings are resampled from 518 px to 224 px; the feature is the class token.",
)
SIGLIP2_CARD = replace(
    DINOV2_CARD,
    name="siglip2",
    architecture="timm vit_base_patch16_siglip_224.v2_webli",
    source="timm/vit_base_patch16_siglip_224.v2_webli",
    revision="4c3661e5ac879a276ddc5ddc6d3f0ecc78fd5d82",
    sha256="9106b0d8d9d02ea90fc3571fffd1557cf444736f695ee40b1e57c856bc3d9494",
    mean=(0.5, 0.5, 0.5),
    std=(0.5, 0.5, 0.5),
    dim=768,
    paper="Tschannen et al., SigLIP 2, 2025",
    layers="patch tokens after the last norm (tokens), their attention pool (global)",
    note="The feature is the attention-pooled embedding.",
)


def build(card: EncoderCard, path: Path | None) -> "tuple[EncoderCard, nn.Module]":
    """Build the network by timm's own loader, which reads torch files with `weights_only`."""
    import timm
    import torch

    if path is None:
        raise BadFile(f"Encoder '{card.name}' needs a weights file.")
    name = card.architecture.removeprefix("timm ")
    # Only networks with position embeddings take, as an argument, an image size other than that of
    # their training.
    resized = {} if card.input_size == _trained_size(name) else {"img_size": card.input_size}
    with torch.random.fork_rng(devices=[]):
        try:
            network = timm.create_model(
                name,
                pretrained=True,
                pretrained_cfg_overlay={"file": str(path)},
                num_classes=0,
                **resized,
            )
        except DAMAGED as error:
            reason = " ".join(str(error).split())[:160]
            raise BadFile(
                f"{path} does not hold the weights of timm's {name} ({reason})."
            ) from None
    return replace(card, sha256=sha256_file(path)), network


def _trained_size(name: str) -> int:
    """Side of the images a timm network was trained on [px]."""
    import timm

    return int(timm.get_pretrained_cfg(name).input_size[-1])


def plugin_for(name: str) -> Plugin:
    """Return the plug-in of `timm:<name>`, its card made from timm's table.

    Raises:
        UnknownName: a network timm has no pretrained weights for.
    """
    import timm

    model = name.removeprefix(PREFIX)
    known = timm.list_pretrained()
    if model not in known and model not in timm.list_models(pretrained=True):
        near = [other for other in known if other.startswith(model[:6])][:20] or [
            "resnet18.a1_in1k"
        ]
        raise UnknownName("timm network (a few of timm.list_pretrained() follow)", model, near)
    config = timm.get_pretrained_cfg(model)
    with_tag = f"{config.architecture}.{config.tag}" if config.tag else config.architecture
    card = EncoderCard(
        name=name,
        architecture=f"timm {with_tag}",
        source=str(config.hf_hub_id),
        revision="main",
        filename=config.hf_hub_filename or "model.safetensors",
        sha256=None,
        licence=config.license or "unknown",
        offline=False,
        input_size=int(config.input_size[-1]),
        input_range=(0.0, 1.0),
        mean=tuple(config.mean),
        std=tuple(config.std),
        interpolation="bilinear" if config.interpolation == "bilinear" else "bicubic",
        dim=_dim(with_tag),
        layers="timm's forward_features (spatial or tokens) and its own pooling (global)",
        paper=config.paper_name or config.paper_ids or f"timm {with_tag}",
    )
    return Plugin(card, build)


def _dim(name: str) -> int:
    """Length of a timm network's pooled feature, from its structure alone.

    A head with a hidden layer keeps it without its classifier.
    """
    import timm
    import torch

    with torch.device("meta"):
        network = timm.create_model(name, num_classes=0)
    return int(getattr(network, "head_hidden_size", network.num_features))


DINOV2 = Plugin(DINOV2_CARD, build)
SIGLIP2 = Plugin(SIGLIP2_CARD, build)
