"""`dataset check`: read all of a dataset and say what is wrong with it."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import option

EXAMPLE = "surgicai-vision dataset check outputs/datasets/grasp --json"


@dataclass(frozen=True)
class Options:
    """Options of `dataset check`."""

    dataset: str = option(
        dataclasses.MISSING, "a dataset of ours, or any LeRobot v3 dataset", metavar="DIR"
    )


def run(options: Options, console: Console) -> dict[str, Any]:
    """Print one line a problem; the exit code is 1 when there is one."""
    from surgicai_vision.dataset import check_dataset

    with console.stage("checking") as progress:
        report = check_dataset(Path(options.dataset), progress)
    for problem in report.problems:
        console.say(problem)
    verdict = (
        "whole"
        if report.ok
        else f"{len(report.problems)} problems; see `surgicai-vision dataset repair --help`"
    )
    console.say(f"{report.episodes} episodes, {report.frames} frames: {verdict}")
    return {**dataclasses.asdict(report), "ok": report.ok, "exit_code": 0 if report.ok else 1}
