"""`render-demos`: render demonstrations into a LeRobot dataset."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands import folders, record_demos
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    config_only,
    executor_option,
    image_size,
    many_of,
    not_negative,
    one_of,
    option,
    positive,
)
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError

CODECS = ("h264", "av1")
EXAMPLE = "surgicai-vision render-demos --task grasp --episodes 50 --view front,back --depth"


@dataclass(frozen=True)
class Options:
    """Options of `render-demos`."""

    demos: tuple[str, ...] | None = option(
        None,
        "demonstrations to render, or several folders of them",
        metavar="DIR[,DIR]",
        default_text="record the expert's into outputs/demos/<task>",
    )
    task: str | None = option(
        None,
        f"without --demos, the task: {', '.join(names.TASKS)}",
        check=one_of("task", names.TASKS),
        default_text="grasp",
    )
    episodes: int | None = option(
        None,
        "without --demos, demonstrations to record",
        check=positive,
        metavar="N",
        default_text="50",
    )
    seed: int = option(
        names.TRAIN_SEED, "without --demos, seed of the first start", check=not_negative
    )
    view: tuple[str, ...] = option(
        ("front", "back"),
        "views, a comma list",
        check=many_of("view", names.CAMERAS),
        metavar="VIEW[,VIEW]",
    )
    size: int = option(224, "height and width of images [px]", check=image_size, metavar="PX")
    depth: bool = option(False, "render depth beside RGB")
    segmentation: bool = option(False, "render the parts beside RGB")
    frame_stride: int = option(
        1,
        "render every N-th frame alone: many episodes at the cost of few",
        check=positive,
        metavar="N",
    )
    video: str | None = option(
        None,
        f"store RGB as video: {', '.join(CODECS)}; the error is measured",
        check=one_of("video codec", CODECS),
        metavar="CODEC",
        default_text="lossless images",
    )
    workers: int = option(folders.CORES, "processes", check=positive, metavar="N")
    executor: str = executor_option()
    out: str | None = option(
        None, "dataset to make", metavar="DIR", default_text="outputs/datasets/<task>"
    )
    env: dict | None = config_only()


def run(options: Options, console: Console) -> dict[str, Any]:
    """Record where that is asked for, render, and say where the dataset is."""
    from surgicai_vision.core.executor import open_engine
    from surgicai_vision.dataset import render_demos

    engine = open_engine(options.executor)
    if options.demos and (options.task or options.episodes or options.env):
        raise InputError(
            "--task, --episodes and env say what to record; with --demos DIR nothing is recorded."
        )
    if not options.view:
        raise InputError(f"--view is empty; give some of {', '.join(names.CAMERAS)}.")
    given = [Path(folder) for folder in options.demos or ()]
    task = folders.demos_task(given[0]) if given else options.task or "grasp"
    out = Path(options.out) if options.out else folders.dataset_folder(task)
    folders.check_folder(out, names.META_FILE)
    demos = given or [_record(options, task, console)]
    with console.stage(f"rendering {', '.join(options.view)}", "frames") as progress:
        summary = render_demos(
            demos,
            out,
            views=options.view,
            size=options.size,
            depth=options.depth,
            segmentation=options.segmentation,
            frame_stride=options.frame_stride,
            video=options.video,
            workers=options.workers,
            engine=engine,
            progress=progress,
        )
    console.say(
        f"{summary.episodes} episodes, {summary.frames} frames in {summary.seconds:.0f} s: {out}"
    )
    say_error(summary, console)
    return {
        **dataclasses.asdict(summary),
        "task": task,
        "views": list(options.view),
        "dataset": str(out),
    }


def say_error(summary: Any, console: Console) -> None:
    """Say what the videos lost."""
    if summary.video_error:
        lost = ", ".join(f"{view} {error:.2f}" for view, error in summary.video_error.items())
        console.say(f"mean absolute error of the videos, out of 255: {lost}")


def _record(options: Options, task: str, console: Console) -> Path:
    """Record the expert's demonstrations first."""
    asked = record_demos.Options(
        task=task,
        episodes=options.episodes or 50,
        seed=options.seed,
        workers=options.workers,
        executor=options.executor,
        env=options.env,
    )
    return Path(record_demos.run(asked, console)["demos"])
