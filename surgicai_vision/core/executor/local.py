"""The local engine: spawned processes on this machine, or none.

Workers are independent: one that dies (killed, out of memory) is replaced, its job is tried again,
and the others continue.
"""

from collections import Counter
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import ClassVar, cast, final

from surgicai_vision.core.executor.engine import Ending, Engine, lost
from surgicai_vision.core.executor.jobs import Task, perform
from surgicai_vision.core.processes import OFFLINE, ONE_THREAD, Died, Done, Failure, Worker

ATTEMPTS = 2
"""How often to start a job whose worker dies, unless the caller says."""

VARIABLES: Mapping[str, str] = {**ONE_THREAD, **OFFLINE}
"""Environment of a worker: one core, and no network, since a job needs only its inputs."""


@final
@dataclass(frozen=True)
class LocalEngine(Engine):
    """Processes of this machine."""

    name: ClassVar[str] = "local"

    def execute(
        self, tasks: Mapping[str, Task], workers: int, attempts: int | None = None
    ) -> Generator[Ending]:
        """Do the tasks in `workers` processes; 0 does them in this one."""
        if not workers:
            for key, task in tasks.items():
                failure = task.do()
                yield key, failure.as_error(str(task.job)) if failure else None
            return
        crew = _Crew(tasks, workers, attempts or ATTEMPTS)
        try:
            yield from crew.work()
            crew.dismiss()
        finally:
            crew.end()


LOCAL = LocalEngine()


@final
class _Crew:
    """The workers of a run, and the queue that they work through."""

    def __init__(self, tasks: Mapping[str, Task], workers: int, attempts: int):
        self._tasks = tasks
        self._workers = workers
        self._attempts = attempts
        self._queue = list(tasks)
        self._started = Counter[str]()
        self._idle: list[Worker] = []
        self._busy: dict[Worker, str] = {}

    def work(self) -> Generator[Ending]:
        """Work through the queue."""
        while self._queue or self._busy:
            while self._queue and len(self._busy) < self._workers:
                self._begin(self._queue.pop(0))
            ready = wait([worker.connection for worker in self._busy])
            for worker in [worker for worker in self._busy if worker.connection in ready]:
                yield from self._hear(worker)

    def dismiss(self) -> None:
        """Let the idle workers exit cleanly."""
        for worker in self._idle:
            worker.dismiss()

    def end(self) -> None:
        """End all workers at once; what they had not committed is lost."""
        for worker in [*self._idle, *self._busy]:
            worker.end()

    def _begin(self, key: str) -> None:
        """Hand a task to an idle worker, or to a new one if none is idle."""
        task = self._tasks[key]
        worker = self._idle.pop() if self._idle else Worker(VARIABLES)
        self._busy[worker] = key
        self._started[key] += 1
        worker.call(perform, task.function, dict(task.job.arguments), str(task.destination))

    def _hear(self, worker: Worker) -> Generator[Ending]:
        """Receive a worker's message; drop a worker that died and try its job again."""
        key = self._busy[worker]
        job = self._tasks[key].job
        try:
            answer = worker.receive()
        except Died:
            del self._busy[worker]
            worker.end()
            if self._started[key] < self._attempts:
                self._queue.insert(0, key)
            else:
                yield key, lost(job, self._started[key])
            return
        if answer is None:
            return
        del self._busy[worker]
        self._idle.append(worker)
        failure = cast(Failure | None, answer.value) if isinstance(answer, Done) else answer
        yield key, failure.as_error(str(job)) if failure else None
