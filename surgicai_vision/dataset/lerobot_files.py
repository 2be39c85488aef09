"""Read the files of any LeRobot v3 dataset one episode at a time, without trusting them.

    files = LeRobotFiles(Path("dataset"))
    files.features, files.fps, files.tasks, files.rows      # what its metadata says
    for table in files.episodes(): …                        # a pyarrow table per episode, in order

Only `meta/info.json` is required. Anything else that is missing or damaged is listed in `problems`,
and reading ends where the data does.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import cast

import pyarrow as pa
import pyarrow.parquet as pq

from surgicai_vision.core.errors import BadFile, first_line, shown
from surgicai_vision.core.files import read_json
from surgicai_vision.core.untrusted import checked
from surgicai_vision.dataset.metadata import INDEX_FEATURES, arrow_schema
from surgicai_vision.dataset.schema import Table

INFO = "meta/info.json"
STATISTICS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
DATA = "data/chunk-*/file-*.parquet"
EPISODES = "meta/episodes/chunk-*/file-*.parquet"
VERSIONS = ("v3.0", "v3.1")
type OpenFile = Callable[[Path], pq.ParquetFile]
"""Opens a data file; lerobot_salvage passes one that recovers a file without a footer."""
MOST_AXES = 5
"""Axes of a feature's shape; more are not supported by LeRobot (lerobot 0.6.1, Array5D)."""
MOST_ELEMENTS = 2**25
"""Most numbers of a feature in one frame, and of all features together that are not images.

An RGB image in 4K (3,840 × 2,160) has three quarters of it.
"""
MOST_TASKS = 1_000_000
"""Most tasks of a dataset."""
UNREADABLE = (OSError, KeyError, ValueError, TypeError, OverflowError, pa.ArrowException)


class LeRobotFiles:
    """A LeRobot dataset's metadata and access to its data.

    Attributes:
        path: its folder.
        info: content of `meta/info.json`.
        features: LeRobot's feature table, shapes as tuples.
        fps: frames per second.
        tasks: task index → its sentence.
        rows: rows of `meta/episodes`, in order; empty if they cannot be read.
        statistics: content of `meta/stats.json`.
        problems: problems found so far, one line each.

    Raises:
        BadFile: there is no `meta/info.json` of a LeRobot v3 dataset.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        if not (self.path / INFO).is_file():
            raise BadFile(
                f"{self.path} is not a LeRobot dataset: it has no {INFO}, without which nothing "
                "can be read."
            )
        self.info = read_json(self.path / INFO)
        self.problems: list[str] = []
        try:
            self.features = {
                str(key): _feature(str(key), row) for key, row in self.info["features"].items()
            }
            _check_numbers(self.features)
            self.fps = float(self.info["fps"])
            own = {key: row for key, row in self.features.items() if key not in INDEX_FEATURES}
            self.schema = arrow_schema(own)
            version = self.info["codebase_version"]
        except (*UNREADABLE, AttributeError, BadFile) as error:
            raise BadFile(
                f"{self.path / INFO} does not describe a LeRobot dataset ({first_line(error)})."
            ) from None
        if version not in VERSIONS or not self.fps > 0:
            raise BadFile(
                f"{self.path / INFO}: version {version!r}, {self.fps:g} fps; supported versions: "
                f"{', '.join(VERSIONS)}."
            )
        self.tasks = self._read_tasks()
        self.rows = self._read_rows()
        self.statistics = self._read_statistics()

    @property
    def video_keys(self) -> tuple[str, ...]:
        """Features stored as videos."""
        return tuple(key for key, row in self.features.items() if row["dtype"] == "video")

    @property
    def image_keys(self) -> tuple[str, ...]:
        """Features stored as images in the data files."""
        return tuple(key for key, row in self.features.items() if row["dtype"] == "image")

    def data_files(self) -> list[Path]:
        """Return the data files, in order."""
        return sorted(self.path.glob(DATA))

    def video_file(self, key: str, chunk: int, file: int) -> Path:
        """Return the path of one video file."""
        return self.path / f"videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"

    def _read_tasks(self) -> dict[int, str]:
        try:
            table = pq.read_table(self.path / TASKS)
            name = "task" if "task" in table.column_names else "__index_level_0__"
            pairs = zip(
                table.column("task_index").to_pylist(), table.column(name).to_pylist(), strict=True
            )
            tasks = {int(index): str(text) for index, text in pairs}
            if tasks and not 0 <= min(tasks) <= max(tasks) < MOST_TASKS:
                raise ValueError(f"a task_index is not within 0 and {MOST_TASKS - 1}")
            return tasks
        except UNREADABLE as error:
            self.problems.append(f"{TASKS} cannot be read ({first_line(error)}).")
            return {}

    def _read_rows(self) -> list[Table]:
        """Read `meta/episodes` up to the first row that is missing or out of order."""
        rows: list[Table] = []
        files = sorted(self.path.glob(EPISODES))
        try:
            for file in files:
                rows.extend(pq.ParquetFile(file).read().to_pylist())
        except UNREADABLE as error:
            self.problems.append(f"meta/episodes cannot be read ({first_line(error)}).")
        if not files:
            self.problems.append("meta/episodes is missing.")
        for number, row in enumerate(rows):
            if row.get("episode_index") != number:
                self.problems.append(
                    f"meta/episodes: row {number} belongs to episode {row.get('episode_index')}."
                )
                return rows[:number]
        return rows

    def _read_statistics(self) -> Table:
        try:
            return dict(read_json(self.path / STATISTICS))
        except (BadFile, TypeError, ValueError) as error:
            self.problems.append(first_line(error))
            return {}

    def episodes(self, open_file: OpenFile = pq.ParquetFile) -> Iterator[pa.Table]:
        """Yield the episodes' rows in order; data files are opened with `open_file`."""
        waiting: pa.Table | None = None
        for group in self._groups(open_file):
            for part in _split(group):
                if waiting is not None and _number(waiting) == _number(part):
                    waiting = pa.concat_tables([waiting, part])
                    continue
                if waiting is not None:
                    yield waiting
                waiting = part
        if waiting is not None:
            yield waiting

    def _groups(self, open_file: OpenFile) -> Iterator[pa.Table]:
        """Yield row groups with the columns of the schema, until one cannot be read."""
        for file in self.data_files():
            name = file.relative_to(self.path)
            try:
                reader = open_file(file)
                for number in range(reader.num_row_groups):
                    yield (
                        reader.read_row_group(number, self.schema.names)
                        .select(self.schema.names)
                        .combine_chunks()
                    )
            except UNREADABLE as error:
                self.problems.append(f"{name} cannot be read further ({first_line(error)}).")
                return


def _feature(key: str, row: Table) -> Table:
    """Return a feature with its shape as a tuple; refuse a name, shape or `info` that cannot be.

    A name is part of its videos' path: LeRobot allows no "/" in it, and "../x" would lead outside.
    """
    if "/" in key:
        raise ValueError(f"the feature's name {shown(key)} contains a /")
    shape = tuple(int(side) for side in row["shape"])
    fits = 1 <= len(shape) <= MOST_AXES and min(shape) >= 1
    if not fits or math.prod(shape) > MOST_ELEMENTS:
        raise ValueError(
            f"the shape of {key} must be 1 to {MOST_AXES} positive numbers whose product is at "
            f"most {MOST_ELEMENTS}"
        )
    if row.get("info") is not None:
        checked(row["info"], dict, f"info of {key}")
    return {**row, "shape": shape}


def _check_numbers(features: Mapping[str, Table]) -> None:
    """Refuse a row that is too large; an image is stored encoded, whatever its shape."""
    plain = [row["shape"] for row in features.values() if row["dtype"] not in ("image", "video")]
    count = sum(math.prod(shape) for shape in plain)
    if count > MOST_ELEMENTS:
        raise ValueError(f"a frame has {count} numbers besides images; at most {MOST_ELEMENTS}")


def _number(table: pa.Table) -> int:
    return cast(int, table.column("episode_index")[0].as_py())


def _split(table: pa.Table) -> Iterator[pa.Table]:
    """Split a table where `episode_index` changes."""
    if not len(table):
        return
    numbers = table.column("episode_index").to_numpy()
    starts = [0, *((numbers[1:] != numbers[:-1]).nonzero()[0] + 1).tolist(), len(table)]
    for start, stop in itertools.pairwise(starts):
        yield table.slice(start, stop - start)
