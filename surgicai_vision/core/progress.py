"""Progress: how work reports its progress."""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


class Progress(Protocol):
    """Reports progress: `progress(done, total)` or `progress(done, total, unit)`."""

    def __call__(self, done: int, total: int, unit: str = ..., /) -> None:
        """Show how much is done."""


class Stage(Protocol):
    """Opens the display of one stage: `with stage("training", "steps") as progress: …`."""

    def __call__(self, title: str, unit: str = ..., /) -> AbstractContextManager[Progress]:
        """Return the stage's display; it ends with the block."""


def silent(done: int, total: int, unit: str = "", /) -> None:
    """Show nothing."""


@contextmanager
def silent_stage(title: str, unit: str = "", /) -> Iterator[Progress]:
    """Yield a progress that shows nothing."""
    yield silent


@contextmanager
def timed(stage: Stage, seconds: dict[str, float]) -> Iterator[Stage]:
    """Yield a stage that adds its time [s] to `seconds`, by the first part of its title."""

    @contextmanager
    def measured(title: str, unit: str = "", /) -> Iterator[Progress]:
        started = time.monotonic()
        with stage(title, unit) as progress:
            yield progress
        name = title.split(":")[0]
        seconds[name] = seconds.get(name, 0.0) + time.monotonic() - started

    yield measured
