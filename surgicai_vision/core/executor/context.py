"""What a run works with, passed along as one value."""

import os
from dataclasses import dataclass
from typing import final

from surgicai_vision.core.errors import InputError
from surgicai_vision.core.executor.engine import Engine
from surgicai_vision.core.executor.local import LOCAL, LocalEngine
from surgicai_vision.core.progress import Stage, silent_stage


@final
@dataclass(frozen=True)
class RunContext:
    """What a run works with: it changes how long the run takes, never its results.

    Attributes:
        workers: processes at a time; 0 works in this process, None takes one per core.
        engine: what runs the jobs.
        stage: opens the display of each stage.
    """

    workers: int | None = None
    engine: Engine = LOCAL
    stage: Stage = silent_stage

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 0:
            raise InputError(f"workers is {self.workers}; it must be 0 (this process) or more.")

    def processes(self, most: int | None = None) -> int:
        """Return how many processes to start; there is work for `most` of them."""
        count = len(os.sched_getaffinity(0)) if self.workers is None else self.workers
        return count if most is None else min(count, most)

    def processes_each(self, jobs: int) -> int:
        """Return how many processes one of `jobs` jobs may use, so that no core is idle.

        Another engine's workers are elsewhere; there a job has one.
        """
        if not isinstance(self.engine, LocalEngine):
            return 1
        return max(1, self.processes() // max(1, jobs))
