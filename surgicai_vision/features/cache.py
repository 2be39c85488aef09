"""Frames → cached frozen features.

Interface:

* `encode(dataset, view, encoder, cache_root, progress) -> Features`: encode one view of a dataset
  once.
* `Features`: the rows as a read-only float16 memory map, aligned with the dataset's frame index.
* `default_cache_root()`, `list_cache(root)`, `prune_cache(root, keep_datasets)`.

An entry is addressed by its content: the dataset's fingerprint, the view, and the encoder's
fingerprint (weights, preprocessing, pool, compute type). So encoding twice does nothing, and a
changed dataset or weights file never hits an old entry. Layout of `<cache root>/features/<key>/`:

    features.npy    (N, dim) float16, allocated in full at the start
    progress.json   rows already on disk; written after each chunk
    manifest.json   what was encoded; written last: its presence marks the entry as complete
    lock            held while a process writes

Whenever a process is killed, `progress.json` counts no more rows than are on disk. The next call
resumes there.
"""

import math
import os
import shutil
import sys
import tokenize
from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, NotRequired, TypedDict

import numpy as np
from filelock import Timeout
from numpy.typing import NDArray

from surgicai_vision import __version__
from surgicai_vision.core.config import JSON, digest, to_mapping
from surgicai_vision.core.errors import (
    BadFile,
    InputError,
    SurgicaiError,
    UnknownName,
    first_line,
)
from surgicai_vision.core.files import CACHE_VARIABLE, cache_root, locked, read_json, write_json
from surgicai_vision.core.progress import Progress
from surgicai_vision.core.untrusted import checked
from surgicai_vision.dataset.subset import DatasetSubset, whole_of

if TYPE_CHECKING:
    from encoders.base import Encoder
    from surgicai_vision.dataset.protocol import Dataset

FORMAT = 1
CHUNK = 256  # frames per progress step: 38 MB of images at 224 × 224
MANIFEST = "manifest.json"
PROGRESS = "progress.json"
ROWS = "features.npy"
LOCK = "lock"
NOT_ROWS = (OSError, ValueError, OverflowError, TypeError, tokenize.TokenError)
"""What numpy raises for a file that holds no rows; the last one is for a truncated header."""


class Manifest(TypedDict):
    """What an entry holds and how it was encoded."""

    format: int
    dataset: str
    whole: NotRequired[str]  # not in entries of earlier versions
    view: str
    encoder: str
    card: dict[str, JSON]
    encoder_fingerprint: str
    weights_sha256: str
    pool: str
    shape: list[int]
    length: int
    dim: int
    dtype: str
    code_version: str


MANIFEST_KINDS: Mapping[str, type] = MappingProxyType(
    {
        **dict.fromkeys(("dataset", "view", "encoder", "encoder_fingerprint", "pool"), str),
        **dict.fromkeys(("weights_sha256", "dtype"), str),
        **dict.fromkeys(("length", "dim"), int),
        "card": dict,
        "shape": list,
    }
)
"""Key of a manifest → its type."""


@dataclass(frozen=True)
class Features:
    """Features of one view of one dataset, complete and read-only.

    Attributes:
        folder: the cache entry.
        manifest: what was encoded and how.
        rows: (N, dim) float16 memory map; row i belongs to frame i of the dataset.
        encoded: frames encoded by the call that returned this; 0 where all were in the cache.
    """

    folder: Path
    manifest: Manifest
    rows: NDArray[np.float16]
    encoded: int = 0

    @property
    def view(self) -> str:
        """The camera the images came from."""
        return self.manifest["view"]

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one feature before it was flattened: (dim,), (C, h, w) or (N, C)."""
        return tuple(self.manifest["shape"])

    @property
    def dim(self) -> int:
        """Length of one row."""
        return self.rows.shape[1]

    def part(self, rows: NDArray[np.int64], dataset: str) -> "Features":
        """Return the features of a subset of the dataset.

        Args:
            rows: (n,) ascending indices of the subset's frames in the whole.
            dataset: fingerprint of the subset.
        """
        contiguous = len(rows) > 0 and rows[-1] - rows[0] + 1 == len(rows)
        # A slice stays on the disk; indices are copied into memory.
        taken = self.rows[int(rows[0]) : int(rows[-1]) + 1] if contiguous else self.rows[rows]
        return replace(
            self, manifest={**self.manifest, "length": len(taken), "dataset": dataset}, rows=taken
        )


default_cache_root = cache_root


def entry_key(dataset: "Dataset", view: str, encoder: "Encoder") -> str:
    """Return the address of an entry: a hash of everything its rows depend on."""
    return digest(
        {
            "format": FORMAT,
            "dataset": dataset.fingerprint,
            "view": view,
            "encoder": encoder.fingerprint,
            "dtype": "float16",
        }
    )


def encode(
    dataset: "Dataset",
    view: str,
    encoder: "Encoder",
    cache_root: Path | None = None,
    progress: Progress | None = None,
) -> Features:
    """Encode one view of a dataset, or return what was encoded before.

    For frames in a row of a dataset that is encoded as a whole, the whole's features are taken: an
    encoder gives the same image the same feature in every batch.

    Args:
        dataset: an opened dataset.
        view: one of its views.
        encoder: a frozen encoder.
        cache_root: folder of the cache; `default_cache_root()` by default.
        progress: called with (frames done, frames in total) after each chunk.

    Raises:
        UnknownName: a view the dataset does not have.
        InputError: a cache folder that cannot be written.
        SurgicaiError: a feature that is not finite.
    """
    if view not in dataset.policy_views:
        raise UnknownName("view of this dataset", view, dataset.policy_views)
    if not dataset.length:
        raise InputError("The dataset holds no frames; record and render some first.")
    root = cache_root or default_cache_root()
    if (found := _find(dataset, view, encoder, root)) is not None:
        return found
    folder = _entry_folder(dataset, view, encoder, root)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"The feature cache {folder} cannot be made ({error.strerror}); "
            f"set ${CACHE_VARIABLE} to another folder."
        ) from None
    with locked(folder / LOCK):  # a second process waits here
        if (folder / MANIFEST).exists():  # and finds the entry complete
            return open_entry(folder, dataset.length)
        encoded = _fill(folder, dataset, view, encoder, progress)
        write_json(folder / MANIFEST, _manifest(dataset, view, encoder))
        (folder / PROGRESS).unlink(missing_ok=True)
    return open_entry(folder, dataset.length, encoded)


def _entry_folder(dataset: "Dataset", view: str, encoder: "Encoder", root: Path) -> Path:
    """Return the folder of an entry in the cache `root`."""
    return root / "features" / entry_key(dataset, view, encoder)


def _find(dataset: "Dataset", view: str, encoder: "Encoder", root: Path) -> Features | None:
    """Return a dataset's features, or a part of those of its whole; None if neither is there.

    Other frames than neighbours are not taken from the whole: they would be copied into memory.
    """
    folder = _entry_folder(dataset, view, encoder, root)
    if (folder / MANIFEST).exists():
        return open_entry(folder, dataset.length)
    if not isinstance(dataset, DatasetSubset) or (np.diff(dataset.rows) != 1).any():
        return None
    found = _find(dataset.whole, view, encoder, root)
    return found and found.part(dataset.rows, dataset.fingerprint)


def open_entry(folder: Path, length: int | None = None, encoded: int = 0) -> Features:
    """Open a complete entry; `BadFile` if it is damaged."""
    try:
        manifest = _read_manifest(folder)
        rows = np.lib.format.open_memmap(folder / ROWS, mode="r")
    except (BadFile, *NOT_ROWS) as error:
        told = first_line(error).rstrip(".")
        raise BadFile(
            f"The cache entry {folder} is damaged ({told}); delete that folder."
        ) from None
    wanted = (manifest["length"] if length is None else length, manifest["dim"])
    if rows.shape != wanted or rows.dtype != np.float16:
        raise BadFile(
            f"The cache entry {folder} holds {rows.shape}, expected {wanted}; delete that folder."
        )
    return Features(folder, manifest, rows, encoded)


def _read_manifest(folder: Path) -> Manifest:
    """Return the manifest of an entry; `BadFile` if it is not one of ours."""
    stored = checked(read_json(folder / MANIFEST), dict, MANIFEST)
    for key, kind in MANIFEST_KINDS.items():
        checked(stored.get(key), kind, f"{MANIFEST}: {key}")
    checked(stored.get("whole", ""), str, f"{MANIFEST}: whole")
    sides = [checked(side, int, f"{MANIFEST}: shape") for side in stored["shape"]]
    if stored["length"] < 1 or min(sides, default=0) < 1 or math.prod(sides) != stored["dim"]:
        raise BadFile(f"{MANIFEST}: its length, shape and dim cannot be those of features")
    manifest: Manifest = stored  # type: ignore[assignment]  # what is read of it was checked
    return manifest


def _manifest(dataset: "Dataset", view: str, encoder: "Encoder") -> Manifest:
    """Describe the entry."""
    return {
        "format": FORMAT,
        "dataset": dataset.fingerprint,
        "whole": whole_of(dataset).fingerprint,
        "view": view,
        "encoder": encoder.card.name,
        "card": to_mapping(encoder.card),
        "encoder_fingerprint": encoder.fingerprint,
        "weights_sha256": encoder.weights_sha256,
        "pool": encoder.pool,
        "shape": list(encoder.shape),
        "length": dataset.length,
        "dim": encoder.dim,
        "dtype": "float16",
        "code_version": __version__,
    }


def _fill(
    folder: Path, dataset: "Dataset", view: str, encoder: "Encoder", progress: Progress | None
) -> int:
    """Encode what is missing; return how many frames that was."""
    rows, start = _allocated(folder, (dataset.length, encoder.dim))
    if progress:
        progress(start, dataset.length)
    done = start
    for stop, frames in _chunks(dataset, view, start):
        with np.errstate(over="ignore"):
            features = encoder(frames).astype(np.float16)
        if not np.isfinite(features).all():
            raise SurgicaiError(
                f"Encoder '{encoder.card.name}' gave features that are not finite in float16 "
                f"for view '{view}'."
            )
        rows[done:stop] = features
        rows.flush()
        write_json(folder / PROGRESS, {"rows": stop})
        done = stop
        if progress:
            progress(done, dataset.length)
    return done - start


def _allocated(
    folder: Path, shape: tuple[int, int]
) -> "tuple[np.memmap[tuple[int, int], np.dtype[np.float16]], int]":
    """Open the rows for writing; return them with the number of rows already there.

    Raises:
        OSError: the disk has no room for all of them.
    """
    path = folder / ROWS
    rows, done = _begun(folder, shape)
    if rows is None:
        (folder / PROGRESS).unlink(missing_ok=True)
        rows = np.lib.format.open_memmap(path, mode="w+", dtype=np.float16, shape=shape)
    _take_blocks(path)
    return rows, done


def _begun(
    folder: Path, shape: tuple[int, int]
) -> "tuple[np.memmap[tuple[int, int], np.dtype[np.float16]] | None, int]":
    """Return the rows that a killed process left, and how many; None if absent or torn."""
    try:
        rows = np.lib.format.open_memmap(folder / ROWS, mode="r+")
        done = int(read_json(folder / PROGRESS)["rows"])
    except (BadFile, KeyError, *NOT_ROWS):
        return None, 0
    fits = rows.shape == shape and rows.dtype == np.float16 and 0 <= done <= shape[0]
    return (rows, done) if fits else (None, 0)


def _take_blocks(path: Path) -> None:
    """Allocate every block of a file that was created at its full size.

    If a memory map touches a block that a full disk cannot provide, SIGBUS kills the process
    without a message. macOS has no such call.

    Raises:
        OSError: the disk has no room for it.
    """
    if sys.platform != "darwin":
        with open(path, "rb+") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)


def _chunks(dataset: "Dataset", view: str, start: int) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield (stop, frames) chunk by chunk; the next chunk is decoded while this one is encoded."""
    starts = range(start, dataset.length, CHUNK)
    if not starts:
        return
    with ThreadPoolExecutor(1) as reader:

        def read(at: int) -> NDArray[np.uint8]:
            return dataset.frames(view, at, min(at + CHUNK, dataset.length))

        pending = reader.submit(read, starts[0])
        for at in starts:
            frames = pending.result()
            if at + CHUNK < dataset.length:
                pending = reader.submit(read, at + CHUNK)
            yield min(at + CHUNK, dataset.length), frames


@dataclass(frozen=True)
class CacheEntry:
    """One entry of the cache as `list_cache` shows it.

    Attributes:
        folder: its folder.
        size: its size on disk [bytes].
        manifest: what it holds; None if it is unfinished or damaged.
    """

    folder: Path
    size: int
    manifest: Manifest | None


def list_cache(root: Path | None = None) -> list[CacheEntry]:
    """List every entry, unfinished and damaged ones included; only folders are entries."""
    folder = (root or default_cache_root()) / "features"
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    return [CacheEntry(each, _size(each), _known(each)) for each in found if each.is_dir()]


def _size(entry: Path) -> int:
    """Return the size on disk of an entry's files [bytes]."""
    size = 0
    for file in entry.iterdir():
        with suppress(FileNotFoundError):  # a process that was writing here has ended
            size += file.stat().st_blocks * 512
    return size


def _known(entry: Path) -> Manifest | None:
    """Return the manifest of an entry; None if it is missing or incomplete."""
    try:
        return _read_manifest(entry)
    except BadFile:
        return None


def prune_cache(root: Path | None = None, keep_datasets: Collection[str] = ()) -> list[CacheEntry]:
    """Delete unfinished and damaged entries and those of other datasets; return them.

    An entry that a process is writing now is left alone.

    Args:
        root: folder of the cache; `default_cache_root()` by default.
        keep_datasets: fingerprints of the datasets whose complete entries stay, and those of
            frames selected from them (`dataset.subset`).
    """
    removed = []
    for entry in list_cache(root):
        known = entry.manifest
        if known and {known["dataset"], known.get("whole")} & set(keep_datasets):
            continue
        try:
            with locked(entry.folder / LOCK, wait=False):
                shutil.rmtree(entry.folder)
        except Timeout:
            continue
        removed.append(entry)
    return removed
