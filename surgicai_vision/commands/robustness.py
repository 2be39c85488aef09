"""`robustness`: evaluate a policy while light, cameras, images or the arm shift."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.evaluate import open_given, say_conditions
from surgicai_vision.commands.options import (
    COUNT,
    DIRECTORY,
    LIST,
    SEED,
    UNIQUE,
    AcceptLicence,
    ActingChanges,
    DatasetFolder,
    DetectorName,
    EnvFields,
    EvaluationWorkers,
    PolicyName,
    PolicyTask,
    WeightFiles,
    default_text,
)
from surgicai_vision.core import names
from surgicai_vision.core.banks import bank_of
from surgicai_vision.evaluation.robustness import CURVES, MARK, SHIFTS, STRENGTHS
from surgicai_vision.features.encoders import WeightsSource

app = App(
    name="robustness",
    help_epilogue="""\
example:
  surgicai-vision robustness outputs/train/grasp-imagenet-lite-front-seed0 \\
      --axis light,blur --strength 0,0.5,1""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `robustness`.

    Attributes:
        task: The task.
        axis: Axes to shift, each alone; all shifts every axis at once, all-but-noise all but one.
        strength: Strengths of the shift, from 0 (none) to 1, increasing.
        episodes: Number of episodes at each strength.
        seed: Seed of the first start; each episode takes the next.
        workers: Number of processes.
        dataset: With policy replay, the dataset whose mean demonstration it plays.
        out: Folder to create or continue.
    """

    policy: PolicyName = field(kw_only=False)
    task: PolicyTask = None
    axis: Annotated[
        tuple[str, ...],
        UNIQUE,
        Parameter(choices=SHIFTS, metavar="AXIS[,AXIS]"),
        default_text("all that change what the policy sees or does"),
    ] = ()
    strength: Annotated[tuple[float, ...], LIST, Parameter(metavar="NUMBER[,NUMBER]")] = STRENGTHS
    episodes: Annotated[int, COUNT] = 20
    seed: Annotated[int, SEED] = names.TEST_SEED
    detector: DetectorName = None
    workers: EvaluationWorkers = None
    dataset: DatasetFolder = None
    weights: WeightFiles = ()
    accept_licence: AcceptLicence = False
    change: ActingChanges = ()
    out: Annotated[
        Path | None,
        DIRECTORY,
        default_text("outputs/robustness/<task>-<policy>-<training>-starts<seed>+<episodes>"),
    ] = None
    env: EnvFields = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Evaluate every axis at every strength and print the curves."""
    from surgicai_vision.evaluation.robustness.curves import robustness

    spec = open_given(
        console,
        options.policy,
        options.task,
        options.env,
        options.dataset,
        WeightsSource.parse(options.weights, options.accept_licence),
        changes=options.change,
        detector=options.detector,
    )
    out = options.out or folders.robustness_folder(spec, options.seed, options.episodes)
    folders.check_folder(out, MARK)
    seeds = range(options.seed, options.seed + options.episodes)
    rows = robustness(
        spec, seeds, out, console.stage, options.axis, options.strength, options.workers
    )
    for axis in dict.fromkeys(row["axis"] for row in rows):
        console.say(curve_line([row for row in rows if row["axis"] == axis]))
    say_conditions(seeds, spec.config, console)
    console.say(f"curves: {out / CURVES}")
    return {
        "policy": spec.name,
        "task": spec.config.task,
        "starts": bank_of(seeds[0]),
        "curves": rows,
        "out": str(out),
    }


def curve_line(rows: list[dict[str, Any]]) -> str:
    """Return one line about the successes along one axis."""
    points = ", ".join(f"{row['strength']:g}: {row['k']}/{row['n']}" for row in rows)
    first = rows[0]
    area = ""
    if first["auc"] is not None:
        area = f"; area {first['auc']:.2f} ({first['auc_low']:.2f}–{first['auc_high']:.2f})"
    last = rows[-1]
    kept = ""
    if last["retention"] is not None:
        kept = (
            f"; keeps {last['retention']:.2f} "
            f"({last['retention_low']:.2f}–{last['retention_high']:.2f}) at {last['strength']:g}"
        )
    return f"{first['axis']:<16} {points}{area}{kept}"
