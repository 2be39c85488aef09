"""`probe`: read the needle's pose from frozen features, before any policy is trained."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    DIRECTORY,
    ENCODERS,
    POOL,
    SEED,
    TASK,
    VIEWS,
    AcceptLicence,
    DatasetFolder,
    WeightFiles,
    default_text,
)
from surgicai_vision.core.files import check_output, write_json
from surgicai_vision.core.words import plural
from surgicai_vision.features import encoders

if TYPE_CHECKING:
    from surgicai_vision.dataset import Dataset

app = App(
    name="probe",
    help_epilogue="""\
example:
  surgicai-vision probe --task grasp --encoder imagenet-lite,random --view front,back""",
)
RESULT = "probe.json"


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `probe`.

    Attributes:
        task: The task, which must be that of a given dataset.
        dataset: Folder of the dataset.
        encoder: Encoders to probe.
        view: Views to probe, each alone and all together.
        pool: What to take from the encoder: one vector (global), a feature map (spatial) or tokens.
        seed: Seed of the cross-validation folds and of the confidence intervals.
        out: Folder for probe.json; an earlier one is replaced.
    """

    task: Annotated[str | None, TASK, default_text("the dataset's, else grasp")] = None
    dataset: DatasetFolder = None
    encoder: Annotated[tuple[str, ...], ENCODERS] = ("imagenet-lite",)
    view: Annotated[tuple[str, ...], VIEWS] = ("front", "back")
    weights: WeightFiles = ()
    accept_licence: AcceptLicence = False
    pool: Annotated[str, POOL] = "global"
    seed: Annotated[int, SEED] = 0
    out: Annotated[
        Path | None, DIRECTORY, default_text("outputs/probes/<task>-<encoders>-<views>")
    ] = None


@app.default
def run(options: Options = Options(), *, console: Console) -> dict[str, object]:
    """Probe every encoder and view set, keep the rows and print them."""
    from surgicai_vision.features.probe import needle_pose

    weights = encoders.WeightsSource.parse(options.weights, options.accept_licence)
    for encoder in options.encoder:
        encoders.find_weights(encoder, weights)
    dataset = folders.open_dataset(options.dataset, options.task, options.view)
    label = "-".join(
        (dataset.task, "+".join(options.encoder).replace(":", "-"), "+".join(options.view))
    )
    out = options.out or folders.OUTPUTS / "probes" / label
    check_output(out, may_resume=RESULT)
    needle_pose(dataset)  # fails before anything is encoded
    rows = [row for encoder in options.encoder for row in _rows(options, encoder, dataset, console)]
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / RESULT, rows)
    console.say(f"probe: {out / RESULT}")
    return {"rows": rows, "out": str(out)}


def _rows(
    options: Options, name: str, dataset: "Dataset", console: Console
) -> list[dict[str, Any]]:
    """Encode what is not in the cache and probe one encoder's views."""
    from surgicai_vision.features.cache import encode
    from surgicai_vision.features.probe import probe

    encoder = encoders.load_encoder(
        name, options.pool, encoders.WeightsSource.parse(options.weights, options.accept_licence)
    )
    entries = {}
    for view in options.view:
        with console.stage(f"features: {name}, {view}", "frames") as progress:
            entries[view] = encode(dataset, view, encoder, progress=progress)
    sets = [(view,) for view in options.view] + ([options.view] if len(options.view) > 1 else [])
    rows = []
    for views in sets:
        with console.stage(f"probe: {name}, {'+'.join(views)}", "folds") as progress:
            found = probe(
                dataset, [entries[view] for view in views], seed=options.seed, progress=progress
            )
        row = {
            "task": dataset.task,
            "encoder": name,
            "view": "+".join(views),
            "pool": options.pool,
            **found.row(),
            "seed": options.seed,
            "dataset": dataset.fingerprint,
            "weights_sha256": encoder.weights_sha256,
        }
        console.say(line(row))
        rows.append(row)
    return rows


def line(row: dict[str, Any]) -> str:
    """Return one line about a probe."""
    parts = []
    for key, unit in (("tip_mm", "mm"), ("angle_deg", "°")):
        value, low, high, chance = (
            row[name] for name in (key, f"{key}_low", f"{key}_high", f"{key}_chance")
        )
        parts.append(f"{value:.2f} {unit} ({low:.2f}–{high:.2f}; mean pose {chance:.2f})")
    tip, angle = parts
    return (
        f"{row['encoder']} {row['view']}: tip {tip}, angle {angle}, {plural(row['n'], 'episode')}"
    )
