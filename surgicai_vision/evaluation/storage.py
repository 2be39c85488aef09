"""Results: an evaluation as a folder, for reports and for anyone's own analysis.

`evaluation.json` (written last, so it marks a complete folder) holds the run, the summary and how
it was made. `episodes.parquet` has one row per episode, `films.safetensors` a few states of each
episode. For a whole procedure, `visits.parquet` has one row per visit of a subtask (`envs.visits`).
"""

import dataclasses
import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import files, names
from surgicai_vision.core.config import JSON, from_mapping, to_mapping
from surgicai_vision.core.errors import BadFile, InputError, first_line, shown
from surgicai_vision.core.untrusted import checked
from surgicai_vision.envs.visits import LAST, Visit
from surgicai_vision.evaluation.finished import FOLDER as FINISHED
from surgicai_vision.evaluation.metrics import (
    KINDS,
    EpisodeMetrics,
    as_table,
    measured_ends,
    summary,
)
from surgicai_vision.evaluation.slot import Episode, Film
from surgicai_vision.training.run_config import RunConfig

MARKER = "evaluation.json"
EPISODES = "episodes.parquet"
FILMS = "films.safetensors"
VISITS = "visits.parquet"
LOCK = "evaluation.lock"
"""Held while a process evaluates into the folder."""
OURS = (MARKER, EPISODES, FILMS, VISITS, LOCK, FINISHED)
"""Every file of an evaluation; a killed evaluation leaves some of them without the marker."""
RUN_FILE = "run.json"
GRID_FILE = "sweep.json"
RESULT_FILE = "result.json"
FAILED_FILE = "failed.json"
FORMAT = 2
"""Version of the files that evaluations, sweeps and quickstarts store; 0.1 wrote none."""

Row = dict[str, Any]
"""A row of a table, or a summary: plain data."""


@dataclass(frozen=True)
class Evaluation:
    """What `evaluation.json` holds.

    Attributes:
        run: what was evaluated.
        summary: its summary, such as the number of successes.
        about: with what, where and by which command it was made.
    """

    run: RunConfig
    summary: Row
    about: Row


def read_versioned(path: Path) -> Row:
    """Read a JSON table that this version wrote.

    Raises:
        BadFile: it cannot be read, or another version wrote it.
    """
    stored = files.read_json(path)
    found = stored.get("format") if isinstance(stored, dict) else None
    if found != FORMAT:
        raise BadFile(
            f"{path} has format {found!r}, of another version (0.1 wrote none); "
            f"this version reads {FORMAT}. Make it again."
        )
    table: Row = stored
    return table


def read_evaluation(folder: Path) -> Evaluation:
    """Read `evaluation.json`.

    Raises:
        BadFile: there is none, it is damaged, or another version wrote it.
    """
    path = folder / MARKER
    stored = read_versioned(path)
    for key in ("run", "summary", "about"):
        if not isinstance(stored.get(key), dict):
            raise BadFile(f"{path} is damaged: it has no table '{key}'. Evaluate again.")
    run = from_mapping(RunConfig, stored["run"], str(path))
    _check_summary(stored["summary"], f"{path}: summary")
    _check_about(stored["about"], f"{path}: about")
    return Evaluation(run, stored["summary"], stored["about"])


def _check_summary(summary: Row, where: str) -> None:
    """Refuse a summary that lacks what reports read from it."""
    checked(summary.get("successes"), int, f"{where}: successes")
    for key in ("task", "policy"):
        checked(summary.get(key), str, f"{where}: {key}")


def _check_about(about: Row, where: str) -> None:
    """Refuse tables and texts of the wrong type; each may be absent or null."""
    checked(about.get("checkpoint") or {}, dict, f"{where}: checkpoint")
    if about.get("high_level"):
        high_level = checked(about["high_level"], dict, f"{where}: high_level")
        checked(high_level.get("policy_sha256"), str, f"{where}: policy_sha256 of high_level")
        checked(high_level.get("stage_errors"), dict, f"{where}: stage_errors of high_level")
    for key in ("command", "scene_hash", "folder"):
        checked(about.get(key) or "", str, f"{where}: {key}")
    check_provenance(about.get("provenance") or {}, f"{where}: provenance")


def check_provenance(value: object, where: str) -> None:
    """Refuse a value that is no table of a machine and its packages (`evaluation.provenance`).

    Raises:
        BadFile: it is of another type.
    """
    table = checked(value, dict, where)
    checked(table.get("packages") or {}, dict, f"{where}: packages")


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Lock a folder that is evaluated into; it is made, and removed again if it stays empty.

    Raises:
        InputError: another process evaluates into it.
    """
    refusal = InputError(
        f"Another run is evaluating into {folder}; wait for it, stop it or give another --out."
    )
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with files.locked(folder / LOCK, refusal=refusal):
            yield
    finally:
        if not any(folder.iterdir()):
            folder.rmdir()


def write_evaluation(
    folder: Path, episodes: Sequence[Episode], run: RunConfig, about: Mapping[str, JSON]
) -> Row:
    """Write an evaluation; an earlier one in the same folder is replaced.

    Args:
        folder: made where it is missing.
        episodes: what `evaluate` returned.
        run: what was evaluated.
        about: how it was made: "checkpoint", "command" and whatever else is worth keeping.

    Returns:
        The summary.
    """
    from safetensors.numpy import save

    folder.mkdir(parents=True, exist_ok=True)
    (folder / MARKER).unlink(missing_ok=True)
    # An earlier evaluation may have had visits that this one has not.
    (folder / VISITS).unlink(missing_ok=True)
    files.remove_partial(folder, OURS)
    rows = [episode.row for episode in episodes]
    files.write_bytes(folder / EPISODES, parquet_bytes(as_table(rows)))
    arrays: dict[str, NDArray[np.generic]] = {}
    for episode in episodes:
        arrays[f"{episode.row.seed}.steps"] = episode.film.steps
        arrays[f"{episode.row.seed}.states"] = episode.film.states
    files.write_bytes(folder / FILMS, save(arrays))
    result = summary(rows)
    visits = [(episode.row.seed, visit) for episode in episodes for visit in episode.visits]
    if visits:
        files.write_bytes(folder / VISITS, parquet_bytes([_visit_row(*one) for one in visits]))
        result["ends"] = measured_ends([visit for _, visit in visits])
    stored = {"format": FORMAT, "run": to_mapping(run), "summary": result, "about": dict(about)}
    files.write_json(folder / MARKER, stored)
    return result


def _visit_row(seed: int, visit: Visit) -> Row:
    """Return one visit of the episode of a start as plain data."""
    is_last = visit.following == LAST
    return {
        "seed": seed,
        **dataclasses.asdict(visit),
        "subtask": names.SUBTASKS[visit.subtask],
        "following": "" if is_last else names.SUBTASKS[visit.following],
        "is_false_end": visit.is_false_end,
        "delay_s": visit.delay,
    }


def parquet_bytes(table: list[Row]) -> bytes:
    """Return rows of plain data as a Parquet file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(table), buffer)
    return buffer.getvalue()


def read_rows(folder: Path) -> list[Row]:
    """Return the rows of an evaluation, one dictionary per episode.

    Raises:
        BadFile: there is none, or it is damaged.
    """
    path = folder / EPISODES
    if not path.is_file():
        raise BadFile(f"{folder} holds no evaluation ({EPISODES} is missing).")
    rows = read_parquet(path)
    if not rows:
        raise BadFile(f"{path} is damaged (no episodes); evaluate again.")
    # A column with only whole numbers comes back as integers, even if its field is a float.
    kinds = {
        name: int | float if kind is float else kind
        for name, kind in get_type_hints(EpisodeMetrics).items()
    }
    needed = [
        field
        for field in dataclasses.fields(EpisodeMetrics)
        if field.name in rows[0] or field.default is dataclasses.MISSING
    ]
    for field in needed:  # fields added later have a default and may be absent
        if not all(isinstance(row.get(field.name), kinds[field.name]) for row in rows):
            raise BadFile(
                f"{path} is damaged (column {field.name} is missing or of another type); "
                "evaluate again."
            )
    unknown = {row["failure"] for row in rows} - {"", *KINDS}
    if unknown:
        raise BadFile(f"{path} is damaged (failures {shown(sorted(unknown))}); evaluate again.")
    return rows


def read_parquet(path: Path) -> list[Row]:
    """Return the rows of a table.

    Raises:
        BadFile: it is damaged.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        rows: list[Row] = pq.read_table(path).to_pylist()
    except (pa.ArrowException, OSError, ValueError) as error:  # the last: undecodable text
        raise BadFile(f"{path} is damaged ({first_line(error)}); make it again.") from None
    return rows


def read_film(folder: Path, seed: int) -> Film:
    """Return the states kept of one episode; a film without states where none were kept.

    Raises:
        BadFile: the file is damaged, or holds no film of this episode.
    """
    from safetensors import SafetensorError, safe_open

    if not (folder / FILMS).is_file():
        return Film(np.zeros(0, np.int64), np.zeros((0, 0)))
    try:
        with safe_open(str(folder / FILMS), framework="numpy") as file:
            steps = file.get_tensor(f"{seed}.steps")
            states = file.get_tensor(f"{seed}.states")
    except SafetensorError as error:
        raise BadFile(
            f"{folder / FILMS} is damaged ({first_line(error)}); evaluate again."
        ) from None
    return Film(np.asarray(steps), np.asarray(states))


def find_evaluations(folder: Path) -> list[Path]:
    """Return the folders of all complete evaluations below `folder`, in the order of names."""
    return sorted(path.parent for path in folder.rglob(MARKER) if files.TEMPORARY not in str(path))
