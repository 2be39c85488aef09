"""Every command that starts processes is killed; `GONE_S` later none of its processes is alive."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import render_demos
from surgicai_vision.demos.record import record

GONE_S = 30.0
"""Longest time that a process may outlive the kill [s]."""

VECTOR_ENV = """
if __name__ == "__main__":
    import gymnasium
    import surgicai_vision.envs
    envs = gymnasium.make_vec("surgicai_vision/Grasp-v0", 2, workers=2)
    envs.reset(seed=0)
    while True:
        envs.step(envs.action_space.sample())
"""

GRID = """
task: [grasp]
encoder: [random]
view: [[front]]
demonstrations: 10
episodes: 10
"""

VERBS = {
    "record-demos": "record-demos --task grasp --episodes 500 --workers 2 --out {out}",
    "render-demos": "render-demos --demos {demos} --size 512 --depth --workers 2 --out {out}",
    "dataset convert": "dataset convert {dataset} --video h264 --workers 2 --out {out}",
    "evaluate": "evaluate expert --task grasp --episodes 500 --workers 2 --out {out}",
    "robustness": "robustness expert --task grasp --episodes 500 --workers 2 --out {out}",
    "sweep": "sweep {grid} --workers 2 --out {out}",
    "quickstart": "quickstart --workers 2 --out {out}",
    "import-demos": "import-demos {pickle} --task handoff --out {out}",
    "doctor": "doctor",
}


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """The inputs of the commands."""
    folder = tmp_path_factory.mktemp("given")
    record(TaskConfig("grasp"), episodes=2, out=folder / "demos", context=RunContext(0))
    render_demos(
        folder / "demos", folder / "dataset", views=("front",), size=256, context=RunContext(0)
    )
    (folder / "grid.yaml").write_text(GRID)
    (folder / "some.pkl").write_bytes(b"\x80\x04]" + 10**7 * b"\x94.")
    (folder / "envs.py").write_text(VECTOR_ENV)
    names = {"demos": "demos", "dataset": "dataset", "grid": "grid.yaml", "pickle": "some.pkl"}
    return {name: str(folder / file) for name, file in names.items()} | {"folder": folder}


def command(verb, given, out):
    if verb == "vector env":
        return [sys.executable, str(given["folder"] / "envs.py")]
    arguments = VERBS[verb].format(out=out, **given).split()
    return [sys.executable, "-m", "surgicai_vision", *arguments]


def parents():
    """Return the parent of every process: (pid, start time) → parent's pid."""
    found = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent, *rest = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if state != "Z":
            found[int(stat.parent.name), rest[17]] = int(parent)
    return found


def descendants(pid):
    """Return (pid, start) of all processes below `pid`."""
    above = parents()
    found = set()
    level = {pid}
    while level:
        below = {child for child, parent in above.items() if parent in level}
        found |= below
        level = {child for child, _ in below}
    return found


def kill_and_look(started, number, delay):
    """Kill a process once it has descendants; return those that outlive it."""
    until = time.monotonic() + 300  # a loaded machine starts slowly
    while not descendants(started.pid):
        assert started.poll() is None, started.communicate()
        assert time.monotonic() < until, "it starts no process"
        time.sleep(0.01)
    time.sleep(delay)
    below = descendants(started.pid)
    assert below and started.poll() is None, started.communicate()
    os.kill(started.pid, number)
    until = time.monotonic() + GONE_S
    while (alive := below & parents().keys()) and time.monotonic() < until:
        time.sleep(0.05)
    return alive


@pytest.mark.parametrize("verb", [*VERBS, "vector env"])
def test_nothing_outlives_a_killed_command(tmp_path, given, verb):
    """Kill as soon as there is a child, which may still be starting, and while it works."""
    run = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "cwd": tmp_path}
    run["env"] = {**os.environ, "TMPDIR": str(tmp_path)}  # a killed process leaves its files there
    short = verb == "import-demos"  # its child lives only briefly
    for number, delay in ((signal.SIGTERM, 0), (signal.SIGKILL, 0 if short else 1)):
        started = subprocess.Popen(command(verb, given, tmp_path / str(number)), **run)
        try:
            alive = kill_and_look(started, number, delay)
            _, said = started.communicate(timeout=GONE_S)
        finally:
            started.kill()
        assert not alive, f"{verb} leaves processes after {signal.Signals(number).name}"
        if number == signal.SIGTERM and verb in VERBS:
            assert (
                said.splitlines()[-1] == "surgicai-vision: interrupted; run the same command again"
            )
            assert started.returncode == 128 + signal.SIGTERM
            assert "Traceback" not in said
