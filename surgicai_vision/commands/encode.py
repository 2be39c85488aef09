"""`encode`: compute a dataset's frozen features."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import many_of, one_of, option, weights_option
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.files import check_output
from surgicai_vision.features import encoders

EXAMPLE = "surgicai-vision encode --task grasp --encoder imagenet-lite --view front,back"


@dataclass(frozen=True)
class Options:
    """Options of `encode`."""

    task: str = option(
        "grasp", f"the dataset's task: {', '.join(names.TASKS)}", check=one_of("task", names.TASKS)
    )
    dataset: str | None = option(
        None, "dataset folder", metavar="DIR", default_text="outputs/datasets/<task>"
    )
    encoder: str = option(
        "imagenet-lite",
        f"one of {encoders.encoder_choices()}",
        check=encoders.check_encoder_option,
    )
    view: tuple[str, ...] = option(
        ("front", "back"),
        "views, a comma list",
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
    export: str | None = option(
        None,
        "also write a dataset with the features in place of images, for LeRobot's policies",
        metavar="DIR",
    )


def run(options: Options, console: Console) -> dict[str, Any]:
    """Encode every view and say where the features are."""
    encoders.find_weights(options.encoder, options.weights, options.accept_licence)
    dataset = folders.open_dataset(options.dataset, options.task, options.view)
    if options.export:
        if options.pool != "global":
            raise InputError(f"--export writes global features; leave --pool {options.pool} out.")
        check_output(Path(options.export))
    from surgicai_vision.features.cache import encode

    encoder = encoders.load_encoder(
        options.encoder, options.weights, options.pool, options.accept_licence
    )
    entries, rows = [], []
    for view in options.view:
        with console.stage(f"encoding {view} by {options.encoder}", "frames") as progress:
            features = encode(dataset, view, encoder, progress=progress)
        state = f"{features.encoded} frames encoded" if features.encoded else "at hand"
        console.say(
            f"{options.encoder} {view}: {len(features.rows)} × {features.dim}, {state}: {features.folder}"
        )
        rows.append(features.rows)
        entries.append(
            {
                "view": view,
                "frames": len(features.rows),
                "dim": features.dim,
                "encoded": features.encoded,
                "folder": str(features.folder),
            }
        )
    if options.export:
        from surgicai_vision.dataset.feature_export import export_features

        about = {
            "encoder": options.encoder,
            "views": list(options.view),
            "weights_sha256": encoder.weights_sha256,
            "encoder_fingerprint": encoder.fingerprint,
        }
        export_features(dataset, rows, about, Path(options.export))
        console.say(f"exported: {options.export}")
    return {
        "encoder": options.encoder,
        "weights_sha256": encoder.weights_sha256,
        "features": entries,
    }
