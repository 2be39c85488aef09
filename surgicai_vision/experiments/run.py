"""Cells: one policy from features to counted successes. A quickstart is a list of cells, a sweep a
grid.

Every step leaves a whole folder and skips the one that is there, so running again continues.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surgicai_vision.core import names
from surgicai_vision.core.cameras import check_view
from surgicai_vision.core.config import read_changes
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.core.progress import Stage
from surgicai_vision.core.tasks import check_task
from surgicai_vision.evaluation.policy_spec import policy_name
from surgicai_vision.features.cache import Features, encode
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource, load_encoder

if TYPE_CHECKING:
    from surgicai_vision.dataset.protocol import Dataset

OWN = "own"
"""Stands for an encoder: a network of the policy's own, trained with it on the images."""


@dataclass(frozen=True)
class Cell:
    """What is trained and evaluated.

    Attributes:
        task: one of `tasks.task_names()`.
        encoder: encoder's name; `OWN` for a policy that trains a network of its own on the images;
            None for a policy without images.
        view: its views, in the order of the features; empty without images.
        seed: training seed.
        policy: policy's name.
        recipe: its recipe: a name, or the path of a YAML file.
        pool: what is taken from the encoder.
        privileged: see the goal in place of all else: the ceiling.
        epochs: passes over the training frames; None takes the recipe's.
        change: keys of the recipe and their values, `config.read_changes`'s texts.
        demonstrations: train on the first so many demonstrations; None takes all.
        chain: how subtasks end, where this is a high-level policy over a policy a subtask
            (`chain.TERMINATIONS`).
        swap: the subtask of such a chain that the expert does.
    """

    task: str
    encoder: str | None
    view: tuple[str, ...]
    seed: int = 0
    policy: str = "bc"
    recipe: str = "paper"
    pool: str = "global"
    privileged: bool = False
    epochs: int | None = None
    change: tuple[str, ...] = ()
    demonstrations: int | None = None
    chain: str | None = None
    swap: str | None = None

    def __post_init__(self) -> None:
        check_task(self.task)
        if self.chain and any(map(names.is_depth_view, self.view)):
            raise InputError(
                f"A chain sees no depth views ({', '.join(self.view)}); give views in colour."
            )
        if self.swap:
            check_name("subtask", self.swap, names.SUBTASKS)
        for view in self.view:
            check_view(view)
        if (self.encoder is None) != (not self.view):
            raise InputError(
                f"encoder '{self.encoder}' with views {list(self.view)}; give both or neither."
            )

    @property
    def name(self) -> str:
        """How tables and folders call the policy."""
        name = policy_name(
            self.encoder, self.view, self.pool, self.privileged, self.policy, self.recipe_label
        )
        chain = f"chain-{self.chain}-" if self.chain else ""
        return f"{chain}{name}" + (f"-swap-{self.swap}" if self.swap else "")

    @property
    def changes(self) -> dict[str, Any]:
        """Keys that replace the recipe's."""
        changes: dict[str, Any] = read_changes(self.change) | (
            {"privileged": True} if self.privileged else {}
        )
        if self.epochs is not None:
            changes["epochs"] = self.epochs
        return changes

    @property
    def recipe_label(self) -> str:
        """The recipe's name and what is changed in it."""
        counts = ((self.epochs, "epochs"), (self.demonstrations, "demos"))
        changed = tuple(f"{count}{unit}" for count, unit in counts if count is not None)
        return "+".join((Path(self.recipe).stem, *self.change, *changed))


def train_cell(
    cell: Cell,
    dataset: "Dataset",
    out: Path,
    stage: Stage,
    weights: WeightsSource = ANYWHERE,
    start: Path | None = None,
    subtask: str | None = None,
    save_every: int = 0,
    log: Callable[[int, dict[str, float]], None] | None = None,
) -> None:
    """Encode the cell's views (from the cache where they are at hand) and train its policy into
    `out`.

    Args:
        cell: what to train.
        dataset: an opened dataset of the cell's task.
        out: checkpoint folder; one of the same training is continued, or left as it is.
        stage: shows progress.
        weights: where pretrained weights come from.
        start: checkpoint folder to start from (fine-tuning).
        subtask: train on this subtask's frames of the dataset's whole procedures.
        save_every: also keep a checkpoint every so many epochs.
        log: called with (epoch, losses by name).
    """
    from surgicai_vision.dataset.subset import (
        DatasetSubset,
        first_episodes,
        of_subtask,
        with_frame_stride,
    )
    from surgicai_vision.training import policies
    from surgicai_vision.training.train import train

    recipe = policies.load_recipe(cell.policy, cell.recipe, cell.changes)
    dataset = with_frame_stride(dataset, recipe.frame_stride)
    begin = policies.load_policy(start) if start else None
    features = _encode(cell, dataset, stage, weights)
    subsets: list[Callable[[Dataset], DatasetSubset]] = []
    if cell.demonstrations is not None:
        subsets.append(functools.partial(first_episodes, count=cell.demonstrations))
    if subtask is not None:
        subsets.append(functools.partial(of_subtask, subtask=subtask))
    for select in subsets:
        subset = select(dataset)
        dataset = subset
        features = [entry.part(subset.rows, subset.fingerprint) for entry in features]
    with stage(f"policy: {cell.name}", "epochs") as progress:
        plugin = policies.policy_plugin(cell.policy)
        train(
            dataset, features, plugin, recipe, seed=cell.seed, out=out, progress=progress,
            recipe_name=cell.recipe_label, start=begin, save_every=save_every, log=log,
        )  # fmt: skip


def encode_cell(
    cell: Cell,
    dataset: "Dataset",
    stage: Stage,
    weights: WeightsSource = ANYWHERE,
) -> list[Features]:
    """Encode the cell's views, all frames that its recipe takes, or find them in the cache."""
    from surgicai_vision.dataset.subset import with_frame_stride
    from surgicai_vision.training import policies

    recipe = policies.load_recipe(cell.policy, cell.recipe, cell.changes)
    dataset = with_frame_stride(dataset, recipe.frame_stride)
    return _encode(cell, dataset, stage, weights)


def _encode(cell: Cell, dataset: "Dataset", stage: Stage, weights: WeightsSource) -> list[Features]:
    """Encode the cell's views, all frames of `dataset`."""
    if not cell.encoder:
        return []
    encoder = load_encoder(cell.encoder, cell.pool, weights)
    features = []
    for view in cell.view:
        with stage(f"features: {cell.encoder}, {view}", "frames") as progress:
            features.append(encode(dataset, view, encoder, progress=progress))
    return features
