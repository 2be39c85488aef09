"""`report`: write the page and the tables of stored results."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import NOT_NEGATIVE, default_text
from surgicai_vision.core.errors import BadFile, SurgicaiError

app = App(name="report", help_epilogue="example:\n  surgicai-vision report outputs/quickstart")
STRIPS = 160


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `report`.

    Attributes:
        dir: Folder with results of quickstart, evaluate, robustness or sweep.
        out: Where to write the page; tables/ stands beside it.
        strips: Film strips at most, as far as the page's budget allows.
    """

    dir: Annotated[Path, Parameter(metavar="DIR")] = field(kw_only=False)
    out: Annotated[Path | None, Parameter(metavar="FILE.html"), default_text("DIR/report.html")] = (
        None
    )
    strips: Annotated[int, NOT_NEGATIVE] = STRIPS


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Write the page and the tables and print where they are."""
    from surgicai_vision.report import collect, write_report
    from surgicai_vision.report.tables import FOLDER

    folder = options.dir
    if not folder.is_dir():
        raise BadFile(
            f"{folder} is no folder; give one that quickstart, evaluate or sweep has written."
        )
    cells = _cells(folder, console)
    found = collect(folder, cells)
    with console.stage("report", "parts") as progress:
        page = write_report(folder, options.out, progress, cells=cells, strips=options.strips)
    tables = page.parent / FOLDER
    console.say(f"report: {page}")
    console.say(f"tables: {tables}")
    counts = {"evaluations": len(found.results), "missing": len(found.missing)}
    return {"report": str(page), "tables": str(tables), **counts, "bytes": page.stat().st_size}


def _cells(folder: Path, console: Console) -> Sequence[Mapping[str, Any]]:
    """Return every cell of the sweep in `folder` with its state.

    Nothing is returned where the folder holds no sweep, or a grid that this version cannot read.
    """
    from surgicai_vision.core.config import from_mapping, to_mapping
    from surgicai_vision.core.files import read_json
    from surgicai_vision.experiments.sweep import Grid, plan
    from surgicai_vision.report import GRID_FILE

    path = folder / GRID_FILE
    if not path.exists():
        return ()
    try:
        states = plan(from_mapping(Grid, read_json(path), str(path)), folder)
    except SurgicaiError as error:
        console.note(
            "The grid cannot be read here, so only cells with a result or a record are reported: "
            f"{error}"
        )
        return ()
    return [
        {**to_mapping(state.cell), "key": state.key, "state": state.state, "reason": state.reason}
        for state in states
    ]
