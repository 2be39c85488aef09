"""Prepare: a task's demonstrations and its dataset in one folder, each made where it is missing."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.variants import Variants
from surgicai_vision.dataset.layouts import SURGICAI
from surgicai_vision.dataset.render import check_request, render_demos
from surgicai_vision.demos.cut import cut_demos
from surgicai_vision.demos.disturbance import UNDISTURBED, Disturbance, check_returning
from surgicai_vision.demos.record import Learner, record
from surgicai_vision.demos.store import list_demos
from surgicai_vision.envs.upset import check_upset_task
from surgicai_vision.experiments.dataset_config import DatasetConfig, Demonstrations


def check_dataset(dataset: DatasetConfig) -> None:
    """Refuse what cannot be recorded or rendered, before any work.

    Raises:
        InputError: upsets in a task that has none; a demonstrator that goes back where it cannot;
            a size or frame stride that is not allowed.
        UnknownName: a view that does not exist.
    """
    recorded = dataset.demonstrations
    check_returning(recorded.demonstrator, dataset.env)
    if recorded.view:
        check_request(recorded.view, dataset.size, recorded.frame_stride, None, SURGICAI)
    if recorded.upset_fraction:
        check_upset_task(recorded.task)


def make_dataset(
    dataset: DatasetConfig, folder: Path, context: RunContext, learner: Learner | None = None
) -> Path:
    """Record and render what `dataset` says, into `folder`/demos and `folder`/dataset.

    Visits in whole procedures go into `folder`/visits. The procedures themselves, and
    demonstrations that are re-posed, are recorded into the folder next to `folder` that has their
    name, if they are not there yet. What a learner was trained on is there already.

    Returns:
        The dataset's folder; that of the demonstrations where nothing is rendered.
    """
    recorded = dataset.demonstrations
    if dataset.visited is not None:
        _cut(dataset.visited, recorded, folder, context)
    few = dataset.multiplied
    demos = [] if few is None else list_demos(_recorded(few, folder, context))
    return prepare_dataset(
        dataset.env,
        folder,
        context,
        demonstrations=recorded.episodes,
        views=recorded.view,
        size=dataset.size,
        depth=dataset.depth,
        frame_stride=recorded.frame_stride,
        demonstrator=recorded.demonstrator,
        disturbance=recorded.disturbance,
        post_success_steps=recorded.post_success_steps,
        seed=dataset.first_seed,
        beside=demos_folders(dataset, folder)[1:],
        demos=demos,
        variants=recorded.looks,
        learner=learner,
    )


def demos_folders(dataset: DatasetConfig, folder: Path) -> list[Path]:
    """Return the folders of the demonstrations that `make_dataset` renders, in order.

    They are its own, the visits, what its learner was trained on, what the learner in those was
    trained on, and so on.
    """
    visits = [] if dataset.visited is None else [folder / "visits"]
    first = dataset.learned
    learned = (
        [] if first is None else demos_folders(first, folder.parent / first.demonstrations.name)
    )
    return [folder / "demos", *visits, *learned]


def _recorded(other: DatasetConfig, folder: Path, context: RunContext) -> Path:
    """Record what a dataset builds on, next to it; return the folder of the demonstrations."""
    alone = replace(other, demonstrations=replace(other.demonstrations, view=()))
    return make_dataset(alone, folder.parent / other.demonstrations.name, context)


def _cut(
    visited: DatasetConfig, recorded: Demonstrations, folder: Path, context: RunContext
) -> None:
    """Cut the visits of a task out of whole procedures."""
    whole = _recorded(visited, folder, context)
    cut_demos(whole, recorded.task, out=folder / "visits", stage=context.stage)


def prepare_dataset(
    config: TaskConfig,
    folder: Path,
    context: RunContext,
    *,
    demonstrations: int,
    views: Sequence[str],
    size: int,
    depth: bool,
    frame_stride: int = 1,
    demonstrator: str = "expert",
    disturbance: Disturbance = UNDISTURBED,
    post_success_steps: int = 0,
    seed: int = names.TRAIN_SEED,
    beside: Sequence[Path] = (),
    demos: Sequence[Path] = (),
    variants: Variants | None = None,
    learner: Learner | None = None,
) -> Path:
    """Record demonstrations into `folder`/demos and render them into `folder`/dataset.

    Without views nothing is rendered. Folders of demonstrations in `beside` are rendered with them,
    each demonstration in every look of `variants`. `demos` are files that a demonstrator re-poses;
    `learner` acts at first.

    Returns:
        The dataset's folder; that of the demonstrations where nothing is rendered.
    """
    record(
        config,
        episodes=demonstrations,
        out=folder / "demos",
        demonstrator=demonstrator,
        seed=seed,
        disturbance=disturbance,
        post_success_steps=post_success_steps,
        demos=demos,
        learner=learner,
        context=context,
    )
    if not views:
        return folder / "demos"
    render_demos(
        [folder / "demos", *beside],
        folder / "dataset",
        views=views,
        size=size,
        depth=depth,
        frame_stride=frame_stride,
        variants=variants,
        context=context,
    )
    return folder / "dataset"
