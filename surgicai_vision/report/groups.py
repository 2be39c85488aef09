"""Groups: the cells that differ only in their training seed, pooled.

Episodes of all cells together: k/n with the exact (Clopper–Pearson) interval. Over several training
seeds: mean ± standard deviation of the cells' rates, and a hierarchical bootstrap interval
(training seeds, then episodes).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from surgicai_vision.core import percentages
from surgicai_vision.evaluation import statistics
from surgicai_vision.evaluation.metrics import KINDS, is_measured
from surgicai_vision.report import text
from surgicai_vision.report.experiment_key import Condition, distinctions, order
from surgicai_vision.report.reader import Collected, Missing, Result

MEASURES = (
    ("d_trans_mm", "position error", "mm", "distance to the goal when the episode ends"),
    ("d_angle_deg", "angle error", "°", "angle to the goal when the episode ends"),
    ("entry_mm", "entry error", "mm", "from the entry's mark to where the needle went in"),
    ("exit_mm", "exit error", "mm", "from the exit's mark to where the needle came out"),
    ("bite_depth_mm", "bite depth", "mm", "of the tip's path below the line from entry to exit"),
    ("bite_length_mm", "bite length", "mm", "straight line from entry to exit"),
    ("entry_deg", "entry angle", "°", "between the needle and the skin's normal where it went in"),
    ("exit_deg", "exit angle", "°", "between the needle and the skin's normal where it came out"),
    ("slip_mm", "needle slip", "mm", "largest slip of the needle in the grip, if it was held"),
    ("slip_deg", "needle slip", "°", "largest turn of the needle in the grip, if it was held"),
    (
        "tissue_force_n",
        "tissue force",
        "N",
        "largest force of needle and instruments on the tissue",
    ),
    ("tissue_impulse_ns", "force × time", "N s", "force on the tissue, summed over the episode"),
    ("tears", "tears", "count", "how often soft tissue tore"),
    ("thread_mm", "thread drawn", "mm", "thread that came out of the exit behind the needle"),
    ("false_ends", "false ends", "count", "subtasks ended before their success was measured"),
    ("end_delay_s", "end delay", "s", "median time from a subtask's measured success to its end"),
)
"""Columns of an episode's row that hold measurements: name, what, unit, explanation."""


@dataclass(frozen=True)
class Across:
    """A rate over training seeds: mean, standard deviation and hierarchical bootstrap interval."""

    seeds: int
    mean: float
    std: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class Group:
    """One condition: its evaluations, one per training seed, and its cells without one."""

    condition: Condition
    results: tuple[Result, ...] = ()
    missing: tuple[Missing, ...] = ()
    details: str = ""
    """What distinguishes it from another condition of its task with the same label, or ""."""

    @property
    def label(self) -> str:
        """The condition with everything that distinguishes it from others of its task."""
        return ", ".join(filter(None, (self.condition.label, self.details)))

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """The episodes of every training seed."""
        return [row for result in self.results for row in result.rows]

    @property
    def successes(self) -> int:
        """Number of episodes that succeeded, k."""
        return sum(bool(row["success"]) for row in self.rows)

    @property
    def paper_successes(self) -> int | None:
        """Episodes successful by the paper's own criterion; None if version 0.1 evaluated them."""
        found = [row.get("paper_success") for row in self.rows]
        return None if None in found else sum(bool(value) for value in found)

    @property
    def episodes(self) -> int:
        """Number of episodes, n; 0 if nothing was evaluated."""
        return len(self.rows)

    @property
    def rate(self) -> float:
        """Success rate k/n."""
        return self.successes / self.episodes

    @cached_property
    def interval(self) -> tuple[float, float]:
        """Exact 95 % interval of the pooled episodes."""
        return statistics.clopper_pearson(self.successes, self.episodes)

    @cached_property
    def across(self) -> Across | None:
        """The rate over training seeds; None with fewer than two."""
        if len(self.results) < 2:
            return None
        groups = [[float(row["success"]) for row in result.rows] for result in self.results]
        rates = [float(np.mean(group)) for group in groups]
        spread = statistics.mean_and_std(rates)
        bounds = statistics.hierarchical_bootstrap(groups, np.random.default_rng(0))
        assert spread["mean"] is not None and spread["std"] is not None
        return Across(len(rates), spread["mean"], spread["std"], bounds)

    @property
    def failures(self) -> dict[str, int]:
        """Failures by kind, in the order of `KINDS`; kinds this version does not know come last."""
        found = [row["failure"] for row in self.rows if not row["success"]]
        known = [*KINDS, *sorted(set(found) - set(KINDS))]
        return {kind: found.count(kind) for kind in known if kind in found}

    def values(self, column: str) -> list[float | None]:
        """Return a column over all episodes; None where there was nothing to measure."""
        return [measured(row, column) for row in self.rows]

    def on_successes(self, column: str) -> dict[str, float | None]:
        """Return mean and deviation of a column over successful episodes."""
        return statistics.mean_and_std([float(row[column]) for row in self.rows if row["success"]])

    def across_text(self) -> str:
        """Return "31.0 ± 4.2 % (22–40 %); by seed 28, 34", or a dash for one training seed.

        Seeds with different numbers of episodes are given as "2/5, 14/20".
        """
        if self.across is None:
            return text.ABSENT
        mean = 100 * self.across.mean
        std = 100 * self.across.std
        won = [sum(bool(row["success"]) for row in result.rows) for result in self.results]
        of = [len(result.rows) for result in self.results]
        counts = [f"{k}/{n}" if len(set(of)) > 1 else str(k) for k, n in zip(won, of, strict=True)]
        by_seed = ", ".join(counts)
        bounds = percentages.interval(self.across.interval)
        return f"{mean:.1f} ± {std:.1f} % ({bounds}); by seed {by_seed}"


def measured(row: Mapping[str, Any], column: str) -> float | None:
    """Return a value of an episode; None if it could not be measured."""
    return row.get(column) if is_measured(row["failure"], column) else None


def group(collected: Collected) -> list[Group]:
    """Return one group for each condition, in the order of the results."""
    conditions = {result.condition for result in collected.results}
    conditions |= {cell.condition for cell in collected.missing}
    details = distinctions(conditions)
    return [
        Group(
            condition,
            tuple(result for result in collected.results if result.condition == condition),
            tuple(cell for cell in collected.missing if cell.condition == condition),
            details[condition],
        )
        for condition in sorted(conditions, key=order)
    ]


def of_task(groups: Sequence[Group], task: str, *, plain: bool = True) -> list[Group]:
    """Return the groups of a task.

    With `plain`, only those without a shift, an expert swap or an upset.
    """
    return [
        item
        for item in groups
        if item.condition.task == task and (item.condition.plain or not plain)
    ]


def best_trained(groups: Sequence[Group]) -> Group | None:
    """Return the trained policy with the highest success rate (the first of them), or None."""
    trained = [item for item in as_trained(groups) if item.condition.trained]
    return max(trained, key=lambda item: item.rate, default=None)


def as_trained(groups: Sequence[Group]) -> list[Group]:
    """Return the evaluations without a shift, on held-out starts.

    If there are none without a shift, return those at strength 0, each once and without its axis,
    else all. If none of these is on held-out starts, return those on others.
    """
    evaluated = [item for item in groups if item.episodes]
    plain = [item for item in evaluated if item.condition.plain]
    unshifted: dict[Condition, Group] = {}
    for item in evaluated:
        if not item.condition.strength:
            condition = item.condition.unshifted
            unshifted.setdefault(condition, replace(item, condition=condition))
    shown = plain or list(unshifted.values()) or evaluated
    return [item for item in shown if item.condition.is_held_out] or shown


def starts_of(groups: Sequence[Group]) -> str:
    """Say what the starts are: "held-out starts", or "starts" if they are from several banks."""
    banks = {item.condition.starts for item in groups}
    return f"{banks.pop()} starts" if len(banks) == 1 else "starts"
