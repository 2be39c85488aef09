"""Envs: the five subtasks and the whole procedure as gymnasium environments.

`make(TaskConfig(task="grasp"),
obs_type="pixels")` returns an unwrapped env; `gymnasium.make("surgicai_vision/Grasp-v0",
obs_type="pixels")` takes the same names, and the fields of `TaskConfig` besides.
"""

import functools
from typing import Any

from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, SceneConfig, TaskConfig, from_mapping
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.tasks import load_subtask
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.grasp import Grasp
from surgicai_vision.envs.handoff import Handoff
from surgicai_vision.envs.insert import Insert
from surgicai_vision.envs.observation import ObservationConfig
from surgicai_vision.envs.place import Place
from surgicai_vision.envs.pullout import Pullout
from surgicai_vision.envs.subtask import Subtask
from surgicai_vision.envs.suture import Suture

__all__ = ["SUBTASKS", "SuturingEnv", "make", "make_task"]

SUBTASKS: dict[str, Subtask] = {
    subtask.name: subtask for subtask in (Grasp(), Place(), Insert(), Handoff(), Pullout())
}
"""Subtask name → what it is, in the order of the procedure."""


def make(
    config: TaskConfig = TaskConfig(),
    obs_type: str = "state",
    cameras: tuple[str, ...] = ("front", "back"),
    image_size: int | tuple[int, int] = 224,
    depth: bool = False,
    segmentation: bool = False,
    render_mode: str | None = None,
) -> SuturingEnv:
    """Return the unwrapped env of a task; see `observation` for what the arguments choose."""
    size = (image_size, image_size) if isinstance(image_size, int) else tuple(image_size)
    if len(size) != 2:
        raise InputError(f"image_size is {size}; it must be one side or (height, width) [pixel].")
    view = ObservationConfig(obs_type, tuple(cameras), size, depth, segmentation)
    if config.task == names.SUTURE:
        return Suture(config, tuple(SUBTASKS.values()), view, render_mode)
    return SuturingEnv(config, (_subtask(config.task),), view, render_mode)


@functools.cache
def _subtask(task: str) -> Subtask:
    """Return what a task that is one subtask is, of ours or of another distribution."""
    return SUBTASKS.get(task) or load_subtask(task)()


def make_task(
    task: str, scene: SceneConfig | dict[str, Any] | None = None, **arguments: Any
) -> SuturingEnv:
    """Return an env from flat arguments; the entry point of the gymnasium ids.

    Args:
        task: one of `tasks.task_names()`.
        scene: a `SceneConfig`, its fields, or None for the default scene.
        **arguments: fields of `TaskConfig` and arguments of `make`.
    """
    fields: dict[str, Any] = {
        key: arguments.pop(key)
        for key in ("step", "tolerance", "reward", "max_steps")
        if key in arguments
    }
    if "randomisation" in arguments:
        axes = arguments.pop("randomisation")
        fields["randomisation"] = (
            from_mapping(RandomisationConfig, axes, "randomisation")
            if isinstance(axes, dict)
            else axes
        )
    chosen = (
        from_mapping(SceneConfig, scene, "scene")
        if isinstance(scene, dict)
        else scene or SceneConfig()
    )
    return make(TaskConfig(task=task, scene=chosen, **fields), **arguments)
