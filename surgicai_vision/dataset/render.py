"""Render demonstrations: states → images, one job per episode, then one LeRobot dataset.

    summary = render_demos(Path("demos"), Path("dataset"), views=("front", "back"), depth=True)
    summary.frames, summary.episodes, summary.seconds, summary.digest

Each episode is committed atomically to `<out>.work` (`render_jobs`). When all are there, the
dataset is assembled and renamed to `out`. If it was killed at any point, the same command
continues; if it has finished, it does nothing. Frames and their order do not depend on the number
of workers.
"""

import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from surgicai_vision.core import names
from surgicai_vision.core.cameras import check_camera
from surgicai_vision.core.config import (
    ACTION_REPEAT_LIMIT,
    JSON,
    TaskConfig,
    check_frame_stride,
    to_mapping,
)
from surgicai_vision.core.errors import BadFile, InputError, check_name
from surgicai_vision.core.executor import Job, RunContext, building, register_job, run
from surgicai_vision.core.files import check_output, code_version, read_json, sha256_file
from surgicai_vision.core.tasks import task_text
from surgicai_vision.core.variants import Variants
from surgicai_vision.dataset import schema
from surgicai_vision.dataset.convert import DatasetSummary, check_video, finished, write_converted
from surgicai_vision.dataset.layouts import LAYOUTS, SURGICAI
from surgicai_vision.dataset.reader import open_dataset
from surgicai_vision.dataset.schema import Table
from surgicai_vision.dataset.writer import SUMMARY_FILE, assemble
from surgicai_vision.demos.store import (
    Demo,
    demos_digest,
    distinct_folders,
    list_demos,
    read_demo,
    read_marker,
)

register_job(
    "render-episode",
    "surgicai_vision.dataset.render_jobs:render_episode",
    stages=("scene", "envs", "demos", "dataset"),
)


def render_demos(
    demos: Path | Sequence[Path],
    out: Path,
    *,
    views: Sequence[str] = (),
    size: int = 224,
    depth: bool = False,
    segmentation: bool = False,
    frame_stride: int = 1,
    variants: Variants | None = None,
    video: str | None = None,
    layout: str = SURGICAI,
    context: RunContext = RunContext(),
) -> DatasetSummary:
    """Render demonstrations into a LeRobot dataset.

    Args:
        demos: folder of demonstrations, or several folders in order; all of one task and scene.
        out: dataset folder to create; repeating the same request continues or reuses it.
        views: cameras, in the order of the dataset's columns; by default those of the layout (of
            ours, front and back).
        size: side of the square images [px].
        depth: also render depth, float32 [m].
        segmentation: also render part indices (`names.PARTS`).
        frame_stride: render only every n-th frame of each episode, from its first. Recorded frames
            are `action_repeat` control steps apart, so that the dataset has `names.FPS /
            (frame_stride * action_repeat)` frames per second of simulated time, which must be a
            whole number. Increments remain those of one recorded step; set-points of layout
            "open-h" are held until the next frame.
        variants: looks in which each demonstration is rendered; None renders each once, as it was
            recorded.
        video: codec of the RGB views, a key of `video.CODECS`; lossless images by default.
        layout: which columns the dataset has, a key of `layouts.LAYOUTS`.
        context: workers, engine and display.

    Raises:
        UnknownName: a view, codec or layout that does not exist.
        InputError: a folder of demonstrations that is given twice, a size or frame stride that is
            not allowed, or a video, frame stride or disturbed demonstration that the layout does
            not support.
        BadFile: `demos` holds no readable demonstrations, or some with another task or scene.
        OutputExists: `out` holds something else.
    """
    started = time.monotonic()
    check_request(views, size, frame_stride, video, layout)
    chosen = LAYOUTS[layout]
    views = views or chosen.views
    check_output(out, may_resume=names.META_FILE)
    sources = distinct_folders([demos] if isinstance(demos, Path) else demos)
    paths = [path for source in sources for path in list_demos(source)]
    options: dict[str, JSON] = {
        "views": list(views),
        "size": size,
        "depth": depth,
        "segmentation": segmentation,
        **({"frame_stride": frame_stride} if frame_stride > 1 else {}),
        **({"variants": variants.request} if variants else {}),
        **({"layout": layout} if layout != SURGICAI else {}),
    }
    request = {**options, "demos": demos_digest(paths), **({"video": video} if video else {})}
    if (out / names.META_FILE).exists():
        return finished(out, request, started)
    origins = [_Origin.of(read_demo(path)) for path in paths]
    config = _same_config(origins, paths)
    _check_labels(origins, paths, layout)
    counts = [len(range(0, origin.length, frame_stride)) for origin in origins]
    if variants:
        config = variants.shown(config)
    acted_in = chosen.task_config(config, frame_stride)
    jobs = [
        _job(path, options | ({"variant": variant} if variants else {}), count)
        for path, count in zip(paths, counts, strict=True)
        for variant in range(variants.count if variants else 1)
    ]
    title = f"dataset: {', '.join(views)} at {size} px"
    with building(out) as (store, result), context.stage(title, "frames") as progress:
        shards = run(jobs, store, context, progress=progress, unit="frames")
        summaries = [read_json(shard / SUMMARY_FILE) for shard in shards]
        meta = {
            **_meta(sources, request, acted_in, summaries, origins),
            **({"layout": layout} if layout != SURGICAI else {}),
            **chosen.about,
        }
        table = chosen.features(views, size, depth, segmentation)
        lossless = store / "lossless" if video else result
        shutil.rmtree(lossless, ignore_errors=True)
        assemble(shards, lossless, table, task_text(config.task), meta)
        if video:
            whole = open_dataset(lossless)
            write_converted(whole, result, views, video, {}, store, context, progress)
    return finished(out, request, started)


def check_request(
    views: Sequence[str], size: int, frame_stride: int, video: str | None, layout: str
) -> None:
    """Refuse arguments of `render_demos` that are wrong for any demonstrations."""
    chosen = LAYOUTS[check_name("layout", layout, LAYOUTS)]
    _check_images(views or chosen.views, size, video)
    check_frame_stride(frame_stride)
    _check_layout(layout, frame_stride, video)


def _job(path: Path, options: Mapping[str, JSON], frames: int) -> Job:
    """Return the job that renders one demonstration."""
    return Job(
        "render-episode",
        {"demo": str(path.resolve()), **options},
        (sha256_file(path),),
        frames,
        ("demo",),
    )


def _check_images(views: Sequence[str], size: int, video: str | None) -> None:
    """Refuse views, sizes and codecs that cannot be rendered."""
    for view in views:
        check_camera(view)
    if not views or len(set(views)) != len(views):
        raise InputError(f"views are {', '.join(views) or 'none'}; give at least one, each once.")
    smallest, largest = schema.SIZES
    if not smallest <= size <= largest:
        raise InputError(f"size is {size}; it must be within {smallest} and {largest} pixels.")
    check_video(video, size)


def _check_layout(layout: str, frame_stride: int, video: str | None) -> None:
    """Refuse what a layout other than ours does not support."""
    if layout == SURGICAI:
        return
    if video:
        raise InputError(
            f"--video {video} works only with surgicai-vision's own layout; render --layout "
            f"{layout} as images and convert them to videos with 'lerobot-edit-dataset "
            "--operation.type convert_image_to_video'."
        )
    if frame_stride > ACTION_REPEAT_LIMIT:
        raise InputError(
            f"frame_stride is {frame_stride}, and an action of layout '{layout}' is held until the "
            f"next frame; allowed: at most {ACTION_REPEAT_LIMIT}."
        )


class _Origin(NamedTuple):
    """What is kept of a demonstration while other processes render its images."""

    length: int
    config: TaskConfig
    scene_hash: str
    demonstrator: str
    code_version: str
    is_disturbed: bool

    @classmethod
    def of(cls, demo: Demo) -> "_Origin":
        """Return a demonstration's origin."""
        return cls(
            len(demo),
            demo.config,
            demo.scene_hash,
            demo.demonstrator,
            demo.code_version,
            demo.executed is not None,
        )


def _same_config(origins: Sequence[_Origin], paths: Sequence[Path]) -> TaskConfig:
    """Return the configuration that all episodes share; refuse different ones."""
    first = origins[0]
    for path, origin in zip(paths, origins, strict=True):
        if origin.config != first.config or origin.scene_hash != first.scene_hash:
            raise BadFile(f"{path} was not made with the same task and scene as {paths[0]}.")
    return first.config


def _check_labels(origins: Sequence[_Origin], paths: Sequence[Path], layout: str) -> None:
    """Refuse demonstrations whose labels are not what moved the arms, in a layout of set-points."""
    if layout == SURGICAI:
        return
    for path, origin in zip(paths, origins, strict=True):
        if origin.is_disturbed:
            raise InputError(
                f"In {path} noise, an upset or a learner altered what was executed, and layout "
                f"'{layout}' holds the set-points that were executed, not the demonstrator's "
                "labels. Record without disturbance, or use surgicai-vision's own layout."
            )


def _meta(
    sources: Sequence[Path],
    request: Table,
    config: TaskConfig,
    summaries: Sequence[Table],
    origins: Sequence[_Origin],
) -> Table:
    """Return the content of `meta/surgicai.json`."""
    spacing = request.get("frame_stride", 1) * origins[0].config.action_repeat
    return {
        "format": schema.FORMAT,
        "request": request,
        "task": config.task,
        "task_config": to_mapping(config),
        "views": request["views"],
        "image_size": request["size"],
        "depth": request["depth"],
        "segmentation": request["segmentation"],
        "cameras": summaries[0]["cameras"],
        "units": {"length": "m", "angle": "rad", "depth": "m", "time": "s"},
        "parts": list(names.PARTS),
        **({"variants": request["variants"]["count"]} if "variants" in request else {}),
        "fps": names.FPS // spacing,
        "renderers": sorted({summary["renderer"] for summary in summaries}),
        "scene_hash": origins[0].scene_hash,
        "demonstrators": sorted({origin.demonstrator for origin in origins}),
        "demos_digest": request["demos"],
        "demos_requests": [read_marker(source).get("request") for source in sources],
        "demos_code_versions": sorted({origin.code_version for origin in origins}),
        "code_version": code_version(),
        "frames": sum(summary["frames"] for summary in summaries),
        "episodes": len(summaries),
        "digest": schema.dataset_digest(summary["digest"] for summary in summaries),
    }
