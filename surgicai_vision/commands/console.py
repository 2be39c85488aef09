"""The console: results on stdout, progress on stderr."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, final

from cyclopts import Parameter

from surgicai_vision.core.progress import Progress, silent

if TYPE_CHECKING:
    from rich.console import OverflowMethod

TITLE_WIDTH = 38
"""Columns of a stage's title [characters], so that the bars of most stages are aligned."""


@final
@Parameter(parse=False)
class Console:
    """Where a command prints; every command with such a parameter gets one."""

    def say(self, text: str = "") -> None:
        """Print a line of the result."""
        print(text, flush=True)

    def note(self, text: str) -> None:
        """Print a line that is not part of the result."""
        from rich.console import Console as Rich

        Rich(stderr=True, highlight=False).print(text, markup=False, soft_wrap=True)

    @contextmanager
    def stage(self, title: str, unit: str = "", /) -> Iterator[Progress]:
        """Show a progress bar for one stage; yields the function that moves it."""
        from rich import progress as rich_progress
        from rich.console import Console as Rich
        from rich.text import Text

        # Where the line is too narrow, the title alone is cut: it may be narrower than its text.
        overflow: OverflowMethod = "ellipsis" if len(title) > TITLE_WIDTH else "crop"
        columns = (
            rich_progress.RenderableColumn(
                Text(title.ljust(TITLE_WIDTH), no_wrap=True, overflow=overflow)
            ),
            rich_progress.BarColumn(bar_width=20),
            rich_progress.MofNCompleteColumn(),
            rich_progress.TextColumn("{task.fields[unit]}"),
            rich_progress.TimeRemainingColumn(compact=True, elapsed_when_finished=True),
        )
        bars = rich_progress.Progress(*columns, console=Rich(stderr=True), refresh_per_second=4)
        bar = bars.add_task(title, total=None, unit=unit)

        def move(done: int, total: int, unit: str = unit, /) -> None:
            bars.start()  # on the first call only: wrong input found before any work shows no bar
            bars.update(bar, completed=done, total=total, unit=unit)

        try:
            yield move
        finally:
            if bars.live.is_started:
                bars.stop()


@final
class QuietConsole:
    """A console that shows nothing (tests and calls from Python)."""

    def say(self, text: str = "") -> None:
        """Drop the line."""

    def note(self, text: str) -> None:
        """Drop the line."""

    @contextmanager
    def stage(self, title: str, unit: str = "", /) -> Iterator[Progress]:
        """Yield a progress that shows nothing."""
        yield silent
