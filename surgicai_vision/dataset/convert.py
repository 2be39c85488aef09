"""Make a dataset from a dataset, without rendering: fewer views, or videos in the place of images.

    convert_dataset(Path("dataset"), Path("dataset-back"), views=("back",))
    made = convert_dataset(Path("dataset"), Path("dataset-h264"), video="h264")
    made.video_error                # view → mean absolute error of its pixels, out of 255

Columns, depth, segmentation and, without `video`, the images are taken over byte by byte. A video
loses something: every frame is decoded again and compared with its image, and what was lost is
written into `meta/surgicai.json`.
"""

import dataclasses
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.core import names
from surgicai_vision.core.errors import BadFile, InputError, OutputExists, check_name
from surgicai_vision.core.executor import RunContext, building, work_folder
from surgicai_vision.core.files import check_output, read_json, whole_folder, write_json
from surgicai_vision.core.progress import Progress
from surgicai_vision.dataset import schema
from surgicai_vision.dataset.lerobot_files import LeRobotFiles
from surgicai_vision.dataset.metadata import (
    FILES_PER_CHUNK,
    INDEX_FEATURES,
    EpisodeRow,
    row_statistics,
    write_metadata,
)
from surgicai_vision.dataset.reader import RenderedDataset, open_dataset
from surgicai_vision.dataset.video import CODECS, PIXELS
from surgicai_vision.dataset.video_jobs import Encoded, Place, encode_views
from surgicai_vision.dataset.writer import DataFiles


@dataclass(frozen=True)
class DatasetSummary:
    """What was made.

    Attributes:
        frames: number of frames.
        episodes: number of episodes.
        seconds: wall-clock time.
        digest: of the decoded content.
        video_error: view → mean absolute error of its video, out of 255; none where images are
            lossless.
    """

    frames: int
    episodes: int
    seconds: float
    digest: str
    video_error: Mapping[str, float] = dataclasses.field(default_factory=dict)


def convert_dataset(
    path: Path,
    out: Path,
    *,
    views: Sequence[str] | None = None,
    video: str | None = None,
    context: RunContext = RunContext(),
) -> DatasetSummary:
    """Write `out`: the views `views` of the dataset `path`, as videos where `video` says so.

    Args:
        path: a dataset of ours.
        out: dataset folder to make; the same request finds it finished.
        views: some of its views, in the order of the new dataset's columns; all by default.
        video: codec, a key of `video.CODECS`; by default images stay as they are.
        context: workers, engine and display.

    Raises:
        UnknownName: a view that the dataset does not have, an unknown codec.
        InputError: a video was asked of a dataset of videos.
        OutputExists: `out` holds something else.
    """
    started = time.monotonic()
    dataset = open_dataset(path)
    views = dataset.views if views is None else tuple(views)
    for view in views:
        check_name("view of this dataset", view, dataset.views)
    if not views or len(set(views)) != len(views):
        raise InputError(f"views are {', '.join(views) or 'none'}; give at least one, each once.")
    check_video(video)
    if video and dataset.video:
        raise InputError(
            f"{path} holds videos already ({dataset.video}); make others from a dataset of images."
        )
    request = {
        "dataset": dataset.meta["digest"],
        "views": list(views),
        "video": video or dataset.video,
    }
    check_output(out, may_resume=names.META_FILE)
    if not (out / names.META_FILE).exists():
        title = f"dataset: {', '.join(views)} of {path.name}"
        with building(out) as (store, result), context.stage(title, "frames") as progress:
            changes = {"request": request}
            write_converted(dataset, result, views, video, changes, store, context, progress)
    return finished(out, request, started)


def check_video(video: str | None) -> None:
    """Raise `UnknownName` unless `video` is a codec or None."""
    if video is not None:
        check_name("video codec", video, CODECS)


def finished(out: Path, request: Mapping[str, Any], started: float) -> DatasetSummary:
    """Return the summary of a finished dataset if it is the one asked for; `OutputExists` if it is
    another.
    """
    meta = read_json(out / names.META_FILE)
    if meta.get("request") != request:
        raise OutputExists(
            f"--out {out} holds a dataset of other demonstrations or options (see {out / names.META_FILE}); "
            "give another folder."
        )
    # Left by a run that was killed after its last step.
    shutil.rmtree(work_folder(out), ignore_errors=True)
    seconds = time.monotonic() - started
    return DatasetSummary(
        meta["frames"], meta["episodes"], seconds, meta["digest"], meta.get("video_error", {})
    )


def write_converted(
    dataset: RenderedDataset,
    out: Path,
    views: Sequence[str],
    video: str | None,
    changes: Mapping[str, Any],
    store: Path,
    context: RunContext,
    progress: Progress,
) -> None:
    """Write the folder `out`, whole; `changes` go into its `meta/surgicai.json`, jobs in `store`
    make videos.
    """
    files = LeRobotFiles(dataset.path)
    if len(files.rows) != int(dataset.meta["episodes"]):
        raise BadFile(f"{dataset.path} is damaged ({' '.join(files.problems)}); repair it first.")
    keys = [
        key for key, _, _ in schema.image_keys(views, dataset.has_depth, dataset.has_segmentation)
    ]
    features = _features(files, dataset, keys, video)
    with whole_folder(out) as folder:
        encoded: list[dict[str, Encoded]] = []
        if video:
            encoded = encode_views(
                dataset,
                folder,
                views,
                video,
                store=store,
                context=context,
                progress=progress,
            )
            places = [{key: item.place for key, item in episode.items()} for episode in encoded]
        else:
            places = _copy_videos(files, folder, [key for key in keys if key in dataset.video_keys])
        rows = _write_data(files, folder, features, places)
        write_metadata(folder, features, list(files.tasks.values()), rows, files.info)
        digest, errors = _look(dataset, keys, rows, encoded, progress)
        meta = {
            **dataset.meta,
            "views": list(views),
            "cameras": {view: dataset.meta["cameras"][view] for view in views},
            "made_from": dataset.meta["digest"],
            "digest": digest,
            **({"video": video, "video_error": errors} if video else {}),
            **changes,
        }
        write_json(folder / names.META_FILE, meta)


def _features(
    files: LeRobotFiles, dataset: RenderedDataset, keys: Sequence[str], video: str | None
) -> dict[str, Any]:
    """Return the new dataset's features."""
    features = {key: files.features[key] for key in keys}
    for key, row in files.features.items():
        if row["dtype"] not in ("image", "video") and key not in INDEX_FEATURES:
            features[key] = row
    if video:
        info = {
            "video.height": dataset.image_size,
            "video.width": dataset.image_size,
            "video.codec": video,
            "video.pix_fmt": PIXELS,
            "video.fps": dataset.fps,
            "video.channels": 3,
            "has_audio": False,
            "is_depth_map": False,
        }
        for view in dataset.views:
            key = names.image_key(view)
            if key in features:
                features[key] = {**features[key], "dtype": "video", "info": info}
    return features


def _write_data(
    files: LeRobotFiles,
    folder: Path,
    features: Mapping[str, Any],
    places: Sequence[Mapping[str, Place]],
) -> list[EpisodeRow]:
    """Write the data files; return the episodes' rows."""
    data = DataFiles(folder, features, files.fps)
    rows = []
    for number, table in enumerate(files.episodes()):
        statistics = row_statistics(files.rows[number])
        kept = {key: value for key, value in statistics.items() if key in features}
        row = data.append(number, table, kept)
        rows.append(dataclasses.replace(row, videos=places[number]) if places else row)
    data.close()
    return rows


def _copy_videos(files: LeRobotFiles, folder: Path, keys: Sequence[str]) -> list[dict[str, Place]]:
    """Take over the videos of `keys`; return where each episode is in them."""
    places: list[dict[str, Place]] = [{} for _ in files.rows]
    for key in keys:
        for file in files.path.glob(f"videos/{key}/chunk-*/file-*.mp4"):
            target = folder / file.relative_to(files.path)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
        for number, row in enumerate(files.rows):
            file_number = (
                row[f"videos/{key}/chunk_index"] * FILES_PER_CHUNK + row[f"videos/{key}/file_index"]
            )
            span = (row[f"videos/{key}/from_timestamp"], row[f"videos/{key}/to_timestamp"])
            places[number][key] = (file_number, *span)
    return places if keys else []


def _look(
    dataset: RenderedDataset,
    keys: Sequence[str],
    rows: Sequence[EpisodeRow],
    encoded: Sequence[Mapping[str, Encoded]],
    progress: Progress,
) -> tuple[str, dict[str, float]]:
    """Return the digest of the content, and each new video's mean absolute error."""
    columns = dataset.columns()
    digests = []
    for number, row in enumerate(rows):
        digest = schema.EpisodeDigest(keys)
        for key in keys:
            if encoded and key in encoded[number]:
                digest.take(key, encoded[number][key].digest)
                continue
            for frame in dataset.decoded(key, row.start, row.stop):
                digest.add(key, frame)
        digests.append(
            digest.hexdigest({key: columns[key][row.start : row.stop] for key in schema.COLUMNS})
        )
        if not encoded:
            progress(row.stop, dataset.length, "frames")
    errors = {}
    for view in dataset.views if encoded else ():
        if names.image_key(view) in keys:
            total = sum(episode[names.image_key(view)].error for episode in encoded)
            errors[view] = round(total / dataset.length, 4)
    return schema.dataset_digest(digests), errors
