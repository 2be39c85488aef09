"""Verify a LeRobot dataset episode by episode, up to the first one that is not whole.

    verifier = Verifier(LeRobotFiles(path))
    for episode in verifier.episodes(scratch): …        # whole ones, in order
    verifier.files.problems                             # why it ended

An episode is whole if its rows are in order and finite, every image decodes to the size given by
its feature, and every video contains the episode's frames. An episode that surgicai-vision rendered
in its own layout must also pass the rules of that package (`surgicai_vision.dataset.rules`).
"""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from lerobot_salvage.recovery import open_or_recover
from surgicai_vision.core import names
from surgicai_vision.core.errors import BadFile, first_line
from surgicai_vision.core.files import read_json
from surgicai_vision.core.untrusted import checked
from surgicai_vision.dataset import codecs, schema
from surgicai_vision.dataset.lerobot_files import MOST_TASKS, LeRobotFiles
from surgicai_vision.dataset.metadata import Features, row_statistics
from surgicai_vision.dataset.reader import VIDEO_PLACE
from surgicai_vision.dataset.rules import ImageWatch, episode_problems, number_problems
from surgicai_vision.dataset.schema import Table
from surgicai_vision.dataset.stats import ImageStatistics, Statistics, column_statistics
from surgicai_vision.dataset.video import count_frames, read_frames


@dataclass(frozen=True)
class Verified:
    """A verified episode.

    Attributes:
        table: its rows, with every image's bytes.
        statistics: its statistics by feature.
        tasks: task index → its sentence, in the order of the indices.
        videos: feature → (file number, start [s], end [s]).
        digest: digest of the content, if surgicai-vision rendered it in its own layout; else "".
    """

    table: pa.Table
    statistics: Mapping[str, Statistics]
    tasks: Mapping[int, str]
    videos: Mapping[str, tuple[int, float, float]]
    digest: str


class _Unfit(Exception):
    """The reason why an episode is not whole."""


class Verifier:
    """Verifies the episodes of a dataset in order.

    Attributes:
        files: the dataset's files; the reason why the episodes end is added to its problems.
        meta: content of `meta/surgicai.json`; empty for datasets from other sources.
        ours: the same; also empty for a layout other than surgicai-vision's own.
        video_files: feature → its videos.
    """

    def __init__(self, files: LeRobotFiles):
        self.files = files
        self.meta = rendered_meta(files.path)
        self.ours = {} if "layout" in self.meta else self.meta
        self.video_files = {
            key: sorted(files.path.glob(f"videos/{key}/chunk-*/file-*.mp4"))
            for key in files.video_keys
        }
        self._lengths: dict[Path, int] = {}
        self._ends = dict.fromkeys(files.video_keys, (0, 0))

    def episodes(self, scratch: Path) -> Iterator[Verified]:
        """Yield the whole episodes from the first on; recovered files go into `scratch`."""
        open_file = functools.partial(open_or_recover, files=self.files, scratch=scratch)
        start = 0
        for number, table in enumerate(self.files.episodes(open_file)):
            try:
                yield self._verify(number, start, table)
            except (_Unfit, BadFile, pa.ArrowException, ValueError, TypeError) as error:
                self.files.problems.append(f"episode {number}: {first_line(error)}")
                return
            start += len(table)

    def _verify(self, number: int, start: int, table: pa.Table) -> Verified:
        columns = {
            key: _array(table.column(key), self.files.features, key) for key in self._plain(table)
        }
        self._check_indices(number, start, columns)
        if self.ours:
            for problem in (
                *episode_problems(number, columns, self.files.fps),
                *number_problems(columns),
            ):
                raise _Unfit(problem)
        known = row_statistics(self.files.rows[number]) if number < len(self.files.rows) else {}
        statistics = {
            key: _statistics(values, self._shape(key))
            for key, values in columns.items()
            if values.dtype != "O"
        }
        digest = schema.EpisodeDigest(self._digested())
        for key in self.files.image_keys:
            table, statistics[key] = self._images(key, table, columns, digest)
        videos = {}
        for key in self.files.video_keys:
            videos[key], seen = self._video(key, number, columns, digest)
            statistics[key] = seen or known.get(key) or self.files.statistics.get(key) or {}
            if not statistics[key]:
                del statistics[key]
        tasks = {
            index: self.files.tasks.get(index, task_name(index))
            for index in np.unique(columns["task_index"]).tolist()
        }
        content = digest.hexdigest(columns, self.ours["views"]) if self.ours else ""
        return Verified(table, statistics, tasks, videos, content)

    def _plain(self, table: pa.Table) -> list[str]:
        return [name for name in table.column_names if name not in self.files.image_keys]

    def _shape(self, key: str) -> tuple[int, ...]:
        return tuple(self.files.features.get(key, {"shape": (1,)})["shape"])

    def _digested(self) -> list[str]:
        """Return the image columns of one of our datasets, in the order of its digest."""
        if not self.ours:
            return []
        options = (self.ours["views"], self.ours["depth"], self.ours["segmentation"])
        return [key for key, _, _ in schema.image_keys(*options)]

    def _check_indices(
        self, number: int, start: int, columns: Mapping[str, NDArray[np.generic]]
    ) -> None:
        count = len(columns["index"])
        expected = {
            "episode_index": np.full(count, number),
            "frame_index": np.arange(count),
            "index": np.arange(start, start + count),
        }
        for key, values in expected.items():
            if not np.array_equal(columns[key], values):
                raise _Unfit(
                    f"its {key} is {columns[key][0]} … {columns[key][-1]}, not "
                    f"{values[0]} … {values[-1]}."
                )
        if not np.allclose(columns["timestamp"], np.arange(count) / self.files.fps, atol=1e-3):
            raise _Unfit(f"its timestamp is not frame_index / {self.files.fps:g}.")
        for key, column in columns.items():
            if column.dtype.kind == "f" and not np.isfinite(column).all():
                raise _Unfit(f"{key} holds numbers that are not finite.")
        tasks = columns["task_index"]
        if tasks.dtype.kind not in "iu" or not 0 <= tasks.min() <= tasks.max() < MOST_TASKS:
            raise _Unfit(f"its task_index is not a whole number from 0 to {MOST_TASKS - 1}.")
        rows = self.files.rows
        if number < len(rows) and rows[number].get("length") != count:
            raise _Unfit(
                f"it has {count} frames, but {rows[number].get('length')} in meta/episodes."
            )

    def _images(
        self,
        key: str,
        table: pa.Table,
        columns: Mapping[str, NDArray[np.generic]],
        digest: schema.EpisodeDigest,
    ) -> tuple[pa.Table, Statistics]:
        """Verify one image column; return the table with the bytes of images stored as files."""
        watch = self._watch(key, columns, True)
        statistics = ImageStatistics()
        found = []
        for index, (content, name) in enumerate(_contents(table.column(key))):
            content = self._beside(name) if content is None else content
            frame = codecs.decode(content, f"frame {index} of {key}")
            self._check_shape(key, index, frame)
            self._look(watch, key, index, frame)
            if self.ours:
                digest.add(key, frame)
            statistics.add(frame)
            found.append({"bytes": content, "path": name})
        column = pa.array(found, table.schema.field(key).type)
        return table.set_column(table.schema.get_field_index(key), key, column), statistics.result()

    def _watch(
        self, key: str, columns: Mapping[str, NDArray[np.generic]], lossless: bool
    ) -> ImageWatch | None:
        if not self.ours:
            return None
        return ImageWatch(key, self.ours["image_size"], self.ours["views"], columns, lossless)

    def _look(
        self, watch: ImageWatch | None, key: str, index: int, frame: NDArray[np.uint8 | np.float32]
    ) -> None:
        """Refuse an image that one of our datasets cannot contain."""
        problem = watch.problem(index, frame) if watch else ""
        if problem:
            raise _Unfit(f"frame {index} of {key}: {problem}.")

    def _check_shape(self, key: str, index: int, frame: NDArray[np.uint8 | np.float32]) -> None:
        shape = self._shape(key)
        if frame.shape not in (shape, (*shape[1:], shape[0])):
            raise _Unfit(f"frame {index} of {key} is {frame.shape}, not {shape}.")

    def _beside(self, name: str | None) -> bytes:
        """Read an image that is stored as a separate file in the dataset."""
        path = (self.files.path / (name or "")).resolve()
        if not name or not path.is_relative_to(self.files.path.resolve()) or not path.is_file():
            raise _Unfit(f"the image {name or '(no name)'} is missing.")
        return path.read_bytes()

    def _video(
        self,
        key: str,
        number: int,
        columns: Mapping[str, NDArray[np.generic]],
        digest: schema.EpisodeDigest,
    ) -> tuple[tuple[int, float, float], Statistics | None]:
        """Verify an episode's frames in a video; return where they are and their statistics."""
        count = len(columns["index"])
        fps = self.files.fps
        file, first = self._place(key, number, count)
        place = (file, first / fps, (first + count) / fps)
        path = self.video_files[key][file]
        self._ends[key] = (file, first + count)
        if (self.files.features[key].get("info") or {}).get("is_depth_map"):
            # Only LeRobot decodes quantised depth; here its frames are just counted.
            held = self._length(path)
            if held < first + count:
                raise _Unfit(f"{path.name} of {key} has {held} frames; it needs {first + count}.")
            return place, None
        watch = self._watch(key, columns, False)
        statistics = ImageStatistics()
        for index, frame in enumerate(read_frames(path, first, count, fps)):
            self._check_shape(key, index, frame)
            self._look(watch, key, index, frame)
            if self.ours:
                digest.add(key, frame)
            statistics.add(frame)
        return place, statistics.result()

    def _place(self, key: str, number: int, count: int) -> tuple[int, int]:
        """Return (file, first frame) of an episode in a feature's videos.

        Its row says where it is; without a row, it starts where the previous episode ended.
        """
        files = self.video_files[key]
        row = self.files.rows[number] if number < len(self.files.rows) else {}
        place: list[Any] = [row.get(f"videos/{key}/{name}") for name in VIDEO_PLACE]
        chunk, number_in_chunk, begin = place
        if begin is not None:
            try:
                named = self.files.video_file(key, chunk, number_in_chunk)
                first = round(begin * self.files.fps)
            except (OverflowError, TypeError, ValueError):  # missing, no number, or infinite
                raise _Unfit(f"its place in the videos of {key} is not numbers.") from None
            if first < 0:
                raise _Unfit(f"its place in the videos of {key} is before their beginning.")
            if named not in files:
                raise _Unfit(f"the video {named.relative_to(self.files.path)} is missing.")
            return files.index(named), first
        file, first = self._ends[key]
        if file < len(files) and first and self._length(files[file]) == first:
            file += 1
            first = 0
        if file >= len(files) or self._length(files[file]) < first + count:
            raise _Unfit(f"the videos of {key} do not contain all its frames.")
        return file, first

    def _length(self, path: Path) -> int:
        if path not in self._lengths:
            self._lengths[path] = count_frames(path)
        return self._lengths[path]


def claimed_episodes(files: LeRobotFiles) -> int:
    """Return the number of episodes according to `info.json`, 0 if it does not say a number."""
    claimed = files.info.get("total_episodes")
    return claimed if isinstance(claimed, int) else 0


def task_name(index: int) -> str:
    """Return the sentence of a task whose own is lost."""
    return f"task {index}"


def rendered_meta(path: Path) -> Table:
    """Return the content of `meta/surgicai.json`; empty if it is missing or damaged.

    It names a `layout` unless the dataset has surgicai-vision's own columns.
    """
    try:
        meta = checked(read_json(path / names.META_FILE), dict, names.META_FILE)
    except BadFile:
        return {}
    whole = "layout" in meta or {"views", "depth", "segmentation", "image_size"} <= set(meta)
    return meta if whole else {}


def _contents(column: pa.ChunkedArray) -> list[tuple[bytes | None, str | None]]:
    """Return (bytes, path) of every image in a column."""
    whole = column.combine_chunks()
    content = pc.struct_field(whole, "bytes").to_pylist()
    return list(zip(content, pc.struct_field(whole, "path").to_pylist(), strict=True))


def _array(column: pa.ChunkedArray, features: Features, key: str) -> NDArray[np.generic]:
    """Return a column as (T,), (T, n), … ; text as objects."""
    if column.null_count:
        raise _Unfit(f"{key} has {column.null_count} missing values.")
    flat = column.combine_chunks()
    count = len(column)
    shape = features.get(key, {"shape": (1,)})["shape"]
    sides = iter(shape)
    while pa.types.is_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        # Rows of other lengths may have the right number of values together.
        if pc.unique(pc.list_value_length(flat)).to_pylist() != [next(sides, None)]:
            raise _Unfit(f"{key} has rows that are not of shape {shape}.")
        flat = pc.list_flatten(flat)
    values = np.asarray(flat)
    whole = (count,) if shape == (1,) else (count, *shape)
    if values.size != int(np.prod(whole)):
        raise _Unfit(f"{key} has {values.size} values, not {count} × {shape}.")
    return values.reshape(whole)


def _statistics(values: NDArray[np.generic], shape: tuple[int, ...]) -> Statistics:
    """Return a column's statistics over all axes but the last, as LeRobot does."""
    table = column_statistics(values.reshape(-1, shape[-1]))
    return {**table, "count": [len(values)]}
