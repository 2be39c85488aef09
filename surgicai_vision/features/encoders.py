"""Encoders by name, imported on first use; other distributions can add theirs (`core.plugins`).

* `encoder_names()`, `check_encoder_name(name)`, `encoder_card(name)`.
* `WeightsSource`: where pretrained weights come from; `find_weights(name, weights)`.
* `load_encoder(name, pool, weights) -> encoders.base.Encoder`: a callable from (batch, height,
  width, 3) uint8 RGB to (batch, dimension) float32.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, cast

from encoders.weights import find
from surgicai_vision.core.errors import InputError, check_name, shown
from surgicai_vision.core.plugins import ENCODERS_GROUP, Registry, instance_of, resolve, uncallable
from surgicai_vision.features.devices import AUTO, find_device

if TYPE_CHECKING:
    from torch import nn

    from encoders.base import Encoder, EncoderCard, Plugin

_is_plugin = instance_of("encoders.card:Plugin")
_is_card = instance_of("encoders.card:EncoderCard")


def _fault(part: object) -> str:
    """Return what is wrong with an object offered as an encoder, "" if nothing."""
    if fault := _is_plugin(part):
        return fault
    plugin = cast("Plugin", part)
    if fault := _is_card(plugin.card):
        return f"has a card that {fault}"
    return uncallable(plugin, "build")


ENCODERS: Final = Registry["Plugin"](
    "encoder",
    ENCODERS_GROUP,
    {
        "imagenet-lite": "encoders.imagenet_lite:IMAGENET_LITE",
        "imagenet-lite-early": "encoders.imagenet_lite_early:IMAGENET_LITE_EARLY",
        "imagenet-lite-smooth": "encoders.imagenet_lite_smooth:IMAGENET_LITE_SMOOTH",
        "random": "encoders.random_resnet:RANDOM",
        "random-conv": "encoders.random_conv:RANDOM_CONV",
        "r3m": "encoders.r3m:R3M",
        "r3m-34": "encoders.r3m:R3M_34",
        "r3m-18": "encoders.r3m:R3M_18",
        "clip": "encoders.clip:CLIP",
        "clip-rn50": "encoders.clip:CLIP_RN50",
        "imagenet": "encoders.imagenet:IMAGENET",
        "dinov2": "encoders.timm_models:DINOV2",
        "siglip2": "encoders.timm_models:SIGLIP2",
        "vc1": "encoders.vc1:VC1",
    },
    _fault,
)
"""Encoder name → its `encoders.base.Plugin`."""

OPEN_ENCODERS: Mapping[str, str] = MappingProxyType({"timm:": "encoders.timm_models:plugin_for"})
"""Prefix of open names → "module:function" that makes the plug-in of such a name."""

POOLS = ("global", "spatial", "tokens")
"""Outputs that may be taken from an encoder; a test compares this with `encoders.base`."""

OFFLINE_ENCODERS = (
    "imagenet-lite",
    "imagenet-lite-early",
    "imagenet-lite-smooth",
    "random",
    "random-conv",
)
"""Encoders that never download; a test compares this with their cards."""


def register_encoder(name: str, plugin: "Plugin", distribution: str = "") -> None:
    """Offer an encoder under a new name in this process; see `Registry.register`.

    Raises:
        NameCollision: the name is taken.
        InputError: this is not an encoder plug-in.
    """
    ENCODERS.register(name, plugin, distribution)


def encoder_names() -> tuple[str, ...]:
    """Return every registered encoder name."""
    return ENCODERS.names()


def encoder_plugin(name: str) -> "Plugin":
    """Import the plug-in of `name`; `UnknownName` lists what exists.

    Its card has this name whatever its author calls it, since checkpoints name their encoder by it.
    """
    check_encoder_name(name)
    for prefix, target in OPEN_ENCODERS.items():
        if name.startswith(prefix):
            plugin: Plugin = resolve(target)(name)
            return plugin
    plugin = ENCODERS.load(name)
    if ENCODERS.is_ours(name):
        return plugin
    return replace(plugin, card=replace(plugin.card, name=name))


def _choices() -> tuple[str, ...]:
    """Return the registered names and the patterns of the open ones."""
    return (*ENCODERS.names(), *(f"{prefix}<name>" for prefix in OPEN_ENCODERS))


def check_encoder_name(name: str) -> str:
    """Return `name` if it is a valid encoder name; imports nothing."""
    if not name.startswith(tuple(OPEN_ENCODERS)):
        check_name("encoder", name, _choices())
        ENCODERS.check(name)
    return name


def encoder_choices() -> str:
    """Return the encoder names as `--help` lists them."""
    return ", ".join(_choices())


def encoder_card(name: str) -> "EncoderCard":
    """Return an encoder's card without loading any weights."""
    return encoder_plugin(name).card


@dataclass(frozen=True)
class WeightsSource:
    """Where pretrained weights come from, and whether their licence is accepted.

    Weights for which no file is given are looked for in the folder $SURGICAI_VISION_WEIGHTS, then
    in the hub's cache, and are then downloaded.

    Attributes:
        files: (encoder's name, its weights file) of each file given; the name is "" for the file of
            every encoder that has no file given by name.
        accept_licence: accept weights under a non-commercial licence.
    """

    files: tuple[tuple[str, Path], ...] = ()
    accept_licence: bool = False

    @classmethod
    def parse(cls, given: Iterable[str], accept_licence: bool = False) -> "WeightsSource":
        """Parse texts of the form FILE or NAME=FILE; one may hold several, separated by commas.

        Raises:
            UnknownName: a NAME that no encoder has.
            InputError: two files for the same encoder.
        """
        files: dict[str, Path] = {}
        parts = [
            part for text in given for part in ([text] if Path(text).is_file() else text.split(","))
        ]
        for part in parts:
            owner, equals, path = part.partition("=")
            if not equals or "/" in owner or Path(part).is_file():
                owner = ""
                path = part
            else:
                check_encoder_name(owner)
            if owner in files:
                encoder = f"encoder '{owner}'" if owner else "every encoder"
                raise InputError(f"--weights names two files for {encoder}; give one.")
            files[owner] = Path(path)
        return cls(tuple(files.items()), accept_licence)

    @classmethod
    def of(cls, file: Path | str | None, accept_licence: bool = False) -> "WeightsSource":
        """Return the source with one file for every encoder, or none where `file` is None."""
        return cls(() if file is None else (("", Path(file)),), accept_licence)

    def file_for(self, encoder: str) -> Path | None:
        """Return the file that is meant for `encoder`, or None if no file is given for it."""
        files = dict(self.files)
        return files.get(encoder, files.get(""))


ANYWHERE: Final = WeightsSource()
"""No file is named; a non-commercial licence is not accepted."""


def load_encoder(
    name: str,
    pool: str = "global",
    weights: WeightsSource = ANYWHERE,
    device: str = AUTO,
) -> "Encoder":
    """Load an encoder by name, permanently frozen.

    Args:
        name: one of `encoder_names()`.
        pool: one of `POOLS`.
        weights: where its pretrained weights come from.
        device: one of `devices.DEVICES`.

    Raises:
        UnknownName: a name or pool that does not exist.
        InputError: a device that is not available, or an encoder from another distribution that
            fails, builds something else or returns features of a length other than its card's.
        MissingWeights: the weights are found nowhere; raised within seconds and before any work.
        BadFile: a weights file that is missing, damaged or of another architecture.
    """
    plugin = encoder_plugin(name)
    path = find_weights(name, weights)
    check_name("pool", pool, POOLS)
    where = find_device(device)
    make = resolve("encoders.base:open_encoder")  # imports torch
    with ENCODERS.calling(name):
        built: object = plugin.build(plugin.card, path)
    card, network = _built(name, built)
    with ENCODERS.calling(name):  # this computes a first feature
        encoder: Encoder = make(card, network, pool, where)
    if pool == "global" and encoder.shape != (card.dim,):
        raise ENCODERS.refusal(
            name,
            f"gives features of shape {encoder.shape}, but its card says dim {card.dim}; its "
            "author must correct one of them",
        )
    return encoder


def _built(name: str, built: object) -> "tuple[EncoderCard, nn.Module]":
    """Return the card and the network that an encoder's `build` returned, or refuse them."""
    wrong = "builds {}; its build must return its card and a torch.nn.Module"
    if not isinstance(built, tuple) or len(built) != 2:
        raise ENCODERS.refusal(name, wrong.format(shown(built)))
    card, network = built
    if _is_card(card) or not isinstance(network, resolve("torch.nn:Module")):
        raise ENCODERS.refusal(name, wrong.format(shown(built)))
    return replace(card, name=name), network


def find_weights(name: str, weights: WeightsSource = ANYWHERE) -> Path | None:
    """Find an encoder's weights file without loading it (or torch); see `load_encoder`."""
    plugin = encoder_plugin(name)
    return find(
        plugin.card, weights.file_for(name), weights.accept_licence, OFFLINE_ENCODERS, plugin.known
    )
