"""`report`: write the page and the tables of stored results."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import NOT_NEGATIVE, default_text
from surgicai_vision.core.errors import BadFile, SurgicaiError

if TYPE_CHECKING:
    from surgicai_vision.report.reader import PlannedRun

app = App(name="report", help_epilogue="example:\n  surgicai-vision report outputs/quickstart")
STRIPS = 160


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `report`.

    Attributes:
        dir: Folder with results of quickstart, evaluate, robustness or sweep.
        out: Page to write; the folder tables/ is written next to it.
        strips: Largest number of film strips, as far as the page's size budget allows.
    """

    dir: Annotated[Path, Parameter(metavar="DIR")] = field(kw_only=False)
    out: Annotated[Path | None, Parameter(metavar="FILE.html"), default_text("DIR/report.html")] = (
        None
    )
    strips: Annotated[int, NOT_NEGATIVE] = STRIPS


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Write the page and the tables and print where they are."""
    from surgicai_vision.report import PAGE_FILE, collect, write_report
    from surgicai_vision.report.tables import FOLDER

    folder = options.dir
    if not folder.is_dir():
        raise BadFile(
            f"{folder} is not a folder; give one that quickstart, evaluate or sweep has written."
        )
    folders.check_file(options.out or folder / PAGE_FILE, "--out", (".html",))
    planned = _planned(folder, console)
    found = collect(folder, planned)
    with console.stage("report", "parts") as progress:
        page = write_report(folder, options.out, progress, planned=planned, strips=options.strips)
    tables = page.parent / FOLDER
    console.say(f"report: {page}")
    console.say(f"tables: {tables}")
    counts = {"evaluations": len(found.results), "missing": len(found.missing)}
    return {"report": str(page), "tables": str(tables), **counts, "bytes": page.stat().st_size}


def _planned(folder: Path, console: Console) -> "Sequence[PlannedRun]":
    """Return every run of the sweep in `folder` with its state; nothing if it holds no sweep.

    Raises:
        BadFile: another version wrote the sweep.
    """
    from surgicai_vision.evaluation.storage import GRID_FILE
    from surgicai_vision.experiments.sweep.plan import plan, read_experiment_of

    if not (folder / GRID_FILE).exists():
        return ()
    experiment = read_experiment_of(folder)
    try:
        return plan(experiment, folder)
    except SurgicaiError as error:
        console.note(
            "The sweep cannot be planned here, so only runs with a result or a record are "
            f"reported: {error}"
        )
        return ()
