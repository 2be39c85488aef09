"""`dataset view`: take some views of a dataset, or store them as video, without rendering."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import many_of, one_of, option, positive
from surgicai_vision.commands.render_demos import CODECS, say_error
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError

EXAMPLE = "surgicai-vision dataset view outputs/datasets/grasp --view back --out outputs/datasets/grasp-back"


@dataclass(frozen=True)
class Options:
    """Options of `dataset view`."""

    dataset: str = option(dataclasses.MISSING, "a dataset of ours", metavar="DIR")
    view: tuple[str, ...] | None = option(
        None,
        "views, a comma list",
        check=many_of("view", names.CAMERAS),
        metavar="VIEW[,VIEW]",
        default_text="all",
    )
    video: str | None = option(
        None,
        f"store RGB as video: {', '.join(CODECS)}; the error is measured",
        check=one_of("video codec", CODECS),
        metavar="CODEC",
        default_text="as it is",
    )
    workers: int = option(
        folders.CORES, "processes that encode videos", check=positive, metavar="N"
    )
    out: str | None = option(
        None,
        "dataset to make",
        metavar="DIR2",
        default_text="DIR with the views and the codec in its name",
    )


def run(options: Options, console: Console) -> dict[str, Any]:
    """Make the dataset and say where it is."""
    from surgicai_vision.dataset import view_dataset

    if options.view == ():
        raise InputError(f"--view is empty; give some of {', '.join(names.CAMERAS)}.")
    path = Path(options.dataset)
    ending = "-".join(part for part in ("+".join(options.view or ()), options.video) if part)
    if not ending:
        raise InputError("There is nothing to do: give --view VIEW[,VIEW], --video CODEC or both.")
    out = Path(options.out) if options.out else path.with_name(f"{path.name}-{ending}")
    with console.stage("writing", "frames") as progress:
        summary = view_dataset(
            path,
            out,
            views=options.view,
            video=options.video,
            workers=options.workers,
            progress=progress,
        )
    console.say(
        f"{summary.episodes} episodes, {summary.frames} frames in {summary.seconds:.0f} s: {out}"
    )
    say_error(summary, console)
    return {**dataclasses.asdict(summary), "dataset": str(out)}
