"""Prepare: a task's demonstrations and its dataset in one folder, each made where it is missing."""

from collections.abc import Sequence
from pathlib import Path

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset.render import render_demos
from surgicai_vision.demos.disturbance import UNDISTURBED, Disturbance
from surgicai_vision.demos.record import record
from surgicai_vision.envs.upset import check_upset_task
from surgicai_vision.experiments.dataset_config import DatasetConfig


def check_dataset(dataset: DatasetConfig) -> None:
    """Refuse what cannot be recorded, before any work.

    Raises:
        InputError: upsets in a task that has none.
    """
    if dataset.demonstrations.upset_fraction:
        check_upset_task(dataset.demonstrations.task)


def make_dataset(dataset: DatasetConfig, folder: Path, context: RunContext) -> Path:
    """Record and render what `dataset` says, into `folder`/demos and `folder`/dataset.

    Returns:
        The dataset's folder; that of the demonstrations where nothing is rendered.
    """
    recorded = dataset.demonstrations
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
    )


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
) -> Path:
    """Record demonstrations into `folder`/demos and render them into `folder`/dataset.

    Without views nothing is rendered.

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
        context=context,
    )
    if not views:
        return folder / "demos"
    render_demos(
        folder / "demos",
        folder / "dataset",
        views=views,
        size=size,
        depth=depth,
        frame_stride=frame_stride,
        context=context,
    )
    return folder / "dataset"
