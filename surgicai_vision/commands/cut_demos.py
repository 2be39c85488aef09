"""`cut-demos`: a subtask's visits in whole procedures, as demonstrations of the subtask."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import DIRECTORY, SUBTASK, default_text
from surgicai_vision.core import names
from surgicai_vision.core.words import plural

app = App(
    name="cut-demos",
    help_epilogue="""\
example:
  surgicai-vision cut-demos --demos outputs/demos/recover --subtask grasp
then, together with demonstrations of the subtask alone:
  surgicai-vision render-demos --demos outputs/demos/grasp,outputs/demos/grasp-visits""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `cut-demos`.

    Attributes:
        demos: Folder with demonstrations of whole procedures.
        subtask: The subtask whose visits to cut out.
        out: Folder to create.
    """

    demos: Annotated[Path | None, DIRECTORY, default_text(f"outputs/demos/{names.SUTURE}")] = None
    subtask: Annotated[str, SUBTASK, Parameter(metavar="SUBTASK")] = "grasp"
    out: Annotated[Path | None, DIRECTORY, default_text("outputs/demos/<subtask>-visits")] = None


@app.default
def run(options: Options = Options(), *, console: Console) -> dict[str, object]:
    """Cut the visits out and write them."""
    from surgicai_vision.demos.cut import cut_demos
    from surgicai_vision.demos.store import MARKER

    demos = options.demos or folders.demos_folder(names.SUTURE)
    out = options.out or folders.demos_folder(f"{options.subtask}-visits")
    folders.check_folder(out, MARKER)
    paths = cut_demos(demos, options.subtask, out=out, stage=console.stage)
    console.say(f"{plural(len(paths), 'visit')} of {options.subtask}: {out}")
    console.say(f"next: surgicai-vision render-demos --demos {out}")
    return {"visits": len(paths), "out": str(out)}
