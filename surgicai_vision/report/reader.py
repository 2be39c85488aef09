"""Reader: a results folder → evaluations, and the runs that have none with the reason why.

A run's condition is everything about it except the training seed and the starts (`experiment_key`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

from surgicai_vision.core import files
from surgicai_vision.core.config import TaskConfig, from_mapping
from surgicai_vision.core.errors import BadFile, SurgicaiError
from surgicai_vision.core.untrusted import checked, finite_number
from surgicai_vision.evaluation.storage import (
    FAILED_FILE,
    GRID_FILE,
    RUN_FILE,
    check_provenance,
    find_evaluations,
    read_evaluation,
    read_parquet,
    read_rows,
    read_versioned,
)
from surgicai_vision.report.experiment_key import Condition, condition_of, order
from surgicai_vision.training.checkpoint import read_checkpoint
from surgicai_vision.training.released import resolve
from surgicai_vision.training.run_config import REFERENCES, RunConfig

__all__ = ["REFERENCES", "Collected", "Missing", "PlannedRun", "Result", "collect", "read_results"]

WORK = "work"
"""Folder in which the jobs of a sweep work."""
PROBES = ("probes.parquet", "probe.json")
RUN_KINDS: Mapping[str, type] = MappingProxyType(
    {
        **dict.fromkeys(("title", "command", "data", "headline", "lead"), str),
        **dict.fromkeys(("seconds", "provenance", "video"), dict),
        **dict.fromkeys(("problems", "skipped"), list),
    }
)
"""Key of `run.json` that the page shows → its type."""
PROBE_TEXTS = ("task", "encoder", "pool")
PROBE_NUMBERS = tuple(
    f"{error}{part}"
    for error in ("tip_mm", "angle_deg")
    for part in ("", "_low", "_high", "_chance")
)
"""Columns of a probe that hold text, and those that hold a number; each may be absent."""

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
        place: where it is stored, below the folder that was read, if another evaluation of the
            same condition and training seed is stored elsewhere.
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
        """Hash and errors of the high-level policy that decided; empty if none are known."""
        found: dict[str, Any] = self.about.get("high_level") or {}
        return found

    @property
    def seed(self) -> int:
        """The training seed."""
        return self.run.seed

    @cached_property
    def own_env(self) -> TaskConfig:
        """The env in which `evaluate` runs its policy unless it is given another.

        It is the task's for a reference, and that of the training for a policy. The training's
        step limit and rules are known only where its checkpoint still is.
        """
        if not self.trained:
            return TaskConfig(self.run.task)
        try:
            return read_checkpoint(resolve(str(self.about.get("folder", "")))).task
        except SurgicaiError:
            return self.run.recorded_in or self.config

    @cached_property
    def condition(self) -> Condition:
        """The condition that was evaluated."""
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
    """A run of a sweep and its state, as `experiments.sweep.plan` reports it."""

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
    """Everything a report is made from."""

    folder: Path
    results: list[Result]
    missing: list[Missing]
    run: dict[str, Any]
    probes: list[dict[str, Any]]

    @property
    def notes(self) -> list[str]:
        """What went wrong outside the runs."""
        return [str(line) for line in self.run.get("problems", [])]


def collect(folder: Path, planned: Sequence[PlannedRun] = ()) -> Collected:
    """Read the results below `folder`.

    Args:
        folder: results of quickstart, evaluate, robustness or sweep.
        planned: the runs of a sweep; those without a result or a record are reported as pending
            or not run.

    Raises:
        BadFile: there is neither an evaluation nor a run that failed or was not run, or results
            are from another version.
    """
    run = _read_run(folder / RUN_FILE) if (folder / RUN_FILE).exists() else {}
    results = read_results(folder, empty=True)
    missing = _missing(folder, run, planned, results)
    if not results and not missing:
        raise BadFile(
            f"{folder} holds no evaluation; "
            f"run `surgicai-vision evaluate POLICY --out {folder}` first."
        )
    return Collected(folder, results, missing, run, read_probes(folder))


def _read_run(path: Path) -> dict[str, Any]:
    """Return what `run.json` holds, without null values.

    Raises:
        BadFile: another version wrote it, or a value that the page shows has the wrong type.
    """
    run = {key: value for key, value in read_versioned(path).items() if value is not None}
    for key in RUN_KINDS.keys() & run.keys():
        checked(run[key], RUN_KINDS[key], f"{path}: {key}")
    for stage, seconds in run.get("seconds", {}).items():
        finite_number(seconds, f"{path}: seconds of {stage}")
    for key, value in run.get("video", {}).items():
        checked(value, str, f"{path}: {key} of video")
    check_provenance(run.get("provenance", {}), f"{path}: provenance")
    if "headline" in run:
        checked(run.get("lead"), str, f"{path}: lead")
    return run


def read_results(folder: Path, empty: bool = False) -> list[Result]:
    """Read all evaluations below `folder`; trained policies first.

    Raises:
        BadFile: there is none (allowed with `empty`), or another version wrote one.
    """
    results = []
    work = folder / WORK if (folder / GRID_FILE).exists() else None  # not filed yet
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

    Several sweeps may evaluate the same expert.
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
    """Distinguish evaluations of the same condition and training seed by their folders.

    Pooled, they would count twice. Other training seeds, strengths and axes of theirs that are
    stored in such a folder belong to it too.
    """
    alike: dict[tuple[Condition, int], list[Result]] = {}
    for result in results:
        alike.setdefault((result.condition, result.seed), []).append(result)
    places: dict[Path, Path] = {}
    of_policy: dict[Condition, set[Path]] = {}
    for (condition, _), same in alike.items():
        if len(same) > 1:
            found = _places([result.folder.relative_to(folder) for result in same], condition)
            places |= zip([result.folder for result in same], found, strict=True)
            of_policy.setdefault(condition.unshifted, set()).update(found)

    def place_of(result: Result) -> Path:
        if result.folder in places:
            return places[result.folder]
        path = result.folder.relative_to(folder)
        others = of_policy.get(result.condition.unshifted, ())
        around = [place for place in others if path.is_relative_to(place)]
        return max(around, key=lambda place: len(place.parts), default=Path())

    found_places = [place_of(result) for result in results]
    return [
        replace(result, place=str(place)) if place.parts else result
        for result, place in zip(results, found_places, strict=True)
    ]


def _places(folders: Sequence[Path], condition: Condition) -> list[Path]:
    """Return in what the folders of one condition differ: without what they all end in.

    `robustness` stores a curve as `<axis>/<strength>`, which is left out as well, as long as the
    places then still differ.
    """
    parts = [folder.parts for folder in folders]
    while all(parts) and len({each[-1] for each in parts}) == 1:
        parts = [each[:-1] for each in parts]
    of_curve = (condition.axis, f"{condition.strength:g}")
    curves = [each[:-2] if each[-2:] == of_curve else each for each in parts]
    return [Path(*each) for each in (curves if len(set(curves)) == len(curves) else parts)]


def read_probes(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of every probe below `folder`.

    Raises:
        BadFile: a file that is damaged, or holds no probes.
    """
    rows: list[dict[str, Any]] = []
    for path in sorted(folder.rglob(PROBES[0])):
        rows += [_checked_probe(row, path) for row in read_parquet(path)]
    if not rows:
        for path in sorted(folder.rglob(PROBES[1])):
            stored = files.read_json(path)
            found = stored.get("rows", []) if isinstance(stored, dict) else stored
            rows += [_checked_probe(row, path) for row in checked(found, list, f"{path}: rows")]
    return rows


def _checked_probe(row: object, path: Path) -> dict[str, Any]:
    """Return a row of a probe file, if the values that the page shows have the right types."""
    probe = checked(row, dict, f"{path}: a row")
    for key in PROBE_TEXTS:
        checked(probe.get(key) or "", str, f"{path}: {key}")
    for key in PROBE_NUMBERS:
        value = probe.get(key)
        if value is not None and value == value:  # an unknown error is null or NaN
            finite_number(value, f"{path}: {key}")
    views = probe.get("view") or ()
    for view in [views] if isinstance(views, str) else checked(views, list, f"{path}: view"):
        checked(view, str, f"{path}: view")
    return probe


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
        run = _run_of(failed, path)
        add(run, FAILED, _last_line(str(failed.get("error", ""))), path.parent.name)
    for skipped in stored.get("skipped", []):
        run = _run_of(skipped, folder / RUN_FILE)
        add(run, NOT_RUN, str(skipped.get("reason", "")), str(skipped.get("key", "")))
    for item in planned:
        if item.state == TO_DO:
            add(item.run, PENDING, item.reason or "the sweep has not reached it yet", item.key)
        elif item.state == NOT_RUN:
            add(item.run, NOT_RUN, item.reason, item.key)
    return sorted(found.values(), key=lambda item: (*order(item.condition), item.seed))


def _run_of(row: object, path: Path) -> RunConfig:
    """Return the run that failed or was not run, as recorded in a file."""
    stored = checked(row, dict, f"{path}: a run")
    return from_mapping(RunConfig, checked(stored.get("run"), dict, f"{path}: run"), str(path))


def _last_line(text: str) -> str:
    """Return the last line of an error, which in a traceback names it."""
    lines = [line.strip() for line in text.strip().splitlines() if line.strip()]
    return lines[-1] if lines else "no error was recorded"
