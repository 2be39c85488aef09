"""Reader: a results folder → evaluations, and the runs that have none with the reason why.

A run's condition is all that it is but the training seed and the starts (`experiment_key`).
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

from surgicai_vision.core import files
from surgicai_vision.core.config import TaskConfig, from_mapping
from surgicai_vision.core.errors import BadFile
from surgicai_vision.evaluation.storage import (
    FAILED_FILE,
    GRID_FILE,
    RUN_FILE,
    find_evaluations,
    read_evaluation,
    read_rows,
    read_versioned,
)
from surgicai_vision.report.experiment_key import Condition, condition_of, order
from surgicai_vision.training.run_config import REFERENCES, RunConfig

__all__ = ["REFERENCES", "Collected", "Missing", "PlannedRun", "Result", "collect", "read_results"]

WORK = "work"
"""Folder of a sweep in which its jobs are at work."""
PROBES = ("probes.parquet", "probe.json")

FAILED, NOT_RUN, PENDING, TO_DO = "failed", "not run", "pending", "to do"


@dataclass(frozen=True)
class Result:
    """One stored evaluation.

    Attributes:
        folder: where it is.
        run: what was evaluated.
        summary: its counts.
        about: how it was made.
        rows: its episodes.
        place: where it stands, if another evaluation of the same condition and training seed
            stands elsewhere.
    """

    folder: Path
    run: RunConfig
    summary: dict[str, Any]
    about: dict[str, Any]
    rows: list[dict[str, Any]]
    place: str = ""

    @property
    def trained(self) -> bool:
        """Whether a trained policy was evaluated."""
        return self.run.is_trained

    @property
    def config(self) -> TaskConfig:
        """The task it was evaluated on."""
        return self.run.env

    @property
    def checkpoint(self) -> dict[str, Any]:
        """Hashes of the policy evaluated; empty for a reference."""
        found: dict[str, Any] = self.about.get("checkpoint") or {}
        return found

    @property
    def high_level(self) -> dict[str, Any]:
        """Hash and errors of the high-level policy that decided; empty where none was counted."""
        found: dict[str, Any] = self.about.get("high_level") or {}
        return found

    @property
    def seed(self) -> int:
        """The training seed."""
        return self.run.seed

    @cached_property
    def condition(self) -> Condition:
        """What it is an evaluation of."""
        return condition_of(self.run, self.place)


@dataclass(frozen=True)
class Missing:
    """A run without an evaluation: failed, not run, or pending, with the reason."""

    condition: Condition
    seed: int
    state: str
    reason: str
    key: str = ""


class PlannedRun(Protocol):
    """A run of a sweep and its state, as `experiments.sweep.plan` tells it."""

    @property
    def run(self) -> RunConfig:
        """The run."""

    @property
    def key(self) -> str:
        """Its folder's name."""

    @property
    def state(self) -> str:
        """One of `plan.STATES`."""

    @property
    def reason(self) -> str:
        """Why it is not run."""


@dataclass(frozen=True)
class Collected:
    """Everything a report is made of."""

    folder: Path
    results: list[Result]
    missing: list[Missing]
    run: dict[str, Any]
    probes: list[dict[str, Any]]

    @property
    def notes(self) -> list[str]:
        """What went wrong beside the runs."""
        return [str(line) for line in self.run.get("problems", [])]


def collect(folder: Path, planned: Sequence[PlannedRun] = ()) -> Collected:
    """Read the results below `folder`.

    Args:
        folder: results of quickstart, evaluate, robustness or sweep.
        planned: the runs of a sweep; those without a result or a record are reported as pending
            or not run.

    Raises:
        BadFile: neither an evaluation nor a run that failed or was not run, or results of another
            version.
    """
    run = read_versioned(folder / RUN_FILE) if (folder / RUN_FILE).exists() else {}
    results = read_results(folder, empty=True)
    missing = _missing(folder, run, planned, results)
    if not results and not missing:
        raise BadFile(
            f"{folder} holds no evaluation; "
            f"run `surgicai-vision evaluate POLICY --out {folder}` first."
        )
    return Collected(folder, results, missing, run, read_probes(folder))


def read_results(folder: Path, empty: bool = False) -> list[Result]:
    """Read all evaluations below `folder`; trained policies first.

    Raises:
        BadFile: there is none, unless `empty`, or another version wrote it.
    """
    results = []
    work = folder / WORK if (folder / GRID_FILE).exists() else None  # what is not filed yet
    for place in find_evaluations(folder):
        if work not in place.parents:
            stored = read_evaluation(place)
            results.append(
                Result(place, stored.run, stored.summary, stored.about, read_rows(place))
            )
    if not results and not empty:
        raise BadFile(
            f"{folder} holds no evaluation; "
            f"run `surgicai-vision evaluate POLICY --out {folder}` first."
        )
    return sorted(
        _told_apart(_once(results), folder),
        key=lambda result: (*order(result.condition), result.seed),
    )


def _once(results: Sequence[Result]) -> list[Result]:
    """Leave out a reference whose episodes are among those of another.

    Several sweeps evaluate the same expert.
    """
    kept: list[Result] = []
    references = [result for result in results if not result.trained]
    for result in sorted(references, key=lambda result: -len(result.rows)):
        same = [
            other
            for other in kept
            if other.condition == result.condition and other.config == result.config
        ]
        if not any(_outcomes(result) <= _outcomes(other) for other in same):
            kept.append(result)
    return [result for result in results if result.trained or result in kept]


def _outcomes(result: Result) -> set[tuple[int, bool, int]]:
    return {(row["seed"], row["success"], row["steps"]) for row in result.rows}


def _told_apart(results: Sequence[Result], folder: Path) -> list[Result]:
    """Name evaluations of the same condition and training seed by their folders.

    Counted together they would count twice.
    """
    count = Counter((result.condition, result.seed) for result in results)
    return [
        replace(result, place=str(result.folder.relative_to(folder)))
        if count[result.condition, result.seed] > 1
        else result
        for result in results
    ]


def read_probes(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of every probe below `folder`."""
    import pyarrow.parquet as pq

    rows: list[dict[str, Any]] = []
    for path in sorted(folder.rglob(PROBES[0])):
        rows += pq.read_table(path).to_pylist()
    if not rows:
        for path in sorted(folder.rglob(PROBES[1])):
            stored = files.read_json(path)
            rows += stored.get("rows", []) if isinstance(stored, dict) else stored
    return rows


def _missing(
    folder: Path,
    stored: Mapping[str, Any],
    planned: Sequence[PlannedRun],
    results: Sequence[Result],
) -> list[Missing]:
    """Return the runs without a result: what failed, what was not run, what is pending."""
    done = {(result.condition, result.seed) for result in results}
    found: dict[tuple[Condition, int], Missing] = {}

    def add(run: RunConfig, state: str, reason: str, key: str) -> None:
        condition = condition_of(run)
        if (condition, run.seed) not in done:
            missing = Missing(condition, run.seed, state, reason, key)
            found.setdefault((condition, run.seed), missing)

    for path in sorted(folder.rglob(FAILED_FILE)):
        failed = read_versioned(path)
        run = from_mapping(RunConfig, failed["run"], str(path))
        add(run, FAILED, _last_line(str(failed.get("error", ""))), path.parent.name)
    for skipped in stored.get("skipped", []):
        run = from_mapping(RunConfig, skipped["run"], str(folder / RUN_FILE))
        add(run, NOT_RUN, str(skipped["reason"]), str(skipped["key"]))
    for item in planned:
        if item.state == TO_DO:
            add(item.run, PENDING, item.reason or "the sweep has not come to it yet", item.key)
        elif item.state == NOT_RUN:
            add(item.run, NOT_RUN, item.reason, item.key)
    return sorted(found.values(), key=lambda item: (*order(item.condition), item.seed))


def _last_line(text: str) -> str:
    """Return the last line of an error: of a traceback the one that names it."""
    lines = [line.strip() for line in text.strip().splitlines() if line.strip()]
    return lines[-1] if lines else "no error was kept"
