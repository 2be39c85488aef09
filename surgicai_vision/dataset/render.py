"""Render demonstrations: states → images, one job an episode, then one LeRobot dataset.

    summary = render_demos(Path("demos"), Path("dataset"), views=("front", "back"), depth=True)
    summary.frames, summary.episodes, summary.seconds, summary.digest

Every state of a demonstration is set in the environment as it was recorded and observed; frame t is
the state before action t. An episode is committed whole to `<out>.work`, and when all are there the
dataset is assembled and renamed whole to `out`. Killed anywhere, the same command continues;
finished, it does nothing. Frames and their order do not depend on the number of workers.
"""

import atexit
import functools
import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from surgicai_vision.core import names
from surgicai_vision.core.cameras import check_camera
from surgicai_vision.core.config import TaskConfig, check_frame_stride, from_mapping, to_mapping
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.core.executor import Job, RunContext, building, job, run
from surgicai_vision.core.files import (
    check_output,
    code_version,
    read_json,
    sha256_file,
    write_json,
)
from surgicai_vision.core.tasks import task_text
from surgicai_vision.dataset import codecs, schema
from surgicai_vision.dataset.convert import DatasetSummary, check_video, finished, write_converted
from surgicai_vision.dataset.reader import open_dataset
from surgicai_vision.dataset.stats import ImageStatistics, column_statistics
from surgicai_vision.dataset.writer import EPISODE_FILE, SUMMARY_FILE, assemble, compression
from surgicai_vision.demos.store import Demo, demos_digest, list_demos, read_demo, read_marker

SIZES = (16, 1024)
"""Smallest and largest image side [px]; MuJoCo's off-screen buffer ends at the latter."""


MEASURED: Mapping[str, Callable[[Any], np.ndarray]] = {
    names.STATE: lambda env: env.agent_pos(),
    names.NEEDLE_POSE: lambda env: env.needle_pose(),
    names.BOTH_ARMS: lambda env: env.both_arms(),
    names.PRIVILEGED_STATE: lambda env: env.state_vector(),
}
"""Column → what the env says of the state that was set."""


def render_demos(
    demos: Path | Sequence[Path],
    out: Path,
    *,
    views: Sequence[str] = ("front", "back"),
    size: int = 224,
    depth: bool = False,
    segmentation: bool = False,
    frame_stride: int = 1,
    video: str | None = None,
    context: RunContext = RunContext(),
) -> DatasetSummary:
    """Render demonstrations into a LeRobot dataset.

    Args:
        demos: folder of demonstrations, or several, one behind the other; all of one task and
            scene.
        out: dataset folder to make; the same request continues it or finds it finished.
        views: cameras, in the order of the dataset's columns.
        size: side of the square images [px].
        depth: also render depth, float32 [m].
        segmentation: also render part indices (`names.PARTS`).
        frame_stride: render every so-manieth frame of each episode alone, from its first; a divisor
            of `names.FPS`, so that the dataset has `names.FPS / every` frames a second of simulated
            time. Actions stay those of one step.
        video: codec of the RGB views, a key of `video.CODECS`; lossless images by default.
        context: workers, engine and display.

    Raises:
        UnknownName: a view or codec that does not exist.
        InputError: a folder of demonstrations that is given twice.
        BadFile: `demos` holds no readable demonstrations, or of another scene.
        OutputExists: `out` holds something else.
    """
    started = time.monotonic()
    _check_images(views, size, video)
    check_frame_stride(frame_stride)
    check_output(out, may_resume=names.META_FILE)
    sources = _distinct([demos] if isinstance(demos, Path) else demos)
    paths = [path for source in sources for path in list_demos(source)]
    options: dict[str, Any] = {
        "views": list(views),
        "size": size,
        "depth": depth,
        "segmentation": segmentation,
    }
    options |= {"frame_stride": frame_stride} if frame_stride > 1 else {}
    request = {**options, "demos": demos_digest(paths), **({"video": video} if video else {})}
    if (out / names.META_FILE).exists():
        return finished(out, request, started)
    origins = [_Origin.of(read_demo(path)) for path in paths]
    config = _same_config(origins, paths)
    jobs = [
        _job(path, options, len(range(0, row.length, frame_stride)))
        for path, row in zip(paths, origins, strict=True)
    ]
    title = f"dataset: {', '.join(views)} at {size} px"
    with building(out) as (store, result), context.stage(title, "frames") as progress:
        shards = run(jobs, store, context, progress=progress, unit="frames")
        meta = _meta(
            sources, request, config, [read_json(shard / SUMMARY_FILE) for shard in shards], origins
        )
        table = schema.features(views, size, depth, segmentation)
        lossless = store / "lossless" if video else result
        shutil.rmtree(lossless, ignore_errors=True)
        assemble(shards, lossless, table, task_text(config.task), meta)
        if video:
            whole = open_dataset(lossless)
            write_converted(whole, result, views, video, {}, store, context, progress)
    return finished(out, request, started)


def _distinct(folders: Sequence[Path]) -> list[Path]:
    """Return the folders of demonstrations; refuse one that is given twice."""
    known: set[Path] = set()
    for folder in folders:
        if folder.resolve() in known:
            raise InputError(
                f"The demonstrations in {folder} are given twice; give each folder once."
            )
        known.add(folder.resolve())
    return list(folders)


def _job(path: Path, options: Mapping[str, Any], frames: int) -> Job:
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
    if not SIZES[0] <= size <= SIZES[1]:
        raise InputError(f"size is {size}; it must be within {SIZES[0]} and {SIZES[1]} pixels.")
    check_video(video)


class _Origin(NamedTuple):
    """What is kept of a demonstration while its images are made elsewhere."""

    length: int
    config: TaskConfig
    scene_hash: str
    demonstrator: str
    code_version: str

    @classmethod
    def of(cls, demo: Demo) -> "_Origin":
        """Return a demonstration's origin."""
        return cls(len(demo), demo.config, demo.scene_hash, demo.demonstrator, demo.code_version)


def _same_config(origins: Sequence[_Origin], paths: Sequence[Path]) -> TaskConfig:
    """Return the one configuration of all episodes."""
    first = origins[0]
    for path, origin in zip(paths, origins, strict=True):
        if origin.config != first.config or origin.scene_hash != first.scene_hash:
            raise BadFile(f"{path} was made with another task or scene than {paths[0]}.")
    return first.config


def _meta(
    sources: Sequence[Path],
    request: Mapping[str, Any],
    config: TaskConfig,
    summaries: Sequence[Mapping[str, Any]],
    origins: Sequence[_Origin],
) -> dict[str, Any]:
    """Return the content of `meta/surgicai.json`."""
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
        "fps": names.FPS // request.get("frame_stride", 1),
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


@functools.lru_cache(maxsize=1)
def _env(config: str, views: tuple[str, ...], size: int, depth: bool, segmentation: bool) -> Any:
    """Return this process's environment; the one before is closed with its GL context."""
    import surgicai_vision.envs as envs

    # The GL context must go before the interpreter does.
    atexit.register(_env.cache_clear)
    return envs.make(
        from_mapping(TaskConfig, json.loads(config)),
        obs_type="pixels_agent_pos",
        cameras=views,
        image_size=size,
        depth=depth,
        segmentation=segmentation,
    )


@job("render-episode", stages=("scene", "envs", "demos", "dataset"))
def render_episode(
    folder: Path,
    demo: str,
    views: Sequence[str],
    size: int,
    depth: bool,
    segmentation: bool,
    frame_stride: int = 1,
) -> None:
    """Job "render-episode": write one episode's columns and images into `folder`."""
    episode = read_demo(Path(demo))
    env = _env(json.dumps(to_mapping(episode.config)), tuple(views), size, depth, segmentation)
    if env.scene.hash != episode.scene_hash:
        raise BadFile(
            f"{demo} was recorded in another scene (hash {episode.scene_hash[:12]}, now {env.scene.hash[:12]}); "
            "record it again with this version."
        )
    keys = schema.image_keys(views, depth, segmentation)
    content: dict[str, list[bytes]] = {key: [] for key, _, _ in keys}
    statistics = {key: ImageStatistics() for key, _, _ in keys}
    hashes = schema.EpisodeDigest(content)
    measured: dict[str, list[np.ndarray]] = {key: [] for key in MEASURED}
    for state in episode.state[:-1:frame_stride]:
        env.set_state_vector(state)
        observation = env.observe()
        for key, view, modality in keys:
            frame = observation[names.frame_key(view, modality)]
            frame = np.repeat(frame, 3, axis=2) if modality == names.SEGMENTATION else frame
            content[key].append(codecs.encode(frame))
            statistics[key].add(frame)
            hashes.add(key, frame)
        for key, measure in MEASURED.items():
            measured[key].append(measure(env))
    columns = _columns(
        episode, frame_stride, {key: np.stack(rows) for key, rows in measured.items()}
    )
    _write_episode(
        folder, content, columns, [key for key, _, modality in keys if modality == names.DEPTH]
    )
    write_json(
        folder / SUMMARY_FILE,
        {
            "frames": len(columns[names.DONE]),
            "digest": hashes.hexdigest(columns),
            "statistics": {
                **{key: statistics[key].result() for key in content},
                **{key: column_statistics(columns[key]) for key in schema.COLUMNS},
            },
            "renderer": _renderer(),
            "cameras": {view: _camera(env, view, size, episode.state) for view in views},
        },
    )


def _columns(
    demo: Demo, frame_stride: int, measured: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return every column of `layout.COLUMNS`, (T,) or (T, n), of the T frames that are
    rendered.
    """
    frames = len(measured[names.STATE])
    return {
        **{key: rows.astype(np.float32) for key, rows in measured.items()},
        names.ACTION: demo.action[::frame_stride],
        names.REWARD: demo.reward[::frame_stride],
        names.DONE: np.arange(frames) == frames - 1,
        names.SUCCESS: demo.success[::frame_stride],
        names.CONTACT: demo.contact[::frame_stride],
        names.PHASE: demo.phase[::frame_stride].astype(np.int64),
        names.SEED: np.full(frames, demo.seed, np.int64),
    }


def _write_episode(
    folder: Path,
    content: Mapping[str, list[bytes]],
    columns: Mapping[str, np.ndarray],
    depth: Sequence[str],
) -> None:
    """Write one episode as parquet: images as LeRobot's (bytes, path) pairs, columns as lists and
    scalars.
    """
    arrays: dict[str, pa.Array] = {}
    for key, images_ in content.items():
        paths = [f"frame-{index:06d}" for index in range(len(images_))]
        arrays[key] = pa.StructArray.from_arrays(
            [pa.array(images_, pa.binary()), pa.array(paths, pa.string())], ["bytes", "path"]
        )
    for key, values in columns.items():
        if key in schema.VECTORS:
            arrays[key] = pa.FixedSizeListArray.from_arrays(
                pa.array(values.ravel()), values.shape[1]
            )
        else:
            arrays[key] = pa.array(values)
    table = pa.table(arrays)
    pq.write_table(
        table,
        folder / EPISODE_FILE,
        compression=compression(table.schema, depth),
        use_dictionary=False,
    )


def _renderer() -> str:
    """Return the GL renderer that drew the images."""
    from surgicai_vision.scene.rendering import renderer_string

    return renderer_string()


def _camera(env: Any, view: str, size: int, states: np.ndarray) -> dict[str, Any]:
    """Return a camera's intrinsics (3, 3) and, unless it moves, T_world_camera (4, 4) (OpenCV axes,
    [m]).
    """
    from surgicai_vision.scene.cameras import extrinsics, intrinsics

    poses = []
    for state in (states[0], states[-1]):
        env.set_state_vector(state)
        poses.append(extrinsics(env.model, env.data, view))
    return {
        "intrinsics": intrinsics(env.model, view, size, size).tolist(),
        "T_world_camera": poses[0].tolist() if np.array_equal(poses[0], poses[1]) else None,
    }
