"""`scene`: show what every camera sees."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    config_only,
    image_size,
    many_of,
    not_negative,
    one_of,
    option,
    task_config,
)
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError

EXAMPLE = "surgicai-vision scene --task grasp --seed 0 --sheet sheet.png"
QUALITIES = ("fast", "high")
FILM_FRAMES = 6


@dataclass(frozen=True)
class Options:
    """Options of `scene`."""

    task: str = option(
        "grasp", f"the task: {', '.join(names.TASKS)}", check=one_of("task", names.TASKS)
    )
    seed: int = option(names.TRAIN_SEED, "seed of the start", check=not_negative)
    view: tuple[str, ...] = option(
        names.CAMERAS,
        "views, a comma list",
        check=many_of("view", names.CAMERAS),
        metavar="VIEW[,VIEW]",
    )
    size: int = option(336, "height and width of each image [px]", check=image_size, metavar="PX")
    quality: str = option(
        "high", "fast (as datasets are rendered) or high", check=one_of("quality", QUALITIES)
    )
    sheet: str | None = option(
        None, "where to write it", metavar="FILE.png", default_text="outputs/scene-<task>.png"
    )
    film: str | None = option(
        None,
        "draw a film strip of the expert in every subtask instead, in the first view",
        metavar="FILE.png",
    )
    env: dict | None = config_only()


def run(options: Options, console: Console) -> dict[str, Any]:
    """Roll the expert once and draw the start and the end as every camera sees them."""
    from surgicai_vision.envs import contact_sheet
    from surgicai_vision.evaluation import policy_spec
    from surgicai_vision.evaluation.provenance import provenance
    from surgicai_vision.evaluation.rollout import evaluate

    if options.film:
        return _film(options, console)
    config = task_config(options.task, options.env)
    path = Path(options.sheet) if options.sheet else folders.OUTPUTS / f"scene-{options.task}.png"
    if not options.view:
        raise InputError(f"--view is empty; give some of {', '.join(names.CAMERAS)}.")
    folders.check_file(path, "--sheet", (".png", ".jpg", ".pdf", ".svg"))
    with console.stage(f"rolling the expert of {options.task}", "steps") as progress:
        episode = evaluate(
            policy_spec.expert, config, [options.seed], workers=1, progress=progress
        )[0]
    moments = {
        "start": episode.film.states[0],
        f"end, step {episode.row.steps}": episode.film.states[-1],
    }
    shown = [(moment, modality) for moment in moments for modality in names.MODALITIES]
    rows, total = [], len(options.view)
    with (
        console.stage("rendering", "views") as progress,
        contact_sheet.stage(config, options.size, options.quality) as see,
    ):
        for done, view in enumerate(options.view):
            rows.append(
                (view, [see(moments[moment], view, modality) for moment, modality in shown])
            )
            progress(done + 1, total)
    outcome = "success" if episode.row.success else f"failure ({episode.row.failure})"
    title = f"{options.task}, seed {options.seed}: the expert's episode, {outcome} after {episode.row.steps} steps"
    figure = contact_sheet.sheet(
        rows, [f"{moment}: {modality}" for moment, modality in shown], title
    )
    figure.savefig(path, dpi=140)
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


def _film(options: Options, console: Console) -> dict[str, Any]:
    """Draw a row of moments for every subtask: the expert's episode from the seed, as the first
    view sees it.
    """
    from surgicai_vision.envs import contact_sheet
    from surgicai_vision.evaluation import policy_spec
    from surgicai_vision.evaluation.rollout import evaluate

    path, rows, outcomes = Path(options.film or ""), [], {}
    folders.check_file(path, "--film", (".png", ".jpg", ".pdf", ".svg"))
    with console.stage("filming", "subtasks") as progress:
        for done, subtask in enumerate(names.SUBTASKS):
            config = task_config(subtask, options.env)
            episode = evaluate(policy_spec.expert, config, [options.seed], workers=1)[0]
            last = len(episode.film.states) - 1
            moments = [
                episode.film.states[round(last * share / (FILM_FRAMES - 1))]
                for share in range(FILM_FRAMES)
            ]
            with contact_sheet.stage(config, options.size, options.quality) as see:
                rows.append(
                    (subtask, [see(state, options.view[0], names.RGB) for state in moments])
                )
            outcomes[subtask] = {"success": episode.row.success, "steps": episode.row.steps}
            progress(done + 1, len(names.SUBTASKS))
    columns = [f"{share / (FILM_FRAMES - 1):.0%} of the episode" for share in range(FILM_FRAMES)]
    figure = contact_sheet.sheet(
        rows, columns, f"the scripted expert, seed {options.seed}, seen by {options.view[0]}"
    )
    figure.savefig(path, dpi=110)
    console.say(f"film: {path}")
    return {"film": str(path), "view": options.view[0], "seed": options.seed, "subtasks": outcomes}
