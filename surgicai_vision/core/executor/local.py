"""The local engine: spawned processes on this machine, or none.

Workers are spawned (a GL context cannot be shared by a fork) and each is on its own: one that dies
(killed, out of memory) is replaced, its job is tried again, and the others go on. A worker whose
parent died ends by itself.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, final

from surgicai_vision.core.errors import SurgicaiError
from surgicai_vision.core.executor.jobs import (
    WORKER_ENVIRONMENT,
    Job,
    JobKind,
    describe,
    failure_of,
    work,
)

ATTEMPTS = 2
"""How often a job is started whose worker dies, where the caller does not say."""
LEAVE_S = 10
"""Longest a dismissed worker may take to leave [s]."""


def execute(
    jobs: Mapping[str, Job],
    store: Path,
    workers: int,
    table: Mapping[str, JobKind],
    attempts: int | None = None,
) -> Generator[tuple[str, SurgicaiError | None]]:
    """Do `jobs` and yield each key as its result is committed, or with the error that the job ended
    in.
    """
    if not workers:
        for key, job in jobs.items():
            yield (
                key,
                failure_of(work(table[job.name].function, dict(job.arguments), store / key), job),
            )
        return
    queue, started = list(jobs), Counter[str]()
    crew: list[_Worker] = []
    try:
        while queue or any(worker.key for worker in crew):
            while queue and len([worker for worker in crew if worker.key]) < workers:
                key = queue.pop(0)
                started[key] += 1
                _free(crew).begin(
                    key, table[jobs[key].name].function, dict(jobs[key].arguments), store / key
                )
            for worker in _heard(crew):
                key = worker.key
                try:
                    yield key, failure_of(worker.result(), jobs[key])
                except EOFError:
                    crew.remove(worker)
                    if started[key] < (attempts or ATTEMPTS):
                        queue.insert(0, key)
                    else:
                        yield key, _died(jobs[key], started[key])
        for worker in crew:
            worker.dismiss()
    finally:
        for worker in crew:
            worker.end()


def _died(job: Job, times: int) -> SurgicaiError:
    return SurgicaiError(
        f"A worker died {times} times (killed, or out of memory) at: {describe(job)}. "
        "What is finished is kept: run the same command again, with fewer workers."
    )


def _free(crew: "list[_Worker]") -> "_Worker":
    """Return a worker without a job; a new one where there is none."""
    for worker in crew:
        if not worker.key:
            return worker
    crew.append(_Worker())
    return crew[-1]


def _heard(crew: "list[_Worker]") -> "list[_Worker]":
    """Wait until some of the busy workers are done or dead and return those."""
    ready = wait([worker.connection for worker in crew if worker.key])
    return [worker for worker in crew if worker.connection in ready]


@final
class _Worker:
    """A process that does one job after the other.

    Attributes:
        key: the job it is at; "" when it waits for one.
        connection: becomes readable when the job is done or the process dead.
    """

    def __init__(self) -> None:
        self.key = ""
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        with environment(WORKER_ENVIRONMENT):
            self._process = context.Process(target=_serve, args=(theirs, os.getpid()))
            self._process.start()
        theirs.close()  # theirs alone holds the other end now: it closes when the process dies

    def begin(self, key: str, function: str, arguments: dict[str, Any], destination: Path) -> None:
        """Hand it a job."""
        self.key = key
        with suppress(OSError):  # dead already: `result` says so
            self.connection.send((function, arguments, destination))

    def result(self) -> tuple[int, str, str] | None:
        """Return what the job reported and free the worker; `EOFError` where the process died."""
        try:
            reported: tuple[int, str, str] | None = self.connection.recv()
        except (OSError, EOFError):
            self.end()
            raise EOFError from None
        self.key = ""
        return reported

    def dismiss(self) -> None:
        """Let an idle process leave in order (it frees its GL context)."""
        self.connection.close()
        self._process.join(LEAVE_S)

    def end(self) -> None:
        """End the process at once; what it had not committed is lost."""
        self.connection.close()
        self._process.kill()
        self._process.join()


def _serve(connection: Connection, parent: int) -> None:
    """Do jobs until the connection ends: Ctrl-C is the parent's to handle, and without a parent
    there is no work.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    try:
        while True:
            connection.send(work(*connection.recv()))
    except (EOFError, OSError):
        return


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
