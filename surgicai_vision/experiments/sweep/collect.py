"""Collect: the tables of all runs that are done, and what the report says about the sweep."""

from collections.abc import Sequence
from pathlib import Path

from surgicai_vision.core import files
from surgicai_vision.core.config import to_mapping
from surgicai_vision.evaluation.provenance import command_line, provenance
from surgicai_vision.evaluation.storage import (
    FORMAT,
    RESULT_FILE,
    RUN_FILE,
    Row,
    parquet_bytes,
    read_rows,
)
from surgicai_vision.experiments.sweep.experiment import Experiment
from surgicai_vision.experiments.sweep.plan import PROBE_FILE, RunState, run_folder, run_key
from surgicai_vision.training.run_config import RunConfig

EPISODES, PROBES = "episodes.parquet", "probes.parquet"
EVALUATION = "evaluation"
"""Folder of a run's episodes, next to its result."""


def collect(experiment: Experiment, out: Path) -> list[Row]:
    """Write `episodes.parquet` of all runs that are done and return its rows."""
    table: list[Row] = []
    for run in experiment.runs:
        folder = run_folder(out, run_key(run))
        if (folder / RESULT_FILE).exists():
            about = _about(run)
            table += [{**about, **row} for row in read_rows(folder / EVALUATION)]
    files.write_bytes(out / EPISODES, parquet_bytes(table))
    return table


def collect_probes(out: Path) -> None:
    """Write `probes.parquet` of all probes there are, one row per encoder and view set."""
    rows = [files.read_json(path) for path in sorted(out.glob(f"probes/*/{PROBE_FILE}"))]
    if rows:
        files.write_bytes(out / PROBES, parquet_bytes(rows))


def _about(run: RunConfig) -> Row:
    """Return what a row says about its run."""
    return {
        "run": run_key(run),
        "encoder": run.encoder,
        "view": "+".join(run.views),
        "training_seed": run.seed,
        "trained_by": run.algo or run.policy,
        "recipe": run.recipe,
        "demonstrations": run.demonstrations,
        "hierarchical": run.termination,
        "expert_swap": run.expert_swap,
        "condition": run.condition,
    }


def store_run(
    experiment: Experiment, out: Path, problems: list[str], skipped: Sequence[RunState]
) -> None:
    """Write what the report says about the sweep; only when something changed."""
    old = files.read_json(out / RUN_FILE) if (out / RUN_FILE).exists() else {}
    made = {
        "format": FORMAT,
        "title": "sweep",
        "command": old.get("command") or command_line(),
        "data": experiment.text,
        "problems": problems,
        "skipped": [
            {"key": state.key, "run": to_mapping(state.run), "reason": state.reason}
            for state in skipped
        ],
        "provenance": old.get("provenance") or provenance(),
    }
    if made != old:
        files.write_json(out / RUN_FILE, made)
