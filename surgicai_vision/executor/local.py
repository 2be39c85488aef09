"""The local engine: spawned processes on this machine, or none.

Workers are spawned (a GL context cannot be shared by a fork). A worker that dies (killed, out of memory) is replaced
and its job tried once more. A worker whose parent died ends by itself.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from surgicai_vision.errors import SurgicaiError
from surgicai_vision.executor.jobs import WORKER_ENVIRONMENT, Job, JobKind, describe, raise_failure, work

ATTEMPTS = 2
"""How often a job is started whose worker dies."""


def execute(jobs: Mapping[str, Job], store: Path, workers: int, table: Mapping[str, JobKind]) -> Iterator[str]:
    """Do `jobs` and yield their keys as they are committed."""
    if not workers:
        for key, job in jobs.items():
            raise_failure(work(table[job.name].function, dict(job.arguments), store / key), job)
            yield key
        return
    waiting, attempts = dict(jobs), Counter[str]()
    while waiting:
        try:
            yield from _pool_run(waiting, attempts, store, workers, table)
        except BrokenProcessPool:
            failed = [key for key in waiting if attempts[key] >= ATTEMPTS]
            if failed:
                names = "; ".join(describe(waiting[key]) for key in failed)
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
    with environment(WORKER_ENVIRONMENT):
        pool = ProcessPoolExecutor(
            min(workers, len(queue)), multiprocessing.get_context("spawn"), _start_worker, (os.getpid(),)
        )
        try:
            while queue or running:
                # No more in flight than there are workers, so a dead worker's job is known.
                while queue and len(running) < workers:
                    key = queue.pop(0)
                    job, attempts[key] = waiting[key], attempts[key] + 1
                    running[pool.submit(work, table[job.name].function, dict(job.arguments), store / key)] = key
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    raise_failure(future.result(), waiting[running[future]])
                    key = running.pop(future)
                    del waiting[key]
                    yield key
            pool.shutdown()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in set(multiprocessing.active_children()) - others:
                child.kill()


@contextmanager
def environment(values: Mapping[str, str]) -> Iterator[None]:
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
