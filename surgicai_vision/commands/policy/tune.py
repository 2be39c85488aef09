"""`policy tune`: choose when a hierarchical policy with learned ends ends a subtask."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    COUNT,
    DIRECTORY,
    SEED,
    UNIQUE,
    WHOLE_NUMBERS,
    AcceptLicence,
    EnvFields,
    EvaluationWorkers,
    WeightFiles,
    default_text,
)
from surgicai_vision.core import names
from surgicai_vision.core.config import JSON
from surgicai_vision.evaluation.hierarchical_config import CONFIDENCES, PATIENCES
from surgicai_vision.features.encoders import WeightsSource

if TYPE_CHECKING:
    from surgicai_vision.evaluation.ends_sweep import Ends

app = App(
    name="tune",
    help_epilogue="""\
example:
  surgicai-vision policy tune hierarchical.yaml --confidence 0.5,0.9 --patience 1,3""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `policy tune`.

    Attributes:
        policy: A hierarchical policy with learned ends: its YAML file, or released:suture.
        confidence: Values to try: probability that another subtask needs to end the present one.
        patience: Values to try: times in a row that the other subtask must be named.
        episodes: Number of validation starts, the same for every pair of values.
        seed: Seed of the first start; each episode takes the next.
        workers: Number of processes.
        out: Folder to create or continue; its hierarchical.yaml has the chosen values.
    """

    policy: Annotated[Path, Parameter(metavar="FILE")] = field(kw_only=False)
    confidence: Annotated[tuple[float, ...], UNIQUE, Parameter(metavar="P[,P]")] = CONFIDENCES
    patience: Annotated[tuple[int, ...], WHOLE_NUMBERS] = PATIENCES
    episodes: Annotated[int, COUNT] = 20
    seed: Annotated[int, SEED] = names.VALIDATION_SEED
    workers: EvaluationWorkers = None
    weights: WeightFiles = ()
    accept_licence: AcceptLicence = False
    out: Annotated[
        Path | None, DIRECTORY, default_text("outputs/ends/<file>-starts<seed>+<episodes>")
    ] = None
    env: EnvFields = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Evaluate every pair on validation starts, and write a file with the best."""
    from surgicai_vision.evaluation.ends_sweep import CHOSEN, MARK, sweep_ends
    from surgicai_vision.training.run_config import Starts

    name = f"{options.policy.stem}-starts{options.seed}+{options.episodes}"
    out = options.out or folders.OUTPUTS / "ends" / name
    folders.check_folder(out, MARK)
    rows = sweep_ends(
        options.policy,
        Starts(options.seed, options.episodes),
        out,
        console.stage,
        options.confidence,
        options.patience,
        cast("dict[str, JSON] | None", options.env),
        WeightsSource.parse(options.weights, options.accept_licence),
        options.workers,
    )
    console.say("confidence  patience  sewn     false ends  delay [s]")
    for row in rows:
        console.say(_line(row))
    console.say(f"best: {out / CHOSEN}")
    return {"ends": [asdict(row) for row in rows], "out": str(out)}


def _line(row: "Ends") -> str:
    """Return one pair as a line of the table."""
    sewn = f"{row.successes}/{row.episodes}"
    delay = "–" if row.delay_s is None else f"{row.delay_s:.2f}"
    return f"{row.confidence:<10g}  {row.patience:<8}  {sewn:<7}  {row.false_ends:<10.2f}  {delay}"
