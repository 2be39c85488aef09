"""Where verbs read and write when nothing else is said: below `outputs/` in the current folder."""

from collections.abc import Sequence
from pathlib import Path

OUTPUTS = Path("outputs")


def demos_folder(task: str) -> Path:
    """Demonstrations of a task."""
    return OUTPUTS / "demos" / task


def dataset_folder(task: str) -> Path:
    """The dataset of a task."""
    return OUTPUTS / "datasets" / task


def train_folder(task: str, encoder: str | None, views: Sequence[str], seed: int) -> Path:
    """The checkpoint of one training."""
    name = f"{encoder}-{'+'.join(views)}" if encoder and views else "proprioception"
    return OUTPUTS / "train" / f"{task}-{name}-seed{seed}"


def evaluation_folder(task: str, policy: str, seed: int, episodes: int) -> Path:
    """One evaluation."""
    return OUTPUTS / "evaluations" / f"{task}-{policy}-starts{seed}+{episodes}"
