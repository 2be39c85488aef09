"""Import of bags: both arms' motion and the needle's from ROS, replayed in our scene.

    summaries = import_bags([Path("trial.bag")], task=None, out=Path("demos"))

A bag is read (`sandbox`, `reader`), resampled to the control rate (`resample`), split into subtasks
(`segments`), freed of pauses (`tracks`), replayed (`replay`) and written. Arms and needle are posed
where they were measured; actions are the motions in between. Success is judged as in the envs, with
one exception: geometric contact (`segments.held`) also counts, because a recorded needle never lies
between our pads to within a tenth of a millimetre.

A needle that is not in the bag is where the task's definition puts it, as in SurgicAI's recordings
(`replay`).
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, TaskConfig, from_mapping, to_mapping
from surgicai_vision.core.errors import InputError, UnreachablePose, check_name
from surgicai_vision.core.executor import building
from surgicai_vision.core.files import check_output, check_renamed, sha256_file, whole_folder
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.demos.imports.replay import Replay, Track, fitting_step, motion_actions
from surgicai_vision.demos.imports.rosbag.config import BagConfig
from surgicai_vision.demos.imports.rosbag.segments import held
from surgicai_vision.demos.imports.rosbag.tracks import SegmentTrack, extract_tracks
from surgicai_vision.demos.record import finished
from surgicai_vision.demos.store import (
    MARKER,
    Demo,
    list_demos,
    read_marker,
    write_demo,
    write_marker,
)
from surgicai_vision.envs import SUBTASKS

Row = Mapping[str, JSON]
DEMONSTRATOR = "bag"
"""The demonstrator's name for a bag, as it is stored."""


@dataclass(frozen=True)
class BagSummary:
    """The result of an import for one subtask.

    Attributes:
        task: the subtask.
        out: its folder of demonstrations.
        paths: the demonstrations' files.
        step: the step preset.
        steps: number of actions.
        clipped: steps faster than the preset allows, whose action was clipped to [-1, 1].
        pauses: samples left out because the arm rested.
        succeeded: demonstrations whose last state meets the task's tolerances in our scene.
        skipped: segments that could not be replayed, and recordings that show nothing of what was
            requested, {"bag", "task", "from", "to", "reason"}; times in seconds.
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
    env: Mapping[str, object] | None = None,
    progress: Progress | None = None,
) -> list[BagSummary]:
    """Import bags into folders of demonstrations, one per subtask.

    Args:
        bags: bag files and ROS 2 folders.
        task: the requested subtask, written to `out`; None: every subtask that is found, written
            to `out`/<task>.
        out: folder to create; repeating the same import of the same bags reuses it.
        config: how to read the bags.
        env: fields of `TaskConfig`, including the scene with its hole pair and instrument.
        progress: called with (bags read, bags, "bags"), then (demonstrations done, demonstrations,
            "demonstrations").

    Raises:
        UnknownName: an unknown task.
        BadFile: an unreadable bag.
        InputError: topics that are not there, nothing to segment by, nothing found in any bag,
            nothing that can be replayed.
        OutputExists: `out` holds something else.
    """
    base = base_config(task, env)
    check_folders(out, task)
    # Read the bags, split into tracks.
    report = progress or silent
    tracks: list[SegmentTrack] = []
    skipped: list[Row] = []
    for number, bag in enumerate(bags):
        report(number, len(bags), "bags")
        usable, unusable = extract_tracks(bag, task, config, base)
        tracks += usable
        skipped += unusable
    request: dict[str, object] = {
        "bags": [_digests(bag) for bag in bags],
        "bag": to_mapping(config),
        "env": dict(env or {}),
    }
    return write_tracks(tracks, skipped, task, out, base, config, request, report)


def base_config(task: str | None, env: Mapping[str, object] | None) -> TaskConfig:
    """Return the env of an import: that of the requested subtask, or of any.

    Raises:
        UnknownName: no subtask of that name, or no such key.
        InputError: an env that names a task, which is a separate argument, or whose actions are
            held; a recorded motion is that of every control step.
    """
    if "task" in (env or {}):
        raise InputError(
            "env: the task is a separate option; write `task:` next to `env:`, or leave it out to "
            "import every subtask that is found."
        )
    config = from_mapping(
        TaskConfig, {**(env or {}), "task": check_name("subtask", task or "grasp", names.SUBTASKS)}
    )
    if config.action_repeat != 1:
        raise InputError(
            f"env: action_repeat is {config.action_repeat}; an import has an action for every "
            "control step: leave it out ('export-demos' can hold its actions)."
        )
    return config


def check_folders(out: Path, task: str | None) -> None:
    """Refuse folders that an import cannot write, before anything is read.

    Args:
        out: as given to the import.
        task: the requested subtask, written to `out`; None: any, written to `out`/<task>.

    Raises:
        OutputExists: one holds something other than demonstrations.
        InputError: one cannot be written.
    """
    for folder in [out] if task else [out / name for name in names.SUBTASKS]:
        check_output(folder, may_resume=MARKER)
        check_renamed(folder)


def write_tracks(
    tracks: Sequence[SegmentTrack],
    skipped: Sequence[Row],
    task: str | None,
    out: Path,
    base: TaskConfig,
    config: BagConfig,
    request: Mapping[str, object],
    report: Progress,
    demonstrator: str = DEMONSTRATOR,
) -> list[BagSummary]:
    """Replay tracks into folders of demonstrations, one per subtask.

    Args:
        tracks: what was found.
        skipped: what was found and cannot be used.
        task: the requested subtask, written to `out`; None: all, written to `out`/<task>.
        out: folder to create.
        base: the env (`base_config`).
        config: how the recording was read.
        request: what was requested; repeating the same request reuses its folders.
        report: gets the number of demonstrations done.
        demonstrator: the demonstrator's name, as it is stored.

    Raises:
        InputError: nothing can be replayed.
    """
    if not tracks:
        first = skipped[0]
        what = f"{first['bag']}: {first['task']}" if first["task"] else first["bag"]
        raise InputError(f"Nothing can be imported: {what}: {first['reason']}.")
    # Create a folder for each subtask that was found, or reuse a finished one.
    summaries = []
    done = 0
    for name in names.SUBTASKS:
        of_subtask = [track for track in tracks if track.task == name]
        if not of_subtask:
            continue
        folder = out if task else out / name
        asked = {**request, "task": name}
        check_output(folder, may_resume=MARKER)
        if not finished(folder, asked):
            _build(
                folder,
                of_subtask,
                [row for row in skipped if row["task"] in (name, "")],
                base,
                config,
                asked,
                functools.partial(_report_all, report, done, len(tracks)),
                demonstrator,
            )
        done += len(of_subtask)
        marker = read_marker(folder)
        notes = {**marker["notes"], "skipped": tuple(marker["skipped"])}
        summaries.append(BagSummary(name, folder, tuple(list_demos(folder)), **notes))
    return summaries


def _digests(bag: Path) -> dict[str, str]:
    """Return the hash of each file of a bag."""
    files = sorted(path for path in bag.iterdir() if path.is_file()) if bag.is_dir() else [bag]
    return {path.name: sha256_file(path) for path in files}


def _report_all(progress: Progress, before: int, total: int, done: int) -> None:
    """Report the progress of one subtask as progress of the whole import."""
    progress(before + done, total, "demonstrations")


def _build(
    out: Path,
    tracks: Sequence[SegmentTrack],
    skipped: Sequence[Row],
    base: TaskConfig,
    config: BagConfig,
    request: Mapping[str, object],
    report: Callable[[int], None],
    demonstrator: str,
) -> None:
    """Replay the tracks of one subtask and write its folder."""
    task = tracks[0].task
    arm = names.ACTIVE_ARM[task]
    longest = max(len(track.track.needle) - 1 for track in tracks)
    step = config.step or fitting_step([track.track.arms[arm] for track in tracks])
    task_config = dataclasses.replace(
        base, task=task, step=step, max_steps=max(base.max_steps, longest)
    )
    # Replay what can be replayed, and note why the rest cannot.
    replay = Replay(task_config)
    rows = list(skipped)
    counts = {"steps": 0, "clipped": 0, "pauses": 0, "succeeded": 0}
    count = 0
    with building(out) as (_, result), whole_folder(result) as folder:
        for number, track in enumerate(tracks, 1):
            try:
                demo, clipped = as_demonstration(replay, track.track, demonstrator)
            except UnreachablePose as error:
                rows.append(track.row(str(error)))
            else:
                write_demo(folder, count, demo)
                count += 1
                more = {
                    "steps": len(demo),
                    "clipped": clipped,
                    "pauses": track.pauses,
                    "succeeded": demo.success[-1],
                }
                counts = {key: counts[key] + int(value) for key, value in more.items()}
            report(number)
        if not count:
            raise InputError(f"No {task} can be replayed in our scene: {rows[-1]['reason']}")
        details = {
            "request": request,
            "skipped": rows,
            "episodes": count,
            "notes": {"step": step, **counts},
        }
        write_marker(folder, task, demonstrator, **details)


def as_demonstration(
    replay: Replay, track: Track, demonstrator: str = DEMONSTRATOR
) -> tuple[Demo, int]:
    """Return a track as a demonstration, and how many of its actions were clipped.

    Raises:
        UnreachablePose: a pose outside the arms' joint limits.
    """
    config = replay.config
    subtask = SUBTASKS[config.task]
    arm = names.ACTIVE_ARM[config.task]
    tip, jaw = track.arms[arm]
    states, infos = replay.play(track)
    action, clipped = motion_actions((tip, jaw), config.step)
    contact = np.array([info["contact"] for info in infos]) | held(arm, tip, jaw, track.needle)
    success = np.array([info["is_success"] for info in infos])
    if subtask.demands[config.tolerance].contact:
        distance = np.array([info["d_trans"] for info in infos])
        angle = np.array([info["d_angle"] for info in infos])
        tolerance = subtask.tolerances[config.tolerance]
        success |= (distance <= tolerance.distance) & (angle <= tolerance.angle) & contact
    reward = [
        replay.reward(bool(succeeded), info)
        for succeeded, info in zip(success[1:], infos[1:], strict=True)
    ]
    demo = replay.as_demo(
        demonstrator,
        states,
        action=action,
        reward=np.array(reward, dtype=np.float32),
        success=success[1:],
        contact=contact[1:],
    )
    return demo, clipped
