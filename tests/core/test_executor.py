"""The executor: the store is the truth, whatever becomes of the processes."""

import fcntl
import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from surgicai_vision.core.errors import InputError, SurgicaiError, UnknownName
from surgicai_vision.core.executor import JOBS, Engine, Job, JobKind, building, run
from surgicai_vision.core.files import whole_folder

TABLE = {
    name: JobKind(f"fake_jobs:{name}", ("names",))
    for name in (
        "square",
        "count",
        "die_once",
        "die",
        "refuse",
        "crash",
        "slow",
        "environment",
        "where",
    )
}


def squares(numbers, **more):
    return [Job("square", {"number": number}, **more) for number in numbers]


def texts(folders):
    return [(folder / "result.txt").read_text() for folder in folders]


def partial(store):
    return [path.name for path in store.glob(".partial-*")]


def test_results_come_in_order_whatever_the_workers(tmp_path):
    inline = run(squares(range(5)), tmp_path / "a", workers=0, table=TABLE)
    spawned = run(squares(range(5)), tmp_path / "b", workers=2, table=TABLE)
    assert texts(inline) == texts(spawned) == ["0", "1", "4", "9", "16"]
    assert [path.name for path in inline] == [path.name for path in spawned]


def test_finished_jobs_are_not_done_again(tmp_path):
    log = tmp_path / "log"
    jobs = [
        Job("count", {"number": number, "log": str(log)}, label=("log",)) for number in range(4)
    ]
    seen = []
    run(jobs[:2], tmp_path / "store", workers=0, table=TABLE)
    run(
        jobs,
        tmp_path / "store",
        workers=0,
        table=TABLE,
        progress=lambda *row: seen.append(row),
        unit="frames",
    )
    assert log.read_text().split() == ["0", "1", "2", "3"]
    assert seen == [(2, 4, "frames"), (3, 4, "frames"), (4, 4, "frames")]


def test_key_depends_on_arguments_and_inputs_but_not_on_labels():
    base = Job("square", {"number": 1, "path": "a"}, ("x",), label=("path",))
    assert base.key(TABLE) == Job(
        "square", {"number": 1, "path": "b"}, ("x",), label=("path",)
    ).key(TABLE)
    others = [
        Job("square", {"number": 2}, ("x",)),
        Job("square", {"number": 1}, ("y",)),
        Job("crash", {"number": 1}),
    ]
    assert len({base.key(TABLE), *(job.key(TABLE) for job in others)}) == 4


def test_a_worker_killed_once_is_replaced(tmp_path):
    jobs = [Job("die_once", {"mark": str(tmp_path / "mark")}), *squares(range(3))]
    folders = run(jobs, tmp_path / "store", workers=2, table=TABLE)
    assert texts(folders) == ["done", "0", "1", "4"]


def test_a_worker_killed_twice_is_an_error_and_keeps_the_rest(tmp_path):
    store = tmp_path / "store"
    with pytest.raises(SurgicaiError, match=r"died 2 times.*die\(\).*same command again"):
        run([*squares(range(2)), Job("die", {})], store, workers=1, table=TABLE)
    seen = []
    run(squares(range(2)), store, workers=0, table=TABLE, progress=lambda *row: seen.append(row))
    assert seen == [(2, 2, "jobs")]


def test_a_run_that_is_told_of_failures_goes_on_after_them(tmp_path):
    heard = {}

    def ended(job, folder, error):
        heard[job.name] = (folder.is_dir(), str(error) if error else "")

    jobs = [Job("die", {}), Job("crash", {}), *squares([3])]
    run(jobs, tmp_path / "store", workers=2, table=TABLE, attempts=3, ended=ended)
    assert heard["square"] == (True, "")
    assert not heard["die"][0] and "died 3 times" in heard["die"][1]
    assert not heard["crash"][0] and "ZeroDivisionError" in heard["crash"][1]


@pytest.mark.parametrize("workers", [0, 1])
def test_failures_keep_their_kind_and_leave_nothing(tmp_path, workers):
    with pytest.raises(InputError, match="bad input"):
        run([Job("refuse", {"kind": "input"})], tmp_path, workers=workers, table=TABLE)
    with pytest.raises(InputError, match="Did you mean 'front'"):
        run([Job("refuse", {"kind": "name"})], tmp_path, workers=workers, table=TABLE)
    with pytest.raises(SurgicaiError, match=r"crash\(\) failed: ZeroDivisionError: by hand"):
        run([Job("crash", {})], tmp_path, workers=workers, table=TABLE)
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


def test_bad_requests_are_refused(tmp_path):
    with pytest.raises(InputError, match="workers is -1"):
        run([], tmp_path, workers=-1)
    with pytest.raises(UnknownName, match="Unknown job 'rm'"):
        run([Job("rm", {})], tmp_path)


def test_workers_are_single_threaded(tmp_path):
    before = os.environ.get("LP_NUM_THREADS")
    assert texts(run([Job("environment", {})], tmp_path, workers=1, table=TABLE)) == ["0"]
    assert os.environ.get("LP_NUM_THREADS") == before


SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from surgicai_vision.core.executor import Job, JobKind, run
if __name__ == "__main__":
    table = {{"slow": JobKind("fake_jobs:slow", ("names",))}}
    jobs = [Job("slow", {{"number": n, "seconds": 0.3}}) for n in range(6)]
    run(jobs, Path({store!r}), workers=2, table=table, progress=lambda *row: print(*row, flush=True))
"""


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGKILL])
def test_interrupted_run_continues(tmp_path, signal_number):
    store = tmp_path / "store"
    script = tmp_path / "script.py"
    script.write_text(
        SCRIPT.format(tests=str(Path(__file__).parents[1] / "helpers"), store=str(store))
    )
    process = subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    for line in process.stdout:
        if line.startswith("2 "):
            break
    process.send_signal(signal_number)
    process.wait(10)
    time.sleep(1.2)  # orphans notice within half a second
    children = subprocess.run(["pgrep", "-f", str(script)], capture_output=True, text=True).stdout
    assert not children
    table = {"slow": TABLE["slow"]}
    jobs = [Job("slow", {"number": number, "seconds": 0.3}) for number in range(6)]
    seen = []
    folders = run(jobs, store, workers=0, table=table, progress=lambda *row: seen.append(row[0]))
    assert seen[0] >= 2
    assert texts(folders) == ["0", "1", "4", "9", "16", "25"]
    assert not partial(store)


def test_a_store_serves_one_run_at_a_time(tmp_path):
    with open(tmp_path / ".lock", "w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="Another run is working"):
            run(squares([7]), tmp_path, workers=0, table=TABLE)
    run(squares([7]), tmp_path, workers=0, table=TABLE)


def test_a_built_folder_appears_whole_or_not_at_all(tmp_path):
    out = tmp_path / "out"

    def build(fail):
        with building(out) as (store, result):
            run(squares([3]), store, workers=0, table=TABLE)
            with whole_folder(result) as folder:
                (folder / "a.txt").write_text("a")
                assert not out.exists()
                if fail:
                    raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build(fail=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.work"]
    build(fail=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]
    assert [path.name for path in out.iterdir()] == ["a.txt"]


def test_building_nothing_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match="nothing"), building(tmp_path / "out"):
        raise InputError("nothing to build")
    assert not list(tmp_path.iterdir())


def listening():
    """Return where this machine listens for TCP besides loopback, in the kernel's spelling."""
    lines = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{name}").read_text().splitlines()
    ]
    loopback = (
        "0100007F:",
        "0000000000000000FFFF00000100007F:",
        "00000000000000000000000001000000:",
    )
    return {row[1] for row in lines if row[3] == "0A" and not row[1].startswith(loopback)}


def test_ray_runs_the_same_jobs_on_loopback_and_replaces_a_killed_worker(tmp_path, monkeypatch):
    """One cluster for all of it: starting Ray takes seconds."""
    if (
        importlib.util.find_spec("ray") is None
    ):  # found, not imported: the engine sets what it listens on
        pytest.skip("Ray is an extra: surgicai-vision[ray]")
    monkeypatch.setenv(
        "PYTHONPATH", str(Path(__file__).parents[1] / "helpers")
    )  # where its workers find the jobs of the tests
    others = listening()
    store = tmp_path / "store"
    heard = []
    jobs = [Job("die_once", {"mark": str(tmp_path / "mark")}), *squares(range(4)), Job("where", {})]

    def progress(*row):
        heard.append((row, listening() - others))

    run(squares(range(2)), store, workers=0, table=TABLE)
    folders = run(jobs, store, workers=2, table=TABLE, engine=Engine("ray"), progress=progress)
    assert texts(folders) == ["done", "0", "1", "4", "9", "127.0.0.1 0"]
    assert [folder.name for folder in folders] == [job.key(TABLE) for job in jobs]
    assert heard[0][0] == (2, 6, "jobs"), "the store is the truth"
    assert all(not foreign for _, foreign in heard), "only loopback listens"
    again = run(
        jobs, store, workers=2, table=TABLE, engine=Engine("ray")
    )  # nothing to do: no cluster is started
    assert again == folders


def test_ray_is_asked_for_in_words(monkeypatch):
    with pytest.raises(UnknownName, match="Did you mean 'ray'"):
        Engine("rya")
    with pytest.raises(InputError, match="give --executor ray with it"):
        Engine(address="127.0.0.1:6379")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'surgicai-vision\[ray\]'"):
        Engine("ray")


def test_registered_jobs_name_modules_of_this_package():
    assert all(
        kind.function.startswith("surgicai_vision.") and ":" in kind.function
        for kind in JOBS.values()
    )
