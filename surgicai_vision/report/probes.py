"""Probing: each encoder's linear probe next to the success of the policies that use it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from surgicai_vision.core import percentages
from surgicai_vision.core.words import plural
from surgicai_vision.evaluation import statistics
from surgicai_vision.report import charts, text
from surgicai_vision.report.charts import Point, Series
from surgicai_vision.report.curves import MOST, Chart
from surgicai_vision.report.experiment_key import Condition
from surgicai_vision.report.groups import Group

FEWEST = 4
"""Minimum number of pairs for reporting a correlation."""
ALL = "all"
"""Task of a probe that names none."""


@dataclass(frozen=True)
class ProbeRow:
    """A probe as the page's table shows it.

    Attributes:
        task: the probe's task, or `ALL`.
        encoder: the encoder's name.
        view: the views.
        tip_mm: error of the needle's tip [mm], as text.
        tip_rest: that error's interval and the mean pose's error, or "".
        tip_sort: what the column is sorted by.
        angle_deg: error of the needle's angle [deg], as text.
        angle_rest: that error's interval and the mean pose's error, or "".
        angle_sort: what the column is sorted by.
        n: episodes of the probe.
        success: successes of the policies that use the encoder, as "k/n".
        rate: their rate, as text.
        point: the rate at the tip's error, if there are both.
    """

    task: str
    encoder: str
    view: str
    tip_mm: str
    tip_rest: str
    tip_sort: float | str
    angle_deg: str
    angle_rest: str
    angle_sort: float | str
    n: int | str
    success: str
    rate: str
    point: Point | None


@dataclass(frozen=True)
class Probes:
    """Probe errors next to success: a table, a chart, and how the two correlate."""

    rows: tuple[ProbeRow, ...]
    chart: Chart | None
    correlation: str


def probes(found: Sequence[Mapping[str, Any]], groups: Sequence[Group]) -> Probes | None:
    """Pair each probe with the success of the policies with its encoder, view, pool and task.

    Only held-out starts count.
    """
    if not found:
        return None
    rows = tuple(_row(probe, [item for item in groups if _matches(probe, item)]) for probe in found)
    pairs = [(row, row.point) for row in rows if row.point is not None]
    return Probes(rows, _chart(pairs), _correlations(pairs))


def _row(probe: Mapping[str, Any], mine: Sequence[Group]) -> ProbeRow:
    """Return one probe with the pooled success of its policies."""
    won = _wins(mine)
    k, n = sum(won.values()), len(won)
    tip, angle = (text.finite([probe.get(name)]) for name in ("tip_mm", "angle_deg"))
    encoder = str(probe.get("encoder"))
    view = _view(probe)
    point = None
    if n and tip:
        low, high = statistics.clopper_pearson(k, n)
        point = Point(tip[0], k / n, low, high, f"{view}: {tip[0]:.1f} mm, {k}/{n}")
    return ProbeRow(
        task=probe.get("task") or ALL,
        encoder=encoder,
        view=view,
        tip_mm=_number(tip),
        tip_rest=_rest(probe, "tip_mm"),
        tip_sort=tip[0] if tip else "",
        angle_deg=_number(angle),
        angle_rest=_rest(probe, "angle_deg"),
        angle_sort=angle[0] if angle else "",
        n=probe.get("n", text.ABSENT),
        success=f"{k}/{n}" if n else text.ABSENT,
        rate=percentages.percent(k / n) if n else "",
        point=point,
    )


def _wins(groups: Sequence[Group]) -> dict[tuple[Condition, int, int], bool]:
    """Return the success of each condition, training seed and start.

    A policy that was evaluated twice on a start counts once, with the later one in the table.
    """
    return {
        (replace(item.condition, place=""), result.seed, int(row["seed"])): bool(row["success"])
        for item in groups
        for result in item.results
        for row in result.rows
    }


def _matches(probe: Mapping[str, Any], item: Group) -> bool:
    condition = item.condition
    if not (item.episodes and condition.trained and condition.plain and condition.is_held_out):
        return False
    if probe.get("task") and probe["task"] != condition.task:
        return False
    pooled = condition.pool == (probe.get("pool") or "global")
    return pooled and probe.get("encoder") == condition.encoder and _view(probe) == condition.view


def _view(probe: Mapping[str, Any]) -> str:
    view = probe.get("view") or ()
    views = view.replace("+", ",").split(",") if isinstance(view, str) else view
    return " + ".join(str(name).strip() for name in views)


def _number(known: Sequence[float]) -> str:
    return f"{known[0]:.2f}" if known else text.ABSENT


def _rest(probe: Mapping[str, Any], name: str) -> str:
    """Return the interval and the mean pose's error, if the probe has them."""
    known = text.finite([probe.get(f"{name}_{part}") for part in ("low", "high", "chance")])
    return f"({known[0]:.2f}–{known[1]:.2f}; {known[2]:.2f})" if len(known) == 3 else ""


def _chart(pairs: Sequence[tuple[ProbeRow, Point]]) -> Chart | None:
    """Draw success against the probe's tip error, one marker per encoder."""
    if len(pairs) < 2 or len({point.x for _, point in pairs}) < 2:
        return None
    encoders = list(dict.fromkeys(row.encoder for row, _ in pairs))[:MOST]
    lines = [
        Series(name, tuple(point for row, point in pairs if row.encoder == name))
        for name in encoders
    ]
    ticks = {point.x: f"{point.x:.1f}" for line in lines for point in line.points}
    name = "error of the needle's tip in the probe [mm]"
    drawing = charts.curves(
        lines, name, label=f"success [%] against {name}", ticks=ticks, joined=False
    )
    return Chart("Success [%] against the probe", drawing, charts.key(lines), (), ())


def _correlations(pairs: Sequence[tuple[ProbeRow, Point]]) -> str:
    """Describe Spearman's rank correlation of tip error and success for each task."""
    parts = []
    for task in dict.fromkeys(row.task for row, _ in pairs):
        mine = [(point.x, point.rate) for row, point in pairs if row.task == task]
        parts.append(f"{'all tasks' if task == ALL else task}: {_correlation(mine)}")
    if not parts:
        return "No policy uses a probed encoder, so there is nothing to correlate."
    return (
        f"Spearman's rank correlation of tip error and success: {'; '.join(parts)}. "
        "Below 0, a better probe goes with more successes."
    )


def _correlation(pairs: Sequence[tuple[float, float]]) -> str:
    if len(pairs) < FEWEST:
        return f"{plural(len(pairs), 'pair')}, too few"
    errors, rates = np.array(pairs).T
    if len(set(errors)) == 1 or len(set(rates)) == 1:
        return f"{len(pairs)} pairs, all equal in one of the two"
    from scipy.stats import spearmanr

    found = spearmanr(errors, rates)
    return (
        f"{found.statistic:.2f} over {len(pairs)} pairs (p"
        f" {text.probability(float(found.pvalue), '= ')})"
    )
