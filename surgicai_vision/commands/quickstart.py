"""`quickstart`: run the whole flow once, small, and write its report."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    COUNT,
    DIRECTORY,
    FILE_ONLY,
    FRACTION,
    IMAGE_SIZE,
    SEED,
    TASK,
    VIEWS,
)
from surgicai_vision.core.percentages import interval
from surgicai_vision.experiments.quickstart_config import PolicyChoice, Quickstart

app = App(name="quickstart", help_epilogue="example:\n  surgicai-vision quickstart")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `quickstart`.

    Attributes:
        procedure: Policy that sews the whole procedure in the first act; null in a --config file
            skips that act.
        task: The task of the second act.
        demonstrations: Number of expert demonstrations.
        noise: Standard deviation of the noise on the expert's motions, in units of their range.
        view: Views to render.
        size: Height and width of images [px].
        frame_stride: Control steps from one frame to the next.
        episodes: Number of held-out starts per evaluation.
        seed: Training seed.
        workers: Number of processes.
        out: Folder to create or continue.
    """

    procedure: Annotated[str | None, Parameter(metavar="POLICY")] = Quickstart.procedure
    task: Annotated[str, TASK] = Quickstart.task
    demonstrations: Annotated[int, COUNT] = Quickstart.demonstrations
    noise: Annotated[float, FRACTION] = Quickstart.noise
    view: Annotated[tuple[str, ...], VIEWS] = Quickstart.view
    size: Annotated[int, IMAGE_SIZE] = Quickstart.size
    frame_stride: Annotated[int, COUNT] = Quickstart.frame_stride
    episodes: Annotated[int, COUNT] = Quickstart.episodes
    seed: Annotated[int, SEED] = Quickstart.seed
    workers: Annotated[int, COUNT] = folders.CORES
    out: Annotated[Path, DIRECTORY] = Path("outputs/quickstart")
    policies: Annotated[tuple[PolicyChoice, ...] | None, FILE_ONLY] = None


@app.default
def run(options: Options = Options(), *, console: Console) -> dict[str, object]:
    """Run the quickstart and print its table and where the page is."""
    from surgicai_vision.core.executor import RunContext
    from surgicai_vision.experiments.quickstart import run_quickstart

    context = RunContext(options.workers, stage=console.stage)
    result = run_quickstart(plan_of(options), options.out, context, console.say)
    console.say()
    for line in table(result["results"]):
        console.say(line)
    console.say()
    console.say(f"report: {result['report']}")
    return result


def plan_of(options: Options) -> Quickstart:
    """Return the quickstart that the options describe."""
    return Quickstart(
        procedure=options.procedure,
        task=options.task,
        demonstrations=options.demonstrations,
        noise=options.noise,
        view=options.view,
        size=options.size,
        frame_stride=options.frame_stride,
        policies=Quickstart.policies if options.policies is None else options.policies,
        episodes=options.episodes,
        seed=options.seed,
    )


def table(results: list[dict[str, Any]]) -> list[str]:
    """Return the lines of a table of evaluations."""
    head = ("policy", "success", "95 % interval", "length [mm]", "steps")
    return aligned([head, *(_row(result) for result in results)])


def aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Return the lines of a table with its columns aligned; the first row is its head."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def _row(result: dict[str, Any]) -> tuple[str, ...]:
    length = result["trajectory_length_mm"]["mean"]
    steps = result["time_steps"]["mean"]
    return (
        result["policy"],
        f"{result['successes']}/{result['episodes']}",
        interval(result["ci95"]),
        "–" if length is None else f"{length:.1f}",
        "–" if steps is None else f"{steps:.0f}",
    )
