"""Envs: the five subtasks and the whole procedure as gymnasium environments.

`make(TaskConfig(task="grasp"), obs_type="pixels")` returns an unwrapped env.
`gymnasium.make("surgicai_vision/Grasp-v0", obs_type="pixels")` takes the same arguments and the
fields of `TaskConfig`, except `max_steps`: gymnasium's `max_episode_steps` sets the limit there.
"""

import dataclasses
import functools
import operator
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import surgicai_vision.scene.mujoco_import  # noqa: F401  # before all that imports MuJoCo
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, SceneConfig, TaskConfig, from_mapping
from surgicai_vision.core.errors import InputError, shown
from surgicai_vision.core.tasks import TASKS, load_subtask
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.goal import GoalSuture, GoalSuturingEnv
from surgicai_vision.envs.grasp import Grasp
from surgicai_vision.envs.handoff import Handoff
from surgicai_vision.envs.insert import Insert
from surgicai_vision.envs.observation import ObservationConfig
from surgicai_vision.envs.place import Place
from surgicai_vision.envs.pullout import Pullout
from surgicai_vision.envs.subtask import Subtask
from surgicai_vision.envs.suture import Suture

__all__ = [
    "SUBTASKS",
    "GoalSuturingEnv",
    "SuturingEnv",
    "check_world",
    "make",
    "make_registered",
    "make_task",
]

OPTIONS = (
    *("step", "tolerance", "reward", "max_steps", "advance"),
    *("action_repeat", "hold_jaw", "end_on_drop"),
)
"""Fields of `TaskConfig` that `make_task` passes on unchanged."""
SUBTASKS: dict[str, Subtask] = {
    subtask.name: subtask for subtask in (Grasp(), Place(), Insert(), Handoff(), Pullout())
}
"""Subtask name → subtask, in the order of the procedure."""


def make(
    config: TaskConfig = TaskConfig(),
    obs_type: str = "state",
    cameras: str | Sequence[str] = ("front", "back"),
    image_size: int | tuple[int, int] = 224,
    depth: bool = False,
    segmentation: bool = False,
    render_mode: str | None = None,
    truncates: bool = True,
    action_mode: str = names.INCREMENTS,
) -> SuturingEnv:
    """Return the unwrapped env of a task; see `observation` for the observation arguments.

    With `action_mode` "absolute" an action is the set-points of both arms (`absolute`).
    """
    chosen = (cameras,) if isinstance(cameras, str) else tuple(cameras)
    size = _sides(image_size)
    view = ObservationConfig(obs_type, chosen, size, depth, segmentation, action_mode)
    shows_goal = obs_type == "goal"
    if config.task == names.SUTURE:
        procedure = GoalSuture if shows_goal else Suture
        return procedure(config, tuple(SUBTASKS.values()), view, render_mode, truncates)
    single = GoalSuturingEnv if shows_goal else SuturingEnv
    return single(config, (_subtask(config.task),), view, render_mode, truncates)


@functools.lru_cache(maxsize=256)
def check_world(env: TaskConfig, where: str) -> None:
    """Refuse a world that geometry forbids (`envs.feasibility`), before any work.

    Args:
        env: the task in its world.
        where: what is done in it, the beginning of the message.

    Raises:
        InputError: naming the obstacle and what is allowed instead.
    """
    try:
        make(env).close()
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _sides(image_size: object) -> tuple[int, int]:
    """Return an image's height and width [pixel] from one side length or a pair of them."""
    sides = image_size if isinstance(image_size, Iterable) else (image_size, image_size)
    try:
        height, width = map(operator.index, sides)
    except (TypeError, ValueError):
        raise InputError(
            f"image_size is {shown(image_size)}; it must be one whole number, or (height, width) "
            "[pixel]."
        ) from None
    return height, width


@functools.cache
def _subtask(task: str) -> Subtask:
    """Return the subtask of a single-subtask task, built-in or of another distribution."""
    if task in SUBTASKS:
        return SUBTASKS[task]
    subtask = load_subtask(task)
    with TASKS.calling(task):
        return subtask()


def make_task(
    task: str, scene: SceneConfig | dict[str, object] | None = None, **arguments: Any
) -> SuturingEnv:
    """Return an env from flat arguments.

    Args:
        task: one of `tasks.task_names()`.
        scene: a `SceneConfig`, its fields, or None for the default scene.
        **arguments: fields of `TaskConfig` and arguments of `make`.
    """
    fields: dict[str, Any] = {key: arguments.pop(key) for key in OPTIONS if key in arguments}
    axes = arguments.pop("randomisation", None) or RandomisationConfig()
    if not isinstance(axes, RandomisationConfig):
        axes = from_mapping(RandomisationConfig, axes, "randomisation")
    chosen = scene or SceneConfig()
    if not isinstance(chosen, SceneConfig):
        chosen = from_mapping(SceneConfig, chosen, "scene")
    config = from_mapping(TaskConfig, {"task": task, **fields}, "env")
    return make(dataclasses.replace(config, scene=chosen, randomisation=axes), **arguments)


def make_registered(task: str, **arguments: Any) -> SuturingEnv:
    """Return the env of a gymnasium id; gymnasium wraps it in a `TimeLimit`.

    Args:
        task: one of `names.TASKS`.
        **arguments: as for `make_task`, without `max_steps`.
    """
    refuse_max_steps(arguments)
    return make_task(task, truncates=False, **arguments)


def refuse_max_steps(arguments: Mapping[str, object]) -> None:
    """Raise `InputError` if `max_steps` is given: two arguments would limit an episode."""
    if "max_steps" in arguments:
        raise InputError(
            f"max_steps is {arguments['max_steps']}; for a gymnasium id, the limit of an episode "
            f"is gymnasium's own argument: max_episode_steps={arguments['max_steps']}."
        )
