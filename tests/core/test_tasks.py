"""Tasks by name: our own tasks, and a task registered in this process."""

import subprocess
import sys
from collections.abc import Iterator
from types import MappingProxyType

import gymnasium
import numpy as np
import pytest

import surgicai_vision
from surgicai_vision import envs
from surgicai_vision.core import names, tasks
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.plugins import NameCollision
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs.grasp import Grasp
from surgicai_vision.envs.subtask import NO_PHASE, Demands, Subtask, Tolerance


class Hover(Grasp):
    """A grasp that is done within 20 mm of its goal: a separate task without an expert."""

    name = "hover_near"
    text = "Hover near the needle."
    phase = NO_PHASE
    max_steps = 40
    tolerances = MappingProxyType({"paper": Tolerance.of(20.0, 90.0)})
    demands = MappingProxyType({"paper": Demands()})


@pytest.fixture
def hover() -> Iterator[type[Subtask]]:
    surgicai_vision.register_task(Hover)
    yield Hover
    tasks.TASKS.unregister(Hover.name)
    gymnasium.registry.pop(tasks.env_id(Hover.name))


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_our_subtasks_say_what_the_names_say(task: str) -> None:
    subtask = tasks.load_subtask(task)
    assert subtask.name == task
    assert subtask.phase == names.SUBTASKS.index(task)
    assert subtask.arm == names.ACTIVE_ARM[task]
    assert isinstance(envs.SUBTASKS[task], subtask)


def test_ids_are_there_in_whatever_order_the_two_are_imported() -> None:
    both = ("surgicai_vision", "gymnasium")
    for first, second in (both, both[::-1]):
        code = f"import {first}, {second}, gymnasium as g; print(*g.registry)"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert {tasks.env_id(task) for task in names.TASKS} <= set(done.stdout.split())
    asked = "import importlib.util as u, surgicai_vision; u.find_spec('gymnasium')"
    code = f"{asked}; import gymnasium as g; print(*g.registry)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert {tasks.env_id(task) for task in names.TASKS} <= set(done.stdout.split())
    code = "import surgicai_vision, sys; print('gymnasium' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "False"


def test_a_registered_task_is_one_of_all(hover: type[Subtask]) -> None:
    assert tasks.task_names() == (*names.TASKS, "hover_near")
    assert TaskConfig("hover_near").max_steps == 40
    assert tasks.task_text("hover_near") == hover.text
    env = gymnasium.make("surgicai_vision/HoverNear-v0")
    _, info = env.reset(seed=0)
    assert info["phase"] == NO_PHASE
    steps = 0
    terminated = truncated = False
    while not (terminated or truncated):
        *_, terminated, truncated, info = env.step(np.zeros(7, np.float32))
        steps += 1
    assert steps == 40
    assert not info["is_success"]
    held = gymnasium.make_vec("surgicai_vision/HoverNear-v0", 1, action_repeat=2)
    held.reset(seed=0)
    ends = [held.step(np.zeros((1, 7), np.float32))[3].item() for _ in range(20)]
    assert ends == [False] * 19 + [True], "it ends its episodes itself, after 40 control steps"
    with pytest.raises(NameCollision, match="hover_near"):
        surgicai_vision.register_task(Hover)


def test_what_a_task_lacks_is_said(hover: type[Subtask]) -> None:
    env = envs.make(TaskConfig("hover_near"))
    env.reset(seed=0)
    with pytest.raises(InputError, match="'hover_near' has no expert"):
        Expert(env).action()
    with pytest.raises(InputError, match=r"tolerance preset of 'hover_near'.*paper"):
        envs.make(TaskConfig("hover_near", tolerance="released"))


def test_a_task_under_another_name_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    tasks.TASKS.register("elsewhere", Hover)
    try:
        with pytest.raises(InputError, match=r"'elsewhere'.*calls itself 'hover_near'"):
            tasks.load_subtask("elsewhere")
    finally:
        tasks.TASKS.unregister("elsewhere")


def test_a_task_whose_name_is_no_id_breaks_only_itself() -> None:
    wrong = type("Wrong", (Hover,), {"name": "hover near"})
    with pytest.raises(InputError, match=r"'hover near' cannot have this name.*letters"):
        surgicai_vision.register_task(wrong)
    assert "hover near" not in tasks.task_names()
    tasks.TASKS.register("hover near", wrong)  # as an entry point does
    try:
        tasks.register_ids()
        assert gymnasium.spec(tasks.env_id("grasp"))
        with pytest.raises(InputError, match=r"'hover near'.*cannot have this name"):
            tasks.load_subtask("hover near")
    finally:
        tasks.TASKS.unregister("hover near")


def test_a_task_that_fails_at_its_start_is_named(
    hover: type[Subtask], monkeypatch: pytest.MonkeyPatch
) -> None:
    env = envs.make(TaskConfig("hover_near"))
    for method in ("start", "target"):
        with monkeypatch.context() as patch:
            patch.setattr(hover, method, lambda *_: 1 / 0)
            with pytest.raises(InputError, match=r"The task 'hover_near' of .*ZeroDivisionError"):
                env.reset(seed=0)


def test_public_names_are_there_and_others_are_not() -> None:
    assert set(surgicai_vision.__all__) <= set(dir(surgicai_vision))
    for name in surgicai_vision.__all__:
        assert callable(getattr(surgicai_vision, name))
    with pytest.raises(AttributeError, match="register_robot"):
        surgicai_vision.register_robot  # noqa: B018
