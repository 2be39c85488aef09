"""Pictures and encoders as LeRobot sees them: float tensors in, frozen features out."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from surgicai_vision import names, registry
from surgicai_vision.checkpoint import SEEN
from surgicai_vision.config import digest, to_mapping
from surgicai_vision.errors import InputError


@functools.lru_cache(maxsize=2)
def load_encoder(name: str, weights: str | None, pool: str) -> Any:
    """Load a frozen encoder, once a process for each choice."""
    return registry.load_encoder(name, weights, pool=pool)


def identity(encoder: Any) -> str:
    """sha256 (hex) over an encoder's weights, preprocessing and pool: what a policy trained on it depends on."""
    card = to_mapping(encoder.card)
    plain = {"weights": encoder.weights_sha256, "pool": encoder.pool, **{key: card[key] for key in SEEN}}
    return digest(plain)


def check_identity(encoder: Any, weights_sha256: str, wanted: str, where: str) -> None:
    """Refuse an encoder other than the one a policy was trained on; `wanted` is its `identity`."""
    if weights_sha256 and encoder.weights_sha256 != weights_sha256:
        raise InputError(
            f"{where} was trained on encoder '{encoder.card.name}' with weights sha256 {weights_sha256}, got "
            f"{encoder.weights_sha256}; hand over the same file."
        )
    if wanted and identity(encoder) != wanted:
        raise InputError(
            f"{where} was trained on encoder '{encoder.card.name}' with another preprocessing or pool; "
            "use the version of surgicai-vision it was trained with."
        )


def as_uint8(pictures: torch.Tensor) -> np.ndarray:
    """Return (B, 3, H, W) float pictures in [0, 1] as (B, H, W, 3) uint8; exact for pictures that were uint8."""
    rounded = (pictures.detach().float() * 255).round().clamp(0, 255).to(torch.uint8)
    return rounded.permute(0, 2, 3, 1).contiguous().cpu().numpy()


def encode(encoder: Any, batch: Mapping[str, torch.Tensor], views: Sequence[str]) -> np.ndarray:
    """Return the features of the views side by side, (B, views × dim) float32."""
    return np.concatenate([encoder(as_uint8(batch[names.image_key(view)])) for view in views], axis=1)
