"""`report`: write the page of stored results."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import option
from surgicai_vision.errors import BadFile

EXAMPLE = "surgicai-vision report outputs/quickstart"


@dataclass(frozen=True)
class Options:
    """Options of `report`."""

    dir: str = option(dataclasses.MISSING, "folder with results of quickstart, evaluate or sweep", metavar="DIR")
    out: str | None = option(None, "where to write the page", metavar="FILE.html", default_text="DIR/report.html")


def run(options: Options, console: Console) -> dict[str, Any]:
    """Write the page and say where it is."""
    from surgicai_vision.report import read_results, write_report

    folder = Path(options.dir)
    if not folder.is_dir():
        raise BadFile(f"{folder} is no folder; give one that quickstart, evaluate or sweep has written.")
    read_results(folder)
    with console.stage("report", "parts") as progress:
        page = write_report(folder, Path(options.out) if options.out else None, progress)
    console.say(f"report: {page}")
    return {"report": str(page)}
