"""How SurgicAI's released code fed its encoders where it departs from the paper
(`config.Deviations`).

Interface:

* `changed(plugin, card, deviations) -> EncoderCard`: the card that the switches amount to.
* `drifted(network, batches) -> bytes`: the BatchNorm statistics (safetensors) that a network left
  under `train()` ends with; `restore(network, path)` puts them into a fresh one.

What is reproduced of the drift is its end: one set of statistics, with which features are then
cached and policies evaluated. The released code also trained on features that changed with each
batch.
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import nn

from encoders.base import best_device, best_dtype
from encoders.card import EncoderCard, Plugin
from surgicai_vision.core.config import Deviations
from surgicai_vision.core.errors import BadFile, InputError

STATISTICS = ("running_mean", "running_var")


def changed(plugin: Plugin, card: EncoderCard, deviations: Deviations) -> EncoderCard:
    """Return the card with the preprocessing of the released code, as far as it is switched on."""
    changes: dict[str, Any] = dict(plugin.released.card) if deviations.preprocessing else {}
    if deviations.bgr:
        changes["channel_order"] = "BGR"
    return replace(card, **changes)


def drifted(network: nn.Module, batches: Iterable[torch.Tensor]) -> bytes:
    """Pass images through a network that is not frozen yet; return its BatchNorm statistics as
    safetensors.

    Args:
        network: as built, in float32.
        batches: normalised images, (B, 3, S, S) float32 each, of demonstrations.

    Raises:
        InputError: a network without BatchNorm, which cannot drift.
    """
    if not _statistics(network):
        raise InputError(
            "This encoder has no BatchNorm, so nothing of it drifts; leave batch_norm_drift off."
        )
    device = best_device()
    network.to(device).to(memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    mixed = best_dtype(device)
    with torch.no_grad(), torch.autocast(device.type, mixed, enabled=mixed != torch.float32):
        for images in batches:
            network(images.to(device).contiguous(memory_format=torch.channels_last))
    return save({name: value.cpu().clone() for name, value in _statistics(network).items()})


def restore(network: nn.Module, path: Path) -> None:
    """Put drifted statistics into a network; `BadFile` where they are not its own."""
    try:
        tensors = load_file(path)
    except (SafetensorError, OSError) as error:
        raise BadFile(
            f"{path} is not a whole safetensors file ({str(error).splitlines()[0]})."
        ) from None
    wanted = _statistics(network)
    if {name: value.shape for name, value in tensors.items()} != {
        name: v.shape for name, v in wanted.items()
    }:
        raise BadFile(f"{path} does not hold the BatchNorm statistics of this encoder.")
    network.load_state_dict(tensors, strict=False)


def _statistics(network: nn.Module) -> dict[str, torch.Tensor]:
    """Return the running means and variances of a network."""
    return {
        name: value for name, value in network.state_dict().items() if name.endswith(STATISTICS)
    }
