"""The interface of every encoder: a frozen network behind one call.

Interface:

* `EncoderCard`, `Plugin` (from encoders.card): what a member file provides. `plugin.build(card,
  path)` returns the final card (a variant of the weights may change it) and a `torch.nn.Module` of
  (B, 3, S, S) normalised images → (B, dim).
* `Encoder(card, network, pool)`: the final class. `encoder(frames (B, H, W, 3) uint8 RGB) -> (B,
  dim) float32`, permanently frozen: eval mode, no gradient, and no way back into training mode.
* `state_sha256(module)`: one hash over all parameters and buffers; `network_sha256(module)`: one
  over its layers and their code.
* `read_tensors(path)`: safetensors, or a torch file read with `weights_only=True`.
* `load_exactly(network, tensors, where)`: load; all names and shapes must match exactly.

The same image gives the same feature, whatever batch it is in, so that a live evaluation sees what
the cache holds. Measured on a Xeon with AMX (bf16, channels_last): convolutions give the same bits
for any batch and thread count. Transformers and attention pools do not (up to 1 % between batch
sizes, and between one and two threads), but do for a fixed batch on one thread, at any position and
next to any other images. Therefore:

* every piece holds exactly as many images as the card says (on a GPU, `CUDA_BATCH`). The remainder
  is padded, unless this network on this machine is found to give the same bits in smaller pieces:
  then it is cut into pieces of the sizes in `SMALL`;
* on a CPU each piece is computed by one thread, and pieces run in parallel, one per core. That is
  also faster when other processes use the cores: 4 to 5 times at a load of 5 on 2 cores, for
  ResNet-50 and EfficientNet;
* features are rounded to the values float16 can hold.

BatchNorms are folded into the convolutions before them (`encoders.fold_batchnorm`).
"""

import contextlib
import functools
import hashlib
import inspect
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from encoders.card import EncoderCard, Plugin
from encoders.fold_batchnorm import fold_batch_norms
from encoders.state import load_exactly, read_tensors, read_torch
from surgicai_vision.core.config import digest
from surgicai_vision.core.errors import InputError, SurgicaiError, check_name

__all__ = [
    "POOLS",
    "Encoder",
    "EncoderCard",
    "MapNetwork",
    "Plugin",
    "freeze",
    "load_exactly",
    "read_tensors",
    "read_torch",
    "state_sha256",
]

POOLS = ("global", "spatial", "tokens")
CUDA_BATCH = 64
LIBRARIES = ("torch", "torchvision", "open_clip", "timm")
"""Packages whose classes are known by their names: the lock file pins what they compute."""
ADDRESS = re.compile(r" at 0x[0-9a-f]+")
"""Where in memory a function is that a layer prints; another in every process."""
SMALL = (4, 2, 1)  # smaller pieces that are tried; each costs as much per image as a whole one
PROBE_SEED = 0
FINGERPRINT_VERSION = 3  # increase when the same weights and card begin to give other features


class MapNetwork(nn.Sequential):
    """Layers with a feature map (B, C, h, w) at their end; its mean is the global feature."""

    def forward_features(self, images: torch.Tensor) -> torch.Tensor:
        """Return the feature map (B, C, h, w)."""
        features = images
        for layer in self:
            features = layer(features)
        return features

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return the mean feature (B, C)."""
        return self.forward_features(images).mean((2, 3))


def state_sha256(module: nn.Module) -> str:
    """sha256 (hex) over names, types, shapes and bytes of all parameters and buffers."""
    total = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        total.update(f"{name} {tensor.dtype} {tuple(tensor.shape)};".encode())
        total.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return total.hexdigest()


def freeze(module: nn.Module) -> nn.Module:
    """Put `module` into eval mode for good: no gradients, and `train()` does nothing any more."""
    module.eval().requires_grad_(False)
    for part in module.modules():
        part.train = functools.partial(_stay, part)  # type: ignore[method-assign]
    return module


def _stay(part: nn.Module, mode: bool = True) -> nn.Module:
    """Stand in for `train` on a frozen module: nothing changes."""
    return part


def best_device() -> torch.device:
    """Return the CUDA device when there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def best_dtype(device: torch.device) -> torch.dtype:
    """Return bfloat16 where the device multiplies it natively, else float32."""
    if device.type == "cuda":
        native = torch.cuda.is_bf16_supported(including_emulation=False)
        return torch.bfloat16 if native else torch.float32
    probes = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    native = any(getattr(torch.cpu, probe, lambda: False)() for probe in probes)
    return torch.bfloat16 if native else torch.float32


def network_sha256(network: nn.Module) -> str:
    """sha256 (hex) over what `network` computes with, besides its weights.

    These are its layers as torch prints them, and the source of those classes among them that are
    no library's: a class that is changed gives other features. A function that they call is not
    seen; a card's `revision` tells of it.
    """
    total = hashlib.sha256(ADDRESS.sub("", repr(network)).encode())
    classes = {type(part) for part in network.modules()}
    for kind in sorted(classes, key=lambda kind: (kind.__module__, kind.__qualname__)):
        if kind.__module__.partition(".")[0] not in LIBRARIES:
            with contextlib.suppress(OSError, TypeError):  # defined without a file, at a prompt
                total.update(inspect.getsource(kind).encode())
    return total.hexdigest()


@functools.cache
def _workers(threads: int) -> ThreadPoolExecutor:
    """Return this process's pool of threads in which torch itself computes with one."""
    return ThreadPoolExecutor(threads, "encoder", torch.set_num_threads, (1,))


@final
class Encoder:
    """A frozen image encoder: uint8 RGB frames in, one float32 feature row each out.

    Attributes:
        card: the encoder's card.
        pool: "global" (one vector), "spatial" (feature map) or "tokens", flattened.
        shape: shape of one feature before flattening: (dim,), (C, h, w) or (N, C).
        dim: length of a feature row.
        weights_sha256: hash of the network's state as loaded, before any cast.
        fingerprint: hash of everything a feature depends on.
    """

    def __init__(
        self,
        card: EncoderCard,
        network: nn.Module,
        pool: str = "global",
        device: torch.device | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        self.card = card
        self.pool = check_name("pool", pool, POOLS)
        self.weights_sha256 = state_sha256(network)
        self._network_sha256 = network_sha256(network)
        self._device = device or best_device()
        self._dtype = dtype or best_dtype(self._device)
        self._batch = CUDA_BATCH if self._device.type == "cuda" else card.batch
        network = freeze(fold_batch_norms(network.eval(), card.input_size)).to(
            self._device, self._dtype
        )
        self._network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        low, high = card.input_range
        mean = torch.tensor(card.mean)
        std = torch.tensor(card.std)
        self._scale = ((high - low) / 255 / std).to(self._device)
        self._shift = ((low - mean) / std).to(self._device)
        self._channels = [2, 1, 0] if card.channel_order == "BGR" else None
        size = card.input_size
        self.shape = tuple(self._run(np.zeros((1, size, size, 3), np.uint8), pad=False).shape[1:])
        self.dim = int(np.prod(self.shape))
        self.fingerprint = digest(self._identity())

    def __call__(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Encode images.

        Args:
            frames: (B, H, W, 3) uint8 RGB; any size, resized to the network's own with
                antialiasing.

        Returns:
            (B, dim) float32, every value exactly representable in float16.

        Raises:
            InputError: frames of another shape or type.
            SurgicaiError: the network gave a value that is not finite in float16.
        """
        frames = np.asarray(frames)
        if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8:
            raise InputError(
                f"Encoder '{self.card.name}' takes (batch, height, width, 3) uint8 RGB images, "
                f"got {frames.shape} {frames.dtype}."
            )
        if not len(frames):
            return np.zeros((0, self.dim), np.float32)
        pieces = self._map(self._cut(frames))
        features = torch.cat(pieces).reshape(len(frames), self.dim).half().float().cpu().numpy()
        if not np.isfinite(features).all():
            raise SurgicaiError(
                f"Encoder '{self.card.name}' gave a feature that is not finite in float16; "
                "its weights or its preprocessing are wrong."
            )
        return features

    def preprocess(self, frames: NDArray[np.uint8]) -> torch.Tensor:
        """Return uint8 RGB (B, H, W, 3) frames as normalised float32 (B, 3, S, S) images."""
        images = (
            torch.from_numpy(np.ascontiguousarray(frames))
            .to(self._device)
            .permute(0, 3, 1, 2)
            .float()
        )
        if self._channels:
            images = images[:, self._channels]
        size = (self.card.input_size, self.card.input_size)
        if images.shape[-2:] != size:
            mode = self.card.interpolation
            images = nn.functional.interpolate(images, size, mode=mode, antialias=True).clamp(
                0, 255
            )
        return images * self._scale[:, None, None] + self._shift[:, None, None]

    def state_sha256(self) -> str:
        """Hash the live network: weights and buffers, as they stand in memory now."""
        return state_sha256(self._network)

    def _cut(self, frames: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
        """Cut frames into whole pieces and what is left over."""
        whole = len(frames) // self._batch * self._batch
        pieces = [frames[at : at + self._batch] for at in range(0, whole, self._batch)]
        rest = frames[whole:]
        for size in self._small if len(rest) and self._any_size else ():
            while len(rest) >= size:
                pieces.append(rest[:size])
                rest = rest[size:]
        return [*pieces, rest] if len(rest) else pieces

    @property
    def _small(self) -> tuple[int, ...]:
        """Sizes of the pieces into which what is left over may be cut."""
        return tuple(size for size in SMALL if size < self._batch)

    @functools.cached_property
    def _any_size(self) -> bool:
        """Whether pieces of `SMALL` give the bits of whole ones; asked of the network, once."""
        if self._device.type == "cuda":
            return False
        side = self.card.input_size
        frames = np.random.default_rng(PROBE_SEED).integers(
            0, 256, (self._batch, side, side, 3), np.uint8
        )
        (whole,) = self._map([frames])
        small = self._map([frames[-size:] for size in self._small], pad=False)
        return all(torch.equal(piece, whole[-len(piece) :]) for piece in small)

    def _map(self, pieces: list[NDArray[np.uint8]], pad: bool | None = None) -> list[torch.Tensor]:
        """Encode pieces, side by side on a CPU unless the caller has asked torch for one thread."""
        threads = torch.get_num_threads()
        if self._device.type == "cuda" or threads == 1:
            return [self._run(piece, pad) for piece in pieces]
        return list(_workers(threads).map(functools.partial(self._run, pad=pad), pieces))

    @torch.inference_mode()
    def _run(self, frames: NDArray[np.uint8], pad: bool | None = None) -> torch.Tensor:
        """Encode one piece of at most a batch, padded unless it need not be.

        Returns:
            (b, *shape) float32, on the device.
        """
        count = len(frames)
        if count < self._batch and (not self._any_size if pad is None else pad):
            frames = np.concatenate(
                [frames, np.zeros((self._batch - count, *frames.shape[1:]), np.uint8)]
            )
        images = (
            self.preprocess(frames).to(self._dtype).contiguous(memory_format=torch.channels_last)
        )
        return self._pooled(images)[:count].float()

    def _pooled(self, images: torch.Tensor) -> torch.Tensor:
        """Return the network's answer as `pool` asks: vector, feature map or tokens."""
        if self.pool == "global":
            vector: torch.Tensor = self._network(images)
            return vector
        take = getattr(self._network, "forward_features", None)
        if take is None:
            raise InputError(
                f"Encoder '{self.card.name}' offers its global feature only; use pool 'global'."
            )
        features: torch.Tensor = take(images)
        if not isinstance(features, torch.Tensor):  # several maps, of several sizes
            raise InputError(
                f"Encoder '{self.card.name}' has several feature maps side by side; use pool "
                "'global'."
            )
        if features.ndim == 4 and getattr(self._network, "output_fmt", "NCHW") == "NHWC":
            features = features.permute(0, 3, 1, 2)  # timm's Swin and its like
        if self.pool == "spatial":
            if features.ndim != 4:
                raise InputError(
                    f"Encoder '{self.card.name}' has tokens, no feature map; use pool 'tokens'."
                )
            return features
        return features.flatten(2).transpose(1, 2) if features.ndim == 4 else features

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return self._device

    def _identity(self) -> dict[str, object]:
        """Return everything a feature depends on, as plain data."""
        card = asdict(self.card)
        keys = (
            "name",
            "revision",
            "architecture",
            "layers",
            "input_size",
            "input_range",
            "mean",
            "std",
            "interpolation",
            "channel_order",
            "batch",
        )
        return {
            "version": FINGERPRINT_VERSION,
            "weights": self.weights_sha256,
            "network": self._network_sha256,
            "shape": self.shape,
            "pool": self.pool,
            "compute": f"{self._device.type} {self._dtype}",
            **{key: card[key] for key in keys},
        }


def open_encoder(card: EncoderCard, network: nn.Module, pool: str, device: str) -> Encoder:
    """Return the encoder of a network on a device, "cpu" or "cuda"."""
    return Encoder(card, network, pool, torch.device(device))
