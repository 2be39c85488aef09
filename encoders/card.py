"""An encoder's card, and the plug-in that a member file provides.

Both are plain data, so that listing encoders loads no torch.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from surgicai_vision.core.errors import InputError, check_at_least, check_name, check_positive

if TYPE_CHECKING:
    from torch import nn

INTERPOLATIONS = ("bilinear", "bicubic")
CHANNEL_ORDERS = ("RGB", "BGR")


@dataclass(frozen=True)
class EncoderCard:
    """Where an encoder comes from and what it wants to see.

    Attributes:
        name: the name users give.
        architecture: the network, in words of the library that builds it.
        source: hub repository, package, place or "seed" the weights come from.
        revision: revision of that repository, version of that package, or the seed.
        filename: the weights file's name there; None where no file exists.
        sha256: the file's hash; None is said as "unpinned": the hub's own hash is taken.
        licence: SPDX name of the weights' licence.
        offline: True when no download is ever needed.
        input_size: side of the square image the network takes [px].
        input_range: what 0 and 255 become before mean and std are applied.
        mean: per-channel mean (R, G, B), in units of `input_range`.
        std: per-channel standard deviation, in units of `input_range`.
        interpolation: "bilinear" or "bicubic", always antialiased, for images of another size.
        dim: length of the global feature.
        paper: where the encoder was published.
        note: what a user must know before comparing it with others.
        layers: where each pool's feature is taken.
        channel_order: order in which the channels are handed to the network, "RGB" or "BGR".
        batch: images a CPU thread computes at once; few where maps are large, so that they stay in
            its cache.
    """

    name: str
    architecture: str
    source: str
    revision: str
    filename: str | None
    sha256: str | None
    licence: str
    offline: bool
    input_size: int
    input_range: tuple[float, float]
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    interpolation: str
    dim: int
    paper: str
    note: str = ""
    layers: str = ""
    channel_order: str = "RGB"
    batch: int = 8

    def __post_init__(self) -> None:
        check_name("interpolation", self.interpolation, INTERPOLATIONS)
        check_name("channel_order", self.channel_order, CHANNEL_ORDERS)
        check_at_least(1, input_size=self.input_size, dim=self.dim, batch=self.batch)
        statistics: tuple[Sequence[float], ...] = (self.mean, self.std)
        if any(len(values) != 3 for values in statistics):
            raise InputError(
                f"mean is {self.mean}, std {self.std}; each has three values, of R, G and B."
            )
        check_positive(
            **{f"std of {channel}": of for channel, of in zip("RGB", self.std, strict=True)}
        )


@dataclass(frozen=True)
class Plugin:
    """A member of the family: its card and the function that builds its network.

    Attributes:
        card: the card as published.
        build: (card, weights file or None) → (final card, network).
        known: further published files the loader knows, filename → sha256.
    """

    card: EncoderCard
    build: "Callable[[EncoderCard, Path | None], tuple[EncoderCard, nn.Module]]"
    known: Mapping[str, str] = MappingProxyType({})
