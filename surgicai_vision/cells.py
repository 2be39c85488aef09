"""Cells: one policy from features to counted successes. A quickstart is a list of cells, a sweep a grid.

Every step leaves a whole folder and skips the one that is there, so running again continues.
"""

import functools
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from surgicai_vision import files, names
from surgicai_vision.agents import BASELINES, PolicyAgent
from surgicai_vision.config import TaskConfig, to_mapping
from surgicai_vision.errors import InputError, check_name
from surgicai_vision.evaluation import Agent, MakeAgent, evaluate
from surgicai_vision.provenance import command_line, provenance
from surgicai_vision.results import MARKER, write_evaluation

Stage = Callable[[str, str], AbstractContextManager[Callable[..., None]]]
"""stage(title, unit) is a context that yields progress(done, total): a bar on the console, or nothing."""


@dataclass(frozen=True)
class Cell:
    """What is trained and evaluated.

    Attributes:
        task: one of `names.TASKS`.
        encoder: encoder's name, or None for a policy without pictures.
        view: its views, in the order of the features; empty without pictures.
        seed: training seed.
        policy: policy's name.
        recipe: its recipe.
    """

    task: str
    encoder: str | None
    view: tuple[str, ...]
    seed: int = 0
    policy: str = "bc"
    recipe: str = "paper"

    def __post_init__(self) -> None:
        check_name("task", self.task, names.TASKS)
        for view in self.view:
            check_name("view", view, names.CAMERAS)
        if (self.encoder is None) != (not self.view):
            raise InputError(f"encoder '{self.encoder}' with views {list(self.view)}; give both or neither.")

    @property
    def name(self) -> str:
        """How tables and folders call the policy."""
        return policy_name(self.encoder, self.view)


@dataclass(frozen=True)
class Subject:
    """Who is evaluated in which task.

    Attributes:
        name: how tables call it.
        config: the task.
        make_agent: makes the agent in a worker process.
        about: more to be kept beside the result.
    """

    name: str
    config: TaskConfig
    make_agent: MakeAgent
    about: dict[str, Any] = field(default_factory=dict)


def policy_name(encoder: str | None, views: Sequence[str]) -> str:
    """Name a policy by its inputs."""
    return f"{encoder}-{'+'.join(views)}" if encoder else "proprioception"


def prepare_dataset(
    config: TaskConfig,
    folder: Path,
    stage: Stage,
    *,
    demonstrations: int,
    views: Sequence[str],
    size: int,
    depth: bool,
    workers: int,
) -> Path:
    """Record demonstrations into `folder`/demos and render them into `folder`/dataset; return the latter."""
    from surgicai_vision.dataset import render_demos
    from surgicai_vision.demos.record import record

    with stage(f"demos: {demonstrations} of {config.task}", "episodes") as progress:
        record(config, episodes=demonstrations, out=folder / "demos", workers=workers, progress=progress)
    with stage(f"dataset: {', '.join(views)} at {size} px", "frames") as progress:
        render_demos(
            folder / "demos", folder / "dataset", views=views, size=size, depth=depth, workers=workers,
            progress=progress,
        )  # fmt: skip
    return folder / "dataset"


def train_cell(cell: Cell, dataset: Any, out: Path, stage: Stage, weights: str | None = None) -> None:
    """Encode the cell's views (from the cache where they are at hand) and train its policy into `out`.

    Args:
        cell: what to train.
        dataset: an opened dataset of the cell's task.
        out: checkpoint folder; one of the same training is continued, or left as it is.
        stage: shows progress.
        weights: file with the encoder's pretrained weights.
    """
    from surgicai_vision import registry
    from surgicai_vision.features import encode
    from surgicai_vision.training import train

    recipe, features = registry.load_recipe(cell.policy, cell.recipe), []
    if cell.encoder:
        encoder = registry.load_encoder(cell.encoder, weights)
        for view in cell.view:
            with stage(f"features: {cell.encoder}, {view}", "frames") as progress:
                features.append(encode(dataset, view, encoder, progress=progress))
    with stage(f"policy: {cell.name}", "epochs") as progress:
        plugin = registry.policy_plugin(cell.policy)
        train(
            dataset, features, plugin, recipe, seed=cell.seed, out=out, progress=progress, recipe_name=cell.recipe
        )  # fmt: skip


def evaluate_once(
    out: Path, make_subject: Callable[[], Subject], seeds: Sequence[int], stage: Stage, workers: int | None
) -> dict[str, Any]:
    """Evaluate into the folder `out` if it holds no evaluation yet; return the summary."""
    if (out / MARKER).exists():
        summary: dict[str, Any] = files.read_json(out / MARKER)["summary"]
        return summary
    subject = make_subject()
    with stage(f"evaluation: {subject.name}", "steps") as progress:
        return evaluate_into(out, subject, seeds, workers, progress)


def evaluate_into(
    out: Path,
    subject: Subject,
    seeds: Sequence[int],
    workers: int | None = None,
    progress: Callable[..., None] | None = None,
) -> dict[str, Any]:
    """Evaluate, store everything in the folder `out` and return the summary."""
    episodes = evaluate(subject.make_agent, subject.config, seeds, workers=workers, progress=progress)
    about = {
        **subject.about,
        "task_config": to_mapping(subject.config),
        "command": command_line(),
        "provenance": provenance(),
    }
    return write_evaluation(out, episodes, about)


def baseline_subject(name: str, config: TaskConfig) -> Subject:
    """Return the subject of a baseline: expert, random or zero."""
    return Subject(name, config, functools.partial(baseline, name))


def checkpoint_subject(folder: Path, weights: str | None = None) -> Subject:
    """Return the subject of a checkpoint folder; its weights are looked up at once.

    Raises:
        BadFile: no checkpoint folder.
        MissingWeights: the encoder's weights are not at hand.
    """
    from surgicai_vision import registry
    from surgicai_vision.checkpoint import read_checkpoint

    checkpoint = read_checkpoint(folder)
    encoder = checkpoint.encoder
    if encoder:
        registry.find_weights(encoder.name, weights)
    about = {
        "checkpoint": {
            "weights_sha256": encoder.weights_sha256 if encoder else None,
            "policy_sha256": checkpoint.policy_sha256,
            "policy": checkpoint.policy,
            "recipe": checkpoint.recipe_name,
            "seed": checkpoint.seed,
            "dataset": checkpoint.dataset,
            "demonstrations": checkpoint.demonstrations,
        },
        "folder": str(folder),
        "views": list(checkpoint.views),
        "encoder": encoder.name if encoder else "proprioception",
    }
    name = policy_name(encoder.name if encoder else None, checkpoint.views)
    return Subject(name, checkpoint.task, functools.partial(policy_agent, folder, weights), about)


def expert() -> Agent:
    """Make the expert (in a worker process)."""
    return baseline("expert")


def baseline(name: str) -> Agent:
    """Make a baseline agent (in a worker process)."""
    agent: Agent = BASELINES[name]()
    return agent


def policy_agent(folder: Path, weights: str | None = None) -> Agent:
    """Make the agent of a checkpoint folder (in a worker process).

    Raises:
        InputError: the encoder at hand is not the one the policy was trained on.
    """
    from surgicai_vision import registry
    from surgicai_vision.checkpoint import check_encoder

    policy = registry.load_policy(folder)
    checkpoint, encoder = policy.checkpoint, None
    if checkpoint.encoder:
        encoder = registry.load_encoder(checkpoint.encoder.name, weights, pool=checkpoint.encoder.pool)
    check_encoder(checkpoint, encoder)
    name = policy_name(checkpoint.encoder.name if checkpoint.encoder else None, checkpoint.views)
    return PolicyAgent(name, policy, encoder, checkpoint.views, checkpoint.image_size)


@contextmanager
def timed(stage: Stage, seconds: dict[str, float]) -> Iterator[Stage]:
    """Yield a `stage` that adds each stage's time to `seconds`, by the first word of its title [s]."""

    @contextmanager
    def measured(title: str, unit: str) -> Iterator[Callable[..., None]]:
        started = time.monotonic()
        with stage(title, unit) as progress:
            yield progress
        name = title.split(":")[0]
        seconds[name] = seconds.get(name, 0.0) + time.monotonic() - started

    yield measured
