"""Executor: jobs by registered name, results in a store, the same command again is the resume.

A job is a registered function called as `function(folder, **arguments)`; it writes its result into
`folder`, which is empty when it starts. The folder is committed to the store by one rename under the job's
key, the sha256 over its name, its JSON arguments, the hashes of its inputs and the versions of the code it
runs. The store is the truth and the processes are not: what is there is never computed again, whatever
killed the run before. Results do not depend on the number of workers.

    jobs = [Job("render-episode", {"demo": "…", "views": ["front"]}, inputs=(sha256,), weight=120)]
    folders = run(jobs, Path("out.work"), workers=2, progress=lambda done, total, unit: None)

Workers are spawned processes (a GL context cannot be shared by a fork); `workers=0` runs in this process.
A worker that dies (killed, out of memory) is replaced and its job tried once more. A worker whose parent
died ends by itself.
"""

import fcntl
import functools
import importlib
import importlib.metadata
import multiprocessing
import os
import shutil
import signal
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from surgicai_vision.config import digest
from surgicai_vision.errors import InputError, SurgicaiError, check_name
from surgicai_vision.files import TEMPORARY, code_version, sync_folder, whole_folder

Progress = Callable[[int, int, str], None]
"""`progress(done, total, unit)`, called after every finished job and once at the start."""


@dataclass(frozen=True)
class JobKind:
    """What a job's name stands for.

    Attributes:
        function: "module:function", imported in the worker on first use.
        stages: the stages whose sources decide the result; a change in them makes a new key.
    """

    function: str
    stages: tuple[str, ...] = ()


JOBS: Mapping[str, JobKind] = MappingProxyType(
    {
        "record-episode": JobKind("surgicai_vision.demos.record:record_episode", ("scene", "envs", "demos")),
        "render-episode": JobKind(
            "surgicai_vision.dataset.rendering:render_episode", ("scene", "envs", "demos", "dataset")
        ),
    }
)

WORKER_ENVIRONMENT: Mapping[str, str] = MappingProxyType(
    {"LP_NUM_THREADS": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
)
"""One worker, one core: llvmpipe's and the BLAS's own threads would fight over it (measured: two
single-threaded processes scale linearly)."""

LOCK = ".lock"
"""File in a store that its run holds locked."""

ATTEMPTS = 2
"""How often a job is started whose worker dies."""


@dataclass(frozen=True)
class Job:
    """One unit of work.

    Attributes:
        name: a key of the table of jobs.
        arguments: JSON data, the function's keyword arguments.
        inputs: hashes of what the job reads besides its arguments.
        weight: what it counts for in the progress.
        label: arguments named here are left out of the key (where a file lies does not change what it holds).
    """

    name: str
    arguments: Mapping[str, Any]
    inputs: tuple[str, ...] = ()
    weight: int = 1
    label: tuple[str, ...] = ()

    def key(self, table: Mapping[str, JobKind] = JOBS) -> str:
        """Return the sha256 (hex) under which the result is stored."""
        return digest(
            {
                "name": self.name,
                "arguments": {k: v for k, v in self.arguments.items() if k not in self.label},
                "inputs": list(self.inputs),
                "code": code_version(*table[self.name].stages),
                "packages": _package_versions(),
            }
        )


@functools.cache
def _package_versions() -> list[str]:
    """Return the versions of the packages that decide numbers and pictures."""
    return [f"{name} {importlib.metadata.version(name)}" for name in ("mujoco", "numpy")]


def run(
    jobs: Sequence[Job],
    store: Path,
    *,
    workers: int = 1,
    progress: Progress | None = None,
    unit: str = "jobs",
    table: Mapping[str, JobKind] = JOBS,
) -> list[Path]:
    """Do the jobs that the store does not hold yet; return every job's result folder, in order.

    Args:
        jobs: what to do.
        store: folder of results; made when missing.
        workers: number of processes; 0 runs in this one.
        progress: called with (done, total, unit), counted by the jobs' weights.
        unit: what the weights count ("frames").
        table: name → kind of job.

    Raises:
        InputError: `workers` below 0, an unknown job, a store in use by another run, or bad input to a job.
        SurgicaiError: a job failed, or its worker died twice.
    """
    if workers < 0:
        raise InputError(f"workers is {workers}; it must be 0 (this process) or more.")
    for job in jobs:
        check_name("job", job.name, table)
    report = progress or (lambda done, total, unit: None)
    folders = {job.key(table): job for job in jobs}
    with claim(store):
        missing = {key: job for key, job in folders.items() if not (store / key).is_dir()}
        total = sum(job.weight for job in folders.values())
        done = total - sum(job.weight for job in missing.values())
        report(done, total, unit)
        for key in _execute(missing, store, workers, table):
            done += folders[key].weight
            report(done, total, unit)
    return [store / job.key(table) for job in jobs]


_claimed: set[Path] = set()
"""Stores this process holds; a claim inside a claim is the same one."""


@contextmanager
def claim(store: Path) -> Iterator[None]:
    """Hold a store alone, and clear what a killed run left unfinished in it.

    Raises:
        InputError: another process holds it.
    """
    path = store.resolve()
    if path in _claimed:
        yield
        return
    path.mkdir(parents=True, exist_ok=True)
    with open(path / LOCK, "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"Another run is working in {store}; wait for it or stop it first.") from None
        for left in path.glob(f"{TEMPORARY}*"):
            shutil.rmtree(left, ignore_errors=True)
        _claimed.add(path)
        try:
            yield
        finally:
            _claimed.discard(path)


def work_folder(out: Path) -> Path:
    """Return the store in which `out` is built: beside it, on the same file system."""
    return out.with_name(f"{out.name}.work")


@contextmanager
def building(out: Path) -> Iterator[tuple[Path, Path]]:
    """Build the folder `out` so that it appears whole, with the store of its jobs beside it.

    Yields the store, for `run`, and a path in it for the result, to be made with `files.whole_folder`. At the end
    the result becomes `out` by one rename and the store is removed; after an error or a kill the store stays, and
    the next run goes on with what it holds.

        with building(out) as (store, result):
            shards = run(jobs, store)
            with whole_folder(result) as folder: …
    """
    store = work_folder(out)
    try:
        with claim(store):
            result = store / "result"
            shutil.rmtree(result, ignore_errors=True)
            yield store, result
            os.rename(result, out)
            sync_folder(out.parent)
            shutil.rmtree(store)
    finally:
        if store.exists() and all(path.name == LOCK for path in store.iterdir()):
            shutil.rmtree(store, ignore_errors=True)


def _execute(jobs: Mapping[str, Job], store: Path, workers: int, table: Mapping[str, JobKind]) -> Iterator[str]:
    """Do `jobs` and yield their keys as they are committed."""
    if not workers:
        for key, job in jobs.items():
            _raise(_work(table[job.name].function, dict(job.arguments), store / key), job)
            yield key
        return
    waiting, attempts = dict(jobs), Counter[str]()
    while waiting:
        try:
            yield from _pool_run(waiting, attempts, store, workers, table)
        except BrokenProcessPool:
            failed = [key for key in waiting if attempts[key] >= ATTEMPTS]
            if failed:
                names = "; ".join(_describe(waiting[key]) for key in failed)
                raise SurgicaiError(
                    f"A worker died {ATTEMPTS} times (killed, or out of memory) at: {names}. "
                    "What is finished is kept: run the same command again, with fewer workers."
                ) from None


def _pool_run(
    waiting: dict[str, Job], attempts: Counter[str], store: Path, workers: int, table: Mapping[str, JobKind]
) -> Iterator[str]:
    """Run one pool until `waiting` is empty or a worker dies; finished keys are taken out of `waiting`."""
    queue = list(waiting)
    running: dict[Future[Any], str] = {}
    others = set(multiprocessing.active_children())
    with _environment(WORKER_ENVIRONMENT):
        pool = ProcessPoolExecutor(
            min(workers, len(queue)), multiprocessing.get_context("spawn"), _start_worker, (os.getpid(),)
        )
        try:
            while queue or running:
                # No more in flight than there are workers, so a dead worker's job is known.
                while queue and len(running) < workers:
                    key = queue.pop(0)
                    job, attempts[key] = waiting[key], attempts[key] + 1
                    running[pool.submit(_work, table[job.name].function, dict(job.arguments), store / key)] = key
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    _raise(future.result(), waiting[running[future]])
                    key = running.pop(future)
                    del waiting[key]
                    yield key
            pool.shutdown()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in set(multiprocessing.active_children()) - others:
                child.kill()


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for the processes started inside."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _start_worker(parent: int) -> None:
    """Prepare a worker: Ctrl-C is the parent's to handle, and without a parent there is nothing to do."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def _work(function: str, arguments: dict[str, Any], destination: Path) -> tuple[int, str, str] | None:
    """Do one job; return None, or (exit code, message, traceback) since not every exception can be pickled."""
    try:
        module, _, name = function.partition(":")
        with whole_folder(destination) as folder:
            getattr(importlib.import_module(module), name)(folder, **arguments)
    except SurgicaiError as error:
        return error.exit_code, str(error), ""
    except Exception as error:
        if destination.is_dir():  # somebody else committed the same result first
            return None
        return 1, f"{type(error).__name__}: {error}", traceback.format_exc()
    return None


def _raise(failure: tuple[int, str, str] | None, job: Job) -> None:
    """Raise what a job reported."""
    if failure is None:
        return
    code, message, trace = failure
    if not trace:
        raise (InputError if code == InputError.exit_code else SurgicaiError)(message)
    error = SurgicaiError(f"{_describe(job)} failed: {message}")
    error.add_note(trace)
    raise error


def _describe(job: Job) -> str:
    """Return a job in a few words for a message."""
    text = ", ".join(f"{key}={value}" for key, value in job.arguments.items() if isinstance(value, (str, int)))
    return f"{job.name}({text})"
