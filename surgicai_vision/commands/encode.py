"""`encode`: compute a dataset's frozen features."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    DEVICE,
    DIRECTORY,
    ENCODER,
    POOL,
    TASK,
    VIEWS,
    AcceptLicence,
    DatasetFolder,
    WeightFiles,
    default_text,
)
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.files import check_output, check_renamed
from surgicai_vision.features import devices, encoders

app = App(
    name="encode",
    help_epilogue="""\
example:
  surgicai-vision encode --task grasp --encoder imagenet-lite --view front,back""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `encode`.

    Attributes:
        task: The task, which must be that of a given dataset.
        dataset: Folder of the dataset.
        encoder: Encoder.
        view: Views to encode.
        pool: What to take from the encoder: one vector (global), a feature map (spatial) or tokens.
        device: Where to compute the features; auto uses a GPU if there is one.
        export: Also write a dataset with features instead of images, for LeRobot's policies.
    """

    task: Annotated[str | None, TASK, default_text("the dataset's, else grasp")] = None
    dataset: DatasetFolder = None
    encoder: Annotated[str, ENCODER] = "imagenet-lite"
    view: Annotated[tuple[str, ...], VIEWS] = ("front", "back")
    weights: WeightFiles = ()
    accept_licence: AcceptLicence = False
    pool: Annotated[str, POOL] = "global"
    device: Annotated[str, DEVICE] = devices.AUTO
    export: Annotated[Path | None, DIRECTORY] = None


@app.default
def run(options: Options = Options(), *, console: Console) -> dict[str, object]:
    """Encode every view and print where the features are."""
    weights = encoders.WeightsSource.parse(options.weights, options.accept_licence)
    # Wrong input is found before torch is imported.
    encoders.find_weights(options.encoder, weights)
    dataset = folders.open_dataset(options.dataset, options.task, options.view)
    if options.export:
        if options.pool != "global":
            raise InputError(f"--export writes global features; leave --pool {options.pool} out.")
        check_output(options.export, option="--export")
        check_renamed(options.export, "--export")
    from surgicai_vision.features.cache import encode

    encoder = encoders.load_encoder(options.encoder, options.pool, weights, options.device)
    entries = []
    rows = []
    for view in options.view:
        with console.stage(f"encoding {view} by {options.encoder}", "frames") as progress:
            features = encode(dataset, view, encoder, progress=progress)
        state = f"{features.encoded} frames encoded" if features.encoded else "in the cache"
        console.say(
            f"{options.encoder} {view}: {len(features.rows)} × {features.dim}, {state}: "
            f"{features.folder}"
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
        export_features(dataset, rows, about, options.export)
        console.say(f"exported: {options.export}")
    return {
        "encoder": options.encoder,
        "weights_sha256": encoder.weights_sha256,
        "features": entries,
    }
