"""Import of the field's datasets: both arms' poses from LeRobot files, replayed in our scene.

    summaries = import_dataset(Path("suturing"), task=None, out=Path("demos"))

This reads a LeRobot dataset of format v2.1 or v3 whose `observation.state` holds the poses of both
arms, as published by Open-H-Embodiment and SutureBot and written by `render-demos --layout open-h`.
Its episodes are read like a bag (`rosbag.importer`): resampled to the control rate, split into
subtasks, freed of pauses and replayed. Only poses and labels are imported, no images.

* Arms: the elements of the state are found by name, `psm1_pose.position.x` … `psm1_jaw`, or
  `psm1_pos_x`, `psm1_quat_x`. Without names, a state of sixteen is PSM1's position, quaternion
  x y z w and jaw, then PSM2's. Elements with other names, such as the ECM's, are left out.
* Frame: the endoscope's view, `ECM_view`, in which a dVRK reports `measured_cp`. If their endoscope
  is placed differently from ours (`envs.absolute.T_WORLD_VIEW`), give its pose in each arm's base
  as `bag: {frames: {psm1: […], psm2: […]}}`. The jaw is the angle between the fingers.
* Labels: our column `phase`, of whole numbers, else `instruction.text` of each frame, else the
  task. Our own sentences are known; `bag: {labels: {"needle pickup": grasp}}` says what others
  mean.
* Needle: our column `needle_pose`; without it the needle is where the task's definition puts it, as
  for a bag without a needle.

Nothing in the files is executed. Columns not named here, and therefore images, are never read.
"""

import dataclasses
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, to_mapping
from surgicai_vision.core.errors import BadFile, InputError, first_line, shown
from surgicai_vision.core.files import read_json
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.core.runs import runs_of
from surgicai_vision.core.untrusted import checked, finite_number, parse_json
from surgicai_vision.demos.imports.rosbag.config import BagConfig
from surgicai_vision.demos.imports.rosbag.importer import (
    BagSummary,
    base_config,
    check_folders,
    write_tracks,
)
from surgicai_vision.demos.imports.rosbag.tracks import SegmentTrack, tracks_of
from surgicai_vision.envs import poses
from surgicai_vision.envs.absolute import ARM_SIZE, SIZE, T_BASE_VIEW
from surgicai_vision.scene.rotations import matrix_to_quaternion_flat

DATA = "data/chunk-*/*.parquet"
"""Data files of both formats: one per episode in v2.1, many episodes per file in v3."""
VERSIONS = ("v2.1", "v3.0", "v3.1")
DEMONSTRATOR = "dataset"
"""The demonstrator's name, as it is stored."""
TEXT = "instruction.text"
VIEW = "ECM_view"
POSE = "geometry_msgs/PoseStamped"
JOINT = "sensor_msgs/JointState"
UNIT_TOLERANCE = 0.01
"""Largest deviation of a quaternion's length from 1."""
JITTER_S = 1e-3
"""Times this close to those of the frame rate are replaced by them: they are float32 [s]."""
MAX_FRAMES = 5_000_000
"""Most frames in a dataset."""
FPS = (0.1, 10_000.0)
"""Fewest and most frames per second."""
MAX_SECONDS = 1e7
"""Largest time of a frame [s]: four months."""
LARGEST_WHOLE = 2**53
"""Whole numbers up to this are exact as float64."""
UNREADABLE = (OSError, KeyError, TypeError, ValueError, OverflowError, pa.ArrowException)
"""What pyarrow raises for a damaged file, and Python for values of the wrong type in it."""
ELEMENTS: Sequence[tuple[str, ...]] = (
    (
        *(f"_pose.position.{axis}" for axis in "xyz"),
        *(f"_pose.orientation.{axis}" for axis in "xyzw"),
        "_jaw",
    ),
    (*(f"_pos_{axis}" for axis in "xyz"), *(f"_quat_{axis}" for axis in "xyzw"), "_jaw"),
)
"""Endings of the names of an arm's eight elements, in our order: those of Open-H-Embodiment's
converter, and of later datasets for peg transfer that follow it."""
LABELS: Mapping[str, str] = MappingProxyType(
    {names.TASK_TEXTS[name].lower(): name for name in names.SUBTASKS}
)
"""Our sentences, in lower case → subtask."""

type Arrays = dict[str, NDArray[np.generic]]


def import_dataset(
    path: Path,
    *,
    task: str | None,
    out: Path,
    config: BagConfig = BagConfig(),  # noqa: B008  # frozen
    env: Mapping[str, object] | None = None,
    progress: Progress | None = None,
) -> list[BagSummary]:
    """Import a dataset into folders of demonstrations, one per subtask.

    Args:
        path: the dataset's folder.
        task: the requested subtask, written to `out`; None: every subtask that is found, written
            to `out`/<task>.
        out: folder to create; repeating the same import of the same data reuses it.
        config: how to read the dataset; topics and convention are those of a bag.
        env: fields of `TaskConfig`, including the scene with its hole pair and instrument.
        progress: called with (frames read, frames, "frames"), then (demonstrations done,
            demonstrations, "demonstrations").

    Raises:
        UnknownName: an unknown task.
        BadFile: a damaged dataset, or one of another format.
        InputError: no poses of the arms, an unknown label, nothing that can be replayed.
        OutputExists: `out` holds something else.
    """
    base = base_config(task, env)
    check_folders(out, task)
    config = _in_view(config)
    report = progress or silent
    files = DatasetFiles(path)
    tracks: list[SegmentTrack] = []
    skipped: list[dict[str, JSON]] = []
    content = hashlib.sha256()
    read = 0
    for number, arrays in files.episodes():
        for key in sorted(arrays):
            content.update(key.encode() + b"\0" + np.ascontiguousarray(arrays[key]).tobytes())
        name = path / f"episode {number}"
        usable, unusable = tracks_of(arrays, name, task, config, base)
        tracks += usable
        skipped += unusable
        read += len(arrays["psm1_pose.time"])
        report(read, max(read, files.frames), "frames")
    if not read:
        raise BadFile(f"{path} holds no frames ({DATA}).")
    request: dict[str, object] = {
        "dataset": content.hexdigest(),
        "bag": to_mapping(config),
        "env": dict(env or {}),
    }
    return write_tracks(tracks, skipped, task, out, base, config, request, report, DEMONSTRATOR)


def _in_view(config: BagConfig) -> BagConfig:
    """Return the config with a dataset's frame and labels where the config gives none."""
    view = {arm: _seven(arm) for arm in names.ARMS}
    frames = dataclasses.replace(
        config.frames,
        psm1=config.frames.psm1 or view[names.PSM1],
        psm2=config.frames.psm2 or view[names.PSM2],
    )
    return dataclasses.replace(config, frames=frames, labels={**LABELS, **config.labels})


def _seven(arm: str) -> tuple[float, ...]:
    """Return `ECM_view` in an arm's base, x y z [m] and a quaternion w x y z."""
    pose = T_BASE_VIEW[arm]
    return (*poses.position(pose), *matrix_to_quaternion_flat(poses.rotation(pose)))


class DatasetFiles:
    """The frames of a LeRobot dataset of either format, without their images.

    Attributes:
        frames: number of frames according to its metadata.

    Raises:
        BadFile: no such dataset, a damaged one, or one of another format.
        InputError: no poses of both arms.
    """

    def __init__(self, path: Path):
        self._path = path
        file = path / names.INFO_FILE
        info = checked(read_json(file), dict, str(file))
        version = info.get("codebase_version")
        self._fps = finite_number(info.get("fps"), f"{file}: fps")
        features = checked(info.get("features"), dict, f"{file}: features")
        self.frames = int(finite_number(info.get("total_frames", 0), f"{file}: total_frames"))
        if version not in VERSIONS or not FPS[0] <= self._fps <= FPS[1]:
            raise BadFile(
                f"{file}: version {shown(version)}, {self._fps:g} fps; supported: "
                f"{', '.join(VERSIONS)} at {FPS[0]:g} to {FPS[1]:g} fps."
            )
        self._index = _elements(path, features)
        self._columns = [names.STATE, "episode_index", "frame_index", "timestamp"]
        wanted = (names.PHASE, TEXT, "task_index", names.NEEDLE_POSE)
        self._columns += [key for key in wanted if key in features]

    def episodes(self) -> Iterator[tuple[int, Arrays]]:
        """Yield each episode's number and arrays, in the form of `rosbag.reader.read`."""
        tasks = self._tasks()
        waiting: pa.Table | None = None
        total = 0
        for file in sorted(self._path.glob(DATA)):
            try:
                total += pq.read_metadata(file).num_rows
                if total > MAX_FRAMES:  # before they are in memory
                    raise BadFile(f"{self._path} holds over {MAX_FRAMES} frames.")
                table = pq.read_table(file, columns=self._columns)
            except UNREADABLE as error:
                raise BadFile(f"{file} cannot be read ({first_line(error)}).") from None
            numbers = _whole(table, "episode_index", str(file))
            for start, stop in runs_of(numbers):
                part = table.slice(start, stop - start)
                if waiting is not None and _number(waiting) == _number(part):
                    waiting = _joined(waiting, part, str(file))
                    continue
                if waiting is not None:
                    yield _number(waiting), self._arrays(waiting, tasks)
                waiting = part
        if waiting is not None:
            yield _number(waiting), self._arrays(waiting, tasks)

    def _tasks(self) -> dict[int, str]:
        """Return each task's sentence; an empty mapping if there is no file of tasks."""
        v3 = self._path / "meta/tasks.parquet"
        v2 = self._path / "meta/tasks.jsonl"
        try:
            if v3.is_file():
                rows = pq.read_table(v3).to_pylist()
            elif v2.is_file():
                lines = v2.read_text("utf-8").splitlines()
                rows = [parse_json(line, str(v2)) for line in lines if line]
            else:
                return {}
            texts = [str(row.get("task", row.get("__index_level_0__", ""))) for row in rows]
            return {int(row["task_index"]): text for row, text in zip(rows, texts, strict=True)}
        except (AttributeError, *UNREADABLE) as error:
            raise BadFile(
                f"{self._path}: its tasks cannot be read ({first_line(error)})."
            ) from None

    def _arrays(self, table: pa.Table, tasks: Mapping[int, str]) -> Arrays:
        """Return one episode's arrays."""
        where = f"{self._path}, episode {_number(table)}"
        state = _matrix(table, names.STATE, where)
        if state.shape[1] <= max(map(max, self._index.values())):
            raise BadFile(
                f"{where}: {names.STATE} has {state.shape[1]} elements, fewer than are named."
            )
        time = self._times(table, where)
        arrays: Arrays = {"topics": np.array([names.STATE], dtype=str)}

        def add(role: str, values: NDArray[np.generic], kind: str, frame: str = "") -> None:
            arrays[f"{role}.time"] = time
            arrays[f"{role}.stamp"] = np.zeros_like(time)
            arrays[f"{role}.value"] = values
            arrays[f"{role}.type"] = np.array(kind)
            arrays[f"{role}.frame"] = np.array(frame)

        for arm, index in self._index.items():
            eight = state[:, index]
            add(f"{arm}_pose", _pose(eight[:, [0, 1, 2, 6, 3, 4, 5]], where, arm), POSE, VIEW)
            add(f"{arm}_jaw", eight[:, 7], JOINT)
        if names.NEEDLE_POSE in table.column_names:
            needle = _matrix(table, names.NEEDLE_POSE, where)
            if needle.shape[1] == 7:
                add("needle", _pose(needle, where, "the needle"), POSE, "world")
        labels = _labels(table, tasks, where)
        if labels is not None:
            add("label", labels, "std_msgs/String")
        return arrays

    def _times(self, table: pa.Table, where: str) -> NDArray[np.int64]:
        """Return each frame's time [ns].

        It comes from the frame rate if the stored times agree with that within `JITTER_S`.
        """
        even = _whole(table, "frame_index", where) / self._fps
        stored = _numbers(table, "timestamp", where)
        if max(np.abs(even).max(), np.abs(stored).max()) > MAX_SECONDS:
            raise BadFile(f"{where}: a frame's time is beyond {MAX_SECONDS:g} s.")
        is_even = bool((np.abs(stored - stored[0] - (even - even[0])) < JITTER_S).all())
        seconds = even - even[0] if is_even else stored - stored[0]
        times: NDArray[np.int64] = np.round(seconds * 1e9).astype(np.int64)
        return times


def _number(table: pa.Table) -> int:
    return int(table.column("episode_index")[0].as_py())


def _joined(first: pa.Table, second: pa.Table, where: str) -> pa.Table:
    """Return the frames of both; one episode's frames may be in two files."""
    try:
        return pa.concat_tables([first, second])
    except pa.ArrowException as error:
        raise BadFile(
            f"{where}: its columns differ from those of the previous file ({first_line(error)})."
        ) from None


def _numbers(table: pa.Table, key: str, where: str) -> NDArray[np.float64]:
    """Return a column with one number per frame as (N,), all of them finite.

    Raises:
        BadFile: there is no such column, or it holds anything else.
    """
    if key not in table.column_names:
        raise BadFile(f"{where}: it has no column {key}.")
    column = table.column(key)
    kind = column.type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)) or column.null_count:
        raise BadFile(
            f"{where}: {key} must hold a number in every frame; it is of type {shown(str(kind))} "
            f"and has {column.null_count} empty frames."
        )
    values: NDArray[np.float64] = column.to_numpy().astype(np.float64)
    if not np.isfinite(values).all():
        raise BadFile(f"{where}: {key} must hold finite numbers.")
    return values


def _whole(table: pa.Table, key: str, where: str) -> NDArray[np.int64]:
    """Return a column with one whole number per frame as (N,); raise `BadFile` as `_numbers`."""
    values = _numbers(table, key, where)
    if (np.abs(values) > LARGEST_WHOLE).any() or (values != np.floor(values)).any():
        raise BadFile(f"{where}: {key} must hold whole numbers of up to 15 digits.")
    return values.astype(np.int64)


def _elements(path: Path, features: Mapping[str, JSON]) -> dict[str, list[int]]:
    """Return the indices of each arm's eight values in the state."""
    row = features.get(names.STATE)
    known = _names(row.get("names")) if isinstance(row, dict) else []
    for endings in ELEMENTS:
        found = {arm: [f"{arm}{ending}" for ending in endings] for arm in names.ARMS}
        if all(name in known for arm_names in found.values() for name in arm_names):
            return {arm: [known.index(name) for name in row] for arm, row in found.items()}
    shape = row.get("shape") if isinstance(row, dict) else None
    if shape == [SIZE] and not any(name.startswith("psm") for name in known):
        return {
            arm: list(range(ARM_SIZE * number, ARM_SIZE * (number + 1)))
            for number, arm in enumerate(names.ARMS)
        }
    raise InputError(
        f"{path}: {names.STATE} has shape {shape} and elements {', '.join(known) or 'unnamed'}; "
        "it must hold the poses and jaws of both arms, "
        f"{', '.join(f'psm1{e}' for e in ELEMENTS[0])} and so on."
    )


def _names(given: JSON) -> list[str]:
    """Return the elements' names in their order; none where a dataset names none.

    They are a list, also one in a list or in a table ({"motors": […]}), or a table of places
    ({"psm1_jaw": 7}).
    """
    if isinstance(given, dict):
        places = {name: place for name, place in given.items() if isinstance(place, int)}
        given = list(sorted(places, key=places.__getitem__) or given.values())
    while isinstance(given, list) and len(given) == 1 and isinstance(given[0], list):
        given = given[0]
    return [str(name) for name in given] if isinstance(given, list) else []


def _matrix(table: pa.Table, key: str, where: str) -> NDArray[np.float64]:
    """Return a column of lists as (N, n)."""
    try:
        values = np.array(table.column(key).to_pylist(), dtype=np.float64)
    except UNREADABLE as error:
        raise BadFile(f"{where}: {key} holds no numbers ({first_line(error)}).") from None
    if values.ndim != 2 or not np.isfinite(values).all():
        raise BadFile(f"{where}: {key} must hold rows of finite numbers.")
    return values


def _pose(values: NDArray[np.float64], where: str, what: str) -> NDArray[np.float64]:
    """Return poses (N, 7), x y z and a unit quaternion w x y z."""
    length = np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    if (np.abs(length - 1.0) > UNIT_TOLERANCE).any():
        raise BadFile(f"{where}: a quaternion of {what} is not a unit quaternion.")
    return np.hstack([values[:, :3], values[:, 3:] / length])


def _labels(table: pa.Table, tasks: Mapping[int, str], where: str) -> NDArray[np.str_] | None:
    """Return what each frame shows: its phase, its instruction or its task; None without any.

    A column `phase` of a type other than ours is not from us and is ignored.
    """
    there = table.column_names
    if names.PHASE in there and pa.types.is_integer(table.schema.field(names.PHASE).type):
        phases = _whole(table, names.PHASE, where)
        if (phases >= 0).all():
            return np.array(phases, dtype=str)
    if TEXT in there:
        texts = [str(text) for text in table.column(TEXT).to_pylist()]
        return np.array(texts, dtype=str)
    if "task_index" in there and tasks:
        numbers = _whole(table, "task_index", where).tolist()
        return np.array([tasks.get(number, "") for number in numbers])
    return None
