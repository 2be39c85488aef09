"""Comparison with the paper: which of our conditions goes with which number of its Table 2."""

from collections.abc import Sequence
from dataclasses import replace

from surgicai_vision.core import percentages
from surgicai_vision.core.tasks import task_names
from surgicai_vision.report import paper
from surgicai_vision.report.experiment_key import Condition
from surgicai_vision.report.groups import Group

_TELLING = tuple(name for name in paper.ENCODERS if name != "random")
_DEMONSTRATIONS = 50
"""Demonstrations of each subtask in the released code."""


def beside_paper(
    groups: Sequence[Group],
) -> list[tuple[str, str, list[tuple[float | None, Group | None]]]]:
    """Return the paper's Table 2 and ours: (task, encoder, [(its rate, our condition) per view]).

    The paper's encoders come first in each task, then those that only we have. Rates are None where
    the paper has none. The list is empty if we have none of the paper's pretrained encoders. Of
    several numbers of demonstrations, the one nearest to the paper's is used, and of several
    evaluations the one with most episodes.
    """
    known = [item for item in groups if _comparable(item.condition)]
    if not any(item.condition.encoder in _TELLING for item in known):
        return []
    known.sort(
        key=lambda item: (
            -abs((item.condition.demonstrations or 0) - _DEMONSTRATIONS),
            item.episodes,
        )
    )
    ours = {(c.task, c.encoder, c.view): item for item in known if (c := item.condition)}
    tasks = [task for task in task_names() if any(task == mine for mine, _, _ in ours)]
    others = sorted({encoder for _, encoder, _ in ours} - set(paper.ENCODERS))
    rows = []
    for task in tasks:
        for encoder in (*paper.ENCODERS, *others):
            in_paper = paper.has(task, encoder)
            pairs = [
                (
                    paper.rate(task, encoder, view) if in_paper else None,
                    ours.get((task, encoder, view)),
                )
                for view in paper.VIEWS
            ]
            if any(rate is not None or item is not None for rate, item in pairs):
                rows.append((task, encoder, pairs))
    return rows


def paper_text(task: str, encoder: str, rate: float | None) -> str:
    """Return the paper's rate as text, or why there is none."""
    if rate is not None:
        return percentages.percent(rate)
    return "not reported" if paper.has(task, encoder) else "not in the paper"


def our_text(item: Group | None) -> str:
    """Return our count and interval, or why there is none."""
    if item is None:
        return "not in this sweep"
    if item.episodes:
        return f"{item.successes}/{item.episodes} ({percentages.interval(item.interval)})"
    return item.missing[0].state


def paper_rate(condition: Condition) -> float | None:
    """Return the paper's rate of the same task, encoder and single view, or None."""
    if not _comparable(condition) or not paper.has(condition.task, condition.encoder):
        return None
    return paper.rate(condition.task, condition.encoder, condition.views[0])


def _comparable(condition: Condition) -> bool:
    """Return True if it is comparable to a number in the paper's Table 2.

    It has one of the two views, and everything else is as usual.
    """
    variant = replace(condition, place="").variant
    usual = condition.trained and condition.plain and not variant
    return usual and len(condition.views) == 1 and condition.views[0] in paper.VIEWS
