"""`train`: train a policy on a dataset's features."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision import names, registry
from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import many_of, not_negative, one_of, option
from surgicai_vision.errors import InputError

EXAMPLE = "surgicai-vision train --encoder random --view back"
NO_ENCODER = "none"


@dataclass(frozen=True)
class Options:
    """Options of `train`."""

    task: str = option("grasp", f"the dataset's task: {', '.join(names.TASKS)}", check=one_of("task", names.TASKS))
    dataset: str | None = option(None, "dataset folder", metavar="DIR", default_text="outputs/datasets/<task>")
    encoder: str = option(
        "imagenet-lite",
        f"one of {', '.join(registry.encoder_names())}, or none for proprioception alone",
        check=one_of("encoder", (*registry.encoder_names(), NO_ENCODER)),
    )
    view: tuple[str, ...] | None = option(
        None,
        "views, a comma list",
        check=many_of("view", names.CAMERAS),
        metavar="VIEW[,VIEW]",
        default_text="front,back",
    )
    weights: str | None = option(None, "file with the encoder's pretrained weights", metavar="FILE")
    policy: str = option("bc", f"one of {', '.join(registry.POLICIES)}", check=one_of("policy", registry.POLICIES))
    recipe: str = option("paper", f"the policy's recipe: {', '.join(registry.recipe_names())}, or FILE.yaml")
    seed: int = option(0, "training seed", check=not_negative)
    out: str | None = option(
        None,
        "checkpoint folder to make or to continue",
        metavar="DIR",
        default_text="outputs/train/<task>-<encoder>-<views>-seed<seed>",
    )


def run(options: Options, console: Console) -> dict[str, Any]:
    """Encode what is not at hand, train and say where the checkpoint is."""
    encoder = None if options.encoder == NO_ENCODER else options.encoder
    if encoder:
        registry.find_weights(encoder, options.weights)
    views = _views(options, encoder)
    out = Path(options.out) if options.out else folders.train_folder(options.task, encoder, views, options.seed)
    folders.check_folder(out, "training.json")
    dataset = folders.open_dataset(options.dataset, options.task, views)
    from surgicai_vision.cells import Cell, train_cell

    cell = Cell(dataset.task, encoder, views, options.seed, options.policy, options.recipe)
    train_cell(cell, dataset, out, console.stage, options.weights)
    console.say(f"checkpoint: {out}")
    console.say(f"next: surgicai-vision evaluate {out}")
    return {"checkpoint": str(out)}


def _views(options: Options, encoder: str | None) -> tuple[str, ...]:
    if encoder is None:
        if options.view:
            raise InputError("--encoder none sees nothing; leave --view out, or name an encoder.")
        return ()
    return ("front", "back") if options.view is None else options.view
