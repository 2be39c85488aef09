"""`robustness`: run a policy while one thing at a time shifts, and draw its successes against the
strength.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.evaluate import subject_of
from surgicai_vision.commands.options import (
    config_only,
    many_of,
    not_negative,
    one_of,
    option,
    positive,
    weights_option,
)
from surgicai_vision.core import names
from surgicai_vision.evaluation.robustness import AXES, CURVES, MARK, STRENGTHS, robustness

EXAMPLE = "surgicai-vision robustness outputs/train/grasp-imagenet-lite-front-seed0 --axis light,blur --strength 0,0.5,1"


@dataclass(frozen=True)
class Options:
    """Options of `robustness`."""

    policy: str = option(
        dataclasses.MISSING,
        "a checkpoint folder, a chain.yaml, or expert, replay, random or zero",
        metavar="POLICY",
    )
    task: str | None = option(
        None,
        f"the task: {', '.join(names.TASKS)}",
        check=one_of("task", names.TASKS),
        default_text="the checkpoint's, else grasp",
    )
    axis: tuple[str, ...] = option(
        (),
        f"what shifts: {', '.join(AXES)}",
        check=many_of("axis", AXES),
        metavar="AXIS,AXIS",
        default_text="all that change what the policy sees or does",
    )
    strength: tuple[float, ...] = option(
        STRENGTHS, "how much, from 0 (not at all) to 1, increasing", metavar="NUMBER,NUMBER"
    )
    episodes: int = option(20, "number of episodes at each strength", check=positive, metavar="N")
    seed: int = option(
        names.TEST_SEED, "seed of the first start; each episode takes the next", check=not_negative
    )
    workers: int | None = option(
        None,
        "processes",
        check=positive,
        metavar="N",
        default_text="one a core, at most one for four episodes",
    )
    dataset: str | None = option(
        None,
        "dataset whose mean demonstration replay plays",
        metavar="DIR",
        default_text="outputs/datasets/<task>",
    )
    weights: str | None = weights_option()
    accept_licence: bool = option(False, "accept weights under a non-commercial licence")
    out: str | None = option(
        None,
        "folder to make or to continue",
        metavar="DIR",
        default_text="outputs/robustness/<task>-<policy>-starts<seed>+<episodes>",
    )
    env: dict | None = config_only()


def run(options: Options, console: Console) -> dict[str, Any]:
    """Evaluate every axis at every strength and print the curves."""
    subject = subject_of(options)
    name = f"{subject.config.task}-{subject.name}-starts{options.seed}+{options.episodes}"
    out = Path(options.out) if options.out else folders.OUTPUTS / "robustness" / name
    folders.check_folder(out, MARK)
    seeds = range(options.seed, options.seed + options.episodes)
    rows = robustness(
        subject, seeds, out, console.stage, options.axis, options.strength, options.workers
    )
    for axis in dict.fromkeys(row["axis"] for row in rows):
        console.say(curve_line([row for row in rows if row["axis"] == axis]))
    console.say(f"curves: {out / CURVES}")
    return {"policy": subject.name, "task": subject.config.task, "curves": rows, "out": str(out)}


def curve_line(rows: list[dict[str, Any]]) -> str:
    """Return one axis in one line for people."""
    points = ", ".join(f"{row['strength']:g}: {row['k']}/{row['n']}" for row in rows)
    area, low, high = (rows[0][key] for key in ("auc", "auc_low", "auc_high"))
    under = "" if area is None else f"; area {area:.2f} ({low:.2f}–{high:.2f})"
    return f"{rows[0]['axis']:<16} {points}{under}"
