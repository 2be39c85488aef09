"""Tasks by name: ours, registered ones and those of other distributions.

* `task_names()`, `check_task(name)`: without importing any task.
* `load_subtask(name)`, `task_text(name)`, `task_steps(name)`: what a task is.
* `register_task(subtask)`: offer one in this process.
* `register_ids()`: every task's gymnasium id; `import surgicai_vision` calls it.
"""

import importlib.util
import re
import sys
from collections.abc import Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, Final, cast

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, shown
from surgicai_vision.core.plugins import TASKS_GROUP, Registry, subclass_of

if TYPE_CHECKING:
    from surgicai_vision.envs.subtask import Subtask

SUBTASK_STEPS: Final = 200
"""Control steps a subtask may take (paper, image policies)."""
NEEDED: Final = ("name", "arm", "tolerances", "demands")
"""Attributes that a task's class must define."""
NAMELESS: Final = "cannot have this name; its author must choose one of letters, digits and _"
FORM: Final = re.compile(r"[\w:.-]+")
"""What gymnasium takes in an id, and so in a task's name."""
_is_subtask = subclass_of("surgicai_vision.envs.subtask:Subtask")


def _fault(part: object) -> str:
    """Return what is wrong with a part offered as a task, "" if nothing."""
    if fault := _is_subtask(part):
        return fault
    subtask = cast("type[Subtask]", part)
    missing = [name for name in NEEDED if not hasattr(subtask, name)]
    if missing:
        return f"lacks {' and '.join(missing)}; its class must have them"
    if subtask.arm not in names.ARMS:
        return f"moves arm {shown(subtask.arm)}; allowed: {', '.join(names.ARMS)}"
    for name in ("tolerances", "demands"):
        presets = getattr(subtask, name)
        if not isinstance(presets, Mapping) or not presets:
            return f"has {name} {shown(presets)}; give a value for each preset, as {{'paper': …}}"
    if undemanded := set(subtask.tolerances) - set(subtask.demands):
        return f"has no demands for its preset '{min(undemanded)}'"
    return ""


TASKS: Final = Registry["type[Subtask]"](
    "task",
    TASKS_GROUP,
    {
        "grasp": "surgicai_vision.envs.grasp:Grasp",
        "place": "surgicai_vision.envs.place:Place",
        "insert": "surgicai_vision.envs.insert:Insert",
        "handoff": "surgicai_vision.envs.handoff:Handoff",
        "pullout": "surgicai_vision.envs.pullout:Pullout",
        names.SUTURE: "surgicai_vision.envs.suture:Suture",
    },
    _fault,
)
"""Task name → its subclass of `envs.subtask.Subtask`; for `suture`, the env of all five."""


def task_names() -> tuple[str, ...]:
    """Return the name of every task: ours in the order of the procedure, then the others."""
    return TASKS.names()


def check_task(name: str) -> str:
    """Return `name` if a task has it, else raise `UnknownName`; import no task."""
    return TASKS.check(name)


def load_subtask(name: str) -> "type[Subtask]":
    """Return the class of a task that is one subtask.

    Raises:
        UnknownName: no task has this name.
        InputError: another distribution's task cannot be imported, lacks something or has another
            name.
    """
    subtask = TASKS.load(name)
    if not FORM.fullmatch(name):
        raise TASKS.refusal(name, NAMELESS)
    if subtask.name != name:
        raise TASKS.refusal(
            name,
            f"calls itself '{subtask.name}'; its author must give the entry point and the class "
            "the same name",
        )
    return subtask


def task_text(name: str) -> str:
    """Return a task as the sentence that LeRobot stores."""
    return names.TASK_TEXTS.get(name) or load_subtask(name).text


def task_steps(name: str) -> int:
    """Return the control steps that an episode of a task may take by default."""
    if name == names.SUTURE:
        return SUBTASK_STEPS * len(names.SUBTASKS)
    return SUBTASK_STEPS if name in names.SUBTASKS else load_subtask(name).max_steps


def env_id(name: str) -> str:
    """Return the gymnasium id of a task: "surgicai_vision/TouchPoint-v0" of "touch_point"."""
    return f"surgicai_vision/{''.join(word.capitalize() for word in name.split('_'))}-v0"


def register_task(subtask: "type[Subtask]", distribution: str = "") -> None:
    """Offer a task under its own name in this process, with its gymnasium id.

    Raises:
        NameCollision: the name is taken.
        InputError: this is not a task, it lacks something, or no task can have its name.
    """
    name = getattr(subtask, "name", shown(subtask))
    TASKS.register(name, subtask, distribution)
    if not FORM.fullmatch(name):
        TASKS.unregister(name)
        raise InputError(f"The task '{name}' {NAMELESS}.")
    register_ids()


def register_ids() -> None:
    """Register every task's gymnasium id, as soon as gymnasium is imported.

    gymnasium has no entry points, and importing it costs a third of the time `--help` may take.
    """
    if "gymnasium" in sys.modules:
        _register_all()
    elif not any(isinstance(finder, _GymnasiumFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _GymnasiumFinder())


class _GymnasiumFinder(MetaPathFinder):
    """Finds gymnasium as Python does, and registers the ids when it has been imported."""

    def __init__(self) -> None:
        self._is_asking = False

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of gymnasium; None for every other module."""
        if fullname != "gymnasium" or self._is_asking:
            return None
        self._is_asking = True
        try:
            spec = importlib.util.find_spec(fullname)
        finally:
            self._is_asking = False
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                execute(module)
                sys.meta_path.remove(self)
                _register_all()

            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


def _register_all() -> None:
    """Register the id of every task; one whose name cannot be an id is refused where it is used."""
    for task in task_names():
        if FORM.fullmatch(task):
            _register_id(task)


def _register_id(task: str) -> None:
    """Register the id of one task.

    gymnasium's `TimeLimit` ends the episodes of our tasks; those of other distributions, which are
    not imported here, end their episodes themselves.
    """
    import gymnasium

    if env_id(task) in gymnasium.registry:
        return
    is_ours = task in names.TASKS
    gymnasium.register(
        id=env_id(task),
        entry_point=f"surgicai_vision.envs:{'make_registered' if is_ours else 'make_task'}",
        vector_entry_point="surgicai_vision.envs.vector_env:make_vector",
        max_episode_steps=task_steps(task) if is_ours else None,
        kwargs={"task": task},
    )
