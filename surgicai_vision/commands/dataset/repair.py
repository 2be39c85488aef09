"""`dataset repair`: keep the longest whole prefix of a broken LeRobot dataset."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import DIRECTORY, default_text

app = App(
    name="repair",
    help_epilogue="""\
example:
  surgicai-vision dataset repair recordings/broken --out recordings/mended""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `dataset repair`.

    Attributes:
        dataset: A LeRobot v3 dataset, ours or any other.
        out: Folder to make.
    """

    dataset: Annotated[Path, DIRECTORY] = field(kw_only=False)
    out: Annotated[
        Path | None,
        Parameter(metavar="DIR2"),
        default_text("DIR itself; the original stays as DIR.broken"),
    ] = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Repair the dataset and print what was kept, what was wrong and where the original is."""
    from surgicai_vision.dataset import repair_dataset

    with console.stage("verifying", "episodes") as progress:
        repair = repair_dataset(options.dataset, options.out, progress)
    for problem in repair.problems:
        console.say(problem)
    if repair.original is None:
        console.say(
            f"nothing to repair: {repair.episodes} episodes, {repair.frames} frames in "
            f"{repair.path} are whole"
        )
    else:
        kept = f"{repair.episodes} of {repair.claimed} episodes, {repair.frames} frames kept"
        console.say(f"{kept}: {repair.path} (original: {repair.original})")
    return {
        **dataclasses.asdict(repair),
        "path": str(repair.path),
        "original": None if repair.original is None else str(repair.original),
    }
