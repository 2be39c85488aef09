"""Import of `robot drive`'s log: what a policy did on a robot, replayed in our scene.

    summaries = import_drive_log(Path("outputs/drive/…/drive.jsonl"), task=None, out=Path("demos"))

The log has one line per control step with both arms' measured poses in their bases and the subtask
(`robot.driver`). Its episodes are read like a bag (`rosbag.importer`): split into subtasks, freed
of pauses and replayed. A control step in which nothing was sent is left out if nothing was measured
either. The log has no needle pose: the needle is where the task's definition puts it, as for a bag
without a needle.

Nothing in the file is executed, and nothing but numbers is read from it.
"""

import dataclasses
import hashlib
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, to_mapping
from surgicai_vision.core.errors import BadFile, first_line
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.core.untrusted import checked, parse_json
from surgicai_vision.demos.imports.rosbag.config import BagConfig
from surgicai_vision.demos.imports.rosbag.importer import (
    BagSummary,
    base_config,
    check_folders,
    write_tracks,
)
from surgicai_vision.demos.imports.rosbag.resample import Arrays
from surgicai_vision.demos.imports.rosbag.tracks import SegmentTrack, tracks_of
from surgicai_vision.scene.rotations import matrix_to_quaternion_flat, rpy_to_matrix

DEMONSTRATOR = "drive"
"""The demonstrator's name, as it is stored."""
SEVEN = 7
"""Numbers per arm: x y z [m], roll pitch yaw, one finger's angle [rad]."""
MAX_STEP = 10**9
"""Largest control step that is read: more than half a year."""
POSE = "geometry_msgs/PoseStamped"
JOINT = "sensor_msgs/JointState"


@dataclasses.dataclass(frozen=True)
class _Step:
    """One line of the log.

    Attributes:
        run: which run of the command it belongs to.
        seed: the episode's seed.
        number: control step in the episode.
        phase: number of the subtask.
        arms: both arms' seven numbers, psm1 first.
    """

    run: int
    seed: int
    number: int
    phase: int
    arms: tuple[float, ...]


def import_drive_log(
    path: Path,
    *,
    task: str | None,
    out: Path,
    config: BagConfig = BagConfig(),  # noqa: B008  # frozen
    env: dict[str, object] | None = None,
    progress: Progress | None = None,
) -> list[BagSummary]:
    """Import a log into folders of demonstrations, one per subtask.

    Args:
        path: the log.
        task: the requested subtask, written to `out`; None: every subtask that is found, written
            to `out`/<task>.
        out: folder to create; repeating the same import of the same log reuses it.
        config: how to read the log; topics, frames and jaw scale are those of a bag.
        env: fields of `TaskConfig`, including the scene with its hole pair and instrument.
        progress: called with (demonstrations done, demonstrations, "demonstrations").

    Raises:
        UnknownName: an unknown task.
        BadFile: a damaged log, or one without measured poses.
        InputError: nothing that can be replayed.
        OutputExists: `out` holds something else.
    """
    base = base_config(task, env)
    check_folders(out, task)
    config = dataclasses.replace(config, jaw_scale=1.0)
    steps = list(_steps(path))
    tracks: list[SegmentTrack] = []
    skipped: list[dict[str, JSON]] = []
    for (run, seed), episode in itertools.groupby(steps, lambda step: (step.run, step.seed)):
        name = path / f"run {run}, start {seed}"
        usable, unusable = tracks_of(_arrays(list(episode)), name, task, config, base)
        tracks += usable
        skipped += unusable
    if not steps:
        raise BadFile(f"{path} holds no measured poses; it is not a log of 'robot drive'.")
    request: dict[str, object] = {
        "drive": hashlib.sha256(path.read_bytes()).hexdigest(),
        "bag": to_mapping(config),
        "env": dict(env or {}),
    }
    report = progress or silent
    return write_tracks(tracks, skipped, task, out, base, config, request, report, DEMONSTRATOR)


def _steps(path: Path) -> Iterator[_Step]:
    """Yield the control steps in which poses were measured; an incomplete last line is ignored."""
    try:
        lines = path.read_text("utf-8").split("\n")[:-1]
    except (OSError, UnicodeDecodeError) as error:
        raise BadFile(f"{path} cannot be read ({first_line(error)}).") from None
    run = 0
    for number, line in enumerate(lines, 1):
        try:
            row = checked(
                parse_json(line, f"{path}, line {number}"), dict, f"{path}, line {number}"
            )
            if "policy" in row:  # the first line of a run says what it is about
                run += 1
                continue
            arms = tuple(float(value) for value in cast(list[float], row["both_arms"]))
            if not arms:
                continue
            seed, step, phase = (int(cast(int, row[key])) for key in ("episode", "step", "phase"))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise BadFile(
                f"{path}, line {number} is not a line of a log ({first_line(error)})."
            ) from None
        if len(arms) != 2 * SEVEN or not np.isfinite(arms).all():
            raise BadFile(f"{path}, line {number}: both_arms must be {2 * SEVEN} finite numbers.")
        if not 0 <= step <= MAX_STEP:
            raise BadFile(f"{path}, line {number}: step must be within 0 and {MAX_STEP}.")
        if not 0 <= phase < len(names.SUBTASKS):
            raise BadFile(f"{path}, line {number}: there is no subtask {phase}.")
        yield _Step(run, seed, step, phase, arms)


def _arrays(episode: list[_Step]) -> Arrays:
    """Return one episode's arrays, in the form of `rosbag.reader.read`."""
    time = np.array([step.number * 1_000_000_000 // names.FPS for step in episode], np.int64)
    arrays: dict[str, NDArray[np.generic]] = {"topics": np.array(["both_arms"], dtype=str)}

    def add(role: str, values: NDArray[np.generic], kind: str) -> None:
        arrays[f"{role}.time"] = time
        arrays[f"{role}.stamp"] = np.zeros_like(time)
        arrays[f"{role}.value"] = values
        arrays[f"{role}.type"] = np.array(kind)
        arrays[f"{role}.frame"] = np.array("")

    for index, arm in enumerate(names.ARMS):
        rows = np.array([step.arms[SEVEN * index : SEVEN * (index + 1)] for step in episode])
        add(f"{arm}_pose", np.array([_pose(row) for row in rows]), POSE)
        add(f"{arm}_jaw", rows[:, 6], JOINT)
    add("label", np.array([str(step.phase) for step in episode]), "std_msgs/String")
    return arrays


def _pose(seven: NDArray[np.float64]) -> list[float]:
    """Return x y z and a unit quaternion w x y z from an arm's seven numbers."""
    a, b, c, d, e, f, g, h, i = rpy_to_matrix(*seven[3:6].tolist()).ravel().tolist()
    return [*seven[:3].tolist(), *matrix_to_quaternion_flat((a, b, c, d, e, f, g, h, i))]
