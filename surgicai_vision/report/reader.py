"""Reading: a results folder → evaluations, and the cells that have none with the reason why.

A cell is one training: task, inputs, policy, recipe, demonstrations, training seed. Its condition
is all of that but the training seed, and the shift under which it was evaluated.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from surgicai_vision.core import files
from surgicai_vision.core.cameras import view_names
from surgicai_vision.core.config import TaskConfig, from_mapping
from surgicai_vision.core.errors import BadFile
from surgicai_vision.evaluation.storage import (
    CELL_FILE,
    FAILED_FILE,
    GRID_FILE,
    MARKER,
    RUN_FILE,
    find_evaluations,
    read_rows,
)
from surgicai_vision.report.experiment_key import (
    Condition,
    condition_of,
    condition_of_policy,
    order,
)

WORK = "work"
"""Folder of a sweep in which its jobs are at work."""
REFERENCES = ("expert", "random", "zero", "replay")
"""Policies that were not trained: what the trained ones stand beside."""
PROBES = ("probes.parquet", "probe.json")

FAILED = "failed"
NOT_RUN = "not run"
PENDING = "pending"
PROBLEM = re.compile(r"(failed|not run): (\w+), (.+), seed (\d+): (.*)", re.DOTALL)
"""A line of `run.json`'s "not_run"."""


@dataclass(frozen=True)
class Result:
    """One stored evaluation: its folder, its summary, how it was made, its rows, its cell."""

    folder: Path
    summary: dict[str, Any]
    about: dict[str, Any]
    rows: list[dict[str, Any]]
    cell: dict[str, Any] = field(default_factory=dict)
    place: str = ""
    """Where it stands, if another evaluation of the same condition and training seed stands
    elsewhere.
    """

    @property
    def trained(self) -> bool:
        """Whether a checkpoint was evaluated."""
        return self.summary["policy"] not in REFERENCES

    @property
    def config(self) -> TaskConfig:
        """The task it was evaluated on."""
        return from_mapping(TaskConfig, self.about["task_config"])

    @property
    def checkpoint(self) -> dict[str, Any]:
        """What is known of the policy evaluated; empty for a reference."""
        found: dict[str, Any] = self.about.get("checkpoint") or {}
        return found

    @property
    def seed(self) -> int:
        """The training seed."""
        return int(self.cell.get("seed") or self.checkpoint.get("seed") or 0)

    @cached_property
    def condition(self) -> Condition:
        """What it is an evaluation of: by its cell where it is one of a sweep, else by what is
        known of the policy.
        """
        shift = self.about.get("shift") or {}
        base = (
            condition_of(self.cell) if self.cell else condition_of_policy(self.summary, self.about)
        )
        return replace(
            base,
            place=self.place,
            axis=str(shift.get("axis") or ""),
            strength=float(shift.get("strength") or 0.0),
            swap=str(self.about.get("swap") or base.swap),
            trained=self.trained,
        )


@dataclass(frozen=True)
class Missing:
    """A cell without an evaluation: failed, not run, or pending, with the reason."""

    condition: Condition
    seed: int
    state: str
    reason: str
    key: str = ""


@dataclass(frozen=True)
class Collected:
    """Everything a report is made of."""

    folder: Path
    results: list[Result]
    missing: list[Missing]
    run: dict[str, Any]
    grid: dict[str, Any]
    probes: list[dict[str, Any]]

    @property
    def notes(self) -> list[str]:
        """What went wrong in the run beside its cells."""
        return [str(line) for line in self.run.get("not_run", []) if not PROBLEM.match(str(line))]


def collect(folder: Path, cells: Sequence[Mapping[str, Any]] = ()) -> Collected:
    """Read the results below `folder`.

    Args:
        folder: results of quickstart, evaluate, robustness or sweep.
        cells: the cells of a sweep, as mappings with "key", "state" ("to do" or "not run"),
            "reason" and the cell's own fields; those that have no result and no record are reported
            as pending or not run.

    Raises:
        BadFile: neither an evaluation nor a cell that failed or was not run.
    """
    grid = _json(folder / GRID_FILE)
    run = _json(folder / RUN_FILE)
    results = read_results(folder, grid, empty=True)
    missing = _missing(folder, run, grid, cells, results)
    if not results and not missing:
        raise BadFile(
            f"{folder} holds no evaluation; run `surgicai-vision evaluate POLICY --out {folder}` first."
        )
    return Collected(folder, results, missing, run, grid, read_probes(folder))


def read_results(
    folder: Path, grid: dict[str, Any] | None = None, empty: bool = False
) -> list[Result]:
    """Read all evaluations below `folder`; trained policies first."""
    results = []
    shared = _shared(grid or {})
    work = folder / WORK if grid else None  # what a running sweep has not filed yet
    for place in find_evaluations(folder):
        if work in place.parents:
            continue
        stored = files.read_json(place / MARKER)
        cell = _json(place.parent / CELL_FILE).get("cell", {})
        mapping = {**shared, **_filled(cell)} if cell else {}
        results.append(Result(place, stored["summary"], stored["about"], read_rows(place), mapping))
    if not results and not empty:
        raise BadFile(
            f"{folder} holds no evaluation; run `surgicai-vision evaluate POLICY --out {folder}` first."
        )
    return sorted(
        _told_apart(_once(results), folder),
        key=lambda result: (*order(result.condition), result.seed),
    )


def _once(results: Sequence[Result]) -> list[Result]:
    """Leave out a reference whose episodes are among those of another: several sweeps evaluate the
    same expert.
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


def _outcomes(result: Result) -> set[tuple[Any, ...]]:
    return {(row["seed"], row["success"], row["steps"]) for row in result.rows}


def _told_apart(results: Sequence[Result], folder: Path) -> list[Result]:
    """Name evaluations of the same condition and training seed by their folders: counted together
    they count twice.
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
    run: dict[str, Any],
    grid: dict[str, Any],
    cells: Sequence[Mapping[str, Any]],
    results: list[Result],
) -> list[Missing]:
    """Return the cells without a result: what failed, what the plan knows, what the run noted, each
    once.
    """
    shared = _shared(grid)
    done = {(result.condition, result.seed) for result in results}
    found: dict[tuple[Condition, int], Missing] = {}

    def add(cell: Mapping[str, Any], state: str, reason: str, key: str) -> None:
        condition = condition_of({**shared, **_filled(cell)})
        seed = int(cell.get("seed") or 0)
        if (condition, seed) not in done:
            found.setdefault((condition, seed), Missing(condition, seed, state, reason, key))

    for path in sorted(folder.rglob(FAILED_FILE)):
        stored = files.read_json(path)
        add(stored["cell"], FAILED, _last_line(str(stored.get("error", ""))), path.parent.name)
    for skipped in run.get("skipped", []):
        add(skipped["cell"], NOT_RUN, str(skipped["reason"]), str(skipped["key"]))
    for cell in cells:
        if cell["state"] in ("to do", NOT_RUN, FAILED):
            state = PENDING if cell["state"] == "to do" else str(cell["state"])
            reason = str(cell.get("reason") or "the sweep has not come to it yet")
            add(cell, state, reason, str(cell.get("key", "")))
    for line in run.get("not_run", []):
        noted = _noted(str(line), shared)
        if noted is None or (noted.condition, noted.seed) in done:
            continue
        key = noted.condition, noted.seed
        if key in found and found[key].state == PENDING:
            found[key] = noted  # where the sweep ran, it could not be run; here it could
        elif not cells:
            found.setdefault(key, noted)
    return sorted(found.values(), key=lambda item: (*order(item.condition), item.seed))


def _noted(line: str, shared: Mapping[str, Any]) -> Missing | None:
    """Read a line that a run has noted of a cell: its policy's name is encoder and views, or stays
    whole.
    """
    match = PROBLEM.match(line)
    if not match:
        return None
    state, task, name, seed, reason = match.groups()
    encoder, _, last = name.rpartition("-")
    views = tuple(last.split("+"))
    known = encoder and all(view in view_names() for view in views)
    cell = {
        "task": task,
        "encoder": encoder if known else name,
        "view": views if known else (),
        **shared,
    }
    return Missing(condition_of(cell), int(seed), state, reason)


def _filled(cell: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in cell.items() if value is not None}


def _json(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = files.read_json(path) if path.exists() else {}
    return found


def _shared(grid: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a cell has of its grid where it says nothing itself: of several demonstration
    counts the largest.
    """
    counts = grid.get("demonstrations")
    counts = [counts] if isinstance(counts, int) else list(counts or ())
    return {"demonstrations": max(counts)} if counts else {}


def _last_line(text: str) -> str:
    """Return the last line of an error: of a traceback the one that names it."""
    lines = [line.strip() for line in text.strip().splitlines() if line.strip()]
    return lines[-1] if lines else "no error was kept"
