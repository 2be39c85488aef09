"""`dataset convert`: take some views of a dataset, or store them as video, without rendering."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import COUNT, DIRECTORY, VIDEO, VIEWS, default_text
from surgicai_vision.commands.render_demos import print_video_error
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.words import plural

app = App(
    name="convert",
    help_epilogue="""\
example:
  surgicai-vision dataset convert outputs/datasets/grasp --view back""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `dataset convert`.

    Attributes:
        dataset: Folder of a dataset made by this product.
        view: Views to keep.
        workers: Number of processes that encode videos.
        out: Folder of the new dataset.
    """

    dataset: Annotated[Path, DIRECTORY] = field(kw_only=False)
    view: Annotated[tuple[str, ...] | None, VIEWS, default_text("all")] = None
    video: Annotated[str | None, VIDEO, default_text("as it is")] = None
    workers: Annotated[int, COUNT] = folders.CORES
    out: Annotated[
        Path | None,
        Parameter(metavar="DIR"),
        default_text("DATASET with the views and the codec in its name"),
    ] = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Make the dataset and print where it is."""
    from surgicai_vision.core.executor import RunContext
    from surgicai_vision.dataset import convert_dataset

    path = options.dataset
    ending = "-".join(part for part in ("+".join(options.view or ()), options.video) if part)
    if not ending:
        raise InputError("There is nothing to do: give --view VIEW[,VIEW], --video CODEC or both.")
    whole = path.absolute()
    out = options.out or whole.with_name(f"{whole.name}-{ending}")
    summary = convert_dataset(
        path,
        out,
        views=options.view,
        video=options.video,
        context=RunContext(options.workers, stage=console.stage),
    )
    console.say(
        f"{plural(summary.episodes, 'episode')}, {plural(summary.frames, 'frame')} "
        f"in {summary.seconds:.0f} s: {out}"
    )
    print_video_error(summary.video_error, console)
    return {**dataclasses.asdict(summary), "dataset": str(out)}
