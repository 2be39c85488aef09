"""LeRobot's v3 metadata, written without importing LeRobot.

Its own writer would do, but importing it takes 11 s on an idle machine (torch, torchvision, datasets) where
everything else here takes one. `tests/test_dataset.py` holds each of these against what lerobot 0.6.1 writes.

    schema = arrow_schema(features)               # of data files, with what `datasets` reads from it
    write_metadata(folder, features, text, episodes)
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from surgicai_vision import names
from surgicai_vision.dataset.statistics import Statistics
from surgicai_vision.files import write_json

CODEBASE_VERSION = "v3.0"
FILES_PER_CHUNK, DATA_FILE_MB, VIDEO_FILE_MB = 1000, 100, 200
"""LeRobot's defaults."""
ROBOT_TYPE = "psm"

INDEX_FEATURES: Mapping[str, str] = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Columns LeRobot adds to every dataset → dtype."""

Features = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class EpisodeRow:
    """One episode's row: its frames [start, stop), its data file's number, and its statistics by feature."""

    start: int
    stop: int
    file: int
    statistics: Mapping[str, Statistics]


def all_features(features: Features) -> dict[str, Any]:
    """Return the features with the columns LeRobot adds."""
    added = {key: {"dtype": dtype, "shape": (1,), "names": None} for key, dtype in INDEX_FEATURES.items()}
    return {**features, **added}


def data_path(file: int) -> str:
    """Return the path of data file number `file` inside the dataset."""
    return f"data/chunk-{file // FILES_PER_CHUNK:03d}/file-{file % FILES_PER_CHUNK:03d}.parquet"


def arrow_schema(features: Features) -> pa.Schema:
    """Return the schema of a data file: Arrow types, and the same as Hugging Face's feature types."""
    fields: list[pa.Field] = []
    hub: dict[str, Any] = {}
    for key, feature in all_features(features).items():
        if feature["dtype"] == "image":
            fields.append(pa.field(key, pa.struct({"bytes": pa.binary(), "path": pa.string()})))
            hub[key] = {"_type": "Image"}
            continue
        kind = pa.bool_() if feature["dtype"] == "bool" else pa.from_numpy_dtype(np.dtype(feature["dtype"]))
        value = {"dtype": feature["dtype"], "_type": "Value"}
        if feature["shape"] == (1,):
            fields.append(pa.field(key, kind))
            hub[key] = value
        else:
            length = feature["shape"][0]
            fields.append(pa.field(key, pa.list_(kind, length)))
            hub[key] = {"feature": value, "length": length, "_type": "List"}
    return pa.schema(fields, metadata={"huggingface": json.dumps({"info": {"features": hub}})})


def write_metadata(folder: Path, features: Features, text: str, episodes: Sequence[EpisodeRow]) -> None:
    """Write `meta/info.json`, `tasks.parquet`, `episodes/…` and `stats.json` of a dataset of one task.

    Args:
        folder: the dataset.
        features: its features, without the columns LeRobot adds.
        text: the task's sentence.
        episodes: every episode, in order.
    """
    import pandas

    meta = folder / "meta"
    (meta / "episodes/chunk-000").mkdir(parents=True)
    info = {
        "codebase_version": CODEBASE_VERSION,
        "fps": names.FPS,
        "features": all_features(features),
        "total_episodes": len(episodes),
        "total_frames": episodes[-1].stop,
        "total_tasks": 1,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": DATA_FILE_MB,
        "video_files_size_in_mb": VIDEO_FILE_MB,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "robot_type": ROBOT_TYPE,
        "splits": {"train": f"0:{len(episodes)}"},
    }
    # In the order of the features, which is the order LeRobot shows and policies stack them in.
    (meta / "info.json").write_text(json.dumps(info, indent=4) + "\n")
    pandas.DataFrame({"task_index": [0]}, index=pandas.Index([text], name="task")).to_parquet(meta / "tasks.parquet")
    rows = [_row(index, text, episode) for index, episode in enumerate(episodes)]
    table = pa.Table.from_pydict({key: [row[key] for row in rows] for key in rows[0]})
    pq.write_table(table, meta / "episodes/chunk-000/file-000.parquet")
    write_json(meta / "stats.json", aggregate([episode.statistics for episode in episodes]))


def _row(index: int, text: str, episode: EpisodeRow) -> dict[str, Any]:
    """Return an episode's row of `meta/episodes`."""
    row = {
        "episode_index": index,
        "tasks": [text],
        "length": episode.stop - episode.start,
        "data/chunk_index": episode.file // FILES_PER_CHUNK,
        "data/file_index": episode.file % FILES_PER_CHUNK,
        "dataset_from_index": episode.start,
        "dataset_to_index": episode.stop,
    }
    for key, statistics in episode.statistics.items():
        row.update({f"stats/{key}/{name}": value for name, value in statistics.items()})
    return {**row, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}


def aggregate(episodes: Sequence[Mapping[str, Statistics]]) -> dict[str, Statistics]:
    """Return the statistics of all episodes together; quantiles are means weighted by frames, as LeRobot's."""
    return {key: _aggregate([episode[key] for episode in episodes]) for key in episodes[0]}


def _aggregate(rows: Sequence[Statistics]) -> Statistics:
    counts = np.array([row["count"][0] for row in rows], dtype=np.float64)
    weights = counts / counts.sum()
    arrays = {name: np.array([row[name] for row in rows], dtype=np.float64) for name in rows[0] if name != "count"}
    mean = np.tensordot(weights, arrays["mean"], 1)
    variance = np.tensordot(weights, arrays["std"] ** 2 + (arrays["mean"] - mean) ** 2, 1)
    result = {name: np.tensordot(weights, values, 1) for name, values in arrays.items()}
    result.update(min=arrays["min"].min(0), max=arrays["max"].max(0), mean=mean, std=np.sqrt(variance))
    return {**{name: value.tolist() for name, value in result.items()}, "count": [int(counts.sum())]}
