"""How well a high-level policy predicts the subtask that is due and the present one's progress.

`stage_errors(answers, target) -> StageErrors`: measured on the frames held out of its training, and
stored in its checkpoint; the report shows them.
"""

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.training.checkpoint import StageErrors

CLASSES = len(names.SUBTASKS)
BINS = 15
"""Bins of the calibration error, as in Guo et al., On calibration of modern neural networks, ICML
2017 (arXiv:1706.04599), Section 3.
"""


def stage_errors(answers: NDArray[np.float32], target: NDArray[np.float32]) -> StageErrors:
    """Compare answers with the column `names.STAGE`.

    Args:
        answers: (N, 5) calibrated logits, or (N, 6) with the progress last; N at least 1.
        target: (N, 2) as `training.visits.stages` returns it.
    """
    logits = np.asarray(answers[:, :CLASSES], np.float64)
    due = target[:, 0].astype(np.int64)
    named = logits.argmax(axis=1)
    confusion = np.zeros((CLASSES, CLASSES), np.int64)
    np.add.at(confusion, (due, named), 1)
    error = None
    known = target[:, 1] >= 0
    if answers.shape[1] > CLASSES and known.any():
        error = float(np.abs(answers[known, CLASSES] - target[known, 1]).mean())
    return StageErrors(
        confusion=tuple(tuple(int(count) for count in row) for row in confusion),
        calibration_error=_calibration_error(logits, named == due),
        progress_error=error,
    )


def _calibration_error(logits: NDArray[np.float64], right: NDArray[np.bool_]) -> float:
    """Return the expected calibration error of the largest probabilities."""
    shares = np.exp(logits - logits.max(axis=1, keepdims=True))
    confidence = 1.0 / shares.sum(axis=1)  # the largest share is 1
    bins = np.minimum((confidence * BINS).astype(np.int64), BINS - 1)
    sums = np.bincount(bins, confidence - right, minlength=BINS)
    return float(np.abs(sums).sum() / len(right))
