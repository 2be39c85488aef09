"""The executor: the store is authoritative, whatever happens to the processes."""

import importlib
import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import fake_jobs
import pytest
from filelock import FileLock

from surgicai_vision.core.errors import InputError, OutputExists, SurgicaiError, UnknownName
from surgicai_vision.core.executor import (
    ENGINES,
    JOBS,
    Engine,
    Job,
    RunContext,
    building,
    open_engine,
    register_job,
    run,
    slurm,
)
from surgicai_vision.core.executor.slurm import SUBMISSIONS, SlurmEngine
from surgicai_vision.core.files import whole_folder


def squares(numbers, **more):
    return [Job("square", {"number": number}, **more) for number in numbers]


def texts(folders):
    return [(folder / "result.txt").read_text() for folder in folders]


def partial(store):
    return [path.name for path in store.glob(".partial-*")]


def test_results_come_in_order_whatever_the_workers(tmp_path):
    inline = run(squares(range(5)), tmp_path / "a", RunContext(0))
    spawned = run(squares(range(5)), tmp_path / "b", RunContext(2))
    assert texts(inline) == texts(spawned) == ["0", "1", "4", "9", "16"]
    assert [path.name for path in inline] == [path.name for path in spawned]


def test_few_jobs_share_the_processes_of_this_machine():
    assert [RunContext(6).processes_each(jobs) for jobs in (1, 2, 4, 6, 9)] == [6, 3, 1, 1, 1]
    assert RunContext(6).processes_each(0) == 6, "nothing is left to do"
    assert RunContext(0).processes_each(1) == 1, "in this process"
    assert RunContext(6, SlurmEngine()).processes_each(1) == 1, "its workers are elsewhere"


def test_finished_jobs_are_not_done_again(tmp_path):
    log = tmp_path / "log"
    jobs = [
        Job("count", {"number": number, "log": str(log)}, label=("log",)) for number in range(4)
    ]
    seen = []
    run(jobs[:2], tmp_path / "store", RunContext(0))
    run(
        jobs,
        tmp_path / "store",
        RunContext(0),
        progress=lambda *row: seen.append(row),
        unit="frames",
    )
    assert log.read_text().split() == ["0", "1", "2", "3"]
    assert seen == [(2, 4, "frames"), (3, 4, "frames"), (4, 4, "frames")]


def test_key_depends_on_arguments_and_inputs_but_not_on_labels():
    base = Job("square", {"number": 1, "path": "a"}, ("x",), label=("path",))
    assert base.key() == Job("square", {"number": 1, "path": "b"}, ("x",), label=("path",)).key()
    others = [
        Job("square", {"number": 2}, ("x",)),
        Job("square", {"number": 1}, ("y",)),
        Job("crash", {"number": 1}),
    ]
    assert len({base.key(), *(job.key() for job in others)}) == 4


def test_a_worker_killed_once_is_replaced(tmp_path):
    jobs = [Job("die_once", {"mark": str(tmp_path / "mark")}), *squares(range(3))]
    folders = run(jobs, tmp_path / "store", RunContext(2))
    assert texts(folders) == ["done", "0", "1", "4"]


def test_a_worker_killed_twice_is_an_error_and_keeps_the_rest(tmp_path):
    store = tmp_path / "store"
    with pytest.raises(SurgicaiError, match=r"died 2 times.*die\(\).*same command again"):
        run([*squares(range(2)), Job("die", {})], store, RunContext(1))
    seen = []
    run(squares(range(2)), store, RunContext(0), progress=lambda *row: seen.append(row))
    assert seen == [(2, 2, "jobs")]


def test_a_run_that_is_told_of_failures_goes_on_after_them(tmp_path):
    heard = {}

    def ended(job, folder, error):
        heard[job.name] = (folder.is_dir(), str(error) if error else "")

    jobs = [Job("die", {}), Job("crash", {}), *squares([3])]
    run(jobs, tmp_path / "store", RunContext(2), attempts=3, ended=ended)
    assert heard["square"] == (True, "")
    assert not heard["die"][0] and "died 3 times" in heard["die"][1]
    assert not heard["crash"][0] and "ZeroDivisionError" in heard["crash"][1]


@pytest.mark.parametrize("workers", [0, 1])
def test_failures_keep_their_kind_and_leave_nothing(tmp_path, workers):
    with pytest.raises(InputError, match="bad input"):
        run([Job("refuse", {"kind": "input"})], tmp_path, RunContext(workers))
    with pytest.raises(InputError, match="Did you mean 'front'"):
        run([Job("refuse", {"kind": "name"})], tmp_path, RunContext(workers))
    with pytest.raises(SurgicaiError, match=r"crash\(\) failed: ZeroDivisionError: by hand"):
        run([Job("crash", {})], tmp_path, RunContext(workers))
    assert not list(tmp_path.iterdir())


def test_bad_requests_are_refused(tmp_path):
    with pytest.raises(InputError, match="workers is -1"):
        RunContext(-1)
    with pytest.raises(UnknownName, match="Unknown job 'rm'"):
        run([Job("rm", {})], tmp_path, RunContext(0))


def test_a_name_stands_for_one_function():
    with pytest.raises(
        InputError, match="Job 'square' is fake_jobs:square already; give other:square another name"
    ):
        register_job("square", "other:square", stages=("core",))


def test_workers_are_single_threaded(tmp_path):
    before = os.environ.get("LP_NUM_THREADS")
    assert texts(run([Job("environment", {})], tmp_path, RunContext(1))) == ["0"]
    assert os.environ.get("LP_NUM_THREADS") == before


SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import fake_jobs
from surgicai_vision.core.executor import Job, RunContext, run
if __name__ == "__main__":
    jobs = [Job("slow", {{"number": n, "seconds": 0.3}}) for n in range(6)]
    run(jobs, Path({store!r}), RunContext(2), progress=lambda *row: print(*row, flush=True))
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
    jobs = [Job("slow", {"number": number, "seconds": 0.3}) for number in range(6)]
    seen = []
    folders = run(jobs, store, RunContext(0), progress=lambda *row: seen.append(row[0]))
    assert seen[0] >= 2
    assert texts(folders) == ["0", "1", "4", "9", "16", "25"]
    assert not partial(store)


def test_a_store_serves_one_run_at_a_time(tmp_path):
    with FileLock(tmp_path / ".lock"), pytest.raises(InputError, match="Another run is working"):
        run(squares([7]), tmp_path, RunContext(0))
    run(squares([7]), tmp_path, RunContext(0))


def test_a_built_folder_appears_whole_or_not_at_all(tmp_path):
    out = tmp_path / "out"

    def build(fail):
        with building(out) as (store, result):
            run(squares([3]), store, RunContext(0))
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
    """Return the non-loopback TCP addresses this machine listens on, in the kernel's notation."""
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
    """One cluster serves all checks: starting Ray takes seconds."""
    if (
        importlib.util.find_spec("ray") is None
    ):  # looked up, not imported: the engine sets what it listens on
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

    run(squares(range(2)), store, RunContext(0))
    folders = run(jobs, store, RunContext(2, open_engine("ray")), progress=progress)
    assert texts(folders) == ["done", "0", "1", "4", "9", "127.0.0.1 0"]
    assert [folder.name for folder in folders] == [job.key() for job in jobs]
    assert heard[0][0] == (2, 6, "jobs"), "the store is the truth"
    assert all(not foreign for _, foreign in heard), "only loopback listens"
    again = run(
        jobs, store, RunContext(2, open_engine("ray"))
    )  # nothing to do: no cluster is started
    assert again == folders


def test_engines_are_asked_for_in_words(monkeypatch):
    with pytest.raises(UnknownName, match="Did you mean 'ray'"):
        open_engine("rya")
    with pytest.raises(
        InputError, match=r"local takes no options; leave 'address=127.0.0.1:6379' out"
    ):
        open_engine("local,address=127.0.0.1:6379")
    with pytest.raises(UnknownName, match="Did you mean 'partition'"):
        open_engine("slurm,partion=cpu")
    with pytest.raises(InputError, match="minutes is 0 and gpus 0; allowed: at least 1"):
        open_engine("slurm,minutes=0")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for name in ("ray", "slurm"):
        with pytest.raises(InputError, match=rf"pip install 'surgicai-vision\[{name}\]'"):
            open_engine(name)


def test_an_error_of_another_distributions_engine_says_whose_it_is(monkeypatch):
    @dataclass(frozen=True)
    class Broken(Engine):
        name: ClassVar[str] = "broken"
        rooms: int = 1

        def __post_init__(self) -> None:
            raise RuntimeError("no licence")

        def execute(self, tasks, workers, attempts=None):
            yield from ()

    ENGINES.register("broken", Broken, "theirs")
    try:
        with pytest.raises(InputError, match=r"The executor 'broken' of 'theirs' failed: .*licen"):
            open_engine("broken,rooms=2")
    finally:
        ENGINES.unregister("broken")


@dataclass(frozen=True)
class Silent(Engine):
    """An engine that drops what `perform` returns, and forgets its last task."""

    name: ClassVar[str] = "silent"

    def execute(self, tasks, workers, attempts=None):
        for key, task in list(tasks.items())[:-1]:
            task.do()
            yield key, None


def test_a_result_that_an_engine_has_not_made_is_an_error(tmp_path):
    jobs = [*squares([2]), Job("crash", {}), *squares([3])]
    told = []
    run(jobs, tmp_path, RunContext(1, Silent()), ended=lambda job, _, error: told.append(error))
    assert told[0] is None
    assert [type(error) for error in told[1:]] == [SurgicaiError, SurgicaiError]
    with pytest.raises(SurgicaiError, match=r"^The executor 'silent' has done crash\(\), but /"):
        run(jobs, tmp_path, RunContext(1, Silent()))


def test_a_folder_that_another_run_has_made_is_found_before_the_work(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with building(out) as (_, result), whole_folder(result) as folder:  # an empty one is taken
        (folder / "made").write_text("first")
    with pytest.raises(OutputExists, match="run the command again"), building(out):
        raise AssertionError
    assert (out / "made").read_text() == "first"
    assert not list(tmp_path.glob("*.work"))


def test_slurm_is_looked_for_before_any_job(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match=r"executor slurm: .*login node"):
        run(squares([1]), tmp_path / "store", RunContext(1, SlurmEngine(partition="cpu")))


@pytest.mark.parametrize("cluster", ["debug", "local"])
def test_slurm_runs_the_same_jobs(tmp_path, monkeypatch, cluster):
    """The debug executor runs them in this process, the local one starts a process per job."""
    monkeypatch.setenv("PYTHONPATH", str(Path(fake_jobs.__file__).parent))
    store = tmp_path / "store"
    context = RunContext(2, SlurmEngine(cluster=cluster))
    heard = []
    jobs = [*squares(range(3)), Job("environment", {})]
    run(squares(range(1)), store, RunContext(0))
    folders = run(jobs, store, context, progress=lambda *row: heard.append(row))
    assert texts(folders)[:3] == ["0", "1", "4"]
    assert cluster == "debug" or texts(folders)[3] == "0", "a batch job has one core"
    assert [folder.name for folder in folders] == [job.key() for job in jobs]
    assert heard[0] == (1, 4, "jobs"), "the store is the truth"
    assert not (store / SUBMISSIONS).exists(), "nothing is left of what went well"
    assert run(jobs, store, context) == folders
    with pytest.raises(SurgicaiError, match=r"crash\(\) failed: ZeroDivisionError: by hand"):
        run([Job("crash", {})], store, context)
    with pytest.raises(InputError, match="Did you mean 'front'"):
        run([Job("refuse", {"kind": "name"})], store, context)


def test_a_killed_batch_job_is_submitted_again(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(fake_jobs.__file__).parent))
    monkeypatch.setattr(slurm, "GRACE_S", 0.2)
    heard = {}

    def ended(job, folder, error):
        heard[job.name] = (folder.is_dir(), str(error) if error else "")

    jobs = [Job("die_once", {"mark": str(tmp_path / "mark")}), Job("die", {}), *squares([3])]
    run(
        jobs,
        tmp_path / "store",
        RunContext(3, SlurmEngine(cluster="local")),
        attempts=2,
        ended=ended,
    )
    assert heard["die_once"] == (True, "") == heard["square"]
    done, said = heard["die"]
    output = Path(re.search(r"its output is in (\S+)\)", said)[1])
    assert not done and "died 2 times" in said and output.is_file()


@pytest.fixture
def interruptible():
    """Let Ctrl-C reach children also where a shell runs the tests in the background (`… &`)."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_run_cancels_its_batch_jobs(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(fake_jobs.__file__).parent))
    jobs = [*squares([1]), Job("slow", {"number": 2, "seconds": 3600})]

    def interrupt(done, total, unit):
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(
            jobs,
            tmp_path / "store",
            RunContext(2, SlurmEngine(cluster="local")),
            progress=interrupt,
        )
    until = time.monotonic() + 300
    while subprocess.run(["pgrep", "-f", str(tmp_path)], capture_output=True).stdout:
        assert time.monotonic() < until, "a batch job outlives its run"
        time.sleep(0.1)


def test_jobs_are_registered_where_they_are_defined():
    for module in ("demos.record", "dataset.render", "experiments.sweep.plan"):
        importlib.import_module(f"surgicai_vision.{module}")
    ours = {
        name: kind for name, kind in JOBS.items() if kind.function.startswith("surgicai_vision.")
    }
    assert ours["record-episode"].function == "surgicai_vision.demos.record:record_episode"
    for kind in ours.values():
        module, _, name = kind.function.partition(":")
        assert callable(getattr(importlib.import_module(module), name))
