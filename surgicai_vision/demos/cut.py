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

The folder is written atomically; repeating the same request reuses it.
"""

import dataclasses
from pathlib import Path

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, check_name
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
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole_folder(out) as folder, stage(f"visits of {subtask}", "procedures") as progress:
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
    """
    config = dataclasses.replace(demo.config, task=subtask, max_steps=TaskConfig(subtask).max_steps)
    number = names.SUBTASKS.index(subtask)
    found = [
        (first, _kept_end(demo, first, end))
        for first, end in runs_of(demo.phase)
        if demo.phase[first] == number
    ]
    return [
        dataclasses.replace(
            demo,
            config=config,
            state=demo.state[first : end + 1],
            action=demo.action[first:end],
            phase=demo.phase[first:end],
            reward=demo.reward[first:end],
            success=demo.success[first:end],
            contact=demo.contact[first:end],
            executed=None if demo.executed is None else demo.executed[first:end],
        )
        for first, end in found
        if end - first >= SHORTEST
    ]


def _kept_end(demo: Demo, first: int, end: int) -> int:
    """Return the step after the last one that is kept of the visit [first, end)."""
    is_broken_off = end < len(demo) and demo.phase[end] < demo.phase[first]
    if not is_broken_off:
        return end
    touching = np.flatnonzero(demo.contact[first:end])
    return first + int(touching[-1]) + 1 if len(touching) else first
