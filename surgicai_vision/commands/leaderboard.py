"""`leaderboard`: check the rows that others measured and write them as one page."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import default_text
from surgicai_vision.core.words import plural

app = App(
    name="leaderboard",
    help_epilogue="""\
example:
  surgicai-vision leaderboard rows --out leaderboard.html""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `leaderboard`.

    Attributes:
        dir: Folder with the files that `submit` wrote, at any depth.
        out: The page to write.
    """

    dir: Annotated[Path, Parameter(metavar="DIR")] = field(kw_only=False)
    out: Annotated[
        Path | None, Parameter(metavar="FILE.html"), default_text("DIR/leaderboard.html")
    ] = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Write the page; the exit code is 1 if a row is refused."""
    from surgicai_vision.report.leaderboard import write_leaderboard

    page = options.out or options.dir / "leaderboard.html"
    if options.dir.is_dir():  # else it is refused below and must not be created
        folders.check_file(page, "--out", (".html",))
    board = write_leaderboard(options.dir, page)
    for name, reason in board.refused.items():
        console.say(f"rejected: {name}: {reason}")
    console.say(f"{plural(len(board.taken), 'row')}: {board.page}")
    return {
        "page": str(board.page),
        "taken": len(board.taken),
        "refused": board.refused,
        "exit_code": 1 if board.refused else 0,
    }
