"""Progress: how long work tells how far it is."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

Stage = Callable[[str, str], AbstractContextManager[Callable[..., None]]]
"""stage(title, unit) is a context that yields progress(done, total): a bar on the console, or
nothing.
"""


@contextmanager
def timed(stage: Stage, seconds: dict[str, float]) -> Iterator[Stage]:
    """Yield a `stage` that adds each stage's time to `seconds`, by the first word of its title
    [s].
    """

    @contextmanager
    def measured(title: str, unit: str) -> Iterator[Callable[..., None]]:
        started = time.monotonic()
        with stage(title, unit) as progress:
            yield progress
        name = title.split(":")[0]
        seconds[name] = seconds.get(name, 0.0) + time.monotonic() - started

    yield measured
