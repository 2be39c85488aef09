"""Prepare: a task's demonstrations and its dataset in one folder, each made where it is missing."""

from collections.abc import Sequence
from pathlib import Path

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset.render import render_demos
from surgicai_vision.demos.record import record
from surgicai_vision.demos.rollout import UNDISTURBED, Disturbance


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
) -> Path:
    """Record demonstrations into `folder`/demos and render them into `folder`/dataset.

    Returns:
        The dataset's folder.
    """
    record(
        config,
        episodes=demonstrations,
        out=folder / "demos",
        demonstrator=demonstrator,
        disturbance=disturbance,
        post_success_steps=post_success_steps,
        context=context,
    )
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
