"""`dataset push`: share a dataset on the Hugging Face Hub, with a card."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import DIRECTORY

app = App(
    name="push",
    help_epilogue="""\
example:
  surgicai-vision dataset push outputs/datasets/grasp --repo somebody/suturing-grasp --private""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `dataset push`.

    Attributes:
        dataset: Folder of a dataset made by this product.
        repo: Repository to push to; created if it does not exist.
        private: If the repository is created, make it private.
        licence: Licence of the dataset, by its short name on the Hub.
        dry_run: Show the card and upload nothing.
    """

    dataset: Annotated[Path, DIRECTORY] = field(kw_only=False)
    repo: Annotated[str, Parameter(metavar="USER/NAME")]
    private: bool = False
    licence: Annotated[str, Parameter(metavar="NAME")] = "mit"
    dry_run: bool = False


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Check the dataset, push it and print where it is."""
    from surgicai_vision.core.hub import check_repository
    from surgicai_vision.dataset.hub import dataset_card, push_dataset
    from surgicai_vision.dataset.reader import open_dataset

    if options.dry_run:
        check_repository(options.repo)
        console.say(dataset_card(open_dataset(options.dataset), options.repo, options.licence))
        return {"repo": options.repo, "dry_run": True}
    with console.stage("checking", "frames") as progress:
        address = push_dataset(
            options.dataset,
            options.repo,
            private=options.private,
            licence=options.licence,
            progress=progress,
        )
    console.say(f"pushed: {address}")
    return {"repo": options.repo, "commit": address}
