"""Visits: from the recorded phases of an episode to the targets of a high-level policy.

A visit is a run of frames of one phase in one episode. It is finished if a later phase follows or
the episode ends: episodes are recorded until their success. If an earlier phase follows, the visit
was broken off: something went wrong, and the demonstrator went back.

Interface:

* `stages(columns, episode_index) -> (N, 2)`: the column `names.STAGE`, the subtask that is due and
  the progress within the present one.
* `subtasks_due(…)`, `progress(…)`: its two halves.

Everything is computed from the columns `names.PHASE`, `names.SUCCESS` and "timestamp".
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import DWELL
from surgicai_vision.core.errors import InputError

AHEAD = 10
"""Control steps by which the label of the subtask that is due is shifted ahead.

In our recordings a subtask continues for `DWELL` steps after its success, while hardly anything
moves. Without the shift its last frames and the first of the next subtask would look alike with
different labels, and a policy would predict the old subtask forever. With it, the next subtask is
due in those frames (docs/hierarchical.md has the measurement).
"""
UNKNOWN = -1.0
"""Progress of a frame whose visit was broken off: there is no end to measure it against."""


@dataclass(frozen=True)
class Visits:
    """The visits of all episodes, V of them in the order of the frames.

    Attributes:
        number: visit of every frame, (N,) int64.
        first: first row of each visit, (V,) int64.
        last: last row of each visit, (V,) int64.
        ends_episode: whether it is the last visit of its episode, (V,) bool.
        is_finished: whether it was not broken off, (V,) bool.
    """

    number: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    ends_episode: NDArray[np.bool_]
    is_finished: NDArray[np.bool_]


def find_visits(phase: NDArray[np.int64], episode_index: NDArray[np.int64]) -> Visits:
    """Return the visits of frames with these phases, (N,), and episodes, (N,) ascending."""
    begins = np.ones(len(phase), bool)
    begins[1:] = (np.diff(phase) != 0) | (np.diff(episode_index) != 0)
    first = np.flatnonzero(begins)
    last = np.append(first[1:], len(phase)) - 1
    ends_episode = np.ones(len(first), bool)
    ends_episode[:-1] = episode_index[first[1:]] != episode_index[first[:-1]]
    goes_on = np.zeros(len(first), bool)
    goes_on[:-1] = phase[first[1:]] > phase[first[:-1]]
    return Visits(np.cumsum(begins) - 1, first, last, ends_episode, ends_episode | goes_on)


def subtasks_due(
    phase: NDArray[np.int64],
    step: NDArray[np.int64],
    episode_index: NDArray[np.int64],
    ahead: int = AHEAD,
    contact: NDArray[np.bool_] | None = None,
) -> NDArray[np.int64]:
    """Return the subtask that is due at every frame: the phase `ahead` control steps later.

    It is never taken from another episode, nor from beyond the end of a visit that was broken off:
    before an upset nothing shows that a return is near. From the first frame after that visit, the
    label is the phase that was returned to. It is so earlier where `contact` shows that the needle
    was lost and the demonstrator had not noticed yet.

    Args:
        phase: (N,) recorded phases.
        step: (N,) control steps since each episode's beginning, ascending within it.
        episode_index: (N,) episode of every frame, ascending.
        ahead: control steps.
        contact: (N,) whether the jaws hold the needle after each frame's action; None where it is
            not known.

    Returns:
        (N,) int64, indices in `names.SUBTASKS`.
    """
    found = find_visits(phase, episode_index)
    limit = found.last.copy()
    for visit in range(len(limit) - 2, -1, -1):
        if found.is_finished[visit] and not found.ends_episode[visit]:
            limit[visit] = limit[visit + 1]
    # Episode and step as one number that increases over all frames, with room for `ahead`.
    episode = np.unique(episode_index, return_inverse=True)[1]
    time = episode * (int(step.max()) + ahead + 1) + step
    later = np.searchsorted(time, time + ahead)
    due: NDArray[np.int64] = phase[np.minimum(later, limit[found.number])]
    if contact is not None:
        for visit in np.flatnonzero(~found.is_finished):
            end = found.last[visit] + 1
            held = np.flatnonzero(contact[found.first[visit] : end])
            if len(held):
                due[found.first[visit] + held[-1] + 1 : end] = phase[end]
    return due


def progress(
    phase: NDArray[np.int64],
    step: NDArray[np.int64],
    episode_index: NDArray[np.int64],
    success: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Return the share of its visit completed at each frame, in [0, 1], or `UNKNOWN`.

    It rises linearly from 0 at a visit's first frame to 1 at the first frame that shows its
    success, and stays there: τ = (t - s) / (e - s) of SARM (Chen et al., arXiv:2509.25358), as in
    `lerobot.rewards.sarm.sarm_utils.compute_tau` of LeRobot 0.6.1. The end e is `DWELL` - 1 control
    steps before the next visit's first frame, because a success must have held for `DWELL` steps;
    in an episode's last visit, `success` gives the end.

    Args:
        phase: (N,) recorded phases.
        step: (N,) control steps since each episode's beginning, ascending within it.
        episode_index: (N,) episode of every frame, ascending.
        success: (N,) whether the step after each frame met the task (`names.SUCCESS`).
    """
    found = find_visits(phase, episode_index)
    shares = np.full(len(phase), UNKNOWN, np.float32)
    for visit in np.flatnonzero(found.is_finished):
        rows = slice(found.first[visit], found.last[visit] + 1)
        if found.ends_episode[visit]:
            met = np.flatnonzero(success[rows])
            end = step[rows][met[0] if len(met) else -1] + 1
        else:
            end = step[found.first[visit + 1]] - DWELL + 1
        begin = step[found.first[visit]]
        shares[rows] = np.clip((step[rows] - begin) / max(end - begin, 1), 0.0, 1.0)
    return shares


def stages(
    columns: Mapping[str, NDArray[np.generic]], episode_index: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Return the column `names.STAGE`: the subtask due and the progress in the present one.

    Args:
        columns: a dataset's columns.
        episode_index: (N,) episode of every frame, ascending.

    Returns:
        (N, 2) float32: an index in `names.SUBTASKS`, and [0, 1] or `UNKNOWN`.

    Raises:
        InputError: the task has no subtasks, or the frames are not from whole procedures.
    """
    phase = np.asarray(columns[names.PHASE], np.int64)
    if len(phase) and not 0 <= phase.min() <= phase.max() < len(names.SUBTASKS):
        raise InputError(
            f"The dataset has phases from {phase.min()} to {phase.max()}; subtasks are learned "
            f"from those of {names.SUTURE}, 0 to {len(names.SUBTASKS) - 1}."
        )
    step = np.rint(np.asarray(columns["timestamp"], np.float64) * names.FPS).astype(np.int64)
    if (np.diff(step)[np.diff(episode_index) == 0] <= 0).any():
        raise InputError(
            "The frames are one subtask's of whole procedures; subtasks and progress are learned "
            "from the procedures themselves. Leave the subtask (--subtask) out."
        )
    success = np.asarray(columns[names.SUCCESS], bool)
    contact = np.asarray(columns[names.CONTACT], bool) if names.CONTACT in columns else None
    due = subtasks_due(phase, step, episode_index, contact=contact)
    share = progress(phase, step, episode_index, success)
    return np.stack([due, share], axis=1).astype(np.float32)
