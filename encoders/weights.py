"""Find pretrained weights, without torch: a missing file is reported at once.

Interface:

* `find(card, weights, accept_licence) -> Path | None`: in this order: the file given, the folder of
  `SURGICAI_VISION_WEIGHTS`, the hub's cache, a download into our own cache (resumed if cut off).
  Any file that was not given by name is checked against the card's hash; for a card without one
  ("unpinned"), the hash reported by the hub is used. Without a network it raises `MissingWeights`
  within seconds.

In the folder of `SURGICAI_VISION_WEIGHTS` a file is looked for as `<encoder>/<filename>` and
`<encoder>.<suffix>`, and, if its hash is known beforehand, as `<filename>`: many networks publish
their weights under the same name.
"""

import functools
import os
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from encoders.card import EncoderCard
from encoders.download import BrokenOff, fetch
from surgicai_vision.core.errors import BadFile, InputError, MissingWeights
from surgicai_vision.core.files import cache_root, sha256_file

FOLDER_VARIABLE = "SURGICAI_VISION_WEIGHTS"
NON_COMMERCIAL = "-NC"
PROBE_SECONDS = 2.0  # without a network the hub's own client would retry for half a minute


def find(
    card: EncoderCard,
    weights: Path | None,
    accept_licence: bool,
    offline_encoders: tuple[str, ...],
    known: Mapping[str, str] | None = None,
) -> Path | None:
    """Return the weights file of `card`, or None where it needs none.

    Args:
        card: the encoder's card.
        weights: the file the caller gave, or None.
        accept_licence: the caller accepts a non-commercial licence.
        offline_encoders: names to offer when nothing is found.
        known: other files the loader knows: filename → sha256.

    Raises:
        BadFile: a file that does not exist or is not the one published under that name.
        InputError: non-commercial weights without `accept_licence`.
        MissingWeights: found nowhere.
    """
    if NON_COMMERCIAL in card.licence.upper() and not accept_licence:
        raise InputError(
            f"The weights of '{card.name}' are under {card.licence} (non-commercial); "
            "add --accept-licence if your use allows it."
        )
    if weights is not None:
        return _given(card, Path(weights), known or {})
    if card.filename is None or card.offline:
        return None
    wanted = {card.filename: card.sha256, **(known or {})}
    found = _in_folder(card, wanted) or _in_hub_cache(card)
    if found is not None:
        return found
    found, problem = _downloaded(card)
    if found is None:
        raise MissingWeights(missing_line(card, offline_encoders, problem))
    return found


def missing_line(card: EncoderCard, offline_encoders: tuple[str, ...], problem: str = "") -> str:
    """Return one line: which file is wanted, from where, and what works without it."""
    reason = f" ({problem})" if problem else ""
    return (
        f"Encoder '{card.name}' needs {card.filename} of the hub repository {card.source} "
        f"(revision {card.revision}, sha256 {card.sha256 or 'unpinned'}), which is neither on "
        f"this machine nor downloadable{reason}; pass it with --weights FILE or put it in the "
        f"folder ${FOLDER_VARIABLE} as {card.name}{Path(str(card.filename)).suffix}. "
        f"Encoders that work offline: {', '.join(offline_encoders)}."
    )


def _given(card: EncoderCard, path: Path, known: Mapping[str, str]) -> Path:
    """Accept a file named by the caller; say so when it is not a published one."""
    if not path.is_file():
        raise BadFile(
            f"--weights {path} is not a file; give the weights file of encoder '{card.name}'."
        )
    published = [sha256 for sha256 in (card.sha256, *known.values()) if sha256]
    if published and not sha256_file(path).startswith(tuple(published)):
        warnings.warn(
            f"{path} is not the published weights file of '{card.name}'; "
            "it is used as given and its own hash is recorded.",
            stacklevel=2,
        )
    return path


def _in_folder(card: EncoderCard, wanted: Mapping[str, str | None]) -> Path | None:
    """Look in the user's weights folder."""
    folder = os.environ.get(FOLDER_VARIABLE)
    if not folder:
        return None
    for filename, sha256 in wanted.items():
        path = Path(folder) / card.name / filename
        if path.is_file():
            return check_hash(path, sha256)
        path = Path(folder) / f"{card.name}{Path(filename).suffix}"
        if path.is_file():  # its name does not say which of the known files it is
            return check_hash(path, *wanted.values())
        path = Path(folder) / filename
        if sha256 and path.is_file() and sha256_file(path).startswith(sha256):
            return path
    return None


def check_hash(path: Path, *allowed: str | None) -> Path:
    """Return `path` if its hash begins as one that is allowed (None allows any), else refuse it."""
    known = tuple(sha256 for sha256 in allowed if sha256 is not None)
    if len(known) == len(allowed) and not (actual := sha256_file(path)).startswith(known):
        raise BadFile(
            f"{path} is damaged or is a different file: sha256 {actual}, expected "
            f"{' or '.join(dict.fromkeys(known))}; replace it."
        )
    return path


def _in_hub_cache(card: EncoderCard) -> Path | None:
    """Look in the hub's cache; nothing is requested."""
    from huggingface_hub import try_to_load_from_cache
    from huggingface_hub.errors import HFValidationError

    for revision in (card.revision, None):
        with suppress(HFValidationError):  # a source that is no repository of the hub
            found = try_to_load_from_cache(card.source, str(card.filename), revision=revision)
            if isinstance(found, str):
                return _check_blob(card, Path(found))
    return None


def _downloaded(card: EncoderCard) -> tuple[Path | None, str]:
    """Return the file downloaded before or now; else None and the reason."""
    folder = cache_root() / "weights" / card.source.replace("/", "--") / card.revision
    target = folder / str(card.filename)
    if target.is_file():
        return check_hash(target, card.sha256), ""
    if not hub_answers():
        return None, ""
    try:
        return fetch(card.source, card.revision, str(card.filename), card.sha256, folder), ""
    except BadFile:
        raise
    except BrokenOff as error:
        return None, f"{error}; what was downloaded is kept; run the same command to resume"
    except Exception as error:  # whatever the network did, the answer to the user is the same line
        return None, (str(error).strip().splitlines() or [type(error).__name__])[0][:160]


@functools.cache
def hub_answers() -> bool:
    """Ask the hub once per process whether it is there, without retries."""
    from huggingface_hub import constants
    from huggingface_hub.utils import get_session

    if constants.is_offline_mode():
        return False
    try:
        get_session().head(constants.ENDPOINT, timeout=PROBE_SECONDS)
    except Exception:  # no network, no name server, a proxy that refuses: all mean no
        return False
    return True


def _check_blob(card: EncoderCard, path: Path) -> Path:
    """Check against the card's hash, or against the hub's own, which names the cached blob."""
    blob = path.resolve().name
    hub_sha256 = blob if len(blob) == 64 else None
    return check_hash(path, card.sha256 or hub_sha256)
