"""Export a dataset with frozen features instead of images, for LeRobot's ACT and Diffusion.

    export_features(dataset, rows, about, out)

The features of all views are concatenated in `observation.environment_state`, which both policies
accept without any image. `features` in `meta/surgicai.json` names the encoder, so that the env can
provide the same features.
"""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.executor import building
from surgicai_vision.core.files import check_output, write_json
from surgicai_vision.core.tasks import task_text
from surgicai_vision.dataset import schema
from surgicai_vision.dataset.reader import RenderedDataset
from surgicai_vision.dataset.schema import Table
from surgicai_vision.dataset.stats import column_statistics
from surgicai_vision.dataset.writer import EPISODE_FILE, SUMMARY_FILE, assemble, column_array


def export_features(
    dataset: RenderedDataset, rows: Sequence[NDArray[np.floating]], about: Table, out: Path
) -> None:
    """Write `out`: the columns of `dataset` and its features, without images.

    Args:
        dataset: an opened dataset.
        rows: (N, dim) features of each view.
        about: `encoder`, `views` and `weights_sha256`, stored in `meta/surgicai.json`.
        out: the new dataset's folder.

    Raises:
        OutputExists: there is something at `out` other than an empty folder.
        InputError: the features are of a different number of frames.
    """
    check_output(out, option="--export")
    for entry in rows:
        if len(entry) != dataset.length:
            raise InputError(
                f"There are {len(entry)} features, but the dataset has {dataset.length} "
                "frames; encode this dataset."
            )
    width = sum(entry.shape[1] for entry in rows)
    features = schema.features((), dataset.image_size, depth=False, segmentation=False)
    features[names.ENVIRONMENT_STATE] = {"dtype": "float32", "shape": (width,), "names": None}
    held = dataset.columns()
    columns = {key: held[key] for key in schema.COLUMNS}
    with building(out) as (store, result):
        scratch = store / "episodes"
        shutil.rmtree(scratch, ignore_errors=True)  # left by a run that was killed
        scratch.mkdir()
        shards = []
        digests = []
        for episode in np.unique(dataset.episode_index):
            where = np.flatnonzero(dataset.episode_index == episode)
            part = {key: values[where] for key, values in columns.items()}
            digests.append(schema.EpisodeDigest(()).hexdigest(part))
            part[names.ENVIRONMENT_STATE] = np.concatenate(
                [entry[where] for entry in rows], axis=1
            ).astype(np.float32)
            shards.append(_write_shard(scratch / str(episode), part))
        meta = {
            **dataset.meta,
            "request": None,  # it is not what was rendered
            "views": [],
            "depth": False,
            "segmentation": False,
            "features": dict(about),
            "exported_from": dataset.fingerprint,
            "digest": schema.dataset_digest(digests),
        }
        assemble(shards, result, features, task_text(dataset.task), meta)


def _write_shard(folder: Path, columns: Mapping[str, NDArray[np.generic]]) -> Path:
    """Write one episode in the form that `assemble` reads."""
    folder.mkdir()
    arrays = {key: column_array(values) for key, values in columns.items()}
    pq.write_table(pa.table(arrays), folder / EPISODE_FILE)
    statistics = {key: column_statistics(values) for key, values in columns.items()}
    write_json(folder / SUMMARY_FILE, {"statistics": statistics})
    return folder
