"""Progress as an input: a high-level policy's predicted progress, fed to a low-level policy.

A recipe with `progress_input` feeds the progress of the subtask, as predicted by another policy
(`policies.hlp` with `progress`), instead of the clock. In training this is the prediction on the
dataset's frames, not the label, so that the input has the same errors as when the policy acts. When
it acts, it is the prediction from the same images. The checkpoint contains that of the other policy
in its folder `progress`, and the hash in its card.

Interface:

* `check_progress_policy(checkpoint, dataset)`: refuse one without progress of this dataset's task.
* `with_progress(dataset, policy, features) -> Dataset`: the dataset with the column
  `names.PROGRESS`.
* `copy_progress_policy(checkpoint, folder)`, `progress_policy_folder(checkpoint)`.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.dataset.protocol import Dataset
from surgicai_vision.dataset.subset import DatasetSubset
from surgicai_vision.features.cache import Features
from surgicai_vision.training.checkpoint import CARD, WEIGHTS, Checkpoint, read_checkpoint

if TYPE_CHECKING:
    from policies.base import Policy

FOLDER = "progress"
"""Folder of the progress policy in the checkpoint of the policy that uses it."""
ROWS = 1024
"""Frames predicted at a time."""
PROGRESS_AT = len(names.SUBTASKS)
"""Index of the progress in a high-level policy's answer, after the logits."""


def check_progress_policy(checkpoint: Checkpoint, dataset: Dataset) -> None:
    """Refuse a policy that does not predict progress in this dataset's task.

    Raises:
        InputError: it predicts none, or that of another task, or it sees images of another size.
    """
    folder = checkpoint.folder
    if not checkpoint.recipe.get("progress"):
        raise InputError(
            f"{folder} does not predict progress; train one with --policy hlp --recipe high-level."
        )
    allowed = dict.fromkeys((dataset.config.task, names.SUTURE))
    if checkpoint.task.task not in allowed:
        raise InputError(
            f"{folder} predicts the progress of '{checkpoint.task.task}'; allowed here: "
            f"{', '.join(allowed)}."
        )
    if checkpoint.views and checkpoint.image_size != dataset.image_size:
        raise InputError(
            f"{folder} sees images of {checkpoint.image_size} pixels; the dataset has "
            f"{dataset.image_size}."
        )


def with_progress(
    dataset: Dataset, policy: "Policy", features: Sequence[Features]
) -> DatasetSubset:
    """Return the dataset with the column `names.PROGRESS`, the predicted progress.

    Args:
        dataset: any dataset.
        policy: predicts the progress; one that `check_progress_policy` accepts.
        features: of the dataset's frames as the policy sees them, one entry per view.
    """
    columns = dataset.columns()
    keys = policy.inputs.vector or (names.STATE,)
    vectors = np.concatenate([np.asarray(columns[key], np.float32) for key in keys], axis=1)
    progress = []
    for at in range(0, dataset.length, ROWS):
        rows = slice(at, at + ROWS)
        seen = [np.asarray(entry.rows[rows], np.float32) for entry in features]
        answers = policy.act(np.concatenate(seen, axis=1) if seen else None, vectors[rows])
        progress.append(answers[:, PROGRESS_AT:])
    return DatasetSubset(
        dataset,
        np.arange(dataset.length),
        {"progress": policy.checkpoint.policy_sha256},
        added={names.PROGRESS: np.concatenate(progress)},
    )


def copy_progress_policy(checkpoint: Checkpoint, folder: Path) -> None:
    """Copy a progress policy into the checkpoint folder of the policy that uses it."""
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    for name in (WEIGHTS, CARD):
        shutil.copyfile(checkpoint.folder / name, folder / FOLDER / name)


def progress_policy_folder(checkpoint: Checkpoint) -> Path | None:
    """Return the folder of the progress policy that a policy uses; None if it uses none.

    Raises:
        BadFile: it is missing, or it is another policy.
    """
    if not checkpoint.progress_sha256:
        return None
    folder = checkpoint.folder / FOLDER
    if read_checkpoint(folder).policy_sha256 != checkpoint.progress_sha256:
        raise BadFile(
            f"{folder} is not the policy whose progress {checkpoint.folder} was trained with "
            "(its hash differs); train again."
        )
    return folder
