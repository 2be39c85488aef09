"""Retention: how much of its success a policy keeps under each shift, and in looks never seen.

`retentions(groups)` has one chart per task and policy with several axes. Its bars are the area
under the retention curve: the remaining success as a share of the plain one, averaged over the
strengths. The worst axis is on top. With each bar come the retention at the largest strength and
its interval. `looks(groups)` puts a policy's evaluation in looks for training next to the one in
held-out looks.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from markupsafe import Markup

from surgicai_vision.core import percentages
from surgicai_vision.core.config import RandomisationConfig
from surgicai_vision.core.tasks import task_names
from surgicai_vision.evaluation import statistics
from surgicai_vision.evaluation.robustness import SINGLE
from surgicai_vision.report import charts, text
from surgicai_vision.report.charts import Bar
from surgicai_vision.report.curves import Chart, evaluated, with_zero
from surgicai_vision.report.experiment_key import Condition, labels
from surgicai_vision.report.groups import Group
from surgicai_vision.report.reader import Result

Start = tuple[int, int]
"""Training seed and start seed of an episode."""


@dataclass(frozen=True)
class Kept:
    """What remains along one axis.

    Attributes:
        axis: the axis.
        area: area under the retention curve; None if there is no plain success to divide by.
        strength: the largest strength.
        plain: successes and episodes without the shift.
        shifted: the same at the largest strength.
        last: retention there, with its interval.
    """

    axis: str
    area: float | None
    strength: float
    plain: tuple[int, int]
    shifted: tuple[int, int]
    last: statistics.Retention


def retentions(groups: Sequence[Group]) -> list[Chart]:
    """Return a chart of bars for each task and policy that was shifted along several axes."""
    found = []
    for task in task_names():
        mine = [item for item in groups if evaluated(item, task) and not item.condition.expert_swap]
        axes = list(dict.fromkeys(item.condition.axis for item in mine if item.condition.axis))
        kept: dict[Condition, list[Kept]] = {}
        for axis in axes:
            along: dict[Condition, list[Group]] = {}
            for item in with_zero(mine, axis):
                along.setdefault(item.condition.unshifted, []).append(item)
            for base, items in along.items():
                one = _kept(axis, items)
                if one is not None:
                    kept.setdefault(base, []).append(one)
        label_of = labels(kept)
        found += [
            _chart(task, label_of[base], rows) for base, rows in kept.items() if len(rows) > 1
        ]
    return found


def _kept(axis: str, items: Sequence[Group]) -> Kept | None:
    """Return what remains along an axis; None without the plain evaluation or a shifted one."""
    ordered = sorted(items, key=lambda item: item.condition.strength)
    first, last = ordered[0], ordered[-1]
    if first.condition.strength > 0 or last is first:
        return None
    strengths = [item.condition.strength for item in ordered]
    area = statistics.area_under_curve(strengths, [item.rate for item in ordered])
    plain, shifted = _paired(_wins(first.results), _wins(last.results))
    return Kept(
        axis,
        area / first.rate if first.successes else None,
        last.condition.strength,
        (first.successes, first.episodes),
        (last.successes, last.episodes),
        statistics.retention(plain, shifted) if plain else statistics.Retention(None, None, None),
    )


def _wins(results: Sequence[Result]) -> dict[Start, bool]:
    """Return the success of every start."""
    return {
        (result.seed, int(row["seed"])): bool(row["success"])
        for result in results
        for row in result.rows
    }


def _paired(
    one: Mapping[Start, bool], other: Mapping[Start, bool]
) -> tuple[list[bool], list[bool]]:
    """Return the successes on the starts that both have."""
    common = [start for start in one if start in other]
    return [one[start] for start in common], [other[start] for start in common]


def _chart(task: str, label: str, rows: list[Kept]) -> Chart:
    """Draw the axes of one policy, the worst first."""
    rows = sorted(rows, key=lambda row: row.area or 0.0)
    bars = [
        Bar(row.axis.replace("_", " "), row.area or 0.0, _last(row), _words(row)) for row in rows
    ]
    title = f"{task}: {label}"
    return Chart(
        title,
        charts.bars(bars, f"{title}: area under the retention curve [%]"),
        Markup(""),
        ("axis", "area under retention", "plain", "at strength", "shifted", "kept there"),
        tuple(_row(row) for row in rows),
        _remark(rows),
    )


def _remark(rows: Sequence[Kept]) -> str:
    """Name the worst single axis of the rows, the worst first."""
    if all(row.area is None for row in rows):
        return "There is no plain success of which a share could be kept."
    for row in rows:
        if row.axis in SINGLE and row.area is not None:
            axis = row.axis.replace("_", " ")
            return f"Worst single axis: {axis}, {_share(row.area)} kept on average."
    return ""


def _last(row: Kept) -> tuple[float, float, float] | None:
    """Return the retention at the largest strength with its bounds."""
    last = row.last
    if last.ratio is None or last.low is None or last.high is None:
        return None
    return last.ratio, last.low, last.high


def _share(value: float | None) -> str:
    return text.ABSENT if value is None else percentages.percent(value)


def _words(row: Kept) -> str:
    """Return the numbers of one axis as a sentence."""
    return (
        f"{row.axis.replace('_', ' ')}: {_share(row.area)} of the plain success on average over "
        f"the strengths; {_kept_text(row)} at {row.strength:g}"
    )


def _kept_text(row: Kept) -> str:
    """Return the retention at the largest strength with its interval."""
    last = _last(row)
    return (
        text.ABSENT
        if last is None
        else f"{percentages.percent(last[0])} ({percentages.interval(last[1:])})"
    )


def _row(row: Kept) -> tuple[str, ...]:
    return (
        row.axis.replace("_", " "),
        _share(row.area),
        "{}/{}".format(*row.plain),
        f"{row.strength:g}",
        "{}/{}".format(*row.shifted),
        _kept_text(row),
    )


# -- looks -----------------------------------------------------------------------------------------


def looks(groups: Sequence[Group]) -> list[tuple[str, ...]]:
    """Return task, policy, counts in held-in and in held-out looks, and what is kept, as text.

    A policy has a row if it was evaluated in both; with several looks of either kind, a row for
    each two of them, which names them. The two evaluations may differ in where they are stored, the
    name of the condition and the looks; their worlds vary alike in all else.
    """
    seen: dict[tuple[Condition, str, RandomisationConfig], _ByLook] = {}
    for item in groups:
        if not (item.episodes and item.condition.plain and item.condition.trained):
            continue
        known = replace(item.condition, place="", name="", world="", recorded_in="")
        for result in item.results:
            axes = result.config.randomisation
            if axes.appearance or axes.shows_heldout:
                world = replace(axes, appearance="", appearance_shift=0.0)
                by_look = seen.setdefault((known, item.condition.learned_in, world), _ByLook())
                kind = by_look.held_out if axes.shows_heldout else by_look.held_in
                kind.setdefault(_look(axes), []).append(result)
    label_of = labels({known for known, _, _ in seen})
    rows: list[tuple[str, ...]] = []
    for (known, _, _), by_look in seen.items():
        pairs = list(itertools.product(by_look.held_in.items(), by_look.held_out.items()))
        for (one, seen_in), (other, seen_out) in pairs:
            held_in, held_out = _wins(seen_in), _wins(seen_out)
            counts = _count(held_in), _count(held_out), _ratio(held_in, held_out)
            looks_shown = f", {one} and {other}" if len(pairs) > 1 else ""
            rows.append((known.task, label_of[known] + looks_shown, *counts))
    return rows


@dataclass
class _ByLook:
    """Results of one policy: the looks (`_look`) of each kind → their results."""

    held_in: dict[str, list[Result]] = field(default_factory=dict)
    held_out: dict[str, list[Result]] = field(default_factory=dict)


def _look(axes: RandomisationConfig) -> str:
    """Return the looks that the episodes of an evaluation have, in words."""
    shifted = f"shifted by {axes.appearance_shift:g}" if axes.appearance_shift else ""
    return " ".join(filter(None, (axes.appearance, shifted)))


def _count(wins: Mapping[Start, bool]) -> str:
    """Return k/n with its interval."""
    won, all_ = sum(wins.values()), len(wins)
    return f"{won}/{all_} ({percentages.interval(statistics.clopper_pearson(won, all_))})"


def _ratio(held_in: Mapping[Start, bool], held_out: Mapping[Start, bool]) -> str:
    """Return the share that is kept on the starts that both have, with its interval."""
    one, other = _paired(held_in, held_out)
    kept = statistics.retention(one, other) if one else None
    if kept is None or kept.ratio is None or kept.low is None or kept.high is None:
        return text.ABSENT
    return f"{percentages.percent(kept.ratio)} ({percentages.interval((kept.low, kept.high))})"
