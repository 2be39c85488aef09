"""`probe`: read the needle's pose from frozen features, before any policy is trained."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import many_of, not_negative, one_of, option, weights_option
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.files import check_output, write_json
from surgicai_vision.features import encoders

EXAMPLE = "surgicai-vision probe --task grasp --encoder imagenet-lite,random --view front,back"
RESULT = "probe.json"


def _check_encoders(name: str, given: tuple[str, ...]) -> None:
    if not given:
        raise InputError(f"{name} is empty; name at least one of {encoders.encoder_choices()}.")
    for encoder in given:
        encoders.check_encoder_name(encoder)


@dataclass(frozen=True)
class Options:
    """Options of `probe`."""

    task: str = option(
        "grasp", f"the dataset's task: {', '.join(names.TASKS)}", check=one_of("task", names.TASKS)
    )
    dataset: str | None = option(
        None, "dataset folder", metavar="DIR", default_text="outputs/datasets/<task>"
    )
    encoder: tuple[str, ...] = option(
        ("imagenet-lite",),
        f"encoders, a comma list of {encoders.encoder_choices()}",
        check=_check_encoders,
        metavar="NAME[,NAME]",
    )
    view: tuple[str, ...] = option(
        ("front", "back"),
        "views, a comma list: each is probed alone, and all side by side",
        check=many_of("view", names.CAMERAS),
        metavar="VIEW[,VIEW]",
    )
    weights: str | None = weights_option()
    accept_licence: bool = option(False, "accept weights under a non-commercial licence")
    pool: str = option(
        "global",
        f"what is taken: {', '.join(encoders.POOLS)}",
        check=one_of("pool", encoders.POOLS),
    )
    seed: int = option(0, "seed of the folds and of the intervals", check=not_negative)
    out: str | None = option(
        None, f"folder for {RESULT}; an earlier one is replaced", metavar="DIR",
        default_text="outputs/probes/<task>-<encoders>-<views>",
    )  # fmt: skip


def run(options: Options, console: Console) -> dict[str, Any]:
    """Probe every encoder and view set, keep the rows and print them."""
    if not options.view:
        raise InputError("--view is empty; name at least one view.")
    for encoder in options.encoder:
        encoders.find_weights(encoder, options.weights, options.accept_licence)
    dataset = folders.open_dataset(options.dataset, options.task, options.view)
    label = "-".join(
        (dataset.task, "+".join(options.encoder).replace(":", "-"), "+".join(options.view))
    )
    out = Path(options.out) if options.out else folders.OUTPUTS / "probes" / label
    check_output(out, may_resume=RESULT)
    rows = [row for encoder in options.encoder for row in _rows(options, encoder, dataset, console)]
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / RESULT, rows)
    console.say(f"probe: {out / RESULT}")
    return {"rows": rows, "out": str(out)}


def _rows(options: Options, name: str, dataset: Any, console: Console) -> list[dict[str, Any]]:
    """Encode what is not at hand and probe one encoder's views."""
    from surgicai_vision.features.cache import encode
    from surgicai_vision.features.probe import probe

    encoder = encoders.load_encoder(name, options.weights, options.pool, options.accept_licence)
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
    """Return a row in one line for people."""
    parts = []
    for key, unit in (("tip_mm", "mm"), ("angle_deg", "°")):
        value, low, high, chance = (
            row[name] for name in (key, f"{key}_low", f"{key}_high", f"{key}_chance")
        )
        parts.append(f"{value:.2f} {unit} ({low:.2f}–{high:.2f}; mean pose {chance:.2f})")
    tip, angle = parts
    return f"{row['encoder']} {row['view']}: tip {tip}, angle {angle}, {row['n']} episodes"
