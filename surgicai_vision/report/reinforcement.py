"""Reinforcement and offline learning: tables 1 and 4 next to the paper's, and learning curves.

`learned(groups)` is None if no evaluation is of an actor (`train --algo`). It has one row per
algorithm, settings, number of demonstrations, world and bank of starts. Its cells are pooled counts
of all training seeds with their exact interval, next to the paper's number if its table has one
that is known here, and starts, world and rules are as in the paper. The
interquartile mean and the probability of improvement (`aggregates`) are taken over runs, one per
task and training seed. Learning curves are those of the `curve.json` next to a policy: on
validation starts, not on the held-out ones of the tables.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from markupsafe import Markup

from surgicai_vision.core import files, names, percentages
from surgicai_vision.core.errors import BadFile
from surgicai_vision.core.words import plural
from surgicai_vision.evaluation import statistics
from surgicai_vision.report import aggregates, charts, paper, text
from surgicai_vision.report.charts import Point, Series
from surgicai_vision.report.curves import MOST, Chart
from surgicai_vision.report.experiment_key import Condition, distinctions
from surgicai_vision.report.formats import escape_markdown
from surgicai_vision.report.groups import Group, starts_of
from surgicai_vision.report.reader import Result
from surgicai_vision.rl.algorithms import ALGORITHMS

CURVE = "curve.json"
POLICY = "policy"
"""Where a sweep keeps a run's policy, next to its evaluation."""
MARK = 0.95
"""Success rate; a table says when each seed first reaches it."""


@dataclass(frozen=True)
class Row:
    """One algorithm, with its settings and demonstrations.

    Attributes:
        algo: its name.
        settings: what is changed, what it sees, its demonstrations and what is unusual about its
            world and starts, in words.
        shared: those of them that all rows of the table share.
        groups: task → its evaluations.
    """

    algo: str
    settings: tuple[str, ...]
    shared: tuple[str, ...]
    groups: Mapping[str, Group]

    @property
    def label(self) -> str:
        """The algorithm with what distinguishes it from the other rows."""
        return ", ".join((self.algo, *(word for word in self.settings if word not in self.shared)))

    @property
    def is_as_published(self) -> bool:
        """Whether the paper's numbers are of the same starts, world and rules."""
        return all(item.condition.is_as_published for item in self.groups.values())

    def scores(self, tasks: Sequence[str]) -> list[list[float]]:
        """Return the success rate of each training seed on each task."""
        return [
            [
                float(np.mean([row["success"] for row in result.rows]))
                for result in self.groups[task].results
            ]
            for task in tasks
        ]

    @cached_property
    def aggregate(self) -> tuple[float, tuple[float, float], int, int]:
        """Interquartile mean over its runs, the interval, and the numbers of runs and tasks."""
        scores = self.scores(list(self.groups))
        generator = np.random.default_rng(0)
        bounds = aggregates.bootstrap(aggregates.interquartile_mean, [scores], generator)
        runs = sum(map(len, scores))
        return aggregates.interquartile_mean(scores), bounds, runs, len(scores)


@dataclass(frozen=True)
class Learned:
    """What a page says about learning.

    Attributes:
        starts: what the starts of its counts are, in words.
        tasks: columns of the table.
        head: headings of the columns.
        rows: its rows, as text.
        shared: settings and demonstrations of every row, in words.
        better: rows of the probability that the best method beats another, as text.
        best: that method.
        curves: success during training against control steps, and against minutes, per task.
    """

    starts: str
    tasks: tuple[str, ...]
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    shared: tuple[str, ...]
    better: tuple[tuple[str, ...], ...]
    best: str
    curves: tuple[Chart, ...]


def learned(groups: Sequence[Group]) -> Learned | None:
    """Return the tables and curves of all evaluations of actors; None without any."""
    rows = table(groups)
    if not rows:
        return None
    tasks = tuple(task for task in names.SUBTASKS if any(task in row.groups for row in rows))
    best = max(rows, key=lambda row: (len(row.groups), row.aggregate[0]))
    return Learned(
        starts_of([item for row in rows for item in row.groups.values()]),
        tasks,
        ("algorithm", *tasks, "interquartile mean"),
        tuple(_cells(row, tasks) for row in rows),
        rows[0].shared,
        tuple(_better(best, row) for row in rows if row is not best),
        best.label,
        tuple(_curves(rows, tasks)),
    )


def table(groups: Sequence[Group]) -> list[Row]:
    """Return the algorithms that have results, in the order of SurgicAI's tables."""
    found: dict[Condition, dict[str, Group]] = {}
    for item in groups:
        condition = item.condition
        # Cloning from images is also called "bc"; an actor's run names its algorithm.
        is_actor = any(result.run.algo for result in item.results) and condition.plain
        is_actor = is_actor and condition.trained_by in ALGORITHMS
        if item.episodes and is_actor and condition.task in names.SUBTASKS and not condition.place:
            found.setdefault(replace(condition, task=""), {})[condition.task] = item
    settings = _settings(found)
    order = list(ALGORITHMS)
    keys = sorted(found, key=lambda key: (order.index(key.trained_by), settings[key]))
    every = [settings[key] for key in keys]
    shared = tuple(word for word in every[0] if all(word in each for each in every)) if keys else ()
    return [Row(key.trained_by, settings[key], shared, found[key]) for key in keys]


def _settings(conditions: Collection[Condition]) -> dict[Condition, tuple[str, ...]]:
    """Return the settings of each condition, in words; see `Row`."""
    without_count = {key: replace(key, demonstrations=None) for key in conditions}
    details = distinctions(without_count.values())
    found = {}
    for key in conditions:
        words = list(key.changes)
        words += [key.encoder] if key.encoder != "relative" else []
        words += [f"{key.demonstrations} demonstrations"] if key.demonstrations else []
        words += [*key.amounts, *key.surroundings, details[without_count[key]]]
        found[key] = tuple(filter(None, words))
    return found


def _cells(row: Row, tasks: Sequence[str]) -> tuple[str, ...]:
    """Return a row of the table as text."""
    cells = []
    for task in tasks:
        theirs = paper.LEARNED.get(row.algo, {}).get(task) if row.is_as_published else None
        beside = f"; paper {percentages.percent(theirs)}" if theirs is not None else ""
        item = row.groups.get(task)
        if item is None:
            cells.append(text.ABSENT + beside)
            continue
        seeds = f", {plural(len(item.results), 'seed')}"
        count = f"{item.successes}/{item.episodes}{seeds}"
        cells.append(f"{count} ({percentages.interval(item.interval)}){beside}")
    mean, bounds, runs, of_tasks = row.aggregate
    middle = f"{mean:.2f} ({bounds[0]:.2f}–{bounds[1]:.2f}); {plural(runs, 'run')}"
    return (row.label, *cells, f"{middle}, {plural(of_tasks, 'task')}")


def _better(best: Row, other: Row) -> tuple[str, ...]:
    """Return the probability that the best method beats another on the tasks that both have."""
    tasks = [task for task in best.groups if task in other.groups]
    if not tasks:
        return other.label, text.ABSENT, "no task in common"
    scores = [best.scores(tasks), other.scores(tasks)]
    value = aggregates.probability_of_improvement(*scores)
    generator = np.random.default_rng(0)
    low, high = aggregates.bootstrap(aggregates.probability_of_improvement, scores, generator)
    return other.label, f"{value:.2f} ({low:.2f}–{high:.2f})", ", ".join(tasks)


# -- learning curves -------------------------------------------------------------------------------


@dataclass(frozen=True)
class CurvePoint:
    """One evaluation during training: the part of `rl.train.Point` that is drawn."""

    env_steps: int
    updates: int
    minutes: float
    successes: int
    episodes: int


Axis = Callable[[CurvePoint], float]
"""Where an evaluation is on a chart's x axis."""


def read_curve(result: Result) -> list[CurvePoint]:
    """Return the evaluations during the training of a result's policy; empty if none were kept."""
    places = [result.folder.parent / POLICY]
    places += [Path(str(result.about["folder"]))] if result.about.get("folder") else []
    for place in places:
        if not (place / CURVE).is_file():
            continue
        try:
            stored = files.read_json(place / CURVE)
            fields = CurvePoint.__dataclass_fields__
            points = [CurvePoint(**{name: row[name] for name in fields}) for row in stored]
        except (BadFile, KeyError, TypeError):
            continue
        return [point for point in points if point.episodes]
    return []


def first_at(mark: float, curve: Sequence[CurvePoint]) -> CurvePoint | None:
    """Return the first evaluation with a success rate of at least `mark`, or None."""
    for point in curve:
        if point.successes >= mark * point.episodes:
            return point
    return None


def _curves(rows: Sequence[Row], tasks: Sequence[str]) -> list[Chart]:
    """Return a chart against control steps and one against minutes for each task."""
    axes: tuple[tuple[str, Axis], ...] = (
        ("control steps, thousands", lambda point: point.env_steps / 1000),
        ("CPU minutes of learning", lambda point: round(point.minutes, 2)),
    )
    found = []
    for task in tasks:
        by_label = {
            row.label: [read_curve(result) for result in row.groups[task].results]
            if task in row.groups
            else []
            for row in rows
        }
        for x_name, x in axes:
            # A line without points keeps its colour: an algorithm has the same on the whole page.
            lines = [Series(label, _points(curves, x)) for label, curves in by_label.items()]
            if any(line.points for line in lines):
                found.append(_chart(f"{task}: {x_name}", lines, x_name, x, by_label))
    return found


def _points(curves: Sequence[Sequence[CurvePoint]], x: Axis) -> tuple[Point, ...]:
    """Return the evaluations of all seeds, the n-th of each pooled.

    A seed that has ended counts with its last one, at the x of the others, but never before an
    earlier point: slow seeds that end first must not turn the line back. What does not move along
    the axis is not a curve and has no points: a single evaluation, or offline learning against
    control steps.
    """
    found: list[Point] = []
    for index in range(max(map(len, curves), default=0)):
        here = [curve[min(index, len(curve) - 1)] for curve in curves if curve]
        won = sum(point.successes for point in here)
        of = sum(point.episodes for point in here)
        bounds = statistics.clopper_pearson(won, of)
        where = float(np.mean([x(curve[index]) for curve in curves if index < len(curve)]))
        where = max(where, found[-1].x) if found else where
        words = f"{won}/{of} ({percentages.interval(bounds)}) at {where:.3g}"
        found.append(Point(where, won / of, *bounds, words))
    return tuple(found) if len({point.x for point in found}) > 1 else ()


def _chart(
    title: str,
    lines: Sequence[Series],
    x_name: str,
    x: Axis,
    by_label: Mapping[str, Sequence[Sequence[CurvePoint]]],
) -> Chart:
    """Draw learning curves; the table has where each seed first reaches `MARK`."""
    drawn = lines[:MOST]
    more = len([line for line in lines[MOST:] if line.points])
    has_points = any(line.points for line in drawn)
    label = f"{title}: success [%] on validation starts"
    rows = []
    for line in (line for line in lines if line.points):
        firsts = [first_at(MARK, curve) for curve in by_label[line.name]]
        reached = ", ".join("never" if first is None else f"{x(first):.3g}" for first in firsts)
        rows.append((line.name, line.points[-1].text, reached))
    return Chart(
        title,
        charts.curves(drawn, x_name, label=label) if has_points else Markup(""),
        charts.key(drawn),
        ("algorithm", "last evaluation of each seed", f"first at {percentages.percent(MARK)}"),
        tuple(rows),
        f"{more} more in the table." if more else "",
    )


# -- Markdown --------------------------------------------------------------------------------------


def markdown(found: Learned) -> str:
    """Return the tables as Markdown, for a page of results."""
    parts = [
        f"Success from {found.starts}: k/n over all training seeds (exact 95 % interval); paper: "
        f"{paper.LEARNED_SOURCE}. Interquartile mean over runs with its bootstrap interval.",
        *([f"Every row: {', '.join(found.shared)}."] if found.shared else []),
        "",
        *_rows(found.head, found.rows),
    ]
    if found.better:
        head = ("against", "probability of improvement", "tasks")
        parts += [f"Probability that a run of {found.best} beats a run of another algorithm:", ""]
        parts += _rows(head, found.better)
    for chart in found.curves:
        parts += [f"{chart.title} (validation starts)", "", *_rows(chart.head, chart.rows)]
    return "\n".join(parts).rstrip() + "\n"


def _rows(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a Markdown table and an empty line."""
    lines = [f"| {' | '.join(map(escape_markdown, row))} |" for row in (head, *rows)]
    return [lines[0], "|" + "---|" * len(head), *lines[1:], ""]
