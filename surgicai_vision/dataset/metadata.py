"""LeRobot's v3 metadata, written without importing LeRobot.

    schema = arrow_schema(features)             # of data files, with Hugging Face's feature types
    write_metadata(folder, features, tasks, episodes)

Importing LeRobot's own writer takes 11 s on an idle machine (torch, torchvision, datasets);
everything else here takes one second. `tests/dataset/test_dataset.py` compares each part with what
lerobot 0.6.1 writes.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from surgicai_vision.core import names
from surgicai_vision.core.files import write_json
from surgicai_vision.dataset.schema import Table
from surgicai_vision.dataset.stats import Statistics

CODEBASE_VERSION = "v3.0"
FILES_PER_CHUNK = 1000
"""LeRobot's default, like the two below."""
DATA_FILE_MB = 100
VIDEO_FILE_MB = 200
ROBOT_TYPE = "psm"

INDEX_FEATURES: Mapping[str, str] = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Column that LeRobot adds to every dataset → dtype."""

Features = Mapping[str, Table]
"""LeRobot's feature table: key → dtype, shape, names, etc."""


@dataclass(frozen=True)
class EpisodeMetadata:
    """One episode's row of `meta/episodes`.

    Attributes:
        start: its first frame in the dataset.
        stop: the frame after its last.
        file: number of its data file.
        statistics: its statistics by feature.
        tasks: sentences of its tasks; empty for all tasks of the dataset.
        videos: feature → (number of the file, begin [s], end [s]).
    """

    start: int
    stop: int
    file: int
    statistics: Mapping[str, Statistics]
    tasks: tuple[str, ...] = ()
    videos: Mapping[str, tuple[int, float, float]] = field(
        default_factory=lambda: MappingProxyType({})
    )


def all_features(features: Features) -> Features:
    """Return the features and the columns that LeRobot adds."""
    added = {
        key: {"dtype": dtype, "shape": (1,), "names": None} for key, dtype in INDEX_FEATURES.items()
    }
    return {**features, **added}


def video_path(key: str, file: int) -> str:
    """Return the path of video file number `file` of a feature inside the dataset."""
    return f"videos/{key}/chunk-{file // FILES_PER_CHUNK:03d}/file-{file % FILES_PER_CHUNK:03d}.mp4"


def data_path(file: int) -> str:
    """Return the path of data file number `file` inside the dataset."""
    return f"data/chunk-{file // FILES_PER_CHUNK:03d}/file-{file % FILES_PER_CHUNK:03d}.parquet"


def arrow_schema(features: Features) -> pa.Schema:
    """Return the schema of a data file, with Hugging Face's feature types in its metadata."""
    fields: list[pa.Field] = []
    hub: dict[str, Table] = {}
    for key, feature in all_features(features).items():
        if feature["dtype"] != "video":
            kind, hub[key] = _types(feature["dtype"], feature["shape"])
            fields.append(pa.field(key, kind))
    return pa.schema(fields, metadata={"huggingface": json.dumps({"info": {"features": hub}})})


def _types(dtype: str, shape: tuple[int, ...]) -> tuple[pa.DataType, Table]:
    """Return a feature's Arrow type and Hugging Face's."""
    if dtype == "image":
        return pa.struct({"bytes": pa.binary(), "path": pa.string()}), {"_type": "Image"}
    other = {"bool": pa.bool_(), "string": pa.string()}
    kind = other.get(dtype) or pa.from_numpy_dtype(np.dtype(dtype))
    value = {"dtype": dtype, "_type": "Value"}
    if shape == (1,):
        return kind, value
    if len(shape) == 1:
        return pa.list_(kind, shape[0]), {"feature": value, "length": shape[0], "_type": "List"}
    for _ in shape:
        kind = pa.list_(kind)
    return kind, {"shape": list(shape), "dtype": dtype, "_type": f"Array{len(shape)}D"}


def write_metadata(
    folder: Path,
    features: Features,
    tasks: Sequence[str],
    episodes: Sequence[EpisodeMetadata],
    origin: Table = MappingProxyType({}),
) -> None:
    """Write `meta/info.json`, `tasks.parquet`, `episodes/…` and `stats.json` of a dataset.

    Args:
        folder: the dataset.
        features: its features, without the columns that LeRobot adds.
        tasks: the sentence of every task, in the order of `task_index`.
        episodes: every episode, in order.
        origin: the `meta/info.json` of the dataset it is made from; some of its entries are kept.
    """
    import pandas

    meta = folder / "meta"
    (meta / "episodes/chunk-000").mkdir(parents=True)
    videos = any(feature["dtype"] == "video" for feature in features.values())
    kept = ("fps", "robot_type", "tools", "data_files_size_in_mb", "video_files_size_in_mb")
    info = {
        "codebase_version": CODEBASE_VERSION,
        "fps": names.FPS,
        "features": all_features(features),
        "total_episodes": len(episodes),
        "total_frames": episodes[-1].stop,
        "total_tasks": len(tasks),
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": DATA_FILE_MB,
        "video_files_size_in_mb": VIDEO_FILE_MB,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        if videos
        else None,
        "robot_type": ROBOT_TYPE,
        "splits": {"train": f"0:{len(episodes)}"},
        **{key: origin[key] for key in kept if key in origin},
    }
    # Keys keep the order of the features, in which LeRobot shows and policies stack them.
    (meta / "info.json").write_text(json.dumps(info, indent=4) + "\n")
    index = pandas.Index(list(tasks), name="task")
    table = pandas.DataFrame({"task_index": range(len(tasks))}, index=index)
    table.to_parquet(meta / "tasks.parquet")
    rows = [_row(number, tasks, episode) for number, episode in enumerate(episodes)]
    columns = {key: [row[key] for row in rows] for key in rows[0]}
    pq.write_table(pa.Table.from_pydict(columns), meta / "episodes/chunk-000/file-000.parquet")
    write_json(meta / "stats.json", aggregate([episode.statistics for episode in episodes]))


def _row(index: int, tasks: Sequence[str], episode: EpisodeMetadata) -> Table:
    """Return an episode's row of `meta/episodes`."""
    row: dict[str, object] = {
        "episode_index": index,
        "tasks": list(episode.tasks or tasks),
        "length": episode.stop - episode.start,
        "data/chunk_index": episode.file // FILES_PER_CHUNK,
        "data/file_index": episode.file % FILES_PER_CHUNK,
        "dataset_from_index": episode.start,
        "dataset_to_index": episode.stop,
    }
    for key, (file, begin, end) in episode.videos.items():
        row[f"videos/{key}/chunk_index"] = file // FILES_PER_CHUNK
        row[f"videos/{key}/file_index"] = file % FILES_PER_CHUNK
        row[f"videos/{key}/from_timestamp"] = begin
        row[f"videos/{key}/to_timestamp"] = end
    for key, statistics in episode.statistics.items():
        row.update({f"stats/{key}/{name}": value for name, value in statistics.items()})
    return {**row, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}


def row_statistics(row: Table) -> dict[str, Statistics]:
    """Return the statistics in an episode's row of `meta/episodes`, by feature."""
    table: dict[str, Statistics] = {}
    for name, value in row.items():
        if name.startswith("stats/") and value is not None:
            _, key, statistic = name.split("/")
            table.setdefault(key, {})[statistic] = value
    return table


def aggregate(episodes: Sequence[Mapping[str, Statistics]]) -> dict[str, Statistics]:
    """Return the statistics of all episodes; quantiles are frame-weighted means, as in LeRobot."""
    return {key: _aggregate([episode[key] for episode in episodes]) for key in episodes[0]}


def _aggregate(rows: Sequence[Statistics]) -> Statistics:
    counts = np.array([row["count"][0] for row in rows], dtype=np.float64)
    weights = counts / counts.sum()
    arrays = {
        name: np.array([row[name] for row in rows], dtype=np.float64)
        for name in rows[0]
        if name != "count"
    }
    mean = np.tensordot(weights, arrays["mean"], 1)
    variance = np.tensordot(weights, arrays["std"] ** 2 + (arrays["mean"] - mean) ** 2, 1)
    result = {name: np.tensordot(weights, values, 1) for name, values in arrays.items()}
    result.update(
        min=arrays["min"].min(0), max=arrays["max"].max(0), mean=mean, std=np.sqrt(variance)
    )
    return {
        **{name: value.tolist() for name, value in result.items()},
        "count": [int(counts.sum())],
    }
