"""Results: an evaluation as a folder, for reports and for anyone's own analysis.

`evaluation.json` (written last: it marks a whole folder) holds the summary and how it was made,
`episodes.parquet` one row an episode, `films.safetensors` a few states of each episode.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surgicai_vision.core import files
from surgicai_vision.core.errors import BadFile
from surgicai_vision.evaluation.metrics import as_table, summary
from surgicai_vision.evaluation.rollout import Episode, Film

MARKER = "evaluation.json"
EPISODES = "episodes.parquet"
FILMS = "films.safetensors"
RUN_FILE = "run.json"
GRID_FILE = "sweep.json"
CELL_FILE = "cell.json"
FAILED_FILE = "failed.json"


def write_evaluation(
    folder: Path, episodes: Sequence[Episode], about: dict[str, Any]
) -> dict[str, Any]:
    """Write an evaluation; an earlier one in the same folder is replaced.

    Args:
        folder: made where it is missing.
        episodes: what `evaluate` returned.
        about: how it was made: "task_config", "checkpoint", "views" and whatever else is worth
            keeping.

    Returns:
        The summary.
    """
    from safetensors.numpy import save

    folder.mkdir(parents=True, exist_ok=True)
    (folder / MARKER).unlink(missing_ok=True)
    rows = [episode.row for episode in episodes]
    files.write_bytes(folder / EPISODES, parquet_bytes(as_table(rows)))
    arrays: dict[str, Any] = {}
    for episode in episodes:
        arrays[f"{episode.row.seed}.steps"] = episode.film.steps
        arrays[f"{episode.row.seed}.states"] = episode.film.states
    files.write_bytes(folder / FILMS, save(arrays))
    result = summary(rows)
    files.write_json(folder / MARKER, {"summary": result, "about": about})
    return result


def parquet_bytes(table: list[dict[str, Any]]) -> bytes:
    """Return rows of plain data as a Parquet file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(table), buffer)
    return buffer.getvalue()


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of an evaluation, one dictionary an episode."""
    import pyarrow.parquet as pq

    path = folder / EPISODES
    if not path.is_file():
        raise BadFile(f"{folder} holds no evaluation ({EPISODES} is missing).")
    rows: list[dict[str, Any]] = pq.read_table(path).to_pylist()
    return rows


def read_film(folder: Path, seed: int) -> Film:
    """Return the states kept of one episode."""
    from safetensors import safe_open

    with safe_open(str(folder / FILMS), framework="numpy") as file:
        steps, states = file.get_tensor(f"{seed}.steps"), file.get_tensor(f"{seed}.states")
    return Film(np.asarray(steps), np.asarray(states))


def find_evaluations(folder: Path) -> list[Path]:
    """Return the folders of all whole evaluations below `folder`, in the order of their names."""
    return sorted(path.parent for path in folder.rglob(MARKER) if files.TEMPORARY not in str(path))
