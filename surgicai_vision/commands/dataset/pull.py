"""`dataset pull`: fetch a dataset from the Hugging Face Hub and check it."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import option

EXAMPLE = "surgicai-vision dataset pull somebody/suturing-grasp --out outputs/datasets/grasp"


@dataclass(frozen=True)
class Options:
    """Options of `dataset pull`."""

    repo: str = option(dataclasses.MISSING, "a LeRobot v3 dataset on the Hub", metavar="USER/NAME")
    out: str | None = option(
        None, "folder to make", metavar="DIR", default_text="outputs/datasets/NAME"
    )
    revision: str | None = option(
        None, "branch, tag or commit", metavar="REV", default_text="the main branch"
    )


def run(options: Options, console: Console) -> dict[str, Any]:
    """Fetch, check and say where it is."""
    from surgicai_vision.dataset.hub import pull_dataset

    out = (
        Path(options.out)
        if options.out
        else folders.dataset_folder(options.repo.partition("/")[2] or options.repo)
    )
    with console.stage("checking") as progress:
        report = pull_dataset(options.repo, out, revision=options.revision, progress=progress)
    console.say(f"{report.episodes} episodes, {report.frames} frames: {out}")
    return {
        "repo": options.repo,
        "dataset": str(out),
        "episodes": report.episodes,
        "frames": report.frames,
    }
