"""Processes: calls in workers, their failures and deaths; children end with their parent."""

import functools
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import fake_calls
import pytest

from surgicai_vision.core import processes
from surgicai_vision.core.errors import InputError, SurgicaiError
from surgicai_vision.core.processes import Child, run_all, run_module

HELPERS = {"PYTHONPATH": str(Path(fake_calls.__file__).parent)}


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def silent(done):
    """Ignore the progress."""


def test_calls_run_at_once_and_come_back_in_order(monkeypatch):
    heard = []
    calls = [functools.partial(fake_calls.count, number) for number in (30, 5)]
    assert run_all(calls, "counting", lambda done: heard.append(tuple(done))) == [30, 5]
    assert heard == sorted(heard), "no call goes back"
    assert any(0 < first < 30 for first, _ in heard), "a call tells how far it is"


def test_a_failure_ends_the_others_and_keeps_its_kind():
    long = functools.partial(fake_calls.sleep, 60)
    began = time.monotonic()
    with pytest.raises(InputError, match="Did you mean 'front'"):
        run_all([long, fake_calls.refuse], "seeing", silent)
    with pytest.raises(
        SurgicaiError, match="counting failed: ZeroDivisionError: by hand"
    ) as caught:
        run_all([long, fake_calls.crash], "counting", silent)
    assert "in crash" in caught.value.__notes__[0], "the traceback is not lost"
    with pytest.raises(
        SurgicaiError, match=r"A process of dying was killed \(exit code -9; out of"
    ):
        run_all([long, fake_calls.die], "dying", silent)
    with pytest.raises(SurgicaiError, match="reading failed: EOFError: No data left in file"):
        run_all([long, fake_calls.read_nothing], "reading", silent)
    assert time.monotonic() - began < 30
    assert not multiprocessing.active_children(), "none is left"


def test_a_child_has_its_environment_and_this_process_keeps_its_own(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MINE", raising=False)
    child = Child(fake_calls.tell_environment, variables={**processes.ONE_THREAD, "MINE": "yes"})
    assert child.connection.recv() == {"OMP_NUM_THREADS": "1", "MINE": "yes"}
    child.dismiss()
    assert child.exit_code == 0
    assert (os.environ["OMP_NUM_THREADS"], os.environ.get("MINE")) == ("7", None)


def test_a_child_that_does_not_leave_is_killed(monkeypatch):
    monkeypatch.setattr(processes, "PATIENCE_S", 0.2)
    child = Child(fake_calls.stay)
    child.dismiss()
    assert child.exit_code == -signal.SIGKILL


def test_a_module_is_run_to_its_end():
    done = run_module("fake_calls", "0", variables={**HELPERS, **processes.ONE_THREAD})
    assert (done.returncode, done.stdout) == (0, "0 1\n")
    done = run_module("fake_calls", "refuse", variables=HELPERS)
    assert done.returncode == 1 and "bad input" in done.stderr
    with pytest.raises(subprocess.TimeoutExpired):
        run_module("fake_calls", "60", variables={**HELPERS, **processes.ONE_THREAD}, timeout=1)


SCRIPT = """
import sys
import fake_calls
from surgicai_vision.core.processes import Child, raise_on_terminate
if __name__ == "__main__":
    raise_on_terminate()
    child = Child(fake_calls.have_children)
    print(*child.connection.recv(), flush=True)
    {then}
"""


@pytest.mark.parametrize("then", ["child.connection.recv()", "pass"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_grandchildren_end_with_their_grandparent(tmp_path, number, then):
    """Holds for a killed process and for one that ends without ending its children."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(then=then))
    environment = {**os.environ, **HELPERS}
    run = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with subprocess.Popen([sys.executable, script], env=environment, **run) as started:
        pids = started.stdout.readline().split()
        assert len(pids) == 3
        if then != "pass":
            started.send_signal(number)
        started.wait(5)
    until = time.monotonic() + 5
    while any(is_alive(pid) for pid in pids) and time.monotonic() < until:
        time.sleep(0.05)
    assert not [pid for pid in pids if is_alive(pid)]
