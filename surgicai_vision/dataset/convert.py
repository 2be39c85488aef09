"""Make a dataset from another dataset: fewer views, or videos instead of images.

    convert_dataset(Path("dataset"), Path("dataset-back"), views=("back",))
    made = convert_dataset(Path("dataset"), Path("dataset-h264"), video="h264")
    made.video_error                # view → mean absolute error of its pixels, out of 255

Nothing is rendered. Columns, depth, segmentation and, without `video`, the images are copied
byte for byte. A video is lossy: every frame is decoded again and compared with its image, and the
error is written to `meta/surgicai.json`.
"""

import dataclasses
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from surgicai_vision.core import names
from surgicai_vision.core.errors import BadFile, InputError, OutputExists, check_name, first_line
from surgicai_vision.core.executor import RunContext, building, work_folder
from surgicai_vision.core.files import check_output, read_json, whole_folder, write_json
from surgicai_vision.core.progress import Progress
from surgicai_vision.dataset import schema
from surgicai_vision.dataset.lerobot_files import LeRobotFiles
from surgicai_vision.dataset.metadata import (
    FILES_PER_CHUNK,
    INDEX_FEATURES,
    EpisodeMetadata,
    Features,
    row_statistics,
    write_metadata,
)
from surgicai_vision.dataset.reader import RenderedDataset, open_dataset
from surgicai_vision.dataset.schema import Table
from surgicai_vision.dataset.video import AV1_SIZE, CODECS, PIXELS
from surgicai_vision.dataset.video_jobs import Encoded, Place, encode_views
from surgicai_vision.dataset.writer import DataFiles


@dataclass(frozen=True)
class DatasetSummary:
    """Summary of a dataset that was made.

    Attributes:
        frames: number of frames.
        episodes: number of episodes.
        seconds: wall-clock time.
        digest: digest of the decoded content.
        video_error: view → mean absolute error of its video, out of 255; empty if the images are
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
    """Write some views of a dataset as a new dataset, as videos if `video` names a codec.

    Args:
        path: a dataset of ours.
        out: dataset folder to create; repeating the same request reuses it.
        views: some of its views, in the order of the new dataset's columns; all by default.
        video: codec, a key of `video.CODECS`; by default images stay as they are.
        context: workers, engine and display.

    Raises:
        UnknownName: a view that the dataset does not have, or an unknown codec.
        InputError: videos were requested from a dataset of videos, or from images whose size the
            codec does not support.
        BadFile: `path` is not a dataset of ours, or a damaged one.
        OutputExists: `out` holds something else.
    """
    started = time.monotonic()
    dataset = open_dataset(path)
    views = dataset.views if views is None else tuple(views)
    for view in views:
        check_name("view of this dataset", view, dataset.views)
    if not views or len(set(views)) != len(views):
        raise InputError(f"views are {', '.join(views) or 'none'}; give at least one, each once.")
    check_video(video, dataset.image_size)
    if video and dataset.video:
        raise InputError(
            f"{path} already holds videos ({dataset.video}); convert a dataset of images instead."
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


def check_video(video: str | None, size: int) -> None:
    """Refuse a video that cannot be made.

    Args:
        video: codec, or None for images.
        size: side of the images [px].

    Raises:
        UnknownName: an unknown codec.
        InputError: a size that the codec does not support.
    """
    if video is None:
        return
    check_name("video codec", video, CODECS)
    if video == "h264" and size % 2:
        raise InputError(
            f"size is {size}, and an h264 video needs an even size; render at {size + 1}, use "
            "av1, or keep the images lossless."
        )
    if video == "av1" and size < AV1_SIZE:
        raise InputError(
            f"size is {size}, and an av1 video needs at least {AV1_SIZE}; render larger images, "
            "use h264, or keep the images lossless."
        )


def finished(out: Path, request: Table, started: float) -> DatasetSummary:
    """Return the summary of a finished dataset.

    Raises:
        OutputExists: it is not the requested dataset.
    """
    meta = read_json(out / names.META_FILE)
    if meta.get("request") != request:
        raise OutputExists(
            f"--out {out} holds a dataset of other demonstrations or options (see "
            f"{out / names.META_FILE}); give another folder."
        )
    # A run that was killed after its last step leaves this behind.
    shutil.rmtree(work_folder(out), ignore_errors=True)
    seconds = time.monotonic() - started
    errors = meta.get("video_error", {})
    return DatasetSummary(meta["frames"], meta["episodes"], seconds, meta["digest"], errors)


def write_converted(
    dataset: RenderedDataset,
    out: Path,
    views: Sequence[str],
    video: str | None,
    changes: Table,
    store: Path,
    context: RunContext,
    progress: Progress,
) -> None:
    """Write the new dataset atomically.

    Args:
        dataset: the dataset to convert.
        out: folder to create.
        views: some of its views.
        video: codec, or None for images as they are.
        changes: values that replace those of its `meta/surgicai.json`.
        store: folder for the results of the jobs that make videos.
        context: workers and engine.
        progress: counts frames.
    """
    files = LeRobotFiles(dataset.path)
    if len(files.rows) != int(dataset.meta["episodes"]):
        raise BadFile(
            f"{dataset.path} is damaged ({' '.join(files.problems)}); repair it first with "
            "'lerobot-salvage repair'."
        )
    shown = schema.image_keys(views, dataset.has_depth, dataset.has_segmentation)
    keys = [key for key, _, _ in shown]
    with _refused_if_damaged(dataset.path):
        features = _features(files, dataset, views, keys, video)
    with whole_folder(out) as folder:
        # Each episode's place in the videos, by feature; empty without videos.
        encoded: list[dict[str, Encoded]] = []
        if video:
            encoded = encode_views(dataset, folder, views, video, store, context, progress)
            places = [{key: item.place for key, item in episode.items()} for episode in encoded]
        else:
            with _refused_if_damaged(dataset.path):
                copied = [key for key in keys if key in dataset.video_keys]
                places = _copy_videos(files, folder, copied)
        with _refused_if_damaged(dataset.path):
            rows = _write_data(files, folder, features, places)
            _check_complete(files, rows, dataset)
            write_metadata(folder, features, list(files.tasks.values()), rows, files.info)
        meta = {
            **dataset.meta,
            "views": list(views),
            "cameras": {view: dataset.meta["cameras"][view] for view in views},
            "made_from": dataset.meta["digest"],
            "digest": _digest(dataset, views, rows, encoded, progress),
            **({"video": video, "video_error": _errors(views, encoded, dataset)} if video else {}),
            **changes,
        }
        write_json(folder / names.META_FILE, meta)


@contextmanager
def _refused_if_damaged(path: Path) -> Iterator[None]:
    """Refuse a dataset whose files hold other types than LeRobot's, or fewer rows or columns."""
    try:
        yield
    except (pa.ArrowException, LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise BadFile(
            f"{path} is damaged ({first_line(error)}); repair it first with 'lerobot-salvage "
            "repair'."
        ) from None


def _features(
    files: LeRobotFiles,
    dataset: RenderedDataset,
    views: Sequence[str],
    keys: Sequence[str],
    video: str | None,
) -> dict[str, Table]:
    """Return the new dataset's features."""
    features: dict[str, Table] = {key: files.features[key] for key in keys}
    left_out = {*schema.calibration_keys(dataset.views)} - {*schema.calibration_keys(views)}
    for key, row in files.features.items():
        is_image = row["dtype"] in ("image", "video")
        if not is_image and key not in INDEX_FEATURES and key not in left_out:
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
    features: Features,
    places: Sequence[Mapping[str, Place]],
) -> list[EpisodeMetadata]:
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


def _check_complete(
    files: LeRobotFiles, rows: Sequence[EpisodeMetadata], dataset: RenderedDataset
) -> None:
    """Refuse a dataset unless every episode and frame could be read."""
    frames = rows[-1].stop if rows else 0
    if len(rows) != len(files.rows) or frames != dataset.length:
        raise BadFile(
            f"{dataset.path} is damaged: {len(rows)} of {len(files.rows)} episodes and {frames} of "
            f"{dataset.length} frames can be read ({' '.join(files.problems)}); repair it first "
            "with 'lerobot-salvage repair'."
        )


def _copy_videos(files: LeRobotFiles, folder: Path, keys: Sequence[str]) -> list[dict[str, Place]]:
    """Copy the videos of `keys`; return where each episode is in them."""
    places: list[dict[str, Place]] = [{} for _ in files.rows]
    for key in keys:
        for file in files.path.glob(f"videos/{key}/chunk-*/file-*.mp4"):
            target = folder / file.relative_to(files.path)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
        for number, row in enumerate(files.rows):
            chunk = row[f"videos/{key}/chunk_index"]
            file_number = chunk * FILES_PER_CHUNK + row[f"videos/{key}/file_index"]
            begin = row[f"videos/{key}/from_timestamp"]
            places[number][key] = (file_number, begin, row[f"videos/{key}/to_timestamp"])
    return places if keys else []


def _digest(
    dataset: RenderedDataset,
    views: Sequence[str],
    rows: Sequence[EpisodeMetadata],
    encoded: Sequence[Mapping[str, Encoded]],
    progress: Progress,
) -> str:
    """Return the digest of the new dataset's content."""
    columns = dataset.columns()
    shown = schema.image_keys(views, dataset.has_depth, dataset.has_segmentation)
    keys = [key for key, _, _ in shown]
    digests = []
    for number, row in enumerate(rows):
        digest = schema.EpisodeDigest(keys)
        for key in keys:
            if encoded and key in encoded[number]:
                digest.take(key, encoded[number][key].digest)
                continue
            for frame in dataset.decoded(key, row.start, row.stop):
                digest.add(key, frame)
        episode = {key: columns[key][row.start : row.stop] for key in schema.columns(views)}
        digests.append(digest.hexdigest(episode, views))
        if not encoded:
            progress(row.stop, dataset.length, "frames")
    return schema.dataset_digest(digests)


def _errors(
    views: Sequence[str], encoded: Sequence[Mapping[str, Encoded]], dataset: RenderedDataset
) -> dict[str, float]:
    """Return the mean absolute error of each view's video, out of 255."""
    errors = {}
    for view in views:
        total = sum(episode[names.image_key(view)].error for episode in encoded)
        errors[view] = round(total / dataset.length, 4)
    return errors
