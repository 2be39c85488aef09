"""Open a dataset of ours and read it fast, in order, without torch and without LeRobot.

    dataset = open_dataset(Path("dataset"))
    dataset.length, dataset.views, dataset.episode_index, dataset.columns()
    dataset.frames("front", 0, 64)          # (64, 224, 224, 3) uint8 RGB
    dataset.depth("front", 0, 64)           # (64, 224, 224, 1) float32 [m]

Frames are numbered over the whole dataset, as LeRobot's `index` column. Reading in order keeps one
row group (one episode) of one column in memory.
"""

import functools
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names
from surgicai_vision.core.config import TaskConfig, from_mapping
from surgicai_vision.core.errors import BadFile, InputError, check_name
from surgicai_vision.core.files import read_json, sha256_file
from surgicai_vision.dataset import codecs, schema
from surgicai_vision.dataset.protocol import episode_bounds
from surgicai_vision.dataset.video import read_frames

VIDEO_PLACE = ("chunk_index", "file_index", "from_timestamp")


def open_dataset(path: Path) -> "RenderedDataset":
    """Open the dataset in folder `path`.

    Raises:
        BadFile: no dataset of ours, or one whose files are damaged or do not fit each other.
    """
    return RenderedDataset(path)


@final
class RenderedDataset:
    """A rendered dataset.

    Attributes:
        path: its folder.
        meta: content of `meta/surgicai.json`.
        task: the task's name.
        config: the task's configuration.
        views: cameras, in order.
        image_size: side of the images [px].
        length: number of frames N.
        fps: frames a second of simulated time; below `names.FPS` where only every so-manieth frame
            was rendered.
        video: codec of the RGB views, None where they are lossless images.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        if not (self.path / names.META_FILE).is_file():
            raise BadFile(
                f"{self.path} is not a dataset of surgicai-vision (no {names.META_FILE} in it); make one with "
                "'surgicai-vision render-demos'."
            )
        self.meta = read_json(self.path / names.META_FILE)
        if isinstance(self.meta, dict) and self.meta.get("format") != schema.FORMAT:
            raise BadFile(
                f"{self.path} was written by another version of surgicai-vision (format "
                f"{self.meta.get('format', 1)}; this version reads {schema.FORMAT}); render it "
                "again with 'surgicai-vision render-demos'."
            )
        try:
            self.task: str = self.meta["task"]
            self.config = from_mapping(
                TaskConfig, self.meta["task_config"], str(self.path / names.META_FILE)
            )
            self.views = tuple(str(view) for view in self.meta["views"])
            self.image_size = int(self.meta["image_size"])
            self.length, self.fps = int(self.meta["frames"]), int(self.meta["fps"])
            self.video: str | None = self.meta.get("video")
            self.has_depth, self.has_segmentation = (
                bool(self.meta["depth"]),
                bool(self.meta["segmentation"]),
            )
        except (KeyError, TypeError, ValueError, InputError) as error:
            raise BadFile(f"{self.path / names.META_FILE} is damaged ({error}).") from None
        self._files = [
            _open(file) for file in sorted(self.path.glob("data/chunk-*/file-*.parquet"))
        ]
        # (file, row group, first frame, frames) of every row group, in order.
        self._groups: list[tuple[int, int, int, int]] = []
        start = 0
        for index, file in enumerate(self._files):
            for group in range(file.metadata.num_row_groups):
                count = file.metadata.row_group(group).num_rows
                self._groups.append((index, group, start, count))
                start += count
        if start != self.length:
            raise BadFile(
                f"{self.path} holds {start} frames; its {names.META_FILE} says {self.length}."
            )

    def __len__(self) -> int:
        return self.length

    @functools.cached_property
    def fingerprint(self) -> str:
        """sha256 (hex) over the data files and `meta/surgicai.json`."""
        total = hashlib.sha256()
        for file in [
            *sorted(self.path.glob("data/chunk-*/file-*.parquet")),
            self.path / names.META_FILE,
        ]:
            total.update(f"{file.relative_to(self.path)} {sha256_file(file)}\n".encode())
        return total.hexdigest()

    @functools.cached_property
    def episode_index(self) -> np.ndarray:
        """Episode of every frame, (N,) int64."""
        return self._column("episode_index")

    @property
    def sights(self) -> tuple[str, ...]:
        """What `frames` shows: the views, and their depth views where depth was rendered."""
        depth = tuple(f"{view}_depth" for view in camera_names() if view in self.views)
        return self.views + (depth if self.has_depth else ())

    @property
    def video_keys(self) -> frozenset[str]:
        """Image columns that are videos."""
        return frozenset(map(names.image_key, self.views)) if self.video else frozenset()

    def bounds(self) -> list[tuple[int, int]]:
        """Return (first frame, frame after the last) of every episode."""
        return episode_bounds(self.episode_index)

    def columns(self) -> dict[str, np.ndarray]:
        """Return every column that is no image, (N,) or (N, n): those of `layout.COLUMNS` and
        LeRobot's.
        """
        return {
            key: self._column(key) for key in (*schema.COLUMNS, "frame_index", "timestamp", "index")
        }

    def frames(self, view: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return the RGB images of a view, or a depth view's grey ones, (stop - start, H, W, 3)
        uint8.
        """
        if names.is_depth_view(view):
            return codecs.grey(self.depth(names.camera_of(view), start, stop))
        return self._images(names.image_key(self._view(view)), start, stop)

    def depth(self, view: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return the depth images of a view, (stop - start, H, W, 1) float32 [m]."""
        self._check("depth", self.has_depth)
        return self._images(names.depth_key(self._view(view)), start, stop)

    def segmentation(self, view: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return the segmentation images of a view, (stop - start, H, W, 1) uint8, indices in
        `names.PARTS`.
        """
        self._check("segmentation", self.has_segmentation)
        return self._images(names.segmentation_key(self._view(view)), start, stop)[..., :1]

    def decoded(self, key: str, start: int, stop: int) -> Iterator[np.ndarray]:
        """Yield the images start … stop - 1 of a column as they decode, whatever their size."""
        if key in self.video_keys:
            yield from self._from_videos(key, start, stop)
            return
        for position, (_, _, first, count) in enumerate(self._groups):
            low, high = max(start, first), min(stop, first + count)
            content = self._content(key, position) if low < high else []
            for index in range(low, high):
                yield codecs.decode(content[index - first], f"{self.path}: {key}, frame {index}")

    def _from_videos(self, key: str, start: int, stop: int) -> Iterator[np.ndarray]:
        """Yield the frames start … stop - 1 of a video column."""
        for row in self._rows:
            first = row["dataset_from_index"]
            low, high = max(start, first), min(stop, row["dataset_to_index"])
            if low < high:
                chunk, file = row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]
                path = self.path / f"videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"
                begin = round(row[f"videos/{key}/from_timestamp"] * self.fps)
                yield from read_frames(path, begin + low - first, high - low, self.fps)

    @functools.cached_property
    def _rows(self) -> list[dict[str, Any]]:
        """Where every episode is in the videos."""
        wanted = [f"videos/{key}/{name}" for key in self.video_keys for name in VIDEO_PLACE]
        rows: list[dict[str, Any]] = []
        for file in sorted(self.path.glob("meta/episodes/chunk-*/file-*.parquet")):
            try:
                columns = ["dataset_from_index", "dataset_to_index", *wanted]
                rows.extend(_open(file).read(columns).select(columns).to_pylist())
            except (KeyError, pa.ArrowException) as error:
                raise BadFile(
                    f"{file} does not say where the videos are ({_line(error)})."
                ) from None
        return rows

    def _view(self, view: str) -> str:
        return check_name("view of this dataset", view, self.views)

    def _check(self, what: str, present: bool) -> None:
        if not present:
            raise BadFile(f"{self.path} holds no {what}; render it again with --{what}.")

    def _column(self, key: str) -> np.ndarray:
        """Return one column, (N,) or (N, n)."""
        parts = [self._read(file, None, key) for file in range(len(self._files))]
        column = pa.chunked_array([chunk for part in parts for chunk in part.chunks])
        if pa.types.is_fixed_size_list(column.type):
            values: np.ndarray = np.asarray(pc.list_flatten(column)).reshape(
                -1, column.type.list_size
            )
        else:
            values = np.asarray(column)
        if values.dtype.kind not in "biuf" or len(values) != self.length:
            raise BadFile(
                f"{self.path}: column {key} holds {column.type} or less than a number a frame."
            )
        return values

    def _images(self, key: str, start: int, stop: int | None) -> np.ndarray:
        """Return the decoded images start … stop - 1 of a column."""
        stop = self.length if stop is None else stop
        if not 0 <= start <= stop <= self.length:
            raise InputError(
                f"frames {start} to {stop} were asked; the dataset has 0 to {self.length}."
            )
        depth = key in [names.depth_key(view) for view in self.views]
        shape = (stop - start, self.image_size, self.image_size, 1 if depth else 3)
        batch = np.empty(shape, np.float32 if depth else np.uint8)
        for index, frame in enumerate(self.decoded(key, start, stop)):
            if frame.shape != shape[1:] or frame.dtype != batch.dtype:
                raise BadFile(
                    f"{self.path}: {key}, frame {start + index}: it is {frame.shape} {frame.dtype}; "
                    f"expected {shape[1:]} {batch.dtype}."
                )
            batch[index] = frame
        return batch

    def _content(self, key: str, position: int) -> list[pa.Buffer]:
        """Return the encoded images of one row group; the last few are kept."""
        cache = self.__dict__.setdefault("_cache", {})
        if (key, position) not in cache:
            while len(cache) >= 2 * max(1, len(self.views)):
                cache.pop(next(iter(cache)))
            file, group, _, _ = self._groups[position]
            column = self._read(file, group, f"{key}.bytes", key).combine_chunks()
            cache[key, position] = [item.as_buffer() for item in pc.struct_field(column, "bytes")]
        return cache[key, position]

    def _read(self, file: int, group: int | None, column: str, key: str | None = None) -> Any:
        """Read one column of one file or row group."""
        reader = self._files[file]
        try:
            columns = [column]
            table = reader.read(columns) if group is None else reader.read_row_group(group, columns)
            return table.column(key or column)
        except (OSError, KeyError, pa.ArrowException) as error:
            raise BadFile(
                f"{self.path}: column {key or column} cannot be read ({_line(error)})."
            ) from None


def _open(path: Path) -> pq.ParquetFile:
    """Open a parquet file, or raise `BadFile`."""
    try:
        return pq.ParquetFile(path)
    except (OSError, pa.ArrowException) as error:
        raise BadFile(f"{path} is not a readable parquet file ({_line(error)}).") from None


def _line(error: Exception) -> str:
    """Return the first line of an error's text."""
    return (str(error).splitlines() or [type(error).__name__])[0]
