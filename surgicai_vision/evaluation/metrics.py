"""Metrics: the record of one episode, and the summary of many.

`docs/evaluation.md` explains every column.

All lengths, angles and forces are read from the measured physical state, never from a command.
"""

import dataclasses
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from surgicai_vision.core import names
from surgicai_vision.evaluation.statistics import clopper_pearson, mean_and_std

if TYPE_CHECKING:
    from surgicai_vision.envs.visits import Visit

KINDS = ("missed", "dropped", "wrong_hole", "time", "physics", "error")
"""Kinds of failure, see `failure_kind`, in the order in which charts stack them."""

ON_SUCCESSES = (("trajectory_length_mm", "trajectory_length_mm"), ("time_steps", "steps"))
"""Key of a summary → column it averages over the successes."""
MEASURED = (
    "d_trans_mm",
    "d_angle_deg",
    "entry_mm",
    "exit_mm",
    "bite_depth_mm",
    "bite_length_mm",
    "entry_deg",
    "exit_deg",
    "slip_mm",
    "slip_deg",
    "tissue_force_n",
    "tissue_impulse_ns",
    "tears",
    "thread_mm",
    "false_ends",
    "end_delay_s",
)
"""Columns that a summary gives as mean, deviation and median, over all episodes that have them."""


@dataclass(frozen=True)
class EpisodeMetrics:
    """One episode.

    Attributes:
        task: one of `tasks.task_names()`.
        policy: name of the policy in tables.
        seed: seed of the start.
        success: whether the task succeeded; never with an error.
        steps: control steps of 20 ms taken.
        trajectory_length_mm: path of the measured active tip, Σ‖Δxyz‖ [mm].
        d_trans_mm: last distance to the goal [mm]; NaN where nothing was measured.
        d_angle_deg: last angle to the goal [deg].
        contact: whether the active jaws touched the needle at the end.
        error: what aborted the episode, or "".
        grasp: grasp level of the scene.
        failure: "" for a success, else one of `KINDS`.
        stages: subtasks of the whole procedure that succeeded in order; 1 for the success of a
            single subtask.
        entry_mm: distance from the entry's mark to where the tip went in [mm]; NaN where it did
            not.
        exit_mm: distance from the exit's mark to where it came out [mm].
        slip_mm: the needle's largest shift in the active jaws since they took it [mm].
        slip_deg: the needle's largest rotation there [deg].
        tissue_force_n: largest net force of needle and instruments on the tissue [N].
        bite_depth_mm: how deep the tip went under the straight line from entry to exit [mm].
        bite_length_mm: straight distance from entry to exit [mm].
        entry_deg: angle of the needle to the skin's normal where the tip went in [deg].
        exit_deg: the same where it came out.
        tissue_impulse_ns: the force on the tissue summed over time [N s].
        tears: how often the tissue tore; NaN where it cannot.
        thread_mm: thread drawn out of the exit [mm]; NaN without a thread.
        paper_success: whether the paper's own success criterion was met.
        upset: what went wrong, one of `envs.upset.KINDS`; "" where nothing did.
        upset_step: control steps taken when it went wrong; -1 where nothing did.
        recovered: something went wrong, and the task still succeeded.
        false_ends: subtasks of the whole procedure that were ended before their success was
            measured (`envs.visits`); NaN for another task.
        end_delay_s: median time from a subtask's measured success to its end [s]; NaN where no
            subtask was ended after its success.
    """

    task: str
    policy: str
    seed: int
    success: bool
    steps: int
    trajectory_length_mm: float
    d_trans_mm: float
    d_angle_deg: float
    contact: bool
    error: str
    grasp: str
    failure: str
    stages: int = 0
    entry_mm: float = math.nan
    exit_mm: float = math.nan
    slip_mm: float = 0.0
    slip_deg: float = 0.0
    tissue_force_n: float = 0.0
    bite_depth_mm: float = math.nan
    bite_length_mm: float = math.nan
    entry_deg: float = math.nan
    exit_deg: float = math.nan
    tissue_impulse_ns: float = 0.0
    tears: float = math.nan
    thread_mm: float = math.nan
    paper_success: bool = False
    upset: str = ""
    upset_step: int = -1
    recovered: bool = False
    false_ends: float = math.nan
    end_delay_s: float = math.nan


def failure_kind(error: str, diverged: bool, touched: bool, wrong_hole: bool, held: bool) -> str:
    """Name why an episode failed: the first kind that applies.

    Args:
        error: what aborted the episode, or "".
        diverged: whether the physics aborted it: "physics"; any other error: "error".
        touched: whether the active jaws ever touched the needle; if not: "missed".
        wrong_hole: the needle went through another opening than the stitch's, and stayed wrong:
            "wrong_hole".
        held: whether either arm held the needle at the end: "time" if one did, else "dropped".
    """
    if error:
        return "physics" if diverged else "error"
    if not touched:
        return "missed"
    if wrong_hole:
        return "wrong_hole"
    return "time" if held else "dropped"


def summary(rows: Sequence[EpisodeMetrics]) -> dict[str, Any]:
    """Return the summary of one policy on one task.

    Trajectory length and steps are averaged over the successful episodes. Each measured column is
    summarised by mean, deviation and median over all episodes that have it ("n" of them).
    """
    first, successes = rows[0], [row for row in rows if row.success]
    failures = [row.failure for row in rows if not row.success]
    return {
        "task": first.task,
        "policy": first.policy,
        "episodes": len(rows),
        "successes": len(successes),
        "success_rate": len(successes) / len(rows),
        "ci95": list(clopper_pearson(len(successes), len(rows))),
        "paper_successes": sum(row.paper_success for row in rows),
        **{key: mean_and_std(_finite(successes, column)) for key, column in ON_SUCCESSES},
        **{column: _spread(_finite(_having(rows, column), column)) for column in MEASURED},
        "grasp": first.grasp,
        "errors": sum(1 for row in rows if row.error),
        "failures": {kind: failures.count(kind) for kind in KINDS if kind in failures},
        "first_seed": min(row.seed for row in rows),
        **(
            {"reached": _reached(rows), "subtasks": subtask_successes(rows)}
            if first.task == names.SUTURE
            else {}
        ),
        **({"upsets": upset_recoveries(rows)} if any(row.upset for row in rows) else {}),
    }


def measured_ends(visits: "Sequence[Visit]") -> list[dict[str, Any]]:
    """Return for each subtask how often it was ended, how often falsely, and how late.

    Args:
        visits: of all episodes of one policy.
    """
    rows = []
    for index, subtask in enumerate(names.SUBTASKS):
        ends = [visit for visit in visits if visit.subtask == index and visit.is_end]
        delays = [visit.delay for visit in ends if visit.delay is not None]
        rows.append(
            {
                "subtask": subtask,
                "ends": len(ends),
                "false_ends": sum(visit.is_false_end for visit in ends),
                "median_delay_s": _median(delays),
            }
        )
    return rows


def subtask_successes(rows: Sequence[EpisodeMetrics]) -> list[dict[str, Any]]:
    """Return for each subtask how many episodes finished it and all before it.

    k of n, with the exact interval.
    """
    stages = []
    for subtask, k in _reached(rows).items():
        low, high = clopper_pearson(k, len(rows))
        stages.append({"subtask": subtask, "k": k, "n": len(rows), "low": low, "high": high})
    return stages


def upset_recoveries(rows: Sequence[EpisodeMetrics]) -> dict[str, dict[str, Any]]:
    """Return each kind of upset that happened: k of n recovered, with the exact interval."""
    found = {}
    for kind in sorted({row.upset for row in rows} - {""}):
        mine = [row for row in rows if row.upset == kind]
        k = sum(row.recovered for row in mine)
        low, high = clopper_pearson(k, len(mine))
        found[kind] = {"k": k, "n": len(mine), "low": low, "high": high}
    return found


def _reached(rows: Sequence[EpisodeMetrics]) -> dict[str, int]:
    """Return how many episodes finished each subtask and all before it."""
    return {
        subtask: sum(row.stages > index for row in rows)
        for index, subtask in enumerate(names.SUBTASKS)
    }


def is_measured(failure: str, column: str) -> bool:
    """Return True unless nothing could be measured: a needle never held has no slip, not 0 mm.

    Args:
        failure: of the episode, "" for a success.
        column: a field of `EpisodeMetrics`.
    """
    return not (column.startswith("slip") and failure == "missed")


def _having(rows: Sequence[EpisodeMetrics], column: str) -> list[EpisodeMetrics]:
    """Return the episodes in which a column could be measured."""
    return [row for row in rows if is_measured(row.failure, column)]


def _finite(rows: Sequence[EpisodeMetrics], column: str) -> list[float]:
    values = [float(getattr(row, column)) for row in rows]
    return [value for value in values if math.isfinite(value)]


def _spread(values: list[float]) -> dict[str, float | None]:
    return {**mean_and_std(values), "median": _median(values), "n": len(values)}


def _median(values: Sequence[float]) -> float | None:
    return statistics.median(values) if values else None


def as_table(rows: Sequence[EpisodeMetrics]) -> list[dict[str, Any]]:
    """Return rows as plain data."""
    return [dataclasses.asdict(row) for row in rows]
