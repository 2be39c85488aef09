"""Fold each BatchNorm into the convolution before it, once the weights are loaded.

    folded = fold_batch_norms(network, 224)    # same output as the network, up to rounding

A frozen BatchNorm is one scale and one shift per channel, which the convolution's own weights can
absorb. As a separate layer it costs one more pass over the whole map: an image takes 33 instead of
24 ms (ResNet-50), 13 instead of 10 (EfficientNet-Lite0; one thread of a Xeon with AMX, bfloat16).
`benchmarks/encode.py` compares with networks as published.
"""

import copy
from typing import cast

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

TOLERANCE = 1e-4
"""Largest change of an answer, as a share of the largest, that is taken for rounding in float32."""
SEED = 0


def fold_batch_norms(network: nn.Module, side: int) -> nn.Module:
    """Return the network with each BatchNorm folded into the convolution before it.

    A BatchNorm's convolution is the part before it in the same parent. Parts that stand in order
    need not run in order, so both networks are shown the same noise; where
    they do not agree, or no BatchNorm is there, the network that was given is returned, untouched.

    Args:
        network: in eval mode, float32.
        side: height and width of the images (B, 3, side, side) it takes.
    """
    if not any(isinstance(part, nn.BatchNorm2d) for part in network.modules()):
        return network  # a transformer: neither copied nor compared
    folded = copy.deepcopy(network)
    _fold(folded)
    images = torch.randn(1, 3, side, side, generator=torch.Generator().manual_seed(SEED))
    with torch.inference_mode():
        before = network(images)
        after = folded(images)
    return (
        folded
        if float((after - before).abs().max()) <= TOLERANCE * float(before.abs().max())
        else network
    )


def _fold(parent: nn.Module) -> None:
    """Fold what is in `parent`."""
    before = None
    for name, part in list(parent.named_children()):
        if (
            isinstance(before, nn.Conv2d)
            and isinstance(part, nn.BatchNorm2d)
            and part.track_running_stats
        ):
            mean = cast(torch.Tensor, part.running_mean)
            variance = cast(torch.Tensor, part.running_var)
            before.weight, before.bias = fuse_conv_bn_weights(
                before.weight, before.bias, mean, variance, part.eps, part.weight, part.bias
            )
            # timm's BatchNorm holds the activation that follows it.
            parent.register_module(name, getattr(part, "act", nn.Identity()))
        else:
            _fold(part)
        before = part
