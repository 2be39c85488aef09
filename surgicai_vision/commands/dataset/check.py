"""`dataset check`: read all of a dataset and say what is wrong with it."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import DIRECTORY
from surgicai_vision.core.words import plural

app = App(
    name="check",
    help_epilogue="example:\n  surgicai-vision dataset check outputs/datasets/grasp --json",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `dataset check`.

    Attributes:
        dataset: Folder of a dataset made by render-demos; lerobot-salvage checks any other.
    """

    dataset: Annotated[Path, DIRECTORY] = field(kw_only=False)


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Print one line per problem; the exit code is 1 if there is one."""
    from surgicai_vision.dataset import check_dataset

    with console.stage("checking") as progress:
        report = check_dataset(options.dataset, progress)
    for problem in report.problems:
        console.say(problem)
    verdict = (
        "whole"
        if report.ok
        else f"{len(report.problems)} problems; `lerobot-salvage repair` keeps what is whole"
    )
    console.say(
        f"{plural(report.episodes, 'episode')}, {plural(report.frames, 'frame')}: {verdict}"
    )
    return {**dataclasses.asdict(report), "ok": report.ok, "exit_code": 0 if report.ok else 1}
