"""Engines: what runs jobs.

Another distribution adds its own through an entry point:

    class MyEngine(Engine):
        name = "mine"

        def execute(self, tasks, workers, attempts=None):
            for key, task in tasks.items():
                failure = task.do()
                yield key, failure.as_error(str(task.job)) if failure else None

    [project.entry-points."surgicai_vision.engines"]
    mine = "my_package:MyEngine"
"""

from abc import ABC, abstractmethod
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from typing import ClassVar

from surgicai_vision.core.errors import SurgicaiError
from surgicai_vision.core.executor.jobs import Job, Task

Ending = tuple[str, SurgicaiError | None]
"""A job's key, and the error that it ended in; None if its result is committed."""


@dataclass(frozen=True)
class Engine(ABC):
    """Runs jobs; it never affects their results.

    An engine is a frozen dataclass whose fields are its options. It calls `jobs.perform` for each
    task, in any process, which returns the failure of a job. It relies only on the store: a job
    whose folder is committed is done.

    Attributes:
        name: its key in the table.
    """

    name: ClassVar[str]

    @abstractmethod
    def execute(
        self, tasks: Mapping[str, Task], workers: int, attempts: int | None = None
    ) -> Generator[Ending]:
        """Do the tasks; yield each key as its result is committed, or with the job's error.

        The caller closes the generator; tasks that still run then are ended.

        Args:
            tasks: key → task.
            workers: how many run at once.
            attempts: how often to start a job whose worker dies; None is the engine's default.
        """


def lost(job: Job, times: int, why: str = "killed, or out of memory") -> SurgicaiError:
    """Return the error of a job whose worker died at every attempt."""
    return SurgicaiError(
        f"A worker died {times} times ({why}) at: {job}. "
        "What is finished is kept: run the same command again, with fewer workers."
    )
