"""Demonstrations on disk: states without images, one file per episode, each written atomically.

A folder of demonstrations holds `demos.json` (format, version, task, demonstrator, what was
skipped) and `episode_000000.safetensors`, `episode_000001.safetensors`, … An episode file holds the
arrays of `Demo` and, in its metadata, everything else as JSON. Nothing in it is executable; a
damaged file raises `BadFile`.

    write_demo(folder, 0, demo)        demo = read_demo(list_demos(folder)[0])
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, digest, from_mapping, to_mapping
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.core.files import code_version, read_json, sha256_file, write_bytes, write_json
from surgicai_vision.core.untrusted import checked, parse_json

FORMAT = "surgicai-vision-demos"
VERSION = 2
MARKER = "demos.json"
"""The file that marks a folder as a folder of demonstrations."""

ARRAYS = {
    "state": ("float64", 2),
    "action": ("float32", 2),
    "phase": ("int8", 1),
    "reward": ("float32", 1),
    "success": ("bool", 1),
    "contact": ("bool", 1),
}
"""Array → (dtype, number of axes) as stored."""
EXECUTED = "executed"
"""Name of the array that only disturbed episodes have."""
SOURCE = "source"
"""Name of the metadata field that only re-posed episodes have."""


@dataclass(frozen=True)
class Demo:
    """One episode of T control steps.

    Attributes:
        config: the task and scene it was made in.
        seed: seed of the start state; -1 if the episode has none (an imported recording).
        demonstrator: "expert", "surgicai", …
        scene_hash: hash of the compiled scene.
        code_version: version of the code that made it.
        state: whole simulator state before each step and after the last, (T + 1, n) float64.
        action: the actions, which are the labels, (T, 7) float32, in [-1, 1].
        phase: index in `names.SUBTASKS` before each step, -1 in another task, (T,) int8.
        reward: reward of each step, (T,) float32.
        success: whether the task is met after each step, (T,) bool.
        contact: whether the jaws touch the needle after each step, (T,) bool.
        executed: the executed actions if they may differ from `action`, (T, 7) float32, or None.
        source: sha256 of the file of the demonstration that this one re-poses; "" if it re-poses
            none.

    Raises:
        InputError: lengths, shapes or numbers that do not match.
    """

    config: TaskConfig
    seed: int
    demonstrator: str
    scene_hash: str
    code_version: str
    state: NDArray[np.float64]
    action: NDArray[np.float32]
    phase: NDArray[np.int8]
    reward: NDArray[np.float32]
    success: NDArray[np.bool_]
    contact: NDArray[np.bool_]
    executed: NDArray[np.float32] | None = None
    source: str = ""

    def __post_init__(self) -> None:
        # Types and axes, then lengths, then the numbers themselves.
        arrays = self.arrays
        for name, (dtype, axes) in ARRAYS.items():
            array = arrays[name]
            if array.ndim != axes or array.dtype != dtype:
                raise InputError(
                    f"Demo.{name} is {array.dtype} with {array.ndim} axes; "
                    f"it must be {dtype} with {axes}."
                )
        if len(self.state) != len(self.action) + 1 or not len(self.action):
            raise InputError(
                f"Demo has {len(self.state)} states and {len(self.action)} actions; "
                "there must be at least one action and one state more than actions."
            )
        for name in ("phase", "reward", "success", "contact"):
            if len(arrays[name]) != len(self.action):
                raise InputError(
                    f"Demo has {len(arrays[name])} of {name} and {len(self.action)} actions."
                )
        executed = self.action if self.executed is None else self.executed
        if executed.shape != self.action.shape or executed.dtype != np.float32:
            raise InputError(
                f"Demo.executed is {executed.shape} {executed.dtype}; "
                f"it must be {self.action.shape} float32."
            )
        if self.action.shape[1] != len(names.ACTION_NAMES):
            raise InputError(
                f"Demo.action has {self.action.shape[1]} columns; "
                f"it must have {len(names.ACTION_NAMES)}."
            )
        numbers = (self.state, self.action, self.reward, executed)
        if not all(np.isfinite(array).all() for array in numbers):
            raise InputError("Demo holds numbers that are not finite.")
        largest = max(float(np.abs(array).max()) for array in (self.action, executed))
        if largest > 1.0:
            raise InputError(f"Demo has an action of {largest:g}; allowed: -1 to 1.")
        if not -1 <= self.phase.min() <= self.phase.max() < len(names.SUBTASKS):
            raise InputError(
                f"Demo has phases {self.phase.min()} to {self.phase.max()}; allowed: -1 to "
                f"{len(names.SUBTASKS) - 1}."
            )

    @property
    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return the arrays by their names in `ARRAYS`."""
        return {
            "state": self.state,
            "action": self.action,
            "phase": self.phase,
            "reward": self.reward,
            "success": self.success,
            "contact": self.contact,
        }

    def __len__(self) -> int:
        """Return the number of control steps T."""
        return len(self.action)


def demo_bytes(demo: Demo) -> bytes:
    """Return the content of an episode file."""
    details = {
        "format": FORMAT,
        "version": VERSION,
        "config": to_mapping(demo.config),
        "seed": int(demo.seed),
        "demonstrator": demo.demonstrator,
        "scene_hash": demo.scene_hash,
        "code_version": demo.code_version,
        **({SOURCE: demo.source} if demo.source else {}),
    }
    arrays = {name: np.ascontiguousarray(array) for name, array in demo.arrays.items()}
    if demo.executed is not None:
        arrays[EXECUTED] = np.ascontiguousarray(demo.executed)
    return save(arrays, metadata={"demo": json.dumps(details, sort_keys=True)})


def write_demo(folder: Path, index: int, demo: Demo) -> Path:
    """Write episode `index` into `folder` atomically; return its path."""
    path = folder / f"episode_{index:06d}.safetensors"
    write_bytes(path, demo_bytes(demo))
    return path


def read_demo(path: Path) -> Demo:
    """Read one episode.

    Raises:
        BadFile: missing, damaged, or not an episode of ours.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            details = parse_json(
                (file.metadata() or {}).get("demo", "null"), f"{path}: its metadata"
            )
            present = [*ARRAYS, *({EXECUTED} & set(file.keys()))]
            arrays = {name: file.get_tensor(name) for name in present}
        if not isinstance(details, dict) or details.pop("format", None) != FORMAT:
            raise BadFile(f"{path} is not a demonstration (no '{FORMAT}' in its metadata).")
        _check_version(path, details.pop("version"))
        details["config"] = from_mapping(TaskConfig, details["config"], str(path))
        fields = {field.name for field in dataclasses.fields(Demo)} - {*ARRAYS, EXECUTED, SOURCE}
        if set(details) - {SOURCE} != fields:
            raise BadFile(f"{path}: its metadata has {sorted(details)}; expected {sorted(fields)}.")
        for name, value in details.items():
            if name != "config":
                checked(value, int if name == "seed" else str, f"{path}: {name}")
        return Demo(**details, **arrays)
    except (OSError, SafetensorError, ValueError, KeyError, TypeError) as error:
        raise BadFile(f"{path} cannot be read as a demonstration ({error}).") from None
    except InputError as error:
        raise error if isinstance(error, BadFile) else BadFile(f"{path}: {error}") from None


def write_marker(folder: Path, task: str, demonstrator: str, **details: object) -> None:
    """Write `demos.json`, which says what the folder holds and which code wrote it."""
    write_json(
        folder / MARKER,
        {
            "format": FORMAT,
            "version": VERSION,
            "task": task,
            "demonstrator": demonstrator,
            "code": code_version(),
            **details,
        },
    )


def read_marker(folder: Path) -> dict[str, Any]:
    """Read `demos.json`.

    Raises:
        BadFile: `folder` is not a folder of demonstrations, or another release wrote it.
    """
    if not (folder / MARKER).is_file():
        raise BadFile(
            f"{folder} is not a folder of demonstrations (no {MARKER} in it); make one with "
            "'surgicai-vision record-demos' or 'import-demos'."
        )
    marker = read_json(folder / MARKER)
    if not isinstance(marker, dict) or marker.get("format") != FORMAT:
        raise BadFile(f"{folder / MARKER} is not of format {FORMAT}.")
    _check_version(folder / MARKER, marker.get("version"))
    for key in ("task", "demonstrator"):
        checked(marker.get(key), str, f"{folder / MARKER}: {key}")
    if marker.get("request") is not None:
        checked(marker["request"], dict, f"{folder / MARKER}: request")
    return marker


def is_same_request(stored: object, request: Mapping[str, object]) -> bool:
    """Return True if the request stored in a marker is this one.

    A field that `TaskConfig` has gained since the marker was written counts as its default.

    Args:
        stored: what the marker holds; None if it holds no request.
        request: in it, "task" is a whole `TaskConfig` as data, if it is a table.
    """
    if isinstance(stored, dict) and isinstance(stored.get("task"), dict):
        try:
            config = from_mapping(TaskConfig, stored["task"])
        except InputError:
            return False
        stored = {**stored, "task": to_mapping(config)}
    return stored == request


def _check_version(path: Path, version: object) -> None:
    """Refuse a file of another format version, including those of release 0.1 (version 1)."""
    if version != VERSION:
        writer = "was written by release 0.1" if version == 1 else f"has format version {version}"
        raise BadFile(
            f"{path} {writer}; this release reads format version {VERSION}: "
            "record or import the demonstrations again."
        )


def list_demos(folder: Path) -> list[Path]:
    """Return the episode files of a folder of demonstrations, in order.

    Raises:
        BadFile: no such folder, no episodes in it, or a gap in their numbers.
    """
    read_marker(folder)
    paths = sorted(folder.glob("episode_*.safetensors"))
    if not paths:
        raise BadFile(f"{folder} holds no episodes.")
    for index, path in enumerate(paths):
        if path.name != f"episode_{index:06d}.safetensors":
            raise BadFile(f"{folder}: episode {index} is missing (found {path.name} instead).")
    return paths


def first_demos(folder: Path, count: int | None) -> list[Path]:
    """Return the files of the first `count` episodes of a folder of demonstrations; None: all.

    Raises:
        BadFile: as `list_demos`.
        InputError: it holds fewer.
    """
    paths = list_demos(folder)
    if count is not None and count > len(paths):
        raise InputError(f"{count} demonstrations were requested; {folder} holds {len(paths)}.")
    return paths[:count]


def demos_digest(paths: list[Path]) -> str:
    """Return the sha256 over the episodes' files, in order."""
    return digest([sha256_file(path) for path in paths])


def distinct_folders(folders: Sequence[Path]) -> list[Path]:
    """Return the folders of demonstrations; refuse one that is given twice."""
    known: set[Path] = set()
    for folder in folders:
        if folder.resolve() in known:
            raise InputError(
                f"The demonstrations in {folder} are given twice; give each folder once."
            )
        known.add(folder.resolve())
    return list(folders)
