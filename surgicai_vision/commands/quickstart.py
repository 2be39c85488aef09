"""`quickstart`: run the whole flow once, small, and write its report."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    config_only,
    many_of,
    not_negative,
    one_of,
    option,
    positive,
)
from surgicai_vision.core import names
from surgicai_vision.experiments.quickstart_config import PolicyChoice, Quickstart

EXAMPLE = "surgicai-vision quickstart"


@dataclass(frozen=True)
class Options:
    """Options of `quickstart`."""

    task: str = option(
        Quickstart.task, f"the task: {', '.join(names.TASKS)}", check=one_of("task", names.TASKS)
    )
    demonstrations: int = option(
        Quickstart.demonstrations, "expert demonstrations", check=positive, metavar="N"
    )
    view: tuple[str, ...] = option(
        Quickstart.view,
        "rendered views, a comma list",
        check=many_of("view", names.CAMERAS),
        metavar="VIEW[,VIEW]",
    )
    size: int = option(
        Quickstart.size, "height and width of images [px]", check=positive, metavar="PX"
    )
    depth: bool = option(Quickstart.depth, "render depth beside RGB")
    recipe: str = option(Quickstart.recipe, "recipe of behaviour cloning")
    episodes: int = option(
        Quickstart.episodes, "held-out starts of each evaluation", check=positive, metavar="N"
    )
    seed: int = option(Quickstart.seed, "training seed", check=not_negative)
    workers: int = option(folders.CORES, "processes", check=positive, metavar="N")
    out: str = option("outputs/quickstart", "folder to make or to continue", metavar="DIR")
    policies: tuple[PolicyChoice, ...] | None = config_only()


def run(options: Options, console: Console) -> dict[str, Any]:
    """Run it, print the table and say where the page is."""
    from surgicai_vision.experiments.quickstart import run_quickstart

    result = run_quickstart(plan_of(options), Path(options.out), console.stage, options.workers)
    console.say()
    for line in table(result["results"]):
        console.say(line)
    console.say()
    console.say(f"report: {result['report']}")
    return result


def plan_of(options: Options) -> Quickstart:
    """Return the plan the options describe."""
    return Quickstart(
        task=options.task,
        demonstrations=options.demonstrations,
        view=options.view,
        size=options.size,
        depth=options.depth,
        recipe=options.recipe,
        policies=Quickstart.policies if options.policies is None else options.policies,
        episodes=options.episodes,
        seed=options.seed,
    )


def table(results: list[dict[str, Any]]) -> list[str]:
    """Return summaries as lines of a table."""
    head = ("policy", "success", "95 % interval", "length [mm]", "steps")
    rows = [head, *(_row(result) for result in results)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(head))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def _row(result: dict[str, Any]) -> tuple[str, ...]:
    low, high = result["ci95"]
    length, steps = result["trajectory_length_mm"]["mean"], result["time_steps"]["mean"]
    return (
        result["policy"],
        f"{result['successes']}/{result['episodes']}",
        f"{100 * low:.0f}–{100 * high:.0f} %",
        "–" if length is None else f"{length:.1f}",
        "–" if steps is None else f"{steps:.0f}",
    )
