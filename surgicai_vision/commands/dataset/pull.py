"""`dataset pull`: fetch a dataset from the Hugging Face Hub and check it."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import DIRECTORY, default_text
from surgicai_vision.core.words import plural

app = App(
    name="pull",
    help_epilogue="""\
example:
  surgicai-vision dataset pull somebody/suturing-grasp --out outputs/datasets/grasp""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `dataset pull`.

    Attributes:
        repo: A dataset on the Hub, shared by `dataset push`.
        out: Folder to create.
        revision: Branch, tag or commit to fetch.
    """

    repo: Annotated[str, Parameter(metavar="USER/NAME")] = field(kw_only=False)
    out: Annotated[Path | None, DIRECTORY, default_text("outputs/datasets/NAME")] = None
    revision: Annotated[
        str | None, Parameter(metavar="REVISION"), default_text("the main branch")
    ] = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Fetch the dataset, check it and print where it is."""
    from surgicai_vision.dataset.hub import pull_dataset

    out = options.out or folders.dataset_folder(options.repo.partition("/")[2] or options.repo)
    with console.stage("checking") as progress:
        report = pull_dataset(options.repo, out, revision=options.revision, progress=progress)
    console.say(f"{plural(report.episodes, 'episode')}, {plural(report.frames, 'frame')}: {out}")
    return {
        "repo": options.repo,
        "dataset": str(out),
        "episodes": report.episodes,
        "frames": report.frames,
    }
