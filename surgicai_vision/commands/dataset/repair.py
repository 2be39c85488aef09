"""`dataset repair`: keep the longest whole prefix of a broken LeRobot dataset."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import option

EXAMPLE = "surgicai-vision dataset repair recordings/broken --out recordings/mended"


@dataclass(frozen=True)
class Options:
    """Options of `dataset repair`."""

    dataset: str = option(
        dataclasses.MISSING, "a LeRobot v3 dataset, ours or any other", metavar="DIR"
    )
    out: str | None = option(
        None,
        "folder to make",
        metavar="DIR2",
        default_text="DIR itself; the original stays as DIR.broken",
    )


def run(options: Options, console: Console) -> dict[str, Any]:
    """Repair and say what was kept, what was wrong and where the original is."""
    from surgicai_vision.dataset import repair_dataset

    with console.stage("verifying", "episodes") as progress:
        repair = repair_dataset(
            Path(options.dataset), Path(options.out) if options.out else None, progress
        )
    for problem in repair.problems:
        console.say(problem)
    if repair.original is None:
        console.say(
            f"nothing to repair: {repair.episodes} episodes, {repair.frames} frames in {repair.path} are whole"
        )
    else:
        kept = f"{repair.episodes} of {repair.claimed} episodes, {repair.frames} frames kept"
        console.say(f"{kept}: {repair.path} (original: {repair.original})")
    return {
        **dataclasses.asdict(repair),
        "path": str(repair.path),
        "original": None if repair.original is None else str(repair.original),
    }
