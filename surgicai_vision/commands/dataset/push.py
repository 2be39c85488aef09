"""`dataset push`: share a dataset on the Hugging Face Hub, with a card."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import option
from surgicai_vision.core.errors import InputError

EXAMPLE = (
    "surgicai-vision dataset push outputs/datasets/grasp --repo somebody/suturing-grasp --private"
)


@dataclass(frozen=True)
class Options:
    """Options of `dataset push`."""

    dataset: str = option(dataclasses.MISSING, "a dataset of ours", metavar="DIR")
    repo: str | None = option(None, "where to; made when it does not exist", metavar="USER/NAME")
    private: bool = option(False, "make it private")
    licence: str = option("mit", "the Hub's short name of a licence", metavar="NAME")
    dry_run: bool = option(False, "show the card and upload nothing")


def run(options: Options, console: Console) -> dict[str, Any]:
    """Check, push and say where it is."""
    from surgicai_vision.dataset.hub import dataset_card, push_dataset
    from surgicai_vision.dataset.reader import open_dataset

    if options.repo is None:
        raise InputError("dataset push needs --repo USER/NAME.")
    if options.dry_run:
        console.say(
            dataset_card(open_dataset(Path(options.dataset)), options.repo, options.licence)
        )
        return {"repo": options.repo, "dry_run": True}
    with console.stage("checking", "frames") as progress:
        address = push_dataset(
            Path(options.dataset),
            options.repo,
            private=options.private,
            licence=options.licence,
            progress=progress,
        )
    console.say(f"pushed: {address}")
    return {"repo": options.repo, "commit": address}
