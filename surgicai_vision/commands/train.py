"""`train`: train a policy on a dataset's features."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.logs import LOGS, open_log
from surgicai_vision.commands.options import (
    many_of,
    not_negative,
    one_of,
    option,
    positive,
    weights_option,
)
from surgicai_vision.core import names
from surgicai_vision.core.config import DEVIATIONS
from surgicai_vision.core.errors import InputError
from surgicai_vision.features import encoders
from surgicai_vision.training import policies

EXAMPLE = "surgicai-vision train --encoder random --view back"
NO_ENCODER, STATE = "none", "state"
"""What stands for an encoder: proprioception alone, and the state with the goal (the ceiling)."""


def _check_encoder(name: str, given: str) -> None:
    if given not in (NO_ENCODER, STATE):
        encoders.check_encoder_option(name, given)


@dataclass(frozen=True)
class Options:
    """Options of `train`."""

    task: str = option(
        "grasp", f"the dataset's task: {', '.join(names.TASKS)}", check=one_of("task", names.TASKS)
    )
    dataset: str | None = option(
        None, "dataset folder", metavar="DIR", default_text="outputs/datasets/<task>"
    )
    subtask: str | None = option(
        None,
        f"take one subtask's frames of a dataset of whole procedures, for a chain: {', '.join(names.SUBTASKS)}",
        check=one_of("subtask", names.SUBTASKS),
        metavar="SUBTASK",
    )
    encoder: str = option(
        "imagenet-lite",
        f"one of {encoders.encoder_choices()}; none for proprioception alone, state for the state with the goal",
        check=_check_encoder,
    )
    view: tuple[str, ...] | None = option(
        None,
        "views, a comma list",
        check=many_of("view", names.CAMERAS),
        metavar="VIEW[,VIEW]",
        default_text="front,back",
    )
    weights: str | None = weights_option()
    accept_licence: bool = option(False, "accept weights under a non-commercial licence")
    pool: str = option(
        "global",
        f"what is taken: {', '.join(encoders.POOLS)}",
        check=one_of("pool", encoders.POOLS),
    )
    policy: str = option(
        "bc", f"one of {', '.join(policies.POLICIES)}", check=one_of("policy", policies.POLICIES)
    )
    recipe: str = option(
        "paper", f"the policy's recipe: {', '.join(policies.recipe_names())}, or FILE.yaml"
    )
    deviation: tuple[str, ...] | None = option(
        None,
        f"what to do as the released code did, a comma list of {', '.join(DEVIATIONS)}",
        check=many_of("deviation", DEVIATIONS),
        metavar="NAME[,NAME]",
        default_text="the recipe's",
    )
    change: tuple[str, ...] | None = option(
        None,
        "replace values of the recipe, a comma list: clock=false,map_head=softmax",
        metavar="KEY=VALUE[,KEY=VALUE]",
        repeat=True,
        default_text="none",
    )
    epochs: int | None = option(
        None, "passes over the frames", check=positive, metavar="N", default_text="the recipe's"
    )
    start: str | None = option(
        None, "checkpoint to start from, with the same inputs (fine-tuning)", metavar="DIR"
    )
    save_every: int = option(
        0,
        "also keep a checkpoint every N epochs; 0 keeps the last",
        check=not_negative,
        metavar="N",
    )
    log: str = option(
        "auto", f"where losses are drawn: {', '.join(LOGS)}", check=one_of("log", LOGS)
    )
    seed: int = option(0, "training seed", check=not_negative)
    out: str | None = option(
        None,
        "checkpoint folder to make or to continue",
        metavar="DIR",
        default_text="outputs/train/<task>-<policy>-seed<seed>",
    )


def run(options: Options, console: Console) -> dict[str, Any]:
    """Encode what is not at hand, train and say where the checkpoint is."""
    encoder = None if options.encoder in (NO_ENCODER, STATE) else options.encoder
    if encoder:
        encoders.find_weights(encoder, options.weights, options.accept_licence)
    from surgicai_vision.experiments.run import Cell, train_cell

    task = names.SUTURE if options.subtask else options.task
    cell = Cell(
        task,
        encoder,
        _views(options, encoder),
        options.seed,
        options.policy,
        options.recipe,
        pool=options.pool if encoder else "global",
        privileged=options.encoder == STATE,
        epochs=options.epochs,
        deviations=options.deviation,
        change=options.change or (),
    )
    policies.load_recipe(cell.policy, cell.recipe, cell.changes)
    label = f"{options.subtask}-of-{task}" if options.subtask else task
    out = Path(options.out) if options.out else folders.train_folder(label, cell.name, cell.seed)
    folders.check_folder(out, "training.json")
    dataset = folders.open_dataset(options.dataset, task, cell.view)
    if options.subtask:
        from surgicai_vision.dataset.subtask_frames import subtask_of

        dataset = subtask_of(dataset, options.subtask)
    cell = replace(cell, task=dataset.task)
    with open_log(options.log, out) as log:
        train_cell(
            cell, dataset, out, console.stage, options.weights, accept_licence=options.accept_licence,
            start=Path(options.start) if options.start else None, save_every=options.save_every, log=log,
        )  # fmt: skip
    console.say(f"checkpoint: {out}")
    if cell.policy == "bc":
        console.say(f"next: surgicai-vision evaluate {out}")
    return {"checkpoint": str(out)}


def _views(options: Options, encoder: str | None) -> tuple[str, ...]:
    if encoder is None:
        if options.view:
            raise InputError(
                f"--encoder {options.encoder} sees no image; leave --view out, or name an encoder."
            )
        return ()
    return ("front", "back") if options.view is None else options.view
