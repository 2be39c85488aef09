"""Import bags: both arms' motion and the needle's from ROS, replayed state by state in our scene.

    summaries = import_bags([Path("trial.bag")], task=None, out=Path("demos"))

Read (`foreign`, `bags`), put on the control rate (`recording`), cut into subtasks (`segments`),
leave out the pauses (`bag_pieces`), replay (`replay`), write. What was measured there is where
everything stands here; actions are the motions between. Success is judged as the envs do, with one
leniency: the jaws' contact may be that of the geometry (`segments.held`), because a foreign needle
never lies between our pads to a tenth of a millimetre.

Without a needle in the bag it lies where the task's definition puts it, as in SurgicAI's recordings
(`replay`).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.config import STEPS, TaskConfig, from_mapping, to_mapping
from surgicai_vision.core.errors import InputError, UnreachablePose, check_name
from surgicai_vision.core.executor import building
from surgicai_vision.core.files import check_output, code_version, sha256_file, whole_folder
from surgicai_vision.core.progress import Progress
from surgicai_vision.demos.imports.replay import MOST_CLIPPED, Replay, Track, moves
from surgicai_vision.demos.imports.rosbag.config import BagConfig
from surgicai_vision.demos.imports.rosbag.segments import held
from surgicai_vision.demos.imports.rosbag.tracks import Piece, take_apart
from surgicai_vision.demos.record import finished
from surgicai_vision.demos.store import (
    MARKER,
    Demo,
    list_demos,
    read_marker,
    write_demo,
    write_marker,
)

Row = Mapping[str, Any]


@dataclass(frozen=True)
class BagSummary:
    """What an import made of one subtask.

    Attributes:
        task: the subtask.
        out: its folder of demonstrations.
        paths: the demonstrations' files.
        step: the step preset.
        steps: number of actions.
        clipped: steps faster than the preset allows, whose action was clipped to [-1, 1].
        pauses: samples left out because the arm rested.
        succeeded: demonstrations whose last state meets the task's tolerances in our scene.
        skipped: parts that could not be replayed, {"bag", "task", "from", "to", "reason"}; times in
            seconds.
    """

    task: str
    out: Path
    paths: tuple[Path, ...]
    step: str
    steps: int
    clipped: int
    pauses: int
    succeeded: int
    skipped: tuple[Row, ...]


def import_bags(
    bags: Sequence[Path],
    *,
    task: str | None,
    out: Path,
    config: BagConfig = BagConfig(),  # noqa: B008  # frozen
    env: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> list[BagSummary]:
    """Import bags into folders of demonstrations, one a subtask.

    Args:
        bags: bag files and ROS 2 folders.
        task: the subtask that is wanted, into `out`; None: every one that is found, into
            `out`/<task>.
        out: folder to make; the same import of the same bags finds it finished.
        config: how to read them.
        env: fields of `TaskConfig`, among them the scene with its hole pair and instrument.
        progress: called with (bags read, bags, "bags"), then (demonstrations done, demonstrations,
            "demonstrations").

    Raises:
        UnknownName: an unknown task.
        BadFile: an unreadable bag.
        InputError: topics that are not there, nothing to segment by, nothing found, nothing that
            can be replayed.
        OutputExists: `out` holds something else.
    """
    base = from_mapping(
        TaskConfig, {**(env or {}), "task": check_name("subtask", task or "grasp", names.SUBTASKS)}
    )
    if task:
        check_output(out, may_resume=MARKER)
    pieces: list[Piece] = []
    skipped: list[Row] = []
    for number, bag in enumerate(bags):
        if progress:
            progress(number, len(bags), "bags")
        found, unusable = take_apart(bag, task, config, base)
        pieces, skipped = pieces + found, [*skipped, *unusable]
    if not pieces:
        raise InputError(f"Nothing can be imported: {skipped[0]['task']}: {skipped[0]['reason']}.")
    request = {
        "bags": [_digests(bag) for bag in bags],
        "bag": to_mapping(config),
        "env": dict(env or {}),
    }
    summaries, done = [], 0
    for name in names.SUBTASKS:
        some = [piece for piece in pieces if piece.task == name]
        if not some:
            continue
        folder = out if task else out / name
        asked = {**request, "task": name}
        check_output(folder, may_resume=MARKER)
        if not finished(folder, asked):
            tell = _told(progress, done, len(pieces))
            _build(
                folder,
                some,
                [row for row in skipped if row["task"] == name],
                base,
                config,
                asked,
                tell,
            )
        done += len(some)
        marker = read_marker(folder)
        notes = {**marker["notes"], "skipped": tuple(marker["skipped"])}
        summaries.append(BagSummary(name, folder, tuple(list_demos(folder)), **notes))
    return summaries


def _digests(bag: Path) -> dict[str, str]:
    """Return the hash of each file of a bag."""
    files = sorted(path for path in bag.iterdir() if path.is_file()) if bag.is_dir() else [bag]
    return {path.name: sha256_file(path) for path in files}


def _told(progress: Progress | None, before: int, total: int) -> Any:
    """Return what tells that so many demonstrations of a subtask are done."""
    return lambda done: progress(before + done, total, "demonstrations") if progress else None


def _build(
    out: Path,
    pieces: Sequence[Piece],
    skipped: Sequence[Row],
    base: TaskConfig,
    config: BagConfig,
    request: Mapping[str, Any],
    tell: Any,
) -> None:
    """Replay the pieces of one subtask and write its folder."""
    task = pieces[0].task
    longest = max(len(piece.track.needle) - 1 for piece in pieces)
    step = config.step or fastest(task, [piece.track for piece in pieces])
    task_config = dataclasses.replace(
        base, task=task, step=step, max_steps=max(base.max_steps, longest)
    )
    replay, rows = Replay(task_config), list(skipped)
    counts = {"steps": 0, "clipped": 0, "pauses": 0, "succeeded": 0}
    count = 0
    with building(out) as (_, result), whole_folder(result) as folder:
        for number, piece in enumerate(pieces, 1):
            try:
                demo, clipped = demonstration(replay, piece.track)
            except UnreachablePose as error:
                rows.append(piece.row(str(error)))
            else:
                write_demo(folder, count, demo)
                count += 1
                more = {
                    "steps": len(demo),
                    "clipped": clipped,
                    "pauses": piece.pauses,
                    "succeeded": demo.success[-1],
                }
                counts = {key: counts[key] + int(value) for key, value in more.items()}
            tell(number)
        if not count:
            raise InputError(f"No {task} can be replayed in our scene: {rows[-1]['reason']}")
        details = {
            "request": request,
            "skipped": rows,
            "episodes": count,
            "notes": {"step": step, **counts},
        }
        write_marker(folder, task, "bag", code=code_version(), **details)


def fastest(task: str, tracks: Sequence[Track]) -> str:
    """Return the smallest step preset that nearly all steps of some tracks fit into, or the one
    that most fit into.
    """
    arm = names.ACTIVE_ARM[task]
    total = sum(len(track.needle) - 1 for track in tracks)
    clipped = {step: sum(moves(*track.arms[arm], step)[1] for track in tracks) for step in STEPS}
    return next(
        (step for step in STEPS if clipped[step] <= MOST_CLIPPED * total),
        min(STEPS, key=lambda s: clipped[s]),
    )


def demonstration(replay: Replay, track: Track) -> tuple[Demo, int]:
    """Return a track as a demonstration, and how many of its actions were clipped.

    Raises:
        UnreachablePose: a pose outside the arms' joint limits.
    """
    from surgicai_vision.envs import SUBTASKS

    config = replay.config
    subtask, arm = SUBTASKS[config.task], names.ACTIVE_ARM[config.task]
    tip, jaw = track.arms[arm]
    states, infos = replay.play(track)
    action, clipped = moves(tip, jaw, config.step)
    contact = np.array([info["contact"] for info in infos]) | held(arm, tip, jaw, track.needle)
    success = np.array([info["is_success"] for info in infos])
    if subtask.demands[config.tolerance].contact:
        distance, angle = (
            np.array([info[key] for info in infos]) for key in ("d_trans", "d_angle")
        )
        near = subtask.tolerances[config.tolerance]
        success |= (distance <= near.distance) & (angle <= near.angle) & contact
    reward = [
        replay.reward(bool(good), info) for good, info in zip(success[1:], infos[1:], strict=True)
    ]
    demo = replay.as_demo(
        "bag",
        states,
        action=action,
        reward=np.array(reward, dtype=np.float32),
        success=success[1:],
        contact=contact[1:],
    )
    return demo, clipped
