"""Estimate: how long the rest of a sweep takes, judged by its finished runs."""

from collections.abc import Sequence
from pathlib import Path

from surgicai_vision.core.files import read_json
from surgicai_vision.evaluation.storage import RESULT_FILE
from surgicai_vision.experiments.sweep.plan import TO_DO, RunState, run_folder


def estimate(states: Sequence[RunState], out: Path, workers: int) -> float | None:
    """Return the seconds that the remaining runs will take; None before the first is finished.

    Args:
        states: the sweep's runs.
        out: the sweep's folder.
        workers: runs done at a time.
    """
    paths = [run_folder(out, state.key) / RESULT_FILE for state in states]
    taken: list[float] = [
        sum(read_json(path)["seconds"].values()) for path in paths if path.exists()
    ]
    if not taken:
        return None
    left = sum(state.state == TO_DO for state in states)
    return left * sum(taken) / len(taken) / max(1, workers)
