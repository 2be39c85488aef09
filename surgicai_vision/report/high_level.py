"""High-level policies: what each got right and wrong on the frames held out from its training."""

from collections.abc import Iterable
from dataclasses import dataclass

from surgicai_vision.core import names, percentages
from surgicai_vision.core.config import from_mapping
from surgicai_vision.core.words import plural
from surgicai_vision.report import charts
from surgicai_vision.report.reader import Result
from surgicai_vision.training.checkpoint import StageErrors


@dataclass(frozen=True)
class ConfusionCell:
    """Frames in which one subtask was due and one subtask was named.

    Attributes:
        share: share of the row's frames, as text [%]; "" if there are none.
        frames: how many frames.
        back: background colour.
        front: colour of the text.
    """

    share: str
    frames: int
    back: str
    front: str


@dataclass(frozen=True)
class HighLevel:
    """A high-level policy as the page shows it.

    Attributes:
        label: the hierarchical policies that it decides in, and their training seeds.
        rows: each subtask that was due, and which ones were named.
        text: the numbers in words.
    """

    label: str
    rows: tuple[tuple[str, tuple[ConfusionCell, ...]], ...]
    text: str


def high_level_policies(results: Iterable[Result]) -> list[HighLevel]:
    """Return every high-level policy that decided in an evaluation and has known errors, once."""
    deciding: dict[str, list[Result]] = {}
    for result in results:
        if result.high_level:
            deciding.setdefault(result.high_level["policy_sha256"], []).append(result)
    return [_shown(mine) for mine in deciding.values()]


def _shown(results: list[Result]) -> HighLevel:
    first = results[0]
    errors = from_mapping(StageErrors, first.high_level["stage_errors"], str(first.folder))
    labels = dict.fromkeys(f"{one.condition.policy}, seed {one.seed}" for one in results)
    said = [
        f"{errors.right} of {plural(errors.frames, 'frame')} predicted correctly "
        f"({percentages.percent(errors.right / errors.frames)})",
        f"calibration error {errors.calibration_error:.3f}",
    ]
    if errors.progress_error is not None:
        said.append(f"mean absolute error of the progress {errors.progress_error:.3f}")
    rows = tuple(zip(names.SUBTASKS, map(_row, errors.confusion), strict=True))
    return HighLevel("; ".join(labels), rows, "; ".join(said))


def _row(counts: tuple[int, ...]) -> tuple[ConfusionCell, ...]:
    total = max(sum(counts), 1)
    cells = []
    for count in counts:
        back, front = charts.heat(count / total)
        share = f"{100 * count / total:.0f}" if count else ""
        cells.append(ConfusionCell(share, count, back, front))
    return tuple(cells)
