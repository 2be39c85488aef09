"""Cut: a subtask's visits in recordings of whole procedures, as demonstrations of the subtask.

    cut_demos(Path("demos/recover"), "grasp", out=Path("demos/grasp-visits"))

A visit is a run of control steps of one phase. A procedure that goes back to a subtask
(`demos.recovery_expert`) visits it more than once, and begins some visits in states that none of
the subtask's own starts has: over a dropped needle, or with a needle that is already in the tissue.
Rendered together with the subtask's own demonstrations (`render-demos --demos A,B`), visits teach
its policy what to do there.

A visit that was broken off is kept up to the last contact of the jaws with the needle: after that
the demonstrator had not yet noticed the loss (`record-demos --late`). Visits of fewer than
`SHORTEST` steps are left out.

Reward and success are the subtask's own, measured anew in the recorded states; in a recording of
the procedure, success is that of the whole procedure.

The folder is written atomically; repeating the same request reuses it, and removes what a killed
run left next to it.
"""

import dataclasses
import functools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.core.executor import building
from surgicai_vision.core.files import check_output, whole_folder
from surgicai_vision.core.progress import Stage, silent_stage
from surgicai_vision.core.runs import runs_of
from surgicai_vision.demos.record import finished
from surgicai_vision.demos.store import (
    MARKER,
    Demo,
    demos_digest,
    list_demos,
    read_demo,
    read_marker,
    write_demo,
    write_marker,
)

SHORTEST = 5
"""Control steps of the shortest visit that is kept: one frame at the stride that policies see."""


def cut_demos(demos: Path, subtask: str, *, out: Path, stage: Stage = silent_stage) -> list[Path]:
    """Write a subtask's visits in whole procedures as demonstrations; return their files.

    Args:
        demos: folder of demonstrations of the whole procedure.
        subtask: one of `names.SUBTASKS`.
        out: folder to create; repeating the same request reuses it.
        stage: shows progress.

    Raises:
        UnknownName: no subtask of that name.
        InputError: demonstrations of a single subtask, or without a visit of this one.
        BadFile: `demos` holds no readable demonstrations.
        OutputExists: `out` holds something else.
    """
    check_name("subtask", subtask, names.SUBTASKS)
    marker = read_marker(demos)
    if marker["task"] != names.SUTURE:
        raise InputError(f"{demos} shows '{marker['task']}'; visits are cut from '{names.SUTURE}'.")
    paths = list_demos(demos)
    request = {"subtask": subtask, "demos": demos_digest(paths)}
    check_output(out, may_resume=MARKER)
    if finished(out, request):
        return list_demos(out)
    with (
        building(out) as (_, result),
        whole_folder(result) as folder,
        stage(f"visits of {subtask}", "procedures") as progress,
    ):
        count = 0
        for done, path in enumerate(paths, 1):
            for visit in visits(read_demo(path), subtask):
                write_demo(folder, count, visit)
                count += 1
            progress(done, len(paths))
        if not count:
            raise InputError(f"{demos} holds no visit of '{subtask}'.")
        details = {"request": request, "episodes": count}
        write_marker(folder, subtask, marker["demonstrator"], **details)
    return list_demos(out)


def visits(demo: Demo, subtask: str) -> list[Demo]:
    """Return a subtask's visits in a whole procedure, each as a demonstration of the subtask.

    A visit's configuration is the procedure's, with the subtask's name and step limit.

    Raises:
        InputError: the procedure was recorded in a scene that is compiled differently now.
    """
    config = dataclasses.replace(demo.config, task=subtask, max_steps=TaskConfig(subtask).max_steps)
    number = names.SUBTASKS.index(subtask)
    found = [
        (first, _kept_end(demo, first, end))
        for first, end in runs_of(demo.phase)
        if demo.phase[first] == number
    ]
    cut = []
    for first, end in found:
        if end - first < SHORTEST:
            continue
        state = demo.state[first : end + 1]
        reward, success = _measured(_env(config, demo.scene_hash), state[1:])
        visit = dataclasses.replace(
            demo,
            config=config,
            state=state,
            action=demo.action[first:end],
            phase=demo.phase[first:end],
            reward=reward,
            success=success,
            contact=demo.contact[first:end],
            executed=None if demo.executed is None else demo.executed[first:end],
        )
        cut.append(visit)
    return cut


@functools.lru_cache(maxsize=1)
def _env(config: TaskConfig, scene_hash: str) -> envs.SuturingEnv:
    """Return this process's env for `config`; refuse a scene other than that of `scene_hash`."""
    env = envs.make(config)
    if env.scene.hash != scene_hash:
        raise InputError(
            f"The procedure was recorded in another scene (hash {scene_hash[:12]}, now "
            f"{env.scene.hash[:12]}); record it again."
        )
    return env


def _measured(
    env: envs.SuturingEnv, state: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return a subtask's reward and success in states (T, n) of the whole procedure, (T,) each."""
    phase = names.SUBTASKS.index(env.task)
    rewards = []
    successes = []
    for one in state:
        env.set_state_vector(one)
        env.simulation.task_state.phase = phase  # the procedure's last step began the next subtask
        info = env.measure()
        rewards.append(env.reward(info))
        successes.append(info["is_success"])
    return np.array(rewards, np.float32), np.array(successes, bool)


def _kept_end(demo: Demo, first: int, end: int) -> int:
    """Return the step after the last one that is kept of the visit [first, end)."""
    is_broken_off = end < len(demo) and demo.phase[end] < demo.phase[first]
    if not is_broken_off:
        return end
    touching = np.flatnonzero(demo.contact[first:end])
    return first + int(touching[-1]) + 1 if len(touching) else first
