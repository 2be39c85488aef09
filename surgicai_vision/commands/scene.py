"""`scene`: show what every camera sees."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    COUNT,
    IMAGE_SIZE,
    SEED,
    TASK,
    UNIQUE,
    VIEWS,
    EnvFields,
    default_text,
    task_config,
    within,
)
from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names
from surgicai_vision.core.errors import InputError

app = App(
    name="scene",
    help_epilogue="example:\n  surgicai-vision scene --task grasp --seed 0 --sheet sheet.png",
)
QUALITIES = ("fast", "high")
FILM_FRAMES = 6
ANIMATION_EVERY = 4
"""Control steps from one image of an animation to the next."""
ANIMATION_SPEED = 2.0
"""Speed of the world in an animation."""
FIGURE_SUFFIXES = (".png", ".jpg", ".pdf", ".svg")
ALL = "all"
PLAIN = "plain"
FAMILIES = {
    ALL: ("", *names.TRAIN_APPEARANCES, *names.HELDOUT_APPEARANCES),
    **names.APPEARANCE_SETS,
    PLAIN: ("",),
    **{name: (name,) for name in names.APPEARANCES},
}
"""Value of --appearance → families."""
LOOKS = Parameter.combine(UNIQUE, Parameter(choices=tuple(FAMILIES), metavar="NAME[,NAME]"))
AT_MOST_FIVE = Parameter.combine(within(0, 5), Parameter(metavar="N"))


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `scene`.

    Attributes:
        task: The task.
        seed: Seed of the start.
        view: Views to show.
        size: Height and width of each image [px].
        quality: Rendering quality: fast (as for datasets) or high.
        sheet: Image to write.
        film: Instead of the sheet, a film strip of the expert in every subtask, in the first view.
        animation: Instead of the sheet, the expert's episode as an animation, in the first view.
        axes: Instead of the sheet, every axis of `robustness` at every strength, in the first view.
        looks: Instead of the sheet, a row per family of looks: every view at seeds from --seed on.
        appearance: Families shown by --looks: all, plain, a set of families, or their names.
        draws: Number of seeds shown by --looks.
        distractors: Largest number of distractor objects in --looks, 0 to 5.
        needles: Instead of the sheet, every needle that randomisation can draw, in the first view.
        placements: Instead of the sheet, the phantom's places and hole pairs, in the first view.
    """

    task: Annotated[str, TASK] = "grasp"
    seed: Annotated[int, SEED] = names.TRAIN_SEED
    view: Annotated[tuple[str, ...], VIEWS] = camera_names()
    size: Annotated[int, IMAGE_SIZE] = 336
    quality: Annotated[str, Parameter(choices=QUALITIES)] = "high"
    sheet: Annotated[
        Path | None, Parameter(metavar="FILE.png"), default_text("outputs/scene-<task>.png")
    ] = None
    film: Annotated[Path | None, Parameter(metavar="FILE.png")] = None
    animation: Annotated[Path | None, Parameter(metavar="FILE.webp")] = None
    axes: Annotated[Path | None, Parameter(metavar="FILE.png")] = None
    looks: Annotated[Path | None, Parameter(metavar="FILE.png")] = None
    appearance: Annotated[tuple[str, ...], LOOKS] = (ALL,)
    draws: Annotated[int, COUNT] = 2
    distractors: Annotated[int, AT_MOST_FIVE] = 0
    needles: Annotated[Path | None, Parameter(metavar="FILE.png")] = None
    placements: Annotated[Path | None, Parameter(metavar="FILE.png")] = None
    env: EnvFields = None


@app.default
def run(options: Options = Options(), *, console: Console) -> dict[str, object]:
    """Roll out the expert once and draw the start and the end as every camera sees them."""
    from surgicai_vision.envs import contact_sheet
    from surgicai_vision.evaluation import agents
    from surgicai_vision.evaluation.provenance import provenance
    from surgicai_vision.evaluation.rollout import evaluate

    drawings = {
        f"--{name}": getattr(options, name)
        for name in ("sheet", "film", "animation", "axes", "looks", "needles", "placements")
    }
    given = [option for option, path in drawings.items() if path]
    if len(given) > 1:
        raise InputError(f"{' and '.join(given)} are given; one call draws one of them.")
    if options.film:
        return _film(options.film, options, console)
    if options.animation:
        return _animation(options.animation, options, console)
    if options.axes:
        return _axes(options.axes, options, console)
    if options.looks:
        return _looks(options.looks, options, console)
    if options.needles:
        return _world(options.needles, "needles", options, console)
    if options.placements:
        return _world(options.placements, "placements", options, console)
    config = task_config(options.task, options.env)
    path = options.sheet or folders.OUTPUTS / f"scene-{options.task}.png"
    folders.check_file(path, "--sheet", FIGURE_SUFFIXES)
    with console.stage(f"rolling out the expert of {options.task}", "steps") as progress:
        episode = evaluate(
            agents.ExpertAgent, config, [options.seed], workers=1, progress=progress
        )[0]
    # One row per view; the columns are the modalities at the start, then those at the end.
    moments = {
        "start": episode.film.states[0],
        f"end, step {episode.row.steps}": episode.film.states[-1],
    }
    shown = [(moment, modality) for moment in moments for modality in names.MODALITIES]
    rows = []
    with (
        console.stage("rendering", "views") as progress,
        contact_sheet.state_renderer(config, options.size, options.quality) as see,
    ):
        for done, view in enumerate(options.view):
            rows.append(
                (view, [see(moments[moment], view, modality) for moment, modality in shown])
            )
            progress(done + 1, len(options.view))
    outcome = "success" if episode.row.success else f"failure ({episode.row.failure})"
    title = (
        f"{options.task}, seed {options.seed}: the expert's episode, "
        f"{outcome} after {episode.row.steps} steps"
    )
    figure = contact_sheet.sheet(
        rows, [f"{moment}: {modality}" for moment, modality in shown], title
    )
    contact_sheet.write(figure, path, dpi=140)
    console.say(f"sheet: {path}")
    return {
        "sheet": str(path),
        "task": options.task,
        "seed": options.seed,
        "views": list(options.view),
        "success": episode.row.success,
        "steps": episode.row.steps,
        "renderer": provenance()["renderer"],
    }


def _film(path: Path, options: Options, console: Console) -> dict[str, object]:
    """Draw a row of images for every subtask: the expert's episode as the first view sees it."""
    from surgicai_vision.envs import contact_sheet
    from surgicai_vision.evaluation import agents
    from surgicai_vision.evaluation.rollout import evaluate

    folders.check_file(path, "--film", FIGURE_SUFFIXES)
    rows = []
    outcomes = {}
    with console.stage("filming", "subtasks") as progress:
        for done, subtask in enumerate(names.SUBTASKS):
            config = task_config(subtask, options.env)
            episode = evaluate(agents.ExpertAgent, config, [options.seed], workers=1)[0]
            last = len(episode.film.states) - 1
            moments = [
                episode.film.states[round(last * share / (FILM_FRAMES - 1))]
                for share in range(FILM_FRAMES)
            ]
            with contact_sheet.state_renderer(config, options.size, options.quality) as see:
                rows.append(
                    (subtask, [see(state, options.view[0], names.RGB) for state in moments])
                )
            outcomes[subtask] = {"success": episode.row.success, "steps": episode.row.steps}
            progress(done + 1, len(names.SUBTASKS))
    columns = [f"{share / (FILM_FRAMES - 1):.0%} of the episode" for share in range(FILM_FRAMES)]
    figure = contact_sheet.sheet(
        rows, columns, f"the scripted expert, seed {options.seed}, seen by {options.view[0]}"
    )
    contact_sheet.write(figure, path, dpi=110)
    console.say(f"film: {path}")
    return {"film": str(path), "view": options.view[0], "seed": options.seed, "subtasks": outcomes}


def _animation(path: Path, options: Options, console: Console) -> dict[str, object]:
    """Draw the expert's whole episode as an animated WebP."""
    from surgicai_vision import envs
    from surgicai_vision.core.video import ANIMATION, write_animation
    from surgicai_vision.demos.expert import Expert
    from surgicai_vision.envs import contact_sheet

    folders.check_file(path, "--animation", (ANIMATION,))
    config = task_config(options.task, options.env)
    view = options.view[0]
    env = envs.make(config, obs_type="state")
    env.reset(seed=options.seed)
    expert = Expert(env)
    images = []
    info: dict[str, object] = {}
    size = (options.size, options.size)
    with console.stage(f"filming the expert of {options.task}", "steps") as progress:
        for step in range(config.max_steps):
            if step % ANIMATION_EVERY == 0:
                image = env.image(view, size, names.RGB, options.quality)
                images.append(contact_sheet.coloured(image, names.RGB))
            _, _, terminated, truncated, info = env.step(expert.action())
            progress(step + 1, config.max_steps)
            if terminated or truncated:
                break
    env.close()
    fps = names.FPS / ANIMATION_EVERY * ANIMATION_SPEED
    count = write_animation(path, images, fps)
    console.say(f"animation: {path}")
    return {"animation": str(path), "images": count, "success": info.get("is_success")}


def _axes(path: Path, options: Options, console: Console) -> dict[str, object]:
    """Draw a row of images for every axis of `robustness`: the start of the episode, shifted."""
    from surgicai_vision.envs import contact_sheet
    from surgicai_vision.evaluation.robustness import AXES, STRENGTHS
    from surgicai_vision.evaluation.robustness.sheet import axis_images, axis_names

    folders.check_file(path, "--axes", FIGURE_SUFFIXES)
    config = task_config(options.task, options.env)
    view = options.view[0]
    rows = []
    shown = axis_names()
    with console.stage("rendering", "axes") as progress:
        for done, axis in enumerate(shown):
            images = axis_images(
                config, axis, view, options.seed, options.size, options.quality, STRENGTHS
            )
            rows.append((axis.replace("_", " "), images))
            progress(done + 1, len(shown))
    figure = contact_sheet.sheet(
        rows,
        [f"strength {strength:g}" for strength in STRENGTHS],
        f"axes of robustness: {options.task}, seed {options.seed}, seen by {view}",
    )
    contact_sheet.write(figure, path, dpi=100)
    console.say(f"sheet: {path}")
    return {"axes": {axis: AXES[axis].text for axis in shown}, "sheet": str(path), "view": view}


def _looks(path: Path, options: Options, console: Console) -> dict[str, object]:
    """Draw a row of images for every family of looks: each view of the start, seed after seed."""
    from surgicai_vision.envs import contact_sheet

    folders.check_file(path, "--looks", FIGURE_SUFFIXES)
    config = task_config(options.task, options.env)
    # A family that is named twice, as by "all" and by itself, is drawn once.
    families = tuple(dict.fromkeys(one for name in options.appearance for one in FAMILIES[name]))
    seeds = range(options.seed, options.seed + options.draws)
    rows = []
    with console.stage("rendering", "looks") as progress:
        for done, family in enumerate(families):
            axes = dataclasses.replace(
                config.randomisation, appearance=family, distractors=options.distractors
            )
            images = contact_sheet.start_images(
                dataclasses.replace(config, randomisation=axes),
                options.view,
                seeds,
                options.size,
                options.quality,
            )
            rows.append((family or PLAIN, images))
            progress(done + 1, len(families))
    columns = [f"{view}, seed {seed}" for seed in seeds for view in options.view]
    figure = contact_sheet.sheet(rows, columns, f"looks: the start of {options.task}")
    contact_sheet.write(figure, path, dpi=80)
    console.say(f"sheet: {path}")
    return {"looks": [name for name, _ in rows], "sheet": str(path), "views": list(options.view)}


def _world(path: Path, kind: str, options: Options, console: Console) -> dict[str, object]:
    """Draw every needle, or the phantom at every place."""
    from surgicai_vision.envs import contact_sheet, world_sheet

    folders.check_file(path, f"--{kind}", FIGURE_SUFFIXES)
    config = task_config(options.task, options.env)
    view = options.view[0]
    draw = {"needles": world_sheet.needle_rows, "placements": world_sheet.placement_rows}[kind]
    with console.stage("rendering"):
        rows, columns = draw(config.scene, view, options.seed, options.size, options.quality)
    figure = contact_sheet.sheet(rows, columns, f"{kind} of a world that varies, seen by {view}")
    contact_sheet.write(figure, path, dpi=110)
    console.say(f"sheet: {path}")
    return {"sheet": str(path), "view": view, "seed": options.seed}
