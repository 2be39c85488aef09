"""Prepare: a task's demonstrations and its dataset in one folder, each made where it is missing."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.executor import LOCAL, Engine
from surgicai_vision.dataset.render import render_demos
from surgicai_vision.demos.record import record
from surgicai_vision.demos.rollout import UNDISTURBED, Disturbance


def prepare_dataset(
    config: TaskConfig,
    folder: Path,
    stage: Any,
    *,
    demonstrations: int,
    views: Sequence[str],
    size: int,
    depth: bool,
    workers: int,
    frame_stride: int = 1,
    engine: Engine = LOCAL,
    demonstrator: str = "expert",
    disturbance: Disturbance = UNDISTURBED,
    post_success_steps: int = 0,
) -> Path:
    """Record demonstrations into `folder`/demos and render them into `folder`/dataset; return the
    latter.
    """
    with stage(f"demos: {demonstrations} of {config.task}", "episodes") as progress:
        record(
            config, episodes=demonstrations, out=folder / "demos", workers=workers, engine=engine, progress=progress,
            demonstrator=demonstrator, disturbance=disturbance, post_success_steps=post_success_steps,
        )  # fmt: skip
    with stage(f"dataset: {', '.join(views)} at {size} px", "frames") as progress:
        render_demos(
            folder / "demos", folder / "dataset", views=views, size=size, depth=depth, frame_stride=frame_stride,
            workers=workers, engine=engine, progress=progress,
        )  # fmt: skip
    return folder / "dataset"
