"""Run jobs against a store: what is there is never computed again, what is missing is done and
committed whole.
"""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from surgicai_vision.core.errors import InputError, SurgicaiError, check_name
from surgicai_vision.core.executor import local, ray_engine
from surgicai_vision.core.executor.jobs import JOBS, Job, JobKind
from surgicai_vision.core.files import TEMPORARY, sync_folder

Progress = Callable[[int, int, str], None]
"""`progress(done, total, unit)`, called after every finished job and once at the start."""

Ended = Callable[[Job, Path, SurgicaiError | None], None]
"""`ended(job, folder, error)`, called as a job ends; without an error the folder holds its
result.
"""

ENGINES = ("local", "ray")


@dataclass(frozen=True)
class Engine:
    """What runs the jobs; it never decides what they give.

    Attributes:
        name: "local" (processes of this machine) or "ray".
        address: of a running Ray cluster whose nodes see the store under the same path; by default
            Ray starts on this machine alone.
    """

    name: str = "local"
    address: str | None = None

    def __post_init__(self) -> None:
        check_name("executor", self.name, ENGINES)
        if self.address and self.name != "ray":
            raise InputError(
                f"--address {self.address} is of a Ray cluster; give --executor ray with it."
            )
        if self.name == "ray":
            ray_engine.check()


LOCAL = Engine()

LOCK = ".lock"
"""File in a store that its run holds locked."""


def run(
    jobs: Sequence[Job],
    store: Path,
    *,
    workers: int = 1,
    progress: Progress | None = None,
    unit: str = "jobs",
    table: Mapping[str, JobKind] = JOBS,
    engine: Engine = LOCAL,
    attempts: int | None = None,
    ended: Ended | None = None,
) -> list[Path]:
    """Do the jobs that the store does not hold yet; return every job's result folder, in order.

    Args:
        jobs: what to do.
        store: folder of results; made when missing.
        workers: number of processes; 0 runs in this one.
        progress: called with (done, total, unit), counted by the jobs' weights.
        unit: what the weights count ("frames").
        table: name → kind of job.
        engine: what runs them.
        attempts: how often a job is started whose worker dies; the engine's own number by default.
        ended: called with (job, its folder, its error or None) for every job of this run as it
            ends; then a job that fails does not end the run.

    Raises:
        InputError: `workers` below 0, an unknown job, a store in use by another run, or bad input
            to a job.
        SurgicaiError: a job failed, or its worker died at every attempt.
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
        if engine.name == "ray":
            finished = ray_engine.execute(
                missing, store.resolve(), workers, table, engine.address, attempts
            )
        else:
            finished = local.execute(missing, store, workers, table, attempts)
        with closing(finished):  # workers end with it, whatever is raised here
            for key, error in finished:
                if ended:
                    ended(folders[key], store / key, error)
                elif error:
                    raise error
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
            raise InputError(
                f"Another run is working in {store}; wait for it or stop it first."
            ) from None
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

    Yields the store, for `run`, and a path in it for the result, to be made with
    `files.whole_folder`. At the end the result becomes `out` by one rename and the store is
    removed; after an error or a kill the store stays, and the next run goes on with what it holds.

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
