"""Open a dataset of ours and read it, fast and without torch or LeRobot.

    dataset = open_dataset(Path("dataset"))
    dataset.length, dataset.views, dataset.episode_index, dataset.columns()
    dataset.frames("front", 0, 64)          # (64, 224, 224, 3) uint8 RGB
    dataset.depth("front", 0, 64)           # (64, 224, 224, 1) float32 [m]
    dataset.intrinsics("front_psm2")        # (N, 3, 3) K; that of a crop includes its window
    dataset.extrinsics("front_psm2")        # (N, 4, 4) T_world_camera

Frames are numbered over the whole dataset, like LeRobot's `index` column. The encoded images of the
last few row groups (one episode of one column each) are kept in memory. Several threads may read
one dataset.
"""

import functools
import hashlib
import itertools
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names
from surgicai_vision.core.config import TaskConfig, from_mapping
from surgicai_vision.core.errors import (
    BadFile,
    InputError,
    check_at_least,
    check_at_most,
    check_name,
    first_line,
)
from surgicai_vision.core.files import read_json, sha256_file
from surgicai_vision.core.untrusted import checked
from surgicai_vision.dataset import codecs, schema
from surgicai_vision.dataset.made import Made
from surgicai_vision.dataset.protocol import episode_bounds
from surgicai_vision.dataset.video import read_frames

DAMAGED = (AttributeError, KeyError, TypeError, ValueError, OverflowError, InputError)
"""Errors raised by a value of the wrong type, or out of its range, in the metadata."""
DECODERS = 4  # threads that decode images: one core decodes about 400 of 224 × 224 a second
MOST_DECODED = 32
"""Most decoded images that wait for a reader: an episode of large ones would fill the memory."""
VIDEO_PLACE = ("chunk_index", "file_index", "from_timestamp")


def open_dataset(path: Path) -> "RenderedDataset":
    """Open the dataset in folder `path`.

    Raises:
        BadFile: not a dataset of ours, or its files are damaged or inconsistent.
    """
    return RenderedDataset(path)


class _RowGroup(NamedTuple):
    """A row group: its file, its number in the file, its first frame and its number of frames."""

    file: int
    number: int
    start: int
    frames: int


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
        fps: frames per second of simulated time; `names.FPS` divided by the control
            steps from frame to frame.
        variants: number of consecutive episodes that show one demonstration in different looks.
        video: codec of the RGB views, None if they are lossless images.
        made: how its demonstrations were made and rendered.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        file = self.path / names.META_FILE
        self.meta = _read_meta(self.path)
        try:
            self.task: str = self.meta["task"]
            self.config = from_mapping(TaskConfig, self.meta["task_config"], str(file))
            self.views = tuple(str(view) for view in self.meta["views"])
            self.image_size = int(self.meta["image_size"])
            self.length = int(self.meta["frames"])
            self.fps = int(self.meta["fps"])
            self.variants = int(self.meta.get("variants", 1))
            self.video: str | None = self.meta.get("video")
            self.made = Made.of(self.meta)
            self.has_depth = bool(self.meta["depth"])
            self.has_segmentation = bool(self.meta["segmentation"])
            checked(self.meta["digest"], str, f"{file}: digest")
            checked(self.meta["episodes"], int, f"{file}: episodes")
            for view in self.views:
                checked(self.meta["cameras"][view], dict, f"{file}: cameras")
            check_at_least(1, frames=self.length, fps=self.fps, variants=self.variants)
            check_at_least(1, image_size=self.image_size)
            check_at_most(schema.SIZES[1], image_size=self.image_size)
        except DAMAGED as error:
            raise BadFile(f"{file} is damaged ({error}).") from None
        self._paths = sorted(self.path.glob("data/chunk-*/file-*.parquet"))
        self._files = [_open(path) for path in self._paths]
        self._lock = threading.RLock()  # a parquet file read by two threads ends the process
        self._cache: dict[tuple[str, int], list[pa.Buffer]] = {}
        self._groups: list[_RowGroup] = []
        start = 0
        for index, reader in enumerate(self._files):
            for group in range(reader.metadata.num_row_groups):
                count = reader.metadata.row_group(group).num_rows
                self._groups.append(_RowGroup(index, group, start, count))
                start += count
        if start != self.length:
            raise BadFile(
                f"{self.path} holds {start} frames; its {names.META_FILE} says {self.length}."
            )

    @functools.cached_property
    def fingerprint(self) -> str:
        """Hash (hex) of the data files and `meta/surgicai.json`."""
        total = hashlib.sha256()
        for file in (*self._paths, self.path / names.META_FILE):
            total.update(f"{file.relative_to(self.path)} {sha256_file(file)}\n".encode())
        return total.hexdigest()

    @functools.cached_property
    def task_index(self) -> NDArray[np.int64]:
        """LeRobot's task index of every frame, (N,) int64; a dataset of ours has only task 0."""
        return self._column("task_index").astype(np.int64, copy=False)

    @functools.cached_property
    def episode_index(self) -> NDArray[np.int64]:
        """Episode of every frame, (N,) int64."""
        return self._column("episode_index").astype(np.int64, copy=False)

    @functools.cached_property
    def demonstration_index(self) -> NDArray[np.int64]:
        """Demonstration of every frame, (N,) int64, ascending."""
        return self.episode_index // self.variants

    @property
    def policy_views(self) -> tuple[str, ...]:
        """What `frames` shows: the views, and their depth views if depth was rendered."""
        depth = tuple(f"{view}_depth" for view in camera_names() if view in self.views)
        return self.views + (depth if self.has_depth else ())

    @property
    def image_keys(self) -> list[str]:
        """Image columns, in the order of the digest."""
        keys = schema.image_keys(self.views, self.has_depth, self.has_segmentation)
        return [key for key, _, _ in keys]

    @property
    def video_keys(self) -> frozenset[str]:
        """Image columns that are stored as videos."""
        return frozenset(map(names.image_key, self.views)) if self.video else frozenset()

    def bounds(self) -> list[tuple[int, int]]:
        """Return (first frame, frame after the last) of every episode."""
        return episode_bounds(self.episode_index)

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """Return every column that is not an image, (N,) or (N, n), by its key."""
        keys = (*schema.columns(self.views), "frame_index", "timestamp", "index")
        return {key: self._column(key) for key in keys}

    def frames(self, view: str, start: int = 0, stop: int | None = None) -> NDArray[np.uint8]:
        """Return the images of one of the `policy_views`, (stop - start, H, W, 3) uint8 RGB."""
        if names.is_depth_view(view):
            return codecs.grey(self.depth(names.camera_of(view), start, stop))
        return self._images(names.image_key(self._view(view)), start, stop, np.uint8)

    def depth(self, view: str, start: int = 0, stop: int | None = None) -> NDArray[np.float32]:
        """Return the depth images of a view, (stop - start, H, W, 1) float32 [m]."""
        self._check("depth", self.has_depth)
        return self._images(names.depth_key(self._view(view)), start, stop, np.float32)

    def segmentation(self, view: str, start: int = 0, stop: int | None = None) -> NDArray[np.uint8]:
        """Return the index in `names.PARTS` of a view's pixels, (stop - start, H, W, 1) uint8."""
        self._check("segmentation", self.has_segmentation)
        key = names.segmentation_key(self._view(view))
        return self._images(key, start, stop, np.uint8)[..., :1]

    def intrinsics(self, view: str) -> NDArray[np.float32]:
        """Return a view's nominal camera matrix K of every frame, (N, 3, 3) [pixel].

        The principal point of a crop encodes where its window lies in its camera's image.
        """
        key = names.intrinsics_key(self._view(view))
        return self._column(key).astype(np.float32, copy=False).reshape(-1, 3, 3)

    def extrinsics(self, view: str) -> NDArray[np.float32]:
        """Return a view's nominal T_world_camera of every frame, OpenCV axes, (N, 4, 4) [m]."""
        key = names.extrinsics_key(self._view(view))
        return self._column(key).astype(np.float32, copy=False).reshape(-1, 4, 4)

    def decoded(self, key: str, start: int, stop: int) -> Iterator[NDArray[np.uint8 | np.float32]]:
        """Yield the images start … stop - 1 of a column as decoded, whatever their size."""
        if key in self.video_keys:
            yield from self._from_videos(key, start, stop)
            return
        with ThreadPoolExecutor(DECODERS) as decoders:
            for position, group in enumerate(self._groups):
                low = max(start, group.start)
                high = min(stop, group.start + group.frames)
                if low < high:
                    content = self._content(key, position)[low - group.start : high - group.start]
                    where = [f"{self.path}: {key}, frame {index}" for index in range(low, high)]
                    for some in itertools.batched(zip(content, where, strict=True), MOST_DECODED):
                        yield from decoders.map(codecs.decode, *zip(*some, strict=True))

    def _from_videos(
        self, key: str, start: int, stop: int
    ) -> Iterator[NDArray[np.uint8 | np.float32]]:
        """Yield the frames start … stop - 1 of a video column."""
        for row in self._rows:
            first = row["dataset_from_index"]
            low = max(start, first)
            high = min(stop, row["dataset_to_index"])
            if low < high:
                chunk = row[f"videos/{key}/chunk_index"]
                file = row[f"videos/{key}/file_index"]
                path = self.path / f"videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"
                begin = round(row[f"videos/{key}/from_timestamp"] * self.fps)
                yield from read_frames(path, begin + low - first, high - low, self.fps)

    @functools.cached_property
    def _rows(self) -> list[schema.Table]:
        """The place of every episode in the videos."""
        wanted = [f"videos/{key}/{name}" for key in self.video_keys for name in VIDEO_PLACE]
        rows: list[schema.Table] = []
        for file in sorted(self.path.glob("meta/episodes/chunk-*/file-*.parquet")):
            try:
                columns = ["dataset_from_index", "dataset_to_index", *wanted]
                found = _open(file).read(columns).select(columns)
                rows.extend(_checked_places(found, file).to_pylist())
            except (KeyError, pa.ArrowException) as error:
                raise BadFile(
                    f"{file} does not say where the videos are ({first_line(error)})."
                ) from None
        shown = [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows]
        if shown != self.bounds():
            raise BadFile(
                f"{self.path}: the rows of meta/episodes are not those of the episodes in the "
                "data; repair it first with 'lerobot-salvage repair'."
            )
        return rows

    def _view(self, view: str) -> str:
        return check_name("view of this dataset", view, self.views)

    def _check(self, what: str, present: bool) -> None:
        if not present:
            raise BadFile(f"{self.path} holds no {what}; render it again with --{what}.")

    def _column(self, key: str) -> NDArray[np.generic]:
        """Return one column, (N,) or (N, n)."""
        parts = [self._read(file, None, key) for file in range(len(self._files))]
        column = pa.chunked_array([chunk for part in parts for chunk in part.chunks])
        if pa.types.is_fixed_size_list(column.type):
            values: NDArray[np.generic] = np.asarray(pc.list_flatten(column)).reshape(
                -1, column.type.list_size
            )
        else:
            values = np.asarray(column)
        if values.dtype.kind not in "biuf" or len(values) != self.length:
            raise BadFile(
                f"{self.path}: column {key} holds {column.type} or fewer than one number per frame."
            )
        wanted = schema.width(key, self.views)
        if values.shape[1:] != ((wanted,) if wanted else ()):
            raise BadFile(
                f"{self.path}: column {key} has {values[0].size} numbers per frame; "
                f"{max(wanted, 1)} are expected."
            )
        return values

    def _images[T: (np.uint8, np.float32)](
        self, key: str, start: int, stop: int | None, dtype: type[T]
    ) -> NDArray[T]:
        """Return the decoded images start … stop - 1 of a column; depth has dtype float32."""
        stop = self.length if stop is None else stop
        if not 0 <= start <= stop <= self.length:
            raise InputError(
                f"frames {start} to {stop} were requested; the dataset has 0 to {self.length}."
            )
        channels = 1 if np.dtype(dtype).kind == "f" else 3
        shape = (stop - start, self.image_size, self.image_size, channels)
        batch = np.empty(shape, dtype)
        for index, frame in enumerate(self.decoded(key, start, stop)):
            if frame.shape != shape[1:] or frame.dtype != batch.dtype:
                raise BadFile(
                    f"{self.path}: {key}, frame {start + index}: it is {frame.shape} "
                    f"{frame.dtype}; expected {shape[1:]} {batch.dtype}."
                )
            batch[index] = frame
        return batch

    def _content(self, key: str, position: int) -> list[pa.Buffer]:
        """Return the encoded images of one row group; the last few are kept."""
        with self._lock:
            if (key, position) not in self._cache:
                while len(self._cache) >= 2 * max(1, len(self.views)):
                    self._cache.pop(next(iter(self._cache)))
                group = self._groups[position]
                column = self._read(group.file, group.number, f"{key}.bytes", key).combine_chunks()
                images = pc.struct_field(column, "bytes")
                if not (pa.types.is_binary(images.type) or pa.types.is_large_binary(images.type)):
                    raise BadFile(f"{self.path}: column {key} holds {images.type}, not images.")
                content = [item.as_buffer() for item in images]
                self._cache[key, position] = content
            return self._cache[key, position]

    def _read(
        self, file: int, group: int | None, column: str, key: str | None = None
    ) -> pa.ChunkedArray:
        """Read one column of one file or row group."""
        reader = self._files[file]
        try:
            columns = [column]
            with self._lock:
                table = (
                    reader.read(columns) if group is None else reader.read_row_group(group, columns)
                )
            return table.column(key or column)
        except (OSError, KeyError, pa.ArrowException) as error:
            raise BadFile(
                f"{self.path}: column {key or column} cannot be read ({first_line(error)})."
            ) from None


def _read_meta(path: Path) -> schema.Table:
    """Return the content of `meta/surgicai.json`, or raise `BadFile`."""
    file = path / names.META_FILE
    if not file.is_file():
        raise BadFile(
            f"{path} is not a dataset of surgicai-vision (no {names.META_FILE} in it); make one "
            "with 'surgicai-vision render-demos'."
        )
    meta = read_json(file)
    if not isinstance(meta, dict):
        raise BadFile(f"{file} is damaged (it holds no table).")
    if meta.get("format") != schema.FORMAT:
        raise BadFile(
            f"{path} was written by another version of surgicai-vision (format "
            f"{meta.get('format', 1)}; this version reads {schema.FORMAT}); render it again with "
            "'surgicai-vision render-demos'."
        )
    if "layout" in meta:
        raise BadFile(
            f"{path} has the third-party layout '{meta['layout']}', which lerobot-train and "
            "LeRobot's tools read; for this command, render the demonstrations without --layout."
        )
    return meta


def _checked_places(table: pa.Table, file: Path) -> pa.Table:
    """Return a table of numbers, integers except times; raise `BadFile` if they are not."""
    for name, column in zip(table.column_names, table.columns, strict=True):
        values = column.to_numpy()
        wanted = "iuf" if name.endswith(VIDEO_PLACE[-1]) else "iu"
        if values.dtype.kind not in wanted or not np.isfinite(values).all():
            raise BadFile(f"{file}: {name} must hold numbers; render the dataset again.")
    return table


def _open(path: Path) -> pq.ParquetFile:
    """Open a parquet file, or raise `BadFile`."""
    try:
        return pq.ParquetFile(path)
    except (OSError, pa.ArrowException) as error:
        raise BadFile(f"{path} is not a readable parquet file ({first_line(error)}).") from None
