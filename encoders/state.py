"""Weights files: read without running code in them, and loaded in full.

Imports no torch before a file is read, so that a card can be looked up at once.
"""

import pickle
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from safetensors import SafetensorError

from surgicai_vision.core.errors import BadFile

if TYPE_CHECKING:
    import torch
    from torch import nn

DAMAGED = (
    pickle.UnpicklingError,
    RuntimeError,
    EOFError,
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AssertionError,
    struct.error,
    zipfile.BadZipFile,
)
"""What `torch.load` raises on a file that is no torch file, cut short, damaged, or not tensors
alone."""


def read_tensors(path: Path) -> "dict[str, torch.Tensor]":
    """Read a flat table of tensors from a safetensors or a torch file; no code in it can run."""
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        try:
            return load_file(path)
        except (SafetensorError, OSError) as error:
            raise BadFile(
                f"{path} is not a complete safetensors file ({_one_line(error)})."
            ) from None
    return read_torch(path)


def read_torch(path: Path) -> "dict[str, torch.Tensor]":
    """Read a torch file with `weights_only=True`; wrappers like {"model": …} are opened."""
    import torch

    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except DAMAGED as error:
        raise BadFile(
            f"{path} is not a complete torch file that holds only weights ({_one_line(error)})."
        ) from None
    for wrapper in ("state_dict", "model", "r3m"):
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
    if not isinstance(content, Mapping):
        raise BadFile(f"{path} holds {type(content).__name__}, not a table of weights.")
    return {str(key): value for key, value in content.items() if isinstance(value, torch.Tensor)}


def load_exactly(
    network: "nn.Module", tensors: "Mapping[str, torch.Tensor]", where: object
) -> None:
    """Load `tensors` into `network`.

    Raises:
        BadFile: a tensor is missing, unexpected or of another shape; the message names it.
    """
    wanted = network.state_dict()
    missing = sorted(wanted.keys() - tensors.keys())
    # Old checkpoints lack BatchNorm's counter, which nothing reads in eval mode.
    missing = [name for name in missing if not name.endswith("num_batches_tracked")]
    unexpected = sorted(tensors.keys() - wanted.keys())
    shapes = [
        name for name in wanted.keys() & tensors.keys() if wanted[name].shape != tensors[name].shape
    ]
    for problem, names in (
        ("lacks", missing),
        ("holds unexpected", unexpected),
        ("has the wrong shape for", shapes),
    ):
        if names:
            raise BadFile(
                f"{where} {problem} {len(names)} of {len(wanted)} tensors ('{names[0]}' first): "
                "these are not weights of this architecture."
            )
    network.load_state_dict(dict(tensors), strict=False)


def _one_line(error: Exception) -> str:
    """First line of an error's text, cut to a readable length."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:120]


def map_network(*layers: "nn.Module") -> "nn.Module":
    """Return the layers as a `MapNetwork`: their map, and its mean over places."""
    from encoders.base import MapNetwork

    return MapNetwork(*layers)
