"""Curves: success against demonstrations, training and shift strength, and over the procedure."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from markupsafe import Markup

from surgicai_vision.core import names, percentages
from surgicai_vision.core.tasks import task_names
from surgicai_vision.evaluation import statistics
from surgicai_vision.report import charts, text
from surgicai_vision.report.charts import Point, Series
from surgicai_vision.report.experiment_key import Condition, labels
from surgicai_vision.report.groups import Group

MOST = len(charts.COLOURS)
"""Most series in one drawing; any further ones are only in the table."""


@dataclass(frozen=True)
class Chart:
    """A drawing with its title, legend and the numbers behind it."""

    title: str
    drawing: Markup
    key: Markup
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    more: str = ""


def data_curves(groups: Sequence[Group]) -> list[Chart]:
    """Return success against the number of demonstrations, one chart per task with several."""
    return _curves_along(
        [item for item in groups if item.condition.demonstrations],
        lambda item: float(item.condition.demonstrations or 0),
        lambda item: replace(item.condition, demonstrations=None),
        "demonstrations",
        logarithmic=True,
    )


def budget_curves(groups: Sequence[Group]) -> list[Chart]:
    """Return success against the minutes of training, one chart per task with several budgets."""
    return _curves_along(
        [item for item in groups if item.condition.minutes],
        lambda item: item.condition.minutes or 0.0,
        lambda item: item.condition.without_budget,
        "minutes of one core",
    )


def _curves_along(
    groups: Sequence[Group],
    x: Callable[[Group], float],
    same: Callable[[Group], Condition],
    x_name: str,
    *,
    logarithmic: bool = False,
) -> list[Chart]:
    """Return a chart for each task in which plain evaluations differ in `x` and nothing else."""
    found = []
    for task in task_names():
        mine = [item for item in groups if evaluated(item, task) and item.condition.plain]
        lines = _series(_by_condition(mine, same), x)
        if lines:
            found.append(_chart(task, lines, x_name, logarithmic=logarithmic))
    return found


def robustness_curves(groups: Sequence[Group]) -> list[Chart]:
    """Return success against the strength of each shift, with the area under the curve.

    There is one chart per task and axis.
    """
    found = []
    for task in task_names():
        mine = [
            item
            for item in groups
            if evaluated(item, task) and not (item.condition.expert_swap or item.condition.upset)
        ]
        for axis in dict.fromkeys(item.condition.axis for item in mine if item.condition.axis):
            members = _by_condition(with_zero(mine, axis), lambda item: item.condition.unshifted)
            lines = _series(members, lambda item: item.condition.strength)
            if lines:
                areas = {base: _area(members[base]) for base in lines}
                title = f"{task}: {axis.replace('_', ' ')}"
                found.append(_chart(title, lines, "strength", extra=("area (interval)", areas)))
    return found


def with_zero(groups: Sequence[Group], axis: str) -> list[Group]:
    """Return the evaluations of one axis.

    An evaluation without a shift serves as strength 0 if none was made at that strength.
    """
    of_axis = [item for item in groups if item.condition.axis == axis]
    lacking = {item.condition.unshifted for item in of_axis} - {
        item.condition.unshifted for item in of_axis if item.condition.strength == 0
    }
    return [*(item for item in groups if item.condition in lacking), *of_axis]


def _area(items: Sequence[Group]) -> str:
    """Return the area under a curve, with an interval if every strength had the same starts.

    The area is linear in the successes: the mean of the starts' own areas is the curve's area.
    """
    ordered = sorted(items, key=lambda item: item.condition.strength)
    strengths = [item.condition.strength for item in ordered]
    if len(set(strengths)) < 2:
        return text.ABSENT
    wins = [
        {(r.seed, row["seed"]): float(row["success"]) for r in item.results for row in r.rows}
        for item in ordered
    ]
    area = statistics.area_under_curve(strengths, [item.rate for item in ordered])
    if any(each.keys() != wins[0].keys() for each in wins):
        return f"{area:.2f}"
    own = [
        statistics.area_under_curve(strengths, [each[start] for each in wins]) for start in wins[0]
    ]
    low, high = statistics.area_interval(own)
    return f"{area:.2f} ({low:.2f}–{high:.2f})"


def _by_condition(
    groups: Sequence[Group], same: Callable[[Group], Condition]
) -> dict[Condition, list[Group]]:
    """Collect the groups that are the `same` except for the x of the curve."""
    found: dict[Condition, list[Group]] = {}
    for item in groups:
        found.setdefault(same(item), []).append(item)
    return found


def _series(
    members: dict[Condition, list[Group]], x: Callable[[Group], float]
) -> dict[Condition, Series]:
    """Join groups into lines, by what is the same along each; a single point is not a curve."""
    label_of = labels(members)
    found = {}
    for condition, items in members.items():
        points = tuple(_point(x(item), item) for item in sorted(items, key=x))
        if len({point.x for point in points}) > 1:
            found[condition] = Series(label_of[condition], points)
    return found


def _point(x: float, item: Group) -> Point:
    count = f"{item.successes}/{item.episodes}"
    return Point(
        x,
        item.rate,
        *item.interval,
        f"{count}, {percentages.percent(item.rate)} ({percentages.interval(item.interval)})",
    )


def _chart(
    title: str,
    series: Mapping[Condition, Series],
    x_name: str,
    *,
    logarithmic: bool = False,
    extra: tuple[str, Mapping[Condition, str]] | None = None,
) -> Chart:
    """Draw lines, with the numbers of each and, in a column of its own, an extra one."""
    lines = list(series.values())
    xs = sorted({point.x for line in lines for point in line.points})
    rows = []
    for condition, line in series.items():
        known = {point.x: point.text for point in line.points}
        rows.append(
            (
                line.name,
                *(known.get(x, text.ABSENT) for x in xs),
                *((extra[1][condition],) if extra else ()),
            )
        )
    drawn = lines[:MOST]
    more = f"{len(lines) - MOST} more in the table." if len(lines) > MOST else ""
    drawing = charts.curves(
        drawn, x_name, logarithmic=logarithmic, label=f"{title}: success [%] against {x_name}"
    )
    head = ("policy", *(f"{x:g}" for x in xs), *((extra[0],) if extra else ()))
    return Chart(title, drawing, charts.key(drawn), head, tuple(rows), more)


def procedure(groups: Sequence[Group]) -> Chart | None:
    """Return how many episodes of the whole procedure finished each subtask and all before it."""
    lines = []
    rows = []
    for item in groups:
        if not evaluated(item, names.SUTURE, trained=False):
            continue
        stages = [int(row.get("stages") or 0) for row in item.rows]
        counts = [sum(stage > index for stage in stages) for index in range(len(names.SUBTASKS))]
        bounds = [statistics.clopper_pearson(count, item.episodes) for count in counts]
        texts = [
            f"{count}/{item.episodes} ({percentages.interval(b)})"
            for count, b in zip(counts, bounds, strict=True)
        ]
        points = [
            Point(index + 1, count / item.episodes, *b, words)
            for index, (count, b, words) in enumerate(zip(counts, bounds, texts, strict=True))
        ]
        lines.append(Series(item.label, tuple(points)))
        rows.append((item.label, *texts))
    if not lines:
        return None
    drawn = lines[:MOST]
    ticks = {float(index + 1): name for index, name in enumerate(names.SUBTASKS)}
    drawing = charts.curves(
        drawn, "finished, with all before it", label="progress in the procedure", ticks=ticks
    )
    more = f"{len(lines) - MOST} more in the table." if len(lines) > MOST else ""
    key = charts.key(drawn)
    return Chart("", drawing, key, ("policy", *names.SUBTASKS), tuple(rows), more)


def evaluated(item: Group, task: str, trained: bool = True) -> bool:
    """Return True for an evaluation of a task; with `trained`, only for one of a trained policy."""
    return bool(
        item.episodes and item.condition.task == task and (item.condition.trained or not trained)
    )
