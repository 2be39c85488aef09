"""Run jobs against a store: a result that is in it is never computed again.

An engine computes the missing results, which are committed whole.
"""

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from surgicai_vision.core.errors import InputError, OutputExists, SurgicaiError
from surgicai_vision.core.executor.context import RunContext
from surgicai_vision.core.executor.engine import Ending
from surgicai_vision.core.executor.jobs import Job, Task
from surgicai_vision.core.files import TEMPORARY, check_renamed, locked, sync_folder
from surgicai_vision.core.progress import Progress, silent

Ended = Callable[[Job, Path, SurgicaiError | None], None]
"""Called as `ended(job, folder, error)`; without an error the folder holds the job's result."""

LOCK = ".lock"
"""File in a store that its run keeps locked."""


def run(
    jobs: Sequence[Job],
    store: Path,
    context: RunContext,
    *,
    progress: Progress = silent,
    unit: str = "jobs",
    attempts: int | None = None,
    ended: Ended | None = None,
) -> list[Path]:
    """Do the jobs that the store does not hold yet; return every job's result folder, in order.

    Args:
        jobs: what to do.
        store: folder of results; created if missing.
        context: workers (0 does the jobs in this process) and engine.
        progress: counts the jobs' weights.
        unit: what the weights count ("frames").
        attempts: how often to start a job whose worker dies; None is the engine's default.
        ended: called for every job of this run as it ends; if given, a job that fails does not end
            the run.

    Raises:
        InputError: an unknown job, a store in use by another run, or bad input to a job.
        SurgicaiError: a job failed, its worker died at every attempt, or its result is missing
            although the engine has ended.
    """
    by_key = {job.key(): job for job in jobs}
    with claim(store):
        missing = {key: job for key, job in by_key.items() if not (store / key).is_dir()}
        total = sum(job.weight for job in by_key.values())
        done = total - sum(job.weight for job in missing.values())
        progress(done, total, unit)
        root = store.resolve()
        tasks = {key: Task(job, job.kind.function, root / key) for key, job in missing.items()}
        endings = context.engine.execute(tasks, context.processes(), attempts)
        with closing(endings):  # workers end with it, whatever is raised here
            for key, error in _checked(endings, tasks, context.engine.name):
                if ended:
                    ended(by_key[key], store / key, error)
                elif error:
                    raise error
                done += by_key[key].weight
                progress(done, total, unit)
    return [store / job.key() for job in jobs]


def _checked(endings: Iterable[Ending], tasks: Mapping[str, Task], engine: str) -> Iterator[Ending]:
    """Yield an engine's endings, and an error for each task whose result is not in the store."""
    told: set[str] = set()
    for key, error in endings:
        told.add(key)
        yield key, error or _missing(tasks[key], engine)
    for key, task in tasks.items():
        if key not in told:
            yield key, _missing(task, engine)


def _missing(task: Task, engine: str) -> SurgicaiError | None:
    """Return the error of a task that an engine has done without a result; None if it has one."""
    if task.destination.is_dir():
        return None
    return SurgicaiError(
        f"The executor '{engine}' has done {task.job}, but {task.destination} is missing; its "
        "workers must share this folder, and it must yield the failure that `jobs.perform` returns."
    )


_claimed: set[Path] = set()
"""Stores that this process holds; nested claims are one claim."""


@contextmanager
def claim(store: Path) -> Iterator[None]:
    """Hold a store exclusively, and clear what a killed run left unfinished in it.

    Raises:
        InputError: another process holds it.
    """
    path = store.resolve()
    if path in _claimed:
        yield
        return
    path.mkdir(parents=True, exist_ok=True)
    refusal = InputError(f"Another run is working in {store}; wait for it or stop it first.")
    with locked(path / LOCK, refusal=refusal):
        for left in path.glob(f"{TEMPORARY}*"):
            shutil.rmtree(left, ignore_errors=True)
        _claimed.add(path)
        try:
            yield
        finally:
            _claimed.discard(path)


def work_folder(out: Path) -> Path:
    """Return the store in which `out` is built: next to it, on the same file system."""
    whole = out.absolute()
    return whole.with_name(f"{whole.name}.work")


@contextmanager
def building(out: Path) -> Iterator[tuple[Path, Path]]:
    """Build the folder `out` so that it appears whole, with the store of its jobs next to it.

    Yields the store, for `run`, and a path in it for the result, to be created with
    `files.whole_folder`. At the end the result becomes `out` by one rename and the store is
    removed; after an error or a kill the store stays, and the next run continues from it.

        with building(out) as (store, result):
            shards = run(jobs, store, context)
            with whole_folder(result) as folder: …

    Raises:
        InputError: nothing can be renamed to `out` (`files.check_renamed`).
        OutputExists: another run has made `out` since the caller looked.
    """
    check_renamed(out)
    store = work_folder(out)
    try:
        with claim(store):
            if out.exists() and any(out.iterdir()):
                raise OutputExists(f"Another run has made {out} meanwhile; run the command again.")
            result = store / "result"
            shutil.rmtree(result, ignore_errors=True)
            yield store, result
            os.rename(result, out)
            sync_folder(out.parent)
            shutil.rmtree(store)
    finally:
        if store.exists() and not any(store.iterdir()):
            store.rmdir()
