"""SurgicAI's recordings as arrays: the contents of its pickles, before any plausibility check.

The layout (taken from the released files; that of the observation from the released code) is a list
of transitions, each {"obs": {"observation": (21,), …}, "next_obs": likewise, "action": (7,),
"reward": (1,), "done": (1,), "info": {"is_success": …}}. The 21 values are the active arm's
commanded pose, its goal and their difference, each x y z [cm] roll pitch yaw jaw [rad] in the arm's
own base, with fixed-axis angles, R = Rz(yaw) Ry(pitch) Rx(roll). The same transitions as plain
arrays (.npz) are read too.

`read(path)` returns {"observation": (N, 21), "next_observation": (N, 21), "action": (N, 7),
"reward": (N,), "done": (N,), "success": (N,)}, float64, or raises `BadFile`. It imports nothing but
numpy and runs in the child process of `sandbox`.
"""

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import BadFile
from surgicai_vision.demos.imports.safe_pickle import MAX_BYTES, unpickle

FIELDS = {
    "observation": 21,
    "next_observation": 21,
    "action": 7,
    "reward": 1,
    "done": 1,
    "success": 1,
}
"""Array → numbers per row."""

MAX_TRANSITIONS = 1_000_000


def read(path: Path) -> dict[str, NDArray[np.float64]]:
    """Read a recording; its first bytes tell whether it is a pickle or an npz.

    Raises:
        BadFile: missing, empty, damaged, malicious, or of another layout.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise BadFile(
                f"{path} has {size / 2**20:.0f} MB; "
                f"recordings above {MAX_BYTES >> 20} MB are not read."
            )
        content = path.read_bytes()
    except OSError as error:
        raise BadFile(f"Cannot read {path}: {error.strerror}.") from None
    rows: Mapping[str, Sequence[NDArray[np.float64]] | NDArray[np.float64]]
    if content[:4] == b"PK\x03\x04":
        rows = _npz(path)
    else:
        rows = _transitions(unpickle(content, str(path)), path)
    arrays = {}
    for name, width in FIELDS.items():
        array = np.asarray(rows[name], dtype=np.float64)
        arrays[name] = array.reshape(len(array), -1)
        if arrays[name].shape != (len(rows["action"]), width):
            raise BadFile(
                f"{path}: {name} has shape {array.shape}; "
                f"expected {len(rows['action'])} rows of {width}."
            )
        if not np.isfinite(array).all():
            raise BadFile(f"{path}: {name} holds numbers that are not finite.")
    return {name: array[:, 0] if FIELDS[name] == 1 else array for name, array in arrays.items()}


def _transitions(tree: object, path: Path) -> dict[str, list[NDArray[np.float64]]]:
    """Return the rows of a list of transitions."""
    if not isinstance(tree, (list, tuple)) or not tree:
        raise BadFile(f"{path} holds {_kind(tree)}; expected a list of transitions.")
    if len(tree) > MAX_TRANSITIONS:
        raise BadFile(
            f"{path} holds {len(tree)} transitions; above {MAX_TRANSITIONS} are not read."
        )
    rows: dict[str, list[NDArray[np.float64]]] = {name: [] for name in FIELDS}
    for index, item in enumerate(tree):
        if not isinstance(item, Mapping):
            raise BadFile(f"{path}: transition {index} is {_kind(item)}; expected a dictionary.")
        try:
            values = {
                "observation": _observation(item["obs"]),
                "next_observation": _observation(item["next_obs"]),
                "action": item["action"],
                "reward": item["reward"],
                "done": item["done"],
                "success": item["info"].get("is_success", False),
            }
            for name, value in values.items():
                rows[name].append(np.asarray(value, dtype=np.float64).reshape(FIELDS[name]))
        except KeyError as error:
            raise BadFile(
                f"{path}: transition {index} has no {error}; it has {sorted(item)[:8]}."
            ) from None
        except (TypeError, ValueError, AttributeError) as error:
            raise BadFile(
                f"{path}: transition {index} is not one of SurgicAI's ({error})."
            ) from None
    return rows


def _observation(value: object) -> object:
    """Return the 21 values of an observation, given bare or in SurgicAI's dictionary."""
    return value["observation"] if isinstance(value, Mapping) else value


def _npz(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return the rows of an npz; its arrays may not unpack to more than a recording can hold."""
    names = {name: "is_success" if name == "success" else name for name in FIELDS}
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {
                entry.filename.removesuffix(".npy"): entry.file_size for entry in archive.infolist()
            }
        missing = sorted(set(names.values()) - set(sizes))
        if missing:
            raise BadFile(
                f"{path} has no array {', '.join(missing)}; "
                f"it has {', '.join(sorted(sizes))[:200]}."
            )
        if any(sizes[name] > MAX_BYTES for name in names.values()):
            raise BadFile(f"{path}: an array unpacks to more than {MAX_BYTES >> 20} MB.")
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: np.asarray(archive[stored]) for name, stored in names.items()}
        for name, array in arrays.items():
            if array.dtype.kind not in "biuf":
                raise BadFile(f"{path}: {name} is of type {array.dtype}, not plain numbers.")
        return {name: np.asarray(array, np.float64) for name, array in arrays.items()}
    except BadFile:
        raise
    except Exception as error:  # a damaged archive can fail in any way
        line = (str(error).splitlines() or [""])[0][:120]
        raise BadFile(f"{path} is not a readable npz ({type(error).__name__}: {line}).") from None


def _kind(value: object) -> str:
    """Return a value's type in two words."""
    empty = isinstance(value, (list, tuple, dict)) and not value
    return f"{'an empty' if empty else 'a'} {type(value).__name__}"
