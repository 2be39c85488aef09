"""Report: stored results → one self-contained page and tables.

A results folder holds evaluations (`storage.find_evaluations`) at any depth. It may also hold the
`run.json` of a run: title, command, seconds of each stage, versions and machine. The report
includes a sweep's runs without a result, with the reason. Images are rendered again from the states
kept of each episode, so results stay small and the page can be rebuilt at any time.

    reader → groups (over training seeds) → pairs, dependences, curves, films → page, tables
"""

from collections.abc import Sequence
from pathlib import Path

from surgicai_vision.core import files
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.evaluation.storage import GRID_FILE, RUN_FILE
from surgicai_vision.report import figures, filmstrips, page
from surgicai_vision.report.dependence import dependences
from surgicai_vision.report.failures import failure_sheet
from surgicai_vision.report.groups import group
from surgicai_vision.report.pairs import compare
from surgicai_vision.report.provenance import commands, origin
from surgicai_vision.report.reader import (
    REFERENCES,
    PlannedRun,
    Result,
    collect,
    read_results,
)
from surgicai_vision.report.tables import write_changed, write_tables
from surgicai_vision.report.video import opening_video

__all__ = [
    "GRID_FILE",
    "REFERENCES",
    "RUN_FILE",
    "Result",
    "collect",
    "read_results",
    "write_report",
]

PAGE_FILE = "report.html"
FAILURES_FILE = "failures.jpg"


def write_report(
    folder: Path,
    out: Path | None = None,
    progress: Progress | None = None,
    *,
    planned: Sequence[PlannedRun] = (),
    strips: int = filmstrips.MOST_STRIPS,
) -> Path:
    """Write the page and the tables of the results below `folder`; return the page's path.

    Args:
        folder: results of quickstart, evaluate, robustness or sweep.
        out: the page, by default `folder`/report.html; `tables/` is written next to it.
        progress: called as progress(parts done, parts).
        planned: the runs of a sweep (see `reader.collect`).
        strips: maximum number of film strips; 0 for none.

    Raises:
        BadFile: the folder has neither a complete evaluation nor a cell that failed or was not run.
    """
    report = progress or silent
    collected = collect(folder, planned)
    groups = group(collected)
    pairs = compare(groups)
    found = dependences(groups)
    title = collected.run.get("title", folder.resolve().name)
    report(1, strips + 3)
    reel = filmstrips.make_reel(groups, strips, lambda done, total: report(1 + done, total + 3))
    path = out or folder / PAGE_FILE
    filled = {
        **page.numbers(collected, groups, pairs, found),
        **origin(collected, groups),
        **figures.static_images(groups, reel),
        "details": page.details(
            groups, reel, {str(r.folder): commands(r, collected.run) for r in collected.results}
        ),
        "footer": page.footer(collected),
        "title": title,
        "video": opening_video(folder, path, collected.run),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    tables = write_tables(path.parent, groups, pairs, found, title)
    sheet = failure_sheet(groups, reel)
    if sheet:
        write_changed(tables / FAILURES_FILE, sheet)
    else:
        (tables / FAILURES_FILE).unlink(missing_ok=True)
    report(len(reel.strips) + 2, len(reel.strips) + 3)
    files.write_bytes(path, page.render(filled).encode())
    report(len(reel.strips) + 3, len(reel.strips) + 3)
    return path
