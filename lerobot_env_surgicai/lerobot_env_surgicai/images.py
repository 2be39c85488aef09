"""Images and encoders as LeRobot sees them: float tensors in, frozen features out."""

import functools
import hashlib
from collections.abc import Mapping, Sequence
from typing import Protocol, final

import numpy as np
import torch
from numpy.typing import NDArray

from encoders.base import Encoder
from surgicai_vision.core import names
from surgicai_vision.core.config import digest, to_mapping
from surgicai_vision.core.errors import InputError
from surgicai_vision.features import encoders
from surgicai_vision.training.checkpoint import PREPROCESSING


class FrameEncoder(Protocol):
    """A callable that encodes frames: an encoder, or a `FeatureMemory` around one."""

    def __call__(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the features (B, dim) float32 of images (B, H, W, 3) uint8."""


@functools.lru_cache(maxsize=2)
def load_encoder(name: str, weights: str | None, pool: str) -> Encoder:
    """Load a frozen encoder; the two used last stay loaded in this process."""
    return encoders.load_encoder(name, pool, encoders.WeightsSource.of(weights))


def identity(encoder: Encoder) -> str:
    """Return a sha256 (hex) of everything about an encoder that a trained policy depends on.

    It covers the weights, the preprocessing and the pool.
    """
    card = to_mapping(encoder.card)
    plain = {
        "weights": encoder.weights_sha256,
        "pool": encoder.pool,
        **{key: card[key] for key in PREPROCESSING},
    }
    return digest(plain)


def check_identity(encoder: Encoder, weights_sha256: str, wanted: str, where: str) -> None:
    """Refuse an encoder other than the one a policy was trained on; `wanted` is its `identity`."""
    if weights_sha256 and encoder.weights_sha256 != weights_sha256:
        raise InputError(
            f"{where} was trained on encoder '{encoder.card.name}' with weights sha256 "
            f"{weights_sha256}, got {encoder.weights_sha256}; give the same file."
        )
    if wanted and identity(encoder) != wanted:
        raise InputError(
            f"{where} was trained on encoder '{encoder.card.name}' with another preprocessing or "
            "pool; use the version of surgicai-vision it was trained with."
        )


def as_uint8(images: torch.Tensor) -> NDArray[np.uint8]:
    """Return (B, 3, H, W) float images in [0, 1] as (B, H, W, 3) uint8.

    Images that were uint8 before are restored exactly.
    """
    rounded = (images.detach().float() * 255).round().clamp(0, 255).to(torch.uint8)
    return rounded.permute(0, 2, 3, 1).contiguous().cpu().numpy()


@final
class FeatureMemory:
    """An encoder that encodes each image once; LeRobot decodes every image again in each epoch.

    An image is identified by the hash of its bytes, so an image of another dataset or an augmented
    image is never mistaken for it. Features have float16 values (`encoders.base`) and are stored
    as float16, so nothing is lost to rounding.

    Args:
        encoder: (B, H, W, 3) uint8 → (B, dim) float32, the same for an image in any batch.
        limit: bytes of features to keep; images beyond it are encoded each time.
    """

    def __init__(self, encoder: FrameEncoder, limit: int = 2 << 30):
        self._encoder = encoder
        self._rows: dict[bytes, NDArray[np.float16]] = {}
        self._left = limit

    def __call__(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the features (B, dim) float32 of images (B, H, W, 3) uint8."""
        keys = [
            hashlib.blake2b(np.ascontiguousarray(frame).data, digest_size=16).digest()
            for frame in frames
        ]
        new = {key: at for at, key in enumerate(keys) if key not in self._rows}
        fresh: dict[bytes, NDArray[np.float16]] = {}
        if new:
            rows = self._encoder(frames[list(new.values())]).astype(np.float16)
            fresh = dict(zip(new, rows, strict=True))
            for key, row in fresh.items():
                if self._left >= row.nbytes:
                    self._rows[key] = row.copy()
                    self._left -= row.nbytes
        return np.stack([fresh[key] if key in fresh else self._rows[key] for key in keys]).astype(
            np.float32
        )


def encode(
    encoder: FrameEncoder, batch: Mapping[str, torch.Tensor], views: Sequence[str]
) -> NDArray[np.float32]:
    """Return the concatenated features of the views, (B, views × dim) float32."""
    return np.concatenate(
        [encoder(as_uint8(batch[names.image_key(view)])) for view in views], axis=1
    )
