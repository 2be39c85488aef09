"""Encoders by name, imported on first use; other distributions add theirs (`core.plugins`).

* `encoder_names()`, `check_encoder_name(name)`, `encoder_card(name)`, `find_weights(name, …)`.
* `load_encoder(name, weights=None, pool="global", accept_licence=False) -> encoders.base.Encoder`:
  a callable from (batch, height, width, 3) uint8 RGB to (batch, dimension) float32.
"""

import importlib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.core.plugins import ENCODERS_GROUP, Registry, resolve

if TYPE_CHECKING:
    from encoders.base import EncoderCard, Plugin

ENCODERS: Final = Registry["Plugin"](
    "encoder",
    ENCODERS_GROUP,
    {
        "imagenet-lite": "encoders.imagenet_lite:IMAGENET_LITE",
        "imagenet-lite-early": "encoders.imagenet_lite_early:IMAGENET_LITE_EARLY",
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
)
"""Encoder name → its `encoders.base.Plugin`."""

OPEN_ENCODERS: Mapping[str, str] = MappingProxyType({"timm:": "encoders.timm_models:plugin_for"})
"""Prefix of open names → "module:function" that makes the plug-in of such a name."""

POOLS = ("global", "spatial", "tokens")
"""What may be taken from an encoder; a test compares this with `encoders.base`."""

OFFLINE_ENCODERS = ("imagenet-lite", "imagenet-lite-early", "random", "random-conv")
"""Encoders that never download; a test compares this with their cards."""


def register_encoder(name: str, plugin: "Plugin", distribution: str = "") -> None:
    """Offer an encoder under a new name in this process; see `Registry.register`.

    Raises:
        NameCollision: the name is taken.
    """
    ENCODERS.register(name, plugin, distribution)


def encoder_names() -> tuple[str, ...]:
    """Return every registered encoder name."""
    return ENCODERS.names()


def encoder_plugin(name: str) -> "Plugin":
    """Import the plug-in of `name`; `UnknownName` lists what exists."""
    check_encoder_name(name)
    for prefix, target in OPEN_ENCODERS.items():
        if name.startswith(prefix):
            plugin: Plugin = resolve(target)(name)
            return plugin
    return ENCODERS.load(name)


def _choices() -> tuple[str, ...]:
    """Return the registered names and the forms of the open ones."""
    return (*ENCODERS.names(), *(f"{prefix}<name>" for prefix in OPEN_ENCODERS))


def check_encoder_name(name: str) -> str:
    """Return `name` if an encoder may be called so; imports nothing."""
    if not name.startswith(tuple(OPEN_ENCODERS)):
        check_name("encoder", name, _choices())
    return name


def encoder_choices() -> str:
    """Return the encoder names as `--help` lists them."""
    return ", ".join(_choices())


def encoder_card(name: str) -> "EncoderCard":
    """Return an encoder's card without loading any weights."""
    return encoder_plugin(name).card


def load_encoder(
    name: str,
    weights: Path | str | None = None,
    pool: str = "global",
    accept_licence: bool = False,
) -> Any:
    """Load an encoder by name, frozen for good.

    Args:
        name: one of `encoder_names()`.
        weights: a weights file, as `weights_of` takes it; without it the folder
            $SURGICAI_VISION_WEIGHTS, the hub's cache and a download are tried, in this order.
        pool: "global", "spatial" or "tokens".
        accept_licence: accept weights under a non-commercial licence.

    Raises:
        UnknownName: a name or pool that does not exist.
        MissingWeights: the weights are found nowhere; raised within seconds and before any work.
        BadFile: a weights file that is missing, damaged or of another architecture.
    """
    plugin = encoder_plugin(name)
    path = find_weights(name, weights, accept_licence)
    base = importlib.import_module("encoders.base")
    check_name("pool", pool, POOLS)
    card, network = plugin.build(plugin.card, path)
    return base.Encoder(card, network, pool)


def find_weights(
    name: str, weights: Path | str | None = None, accept_licence: bool = False
) -> Path | None:
    """Find an encoder's weights file without loading it (or torch); see `load_encoder` for the
    errors.
    """
    plugin = encoder_plugin(name)
    lookup = importlib.import_module("encoders.weights")
    return lookup.find(
        plugin.card, weights_of(name, weights), accept_licence, OFFLINE_ENCODERS, plugin.known
    )


def weights_of(name: str, given: Path | str | None) -> Path | None:
    """Return the weights file that is meant for encoder `name`, or None.

    Args:
        name: an encoder.
        given: FILE (for every encoder that has none of its own), NAME=FILE (for that encoder
            alone), or several of them between commas.

    Raises:
        UnknownName: a NAME that no encoder has.
        InputError: two files for the same encoder.
    """
    if given is None or isinstance(given, Path) or Path(given).is_file():
        return Path(given) if given is not None else None
    files: dict[str, Path] = {}
    for part in given.split(","):
        owner, equals, path = part.partition("=")
        if not equals or "/" in owner:
            owner, path = "", part
        else:
            check_encoder_name(owner)
        if owner in files:
            raise InputError(
                f"--weights names two files for {f'encoder {owner!r}' if owner else 'every encoder'}."
            )
        files[owner] = Path(path)
    return files.get(name, files.get(""))
