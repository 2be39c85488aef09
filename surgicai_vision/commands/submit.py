"""`submit`: make the row of an evaluation for the leaderboard."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter, validators

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import default_text
from surgicai_vision.core.errors import OutputExists
from surgicai_vision.core.files import check_output

app = App(
    name="submit",
    help_epilogue="""\
example:
  surgicai-vision submit outputs/evaluate/mine --name "My policy" --by "Jane Doe" --minutes 25
an evaluation that it accepts:
  surgicai-vision evaluate outputs/train/mine --episodes 100 --out outputs/evaluate/mine
another, with everything shifted:
  surgicai-vision robustness outputs/train/mine --axis all --strength 0.5 --episodes 100 \\
      --out outputs/robustness/mine
  surgicai-vision submit outputs/robustness/mine/all/0.5 --name Mine --by Me""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `submit`.

    Attributes:
        evaluation: Folder of an evaluation, by `evaluate`, a sweep or `robustness` (DIR/all/0.5).
        name: Name of the policy on the leaderboard.
        by: Who measured the policy.
        link: Address of the policy's code or paper, https://…
        minutes: Minutes of training.
        hardware: Hardware that the policy was trained on.
        note: Anything else that a reader must know.
        out: The file to write.
    """

    evaluation: Annotated[Path, Parameter(metavar="DIR")] = field(kw_only=False)
    name: str
    by: str
    link: Annotated[str, Parameter(show_default=False)] = ""
    minutes: Annotated[float | None, Parameter(validator=validators.Number(gte=0))] = None
    hardware: Annotated[str, Parameter(show_default=False)] = ""
    note: Annotated[str, Parameter(show_default=False)] = ""
    out: Annotated[
        Path | None,
        Parameter(metavar="FILE.json"),
        default_text("<task>-<digest>.json"),
    ] = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Check the evaluation as the leaderboard will and write its row."""
    from surgicai_vision.report.leaderboard import Entry, make_row, write_row

    if options.out:
        _check_out(options.out)
    entry = Entry(
        options.name, options.by, options.link, options.minutes, options.hardware, options.note
    )
    row = make_row(options.evaluation, entry)
    out = options.out or Path(f"{row.run.task}-{row.digest[:12]}.json")
    _check_out(out)
    write_row(row, out)
    console.say(f"row: {out}")
    console.say("next: send it as described in docs/submit.md")
    return {"row": str(out), "digest": row.digest, "successes": sum(row.successes)}


def _check_out(out: Path) -> None:
    """Refuse a row's file that exists already or cannot be written."""
    if out.is_file():
        raise OutputExists(f"--out {out} exists already; give a file that does not exist yet.")
    check_output(out)
    folders.check_file(out, "--out", (".json",))
