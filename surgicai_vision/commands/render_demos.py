"""`render-demos`: render demonstrations into a LeRobot dataset."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders, record_demos
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    COUNT,
    DIRECTORY,
    EXECUTOR,
    FRACTION,
    IMAGE_SIZE,
    SEED,
    TASK,
    VIDEO,
    VIEWS,
    EnvFields,
    default_text,
    task_config,
    within,
)
from surgicai_vision.core import names
from surgicai_vision.core.config import RANDOMISATION_CHOICES
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.files import check_renamed
from surgicai_vision.core.variants import Variants
from surgicai_vision.core.words import plural

app = App(
    name="render-demos",
    help_epilogue="""\
example:
  surgicai-vision render-demos --task grasp --episodes 50 --view front,back --depth""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `render-demos`.

    Attributes:
        demos: One or more folders of demonstrations to render.
        task: Without --demos, the task to record.
        episodes: Without --demos, the number of demonstrations to record.
        seed: Without --demos, the seed of the first start.
        view: Views to render.
        layout: Columns of the dataset: ours, or both arms' poses as in Open-H-Embodiment.
        size: Height and width of images [px].
        depth: Also render depth.
        segmentation: Also render a segmentation into parts.
        frame_stride: Render only every N-th frame, which costs less time and space per episode.
        appearance: Looks to draw instead of the recorded ones: a set of families, or a family.
        distractors: Largest number of distractor objects, drawn with the look.
        variants: Number of looks in which to render each demonstration.
        corruption: Largest strength of smoke, blur and pixel noise, each drawn with the look.
        shift: Strength by which cameras, lights and joints are off, drawn with the look.
        aimed: Place crops where a detector would see the jaws, not where the arm reports them.
        workers: Number of processes.
        out: Folder of the dataset to create.
    """

    demos: Annotated[
        tuple[Path, ...],
        Parameter(metavar="DIR[,DIR]"),
        default_text("record the expert's in outputs/demos/<task>"),
    ] = ()
    task: Annotated[str | None, TASK, default_text("grasp")] = None
    episodes: Annotated[int | None, COUNT, default_text("50")] = None
    seed: Annotated[int | None, SEED, default_text(str(names.TRAIN_SEED))] = None
    view: Annotated[
        tuple[str, ...], VIEWS, default_text("front,back; for open-h its endoscope and wrist views")
    ] = ()
    layout: Annotated[str, Parameter(choices=("surgicai", "open-h"))] = "surgicai"
    size: Annotated[int, IMAGE_SIZE] = 224
    depth: bool = False
    segmentation: bool = False
    frame_stride: Annotated[int, COUNT] = 1
    appearance: Annotated[
        str | None,
        Parameter(choices=RANDOMISATION_CHOICES["appearance"][1:]),
        default_text("as recorded"),
    ] = None
    distractors: Annotated[int | None, within(1, 5), default_text("as recorded")] = None
    variants: Annotated[int, COUNT] = 1
    corruption: Annotated[float, FRACTION] = 0.0
    shift: Annotated[float, FRACTION] = 0.0
    aimed: bool = False
    video: Annotated[str | None, VIDEO, default_text("lossless images")] = None
    workers: Annotated[int, COUNT] = folders.CORES
    executor: Annotated[str, EXECUTOR] = "local"
    out: Annotated[
        Path | None, DIRECTORY, default_text("outputs/datasets/<task>, for open-h <task>-open-h")
    ] = None
    env: EnvFields = None


@app.default
def run(options: Options = Options(), *, console: Console) -> dict[str, object]:
    """Record demonstrations if none are given, render them and print where the dataset is."""
    from surgicai_vision.core.executor import LOCAL, RunContext, open_engine
    from surgicai_vision.dataset import render_demos
    from surgicai_vision.dataset.layouts import LAYOUTS
    from surgicai_vision.dataset.render import check_request
    from surgicai_vision.scene.opengl import check_opengl

    # Wrong input is found before any work.
    context = RunContext(options.workers, open_engine(options.executor), console.stage)
    recorded = (options.task, options.episodes, options.seed, options.env)
    if options.demos and any(value is not None for value in recorded):
        raise InputError(
            "--task, --episodes, --seed and env say what to record; with --demos DIR nothing is "
            "recorded."
        )
    variants = Variants.asked(
        options.appearance or "",
        options.distractors or 0,
        options.variants,
        options.corruption,
        options.shift,
        options.aimed,
    )
    task = folders.demos_task(options.demos[0]) if options.demos else options.task or "grasp"
    of_others = "" if options.layout == "surgicai" else f"-{options.layout}"
    out = options.out or folders.dataset_folder(f"{task}{of_others}")
    folders.check_folder(out, names.META_FILE)
    check_renamed(out)  # before any demonstration is recorded
    layout = LAYOUTS[options.layout]
    check_request(options.view, options.size, options.frame_stride, options.video, options.layout)
    if not options.demos:
        layout.task_config(task_config(task, options.env), options.frame_stride)
    if context.engine == LOCAL:  # with other engines the workers must be able to draw
        check_opengl()
    demos = options.demos or [_record(options, task, console)]
    summary = render_demos(
        demos,
        out,
        views=options.view,
        size=options.size,
        depth=options.depth,
        segmentation=options.segmentation,
        frame_stride=options.frame_stride,
        variants=variants,
        video=options.video,
        layout=options.layout,
        context=context,
    )
    console.say(
        f"{plural(summary.episodes, 'episode')}, {plural(summary.frames, 'frame')} "
        f"in {summary.seconds:.0f} s: {out}"
    )
    print_video_error(summary.video_error, console)
    return {
        **dataclasses.asdict(summary),
        "task": task,
        "views": list(options.view) or list(layout.views),
        "dataset": str(out),
    }


def print_video_error(errors: Mapping[str, float], console: Console) -> None:
    """Print the error of each view's video, if there are videos."""
    if errors:
        lost = ", ".join(f"{view} {error:.2f}" for view, error in errors.items())
        console.say(f"mean absolute error of the videos, out of 255: {lost}")


def _record(options: Options, task: str, console: Console) -> Path:
    """Record the expert's demonstrations first."""
    asked = record_demos.Options(
        task=task,
        episodes=options.episodes or 50,
        seed=names.TRAIN_SEED if options.seed is None else options.seed,
        workers=options.workers,
        executor=options.executor,
        env=options.env,
    )
    return Path(str(record_demos.run(asked, console=console)["demos"]))
