"""Assemble rendered episodes into one LeRobot v3 dataset.

    assemble(shards, out, features, text, meta)

The episodes' parquet files are copied row group by row group into data files of at most `DATA_FILE_MB`, with
the index columns filled in; info, episodes, tasks and statistics are written by LeRobot's own metadata
writer. (LeRobot's `aggregate_datasets` reads and rewrites the growing file for every episode: 7 ms a frame
of two views with depth, where this takes below 1.) The folder appears under its name when it is complete.
"""

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from surgicai_vision import names
from surgicai_vision.dataset.statistics import column_statistics
from surgicai_vision.files import read_json, whole_folder, write_json

EPISODE_FILE, SUMMARY_FILE = "episode.parquet", "summary.json"
"""What a rendered episode's folder holds."""

DATA_FILE_MB = 100
"""Largest data file, LeRobot's own default [MB]."""


def assemble(
    shards: Sequence[Path], out: Path, features: Mapping[str, Any], text: str, meta: Mapping[str, Any]
) -> None:
    """Write the dataset `out` from rendered episodes.

    Args:
        shards: the episodes' folders, in order.
        out: dataset folder; it does not exist yet.
        features: LeRobot feature table.
        text: the task's sentence.
        meta: content of `meta/surgicai.json`.
    """
    LeRobotDatasetMetadata, get_hf_features_from_features = _lerobot()
    with whole_folder(out) as folder:
        # LeRobot makes its root itself and refuses one that exists.
        folder.rmdir()
        lerobot = LeRobotDatasetMetadata.create(
            "local/surgicai-vision", names.FPS, dict(features), robot_type="psm", root=folder, use_videos=False
        )
        lerobot.save_episode_tasks([text])
        schema = get_hf_features_from_features(lerobot.features).arrow_schema
        data = _DataFiles(folder, schema, features)
        for index, shard in enumerate(shards):
            statistics = read_json(shard / SUMMARY_FILE)["statistics"]
            place, indices = data.append(index, pq.read_table(shard / EPISODE_FILE))
            statistics.update({key: column_statistics(values) for key, values in indices.items()})
            arrays = {key: {name: np.array(v) for name, v in row.items()} for key, row in statistics.items()}
            lerobot.save_episode(index, place["dataset_to_index"] - place["dataset_from_index"], [text], arrays, place)
        data.close()
        lerobot.finalize()
        write_json(folder / names.META_FILE, meta)


def _lerobot() -> Any:
    """Import what is needed of LeRobot, offline and without its notices."""
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
        from lerobot.datasets.feature_utils import get_hf_features_from_features
    finally:
        logging.disable(level)
    return LeRobotDatasetMetadata, get_hf_features_from_features


class _DataFiles:
    """The growing `data/chunk-…/file-….parquet` files: one row group an episode."""

    def __init__(self, folder: Path, schema: pa.Schema, features: Mapping[str, Any]):
        self._folder, self._schema = folder, schema
        self._file, self._frames, self._bytes = -1, 0, 0
        self._writer: pq.ParquetWriter | None = None
        depth = [key for key, row in features.items() if (row.get("info") or {}).get("is_depth_map")]
        plain = [key for key, row in features.items() if row["dtype"] != "image"]
        # PNG is compressed already; raw float32 TIFF is not, and zstd's first level halves it in no time.
        self._compression = {
            **{f"{key}.bytes": "zstd" if key in depth else "none" for key in features if key not in plain},
            **{f"{key}.path": "zstd" for key in features if key not in plain},
            **{_leaf(schema, key): "zstd" for key in schema.names if key not in features or key in plain},
        }

    def append(self, index: int, episode: pa.Table) -> tuple[dict[str, int], dict[str, np.ndarray]]:
        """Write episode `index`; return its place for LeRobot's metadata and its index columns."""
        count = len(episode)
        indices = {
            "timestamp": (np.arange(count) / names.FPS).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, index),
            "index": np.arange(self._frames, self._frames + count),
            "task_index": np.zeros(count, np.int64),
        }
        for name, values in indices.items():
            episode = episode.append_column(name, pa.array(values))
        table = episode.select(self._schema.names).cast(self._schema)
        if self._writer is None or self._bytes >= DATA_FILE_MB * 2**20:
            self._next_file()
        assert self._writer is not None
        self._writer.write_table(table, row_group_size=count)
        self._bytes = self._path().stat().st_size
        start, self._frames = self._frames, self._frames + count
        place = {
            "data/chunk_index": self._file // 1000,
            "data/file_index": self._file % 1000,
            "dataset_from_index": start,
            "dataset_to_index": self._frames,
        }
        return place, indices

    def _path(self) -> Path:
        """Return the present data file."""
        return self._folder / f"data/chunk-{self._file // 1000:03d}/file-{self._file % 1000:03d}.parquet"

    def _next_file(self) -> None:
        self.close()
        self._file += 1
        self._path().parent.mkdir(parents=True, exist_ok=True)
        self._writer = pq.ParquetWriter(
            self._path(), self._schema, compression=self._compression, compression_level=None, use_dictionary=False
        )

    def close(self) -> None:
        """Write the last file's footer."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def _leaf(schema: pa.Schema, key: str) -> str:
    """Return the parquet column path of a scalar or list column."""
    return f"{key}.list.element" if pa.types.is_fixed_size_list(schema.field(key).type) else key
