"""Import of SurgicAI's recordings: its arm motions, replayed state by state in our scene.

    summary = import_demos(Path("pickup.pkl"), task="handoff", out=Path("demos"))

A recording is read (`sandbox`), split into episodes, checked against the task, replayed (`replay`)
and written.

Half of the released insertions, and a few placements, turn the long way round, because the released
code compares yaw angles without unwrapping them. Our arm's roll joint cannot follow, so their yaw
is unwrapped: the path is the same, but the yaw goes the short way at the same times.

The recorded rotation increments are roll, pitch and yaw; ours are rotation vectors in the base's
axes. Actions are therefore recomputed from the poses, and the recorded ones only determine the step
preset. If more than one in a hundred would not fit the preset, the next larger one is used.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, STEPS, TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, UnreachablePose, check_name
from surgicai_vision.core.executor import building
from surgicai_vision.core.files import check_output, sha256_file, whole_folder
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.demos.imports.replay import Episode, Replay, fitting_step, grip_error, trimmed
from surgicai_vision.demos.imports.sandbox import read_sandboxed
from surgicai_vision.demos.record import finished
from surgicai_vision.demos.store import MARKER, list_demos, read_marker, write_demo, write_marker

OPEN_JAW = 0.4
"""A jaw open wider than this after the first step means a grasp; the recordings have 0.8 or 0
[rad]."""
AGREEMENT = 0.02
"""A step agrees with a preset if it differs from action × step size by less than this, in step
sizes."""
STEP_LIMIT = 200
"""Episode limit of the image evaluation (facts of SurgicAI); longer recordings raise it."""


@dataclass(frozen=True)
class ImportSummary:
    """The result of an import.

    Attributes:
        paths: the demonstrations' files.
        step: the step preset inferred from the motion.
        steps: number of recorded steps.
        disagreeing: steps that differ from action × step size by more than `AGREEMENT`.
        clipped: steps whose action left [-1, 1] on conversion and was clipped.
        skipped: episodes that could not be replayed, {"episode", "reason"}.
        unwrapped: episodes whose yaw turned the long way round and was unwrapped.
    """

    paths: tuple[Path, ...]
    step: str
    steps: int
    disagreeing: int
    clipped: int
    skipped: tuple[Mapping[str, JSON], ...]
    unwrapped: int = 0


def import_demos(
    file: Path, *, task: str, out: Path, progress: Progress | None = None
) -> ImportSummary:
    """Import a recording of SurgicAI into the folder of demonstrations `out`.

    Args:
        file: a pickle as SurgicAI writes it, or an npz of the same arrays.
        task: what the recording shows, one of `names.SUBTASKS`; the file does not say.
        out: folder to create; repeating the same import of the same file reuses it.
        progress: called with (episodes done, episodes, "episodes").

    Raises:
        UnknownName: an unknown task.
        BadFile: an unreadable recording.
        InputError: the motion cannot be that of the task.
        OutputExists: `out` holds something else.
    """
    check_name("subtask", task, names.SUBTASKS)
    check_output(out, may_resume=MARKER)
    arrays = read_sandboxed(file)
    request = {"file": sha256_file(file), "task": task}
    if not finished(out, request):
        episodes = split({name: rows.astype(np.float64) for name, rows in arrays.items()})
        check_task(episodes, task)
        episodes = [trimmed(episode, task) for episode in episodes]
        step, disagreeing = infer_step(episodes)
        wrapped = sum(is_yaw_wrapped(episode) for episode in episodes)
        episodes = [unwrap_yaw(episode) for episode in episodes]
        step = fitting_step([episode.motion for episode in episodes], step)
        limit = max(STEP_LIMIT, *(len(episode.action) for episode in episodes))
        config = TaskConfig(task, step=step, tolerance="released", reward="dense", max_steps=limit)
        with building(out) as (_, result), whole_folder(result) as folder:
            clipped, skipped = _write(folder, episodes, config, progress or silent)
            notes = {
                "clipped": clipped,
                "step": step,
                "steps": sum(len(episode.action) for episode in episodes),
                "disagreeing": disagreeing,
                "unwrapped": wrapped,
            }
            kept = len(episodes) - len(skipped)
            details = {"request": request, "skipped": skipped, "episodes": kept, "notes": notes}
            write_marker(folder, task, "surgicai", **details)
    marker = read_marker(out)
    return ImportSummary(
        tuple(list_demos(out)), skipped=tuple(marker["skipped"]), **marker["notes"]
    )


def _write(
    folder: Path, episodes: list[Episode], config: TaskConfig, progress: Progress
) -> tuple[int, list[dict[str, JSON]]]:
    """Replay and write the episodes; return the number of clipped actions and what was skipped."""
    replay = Replay(config)
    skipped: list[dict[str, JSON]] = []
    clipped = 0
    count = 0
    for index, episode in enumerate(episodes):
        try:
            demo, clipped_here = replay.demo(episode)
        except UnreachablePose as error:
            skipped.append({"episode": index, "reason": str(error)})
        else:
            write_demo(folder, count, demo)
            count += 1
            clipped += clipped_here
        progress(index + 1, len(episodes), "episodes")
    if not count:
        raise InputError(f"No episode can be replayed in our scene: {skipped[0]['reason']}")
    return clipped, skipped


def split(arrays: Mapping[str, NDArray[np.float64]]) -> list[Episode]:
    """Split transitions into episodes at `done`, and convert centimetres to metres.

    Raises:
        BadFile: the last episode is not done, or a transition does not continue the one before.
    """
    ends = np.flatnonzero(arrays["done"] > 0.5)
    if not len(ends) or ends[-1] != len(arrays["done"]) - 1:
        raise BadFile(
            "The recording does not end with a transition marked done; it seems to be cut off."
        )
    metres = np.array([0.01, 0.01, 0.01, 1.0, 1.0, 1.0, 1.0])
    episodes = []
    start = 0
    for number, end in enumerate(ends):
        rows = slice(start, end + 1)
        before = arrays["observation"][rows]
        after = arrays["next_observation"][rows]
        if not np.allclose(after[:-1, :7], before[1:, :7], atol=1e-4):
            raise BadFile(
                f"The recording jumps inside episode {number}: a next_observation differs from "
                "the observation that follows."
            )
        if not np.allclose(before[:, 7:14] - before[:, :7], before[:, 14:], atol=1e-3):
            raise BadFile(
                f"Episode {number}: its observations are not (current, goal, goal - current)."
            )
        if len(before) < 2:
            raise BadFile(
                f"Episode {number} has {len(before)} transition; an episode has at least 2."
            )
        poses = np.concatenate([before[:, :7], after[-1:, :7]]) * metres
        action, reward, success = (arrays[key][rows] for key in ("action", "reward", "success"))
        episodes.append(Episode(poses, before[0, 7:14] * metres, action, reward, success > 0.5))
        start = end + 1
    return episodes


def check_task(episodes: list[Episode], task: str) -> None:
    """Refuse a task that the motion contradicts.

    The contradictions are another arm, open jaws on a held needle, and a needle outside the jaws.

    Raises:
        InputError: it names the contradiction and the tasks that would fit.
    """
    # PSM1 works at positive x of its base and PSM2 at negative x, in every recording.
    arm = (
        names.PSM1
        if np.median([episode.pose[:, 0].mean() for episode in episodes]) > 0
        else names.PSM2
    )
    # After the first step: the first one of a pullout recording starts from another pose.
    jaw = float(np.median([episode.pose[1, 6] for episode in episodes]))
    grasps = ("grasp", "handoff") if jaw > OPEN_JAW else ("place", "insert", "pullout")
    fits = [name for name in grasps if names.ACTIVE_ARM[name] == arm]
    if task not in fits:
        raise InputError(
            f"The recording is not of {task}: it moves {arm} and begins with its jaw at "
            f"{jaw:.2f} rad; that fits {' or '.join(fits)}."
        )
    errors = [grip_error(trimmed(episode, task), task) for episode in episodes]
    if np.median(errors) > 0.0:
        others = " or ".join(name for name in fits if name != task) or "no task"
        raise InputError(
            f"The recording is not of {task}: with its goal the needle would lie "
            f"{np.median(errors) * 1e3:.0f} mm outside the jaws; that fits {others}."
        )


def is_yaw_wrapped(episode: Episode) -> bool:
    """Return True if an episode turns by more than half a turn in yaw."""
    return bool(abs(episode.pose[-1, 5] - episode.pose[0, 5]) > np.pi)


def unwrap_yaw(episode: Episode) -> Episode:
    """Return an episode whose yaw ends where it ended, but goes there the short way."""
    if not is_yaw_wrapped(episode):
        return episode
    travel = episode.pose[-1, 5] - episode.pose[0, 5]
    short = travel - 2 * np.pi * np.round(travel / (2 * np.pi))
    pose = episode.pose.copy()
    pose[:, 5] = pose[0, 5] + (pose[:, 5] - pose[0, 5]) * short / travel
    return dataclasses.replace(episode, pose=pose)


def infer_step(episodes: list[Episode]) -> tuple[str, int]:
    """Return the step preset that best explains the motion, and how many steps it does not explain.

    The first release's insertions have a step of 0.25 mm, which is not one of our presets. A motion
    explained by any other constant step gets the smallest preset that is at least as large.

    Raises:
        InputError: no constant step explains the motion.
    """
    moves = np.concatenate([np.diff(episode.pose, axis=0) for episode in episodes])
    recorded = np.concatenate([episode.action for episode in episodes])
    sizes = {
        name: np.array([metres] * 3 + [np.radians(degrees)] * 3 + [jaw])
        for name, (metres, degrees, jaw) in STEPS.items()
    }
    wrong = {name: _unexplained(moves, recorded, size) for name, size in sizes.items()}
    best = min(wrong, key=lambda name: wrong[name])
    if wrong[best] <= len(recorded) // 2:
        return best, wrong[best]
    own = _fitted(moves, recorded)
    disagreeing = _unexplained(moves, recorded, own)
    larger = [
        name for name, size in sizes.items() if (own[:6] <= size[:6] * (1.0 + AGREEMENT)).all()
    ]
    if disagreeing > len(recorded) // 2 or not larger:
        raise InputError(
            f"No step size explains the motion: {wrong[best]} of {len(recorded)} steps differ from "
            f"action × step even for '{best}'; is this a recording of SurgicAI?"
        )
    return larger[0], disagreeing


def _unexplained(
    moves: NDArray[np.float64], actions: NDArray[np.float64], size: NDArray[np.float64]
) -> int:
    """Return how many moves (N, 7) differ from actions (N, 7) × size (7,)."""
    return int((np.abs(moves / size - actions) > AGREEMENT).any(axis=1).sum())


def _fitted(moves: NDArray[np.float64], actions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a motion's step size (7,), the median of move over action, for rotation as well."""
    size = np.full(7, STEPS["paper"][2])
    for axes in (slice(0, 3), slice(3, 6)):
        moved = np.abs(actions[:, axes]) > AGREEMENT
        ratios = moves[:, axes] / np.where(moved, actions[:, axes], 1.0)
        size[axes] = np.median(ratios[moved]) if moved.any() else np.inf
    fitted: NDArray[np.float64] = np.maximum(size, 1e-9)
    return fitted
