"""The Slurm engine: jobs as batch jobs of a cluster, submitted by submitit.

The nodes must see the store and this Python environment under the same paths. Up to `workers` jobs
are submitted at a time, each with one core. One that is killed, preempted or over its time is
submitted again; its result is committed by one rename, so a job that ran twice has one result. An
interrupted run cancels its jobs. A killed run cannot; the next run finds what they committed.
"""

import importlib.util
import shutil
import time
from collections import Counter
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, final

from surgicai_vision.core.errors import InputError, SurgicaiError, check_name
from surgicai_vision.core.executor.engine import Ending, Engine, lost
from surgicai_vision.core.executor.jobs import Task, perform
from surgicai_vision.core.executor.local import VARIABLES
from surgicai_vision.core.processes import Failure, environment

if TYPE_CHECKING:
    import submitit

ATTEMPTS = 3
"""How often to submit a job that ends without a result, unless the caller says."""

POLL_S = 0.5
"""Interval between looks at the store [s]; submitit asks Slurm itself far less often."""

GRACE_S = 15.0
"""Longest time a network file system may take to show the result of a job that ended [s]."""

CLUSTERS = ("slurm", "local", "debug")

SUBMISSIONS = ".submitit"
"""Folder in the store: what submitit writes for each job, its output included."""


@final
@dataclass(frozen=True)
class SlurmEngine(Engine):
    """Batch jobs of Slurm.

    Attributes:
        partition: where the jobs run; None is the cluster's default.
        account: account to charge; None is the user's default.
        minutes: time limit of a job [min].
        memory_gb: memory of a job [GB]; None is the cluster's default.
        gpus: GPUs of a job.
        cluster: "slurm"; "local" runs each job as a process and "debug" in this process, to try
            the engine on a machine without Slurm.
    """

    name: ClassVar[str] = "slurm"
    partition: str | None = None
    account: str | None = None
    minutes: int = 240
    memory_gb: float | None = None
    gpus: int = 0
    cluster: str = "slurm"

    def __post_init__(self) -> None:
        check_name("cluster", self.cluster, CLUSTERS)
        if self.minutes < 1 or self.gpus < 0:
            raise InputError(
                f"minutes is {self.minutes} and gpus {self.gpus}; "
                "allowed: at least 1 and at least 0."
            )
        if importlib.util.find_spec("submitit") is None:
            raise InputError(
                "--executor slurm needs submitit, which is not installed: "
                "`pip install 'surgicai-vision[slurm]'`, or leave it out."
            )

    def execute(
        self, tasks: Mapping[str, Task], workers: int, attempts: int | None = None
    ) -> Generator[Ending]:
        """Do the tasks, `workers` at a time."""
        if not tasks:
            return
        store = next(iter(tasks.values())).destination.parent
        queue = _Queue(tasks, self._executor(store), max(1, workers), attempts or ATTEMPTS)
        try:
            yield from queue.work()
            if not queue.lost:  # else the message names an output file in it
                shutil.rmtree(store / SUBMISSIONS, ignore_errors=True)
        finally:
            queue.cancel()

    def _executor(self, store: Path) -> "submitit.AutoExecutor":
        """Return submitit's executor with the options of this engine."""
        import submitit

        try:
            executor = submitit.AutoExecutor(store / SUBMISSIONS, cluster=self.cluster)
        except RuntimeError as error:
            raise InputError(
                f"--executor slurm: {error} Run it where `sbatch` works, such as a login node."
            ) from None
        executor.update_parameters(
            name="surgicai-vision",
            timeout_min=self.minutes,
            cpus_per_task=1,
            gpus_per_node=self.gpus or None,
            mem_gb=self.memory_gb,
            slurm_partition=self.partition,
            slurm_account=self.account,
        )
        return executor


@final
class _Queue:
    """The jobs of a run: those still to be submitted and those on the cluster.

    Attributes:
        lost: whether a job ended without a result at every attempt.
    """

    def __init__(
        self,
        tasks: Mapping[str, Task],
        executor: "submitit.AutoExecutor",
        most: int,
        attempts: int,
    ):
        self.lost = False
        self._tasks = tasks
        self._executor = executor
        self._most = most
        self._attempts = attempts
        self._queue = list(tasks)
        self._submitted = Counter[str]()
        self._running: dict[str, submitit.Job[Failure | None]] = {}
        self._over: dict[str, float] = {}

    def work(self) -> Generator[Ending]:
        """Submit and wait until every job has ended."""
        while self._queue or self._running:
            while self._queue and len(self._running) < self._most:
                self._submit(self._queue.pop(0))
            endings = [ending for key in list(self._running) for ending in self._look(key)]
            yield from endings
            if not endings and self._running:
                time.sleep(POLL_S)

    def cancel(self) -> None:
        """Cancel the jobs that are still on the cluster."""
        for job in self._running.values():
            job.cancel(check=False)

    def _submit(self, key: str) -> None:
        task = self._tasks[key]
        with environment(VARIABLES):  # sbatch hands its own environment to the job
            self._running[key] = self._executor.submit(
                perform, task.function, dict(task.job.arguments), str(task.destination)
            )
        self._submitted[key] += 1

    def _look(self, key: str) -> Generator[Ending]:
        """Yield a job that has ended; resubmit one that ended without a result."""
        task = self._tasks[key]
        job = self._running[key]
        over = job.done()
        if task.destination.is_dir():
            del self._running[key]
            yield key, None
        elif over and self._has_answered(job):
            del self._running[key]
            yield key, _error(job, task)
        elif over and time.monotonic() - self._over.setdefault(key, time.monotonic()) >= GRACE_S:
            del self._running[key]
            del self._over[key]
            if self._submitted[key] < self._attempts:
                self._queue.insert(0, key)
            else:
                self.lost = True
                why = f"{job.state.lower()}; its output is in {job.paths.stderr}"
                yield key, lost(task.job, self._submitted[key], why)

    def _has_answered(self, job: "submitit.Job[Failure | None]") -> bool:
        return self._executor.cluster == "debug" or job.paths.result_pickle.exists()


def _error(job: "submitit.Job[Failure | None]", task: Task) -> SurgicaiError | None:
    """Return the error of a job that has answered; None if it succeeded."""
    broken = job.exception()
    if broken is not None:  # it failed before our function was called
        error = SurgicaiError(
            f"{task.job} could not be started; its output is in {job.paths.stderr}"
        )
        error.add_note(str(broken))
        return error
    failure = job.result()
    return failure.as_error(str(task.job)) if failure else None
