"""Encode a dataset's images as videos, one job for each view and block of episodes.

Each block becomes one video file. Blocks depend only on the dataset, so the files are the same for
any number of workers. Every frame is decoded again and compared with its image.
"""

import functools
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.executor import Job, RunContext, job, run
from surgicai_vision.core.files import read_json, write_json
from surgicai_vision.core.progress import Progress
from surgicai_vision.dataset import schema
from surgicai_vision.dataset.metadata import video_path
from surgicai_vision.dataset.reader import RenderedDataset, open_dataset
from surgicai_vision.dataset.video import VideoWriter, read_frames

BLOCK_FRAMES = 2000
"""Minimum frames of every block but the last: some 10 MB of video, half a minute of one core."""
VIDEO_FILE = "video.mp4"
COMPARISON_FILE = "comparison.json"
"""Digest and error of every episode of a block."""

Place = tuple[int, float, float]
"""(number of the video file, begin [s], end [s])."""


@dataclass(frozen=True)
class Encoded:
    """One view of one episode, encoded.

    Attributes:
        place: its place in the view's videos.
        digest: sha256 (hex) of its decoded frames, as `schema.EpisodeDigest` takes it.
        error: sum over its frames of the mean absolute error, out of 255.
    """

    place: Place
    digest: str
    error: float


def encode_views(
    dataset: RenderedDataset,
    folder: Path,
    views: Sequence[str],
    video: str,
    store: Path,
    context: RunContext,
    progress: Progress,
) -> list[dict[str, Encoded]]:
    """Encode some views of a dataset; return every episode's videos by image key.

    Args:
        dataset: a dataset of images.
        folder: the folder in which `videos/` is written.
        views: cameras.
        video: codec, a key of `video.CODECS`.
        store: folder for the jobs' results.
        context: workers and engine.
        progress: counts the frames of all views.
    """
    bounds = dataset.bounds()
    blocks = _blocks(bounds)
    same = {
        "dataset": str(dataset.path.resolve()),
        "digest": dataset.meta["digest"],
        "video": video,
    }
    jobs = [
        Job(
            "encode-video",
            {**same, "view": view, "first": first, "stop": stop},
            (),
            bounds[stop - 1][1] - bounds[first][0],
            ("dataset",),
        )
        for view in views
        for first, stop in blocks
    ]
    results = iter(run(jobs, store, context, unit="frames", progress=progress))
    episodes: list[dict[str, Encoded]] = [{} for _ in bounds]
    for view in views:
        key = names.image_key(view)
        for number, (first, stop) in enumerate(blocks):
            result = next(results)
            target = folder / video_path(key, number)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(result / VIDEO_FILE, target)
            start = bounds[first][0]
            compared = read_json(result / COMPARISON_FILE)
            for index, row in zip(range(first, stop), compared, strict=True):
                low, high = ((frame - start) / dataset.fps for frame in bounds[index])
                episodes[index][key] = Encoded((number, low, high), row["digest"], row["error"])
    return episodes


def _blocks(bounds: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return (first episode, episode after the last) of every block."""
    blocks = []
    first = 0
    for index, (_, stop) in enumerate(bounds):
        if stop - bounds[first][0] >= BLOCK_FRAMES or index == len(bounds) - 1:
            blocks.append((first, index + 1))
            first = index + 1
    return blocks


@functools.lru_cache(maxsize=1)
def _dataset(folder: str, digest: str) -> RenderedDataset:
    """Open the dataset of this digest in a folder; another one there is opened anew."""
    return open_dataset(Path(folder))


@job("encode-video", stages=("dataset",), packages=("numpy", "av"))
def encode_block(
    folder: Path, dataset: str, digest: str, video: str, view: str, first: int, stop: int
) -> None:
    """Encode a view of the episodes first … stop - 1 and compare each frame with its image."""
    data = _dataset(dataset, digest)
    key = names.image_key(view)
    path = folder / VIDEO_FILE
    bounds = data.bounds()[first:stop]
    begin = bounds[0][0]
    end = bounds[-1][1]
    with VideoWriter(path, video, data.fps, data.image_size) as writer:
        for image in data.decoded(key, begin, end):
            writer.add(image.astype(np.uint8, copy=False))
    rows = []
    decoded = read_frames(path, 0, end - begin, data.fps)
    for low, high in bounds:
        shown = schema.ImageDigest()
        error = 0.0
        for before, after in zip(data.decoded(key, low, high), decoded, strict=False):
            error += float(np.abs(after.astype(np.int16) - before).mean())
            shown.add(after)
        rows.append({"digest": shown.hexdigest(), "error": error})
    write_json(folder / COMPARISON_FILE, rows)
