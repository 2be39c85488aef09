"""`release`: build the policies that come with the product, from scratch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import COUNT, DIRECTORY, IMAGE_SIZE, UNIQUE, default_text

app = App(
    name="release",
    help_epilogue="""\
example:
  surgicai-vision release --only grasp
to try it in minutes, in a folder apart from the package's own policies:
  SURGICAI_VISION_RELEASED=outputs/tried surgicai-vision release \\
      --demonstrations 5 --epochs 1 --episodes 2 --out outputs/release-tried""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `release`.

    Attributes:
        plan: YAML file that says what to build.
        only: Build only these policies; suture is assembled from existing ones.
        demonstrations: Number of demonstrations of each kind, instead of the plan's.
        epochs: Number of passes over the frames, instead of the recipe's.
        episodes: Number of held-out starts per evaluation, instead of the plan's.
        size: Height and width of images [px], instead of the plan's.
        workers: Number of processes.
        out: Working folder, to create or continue; the policies go into the package, or into
            $SURGICAI_VISION_RELEASED.
    """

    plan: Annotated[
        Path | None, Parameter(metavar="FILE.yaml"), default_text("configs/sweep/procedure.yaml")
    ] = None
    only: Annotated[
        tuple[str, ...], UNIQUE, Parameter(metavar="NAME[,NAME]"), default_text("all")
    ] = ()
    demonstrations: Annotated[int | None, COUNT, default_text("the plan's")] = None
    epochs: Annotated[int | None, COUNT, default_text("the recipe's")] = None
    episodes: Annotated[int | None, COUNT, default_text("the plan's")] = None
    size: Annotated[int | None, IMAGE_SIZE, default_text("the plan's")] = None
    workers: Annotated[int, COUNT] = folders.CORES
    out: Annotated[Path, DIRECTORY] = Path("outputs/release")


@app.default
def run(options: Options = Options(), *, console: Console) -> dict[str, object]:
    """Build the policies, and print how often each succeeds."""
    from surgicai_vision.core.config import to_mapping
    from surgicai_vision.core.executor import RunContext
    from surgicai_vision.experiments.plan_config import read_plan
    from surgicai_vision.experiments.release import run_release
    from surgicai_vision.training.released import PREFIX, released_folder

    plan = read_plan(options.plan).smaller(
        demonstrations=options.demonstrations,
        epochs=options.epochs,
        episodes=options.episodes,
        size=options.size,
    )
    context = RunContext(options.workers, stage=console.stage)
    cards = run_release(plan, options.out, context, options.only)
    for card in cards:
        console.say(f"{PREFIX}{card.name:<8}  {card.counted}")
    console.say(f"policies: {released_folder()}")
    return {"folder": str(released_folder()), "policies": [to_mapping(card) for card in cards]}
