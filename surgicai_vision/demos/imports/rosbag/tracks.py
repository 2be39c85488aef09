"""Pieces: the subtasks found in a bag, each as a track that can be replayed.

It stands between reading (`foreign`, `recording`, `segments`) and replaying (`bag_import`).

    pieces, skipped = take_apart(Path("trial.bag"), None, BagConfig(), TaskConfig())
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, SurgicaiError
from surgicai_vision.demos.imports.replay import Episode, Track, grip_error, needle_path
from surgicai_vision.demos.imports.rosbag.config import BagConfig, listed
from surgicai_vision.demos.imports.rosbag.resample import Arm, Recording, recording_of
from surgicai_vision.demos.imports.rosbag.segments import Segment, holes_passed, moving, segments
from surgicai_vision.demos.imports.sandbox import read_sandboxed
from surgicai_vision.scene import kinematics, needle
from surgicai_vision.scene.holes import PAIRS
from surgicai_vision.scene.rotations import matrix_to_rpy

CLOSED = ("place", "insert", "pullout")
"""Subtasks whose arm holds the needle from beginning to end: without a jaw on record it is
closed.
"""
SLACK = 0.005
"""Furthest an inferred needle may lie outside the jaws that hold it [m]: the paper lets place and
insert end that far from their goals."""
START_JAW = kinematics.PSM1_START[6]
"""Jaw of an arm that does not hold the needle and whose jaw is not on record [rad]."""


class Unusable(SurgicaiError):
    """A part of a recording that cannot be replayed."""


@dataclass(frozen=True)
class Piece:
    """One subtask found in a bag.

    Attributes:
        bag: the bag's name.
        task: the subtask.
        begin, end: where it lies, in seconds of the recording.
        track: what is replayed.
        pauses: samples left out because the arm rested.
    """

    bag: str
    task: str
    begin: float
    end: float
    track: Track
    pauses: int

    def row(self, reason: str) -> dict[str, Any]:
        """Return what is told of a piece that is skipped."""
        return _row(self.bag, self.task, self.begin, self.end, reason)


def take_apart(
    bag: Path, task: str | None, config: BagConfig, base: TaskConfig
) -> tuple[list[Piece], list[dict[str, Any]]]:
    """Return the pieces of a bag, and the parts that cannot be used, {"bag", "task", "from", "to",
    "reason"}.

    Args:
        bag: the bag.
        task: the subtask that is wanted; None for all.
        config: how to read it.
        base: the scene.

    Raises:
        BadFile: an unreadable bag.
        InputError: topics that are not there, nothing to segment by, nothing found.
    """
    arrays = read_sandboxed(
        bag, "bag", topics=config.all_topics, needed=list(config.topics.given())
    )
    try:
        recording = recording_of(arrays, config, base.scene.instrument)
        pair = PAIRS[base.scene.layout][base.scene.hole_pair - 1]
        found = segments(recording, pair, config, task)
        passed = None if recording.needle is None else holes_passed(recording.needle, pair)
        pieces, skipped = [], []
        for segment in found:
            begin, end = (float(recording.time[index]) for index in (segment.start, segment.stop))
            try:
                track, pauses = _track(recording, passed, segment, config, base)
                pieces.append(Piece(bag.name, segment.task, begin, end, track, pauses))
            except Unusable as error:
                skipped.append(_row(bag.name, segment.task, begin, end, str(error)))
    except InputError as error:
        raise type(error)(f"{bag}: {error}") if type(error) is InputError else error from None
    return pieces, skipped


def _row(bag: str, task: str, begin: float, end: float, reason: str) -> dict[str, Any]:
    return {
        "bag": bag,
        "task": task,
        "from": round(begin, 2),
        "to": round(end, 2),
        "reason": reason,
    }


def _track(
    recording: Recording,
    passed: np.ndarray | None,
    segment: Segment,
    config: BagConfig,
    base: TaskConfig,
) -> tuple[Track, int]:
    """Return a segment's track without its pauses, and how many samples were left out."""
    whole = slice(segment.start, segment.stop + 1)
    if not recording.valid[whole].all():
        raise Unusable(f"a topic is silent for over {config.max_gap:g} s")
    active = names.ACTIVE_ARM[segment.task]
    arms = {
        arm: (motion.tip, _jaw(recording, arm, segment.task, config))
        for arm, motion in recording.arms.items()
    }
    if active not in arms:
        wanted = config.all_topics[f"{active}_pose"]
        raise InputError(
            f"{segment.task} is done by {active}, whose pose is not on {wanted}. "
            f"The topics are {listed(recording.topics, wanted)}."
        )
    tip, jaw = arms[active]
    kept = (
        moving(tip[whole], jaw[whole])
        if config.drop_pauses
        else np.arange(segment.stop - segment.start + 1)
    )
    index = segment.start + kept
    if len(index) < 3:
        raise Unusable("the arm does not move")
    lying = (
        _inferred(tip[index], jaw[index], segment.task, base)
        if recording.needle is None
        else recording.needle[index]
    )
    return Track(
        {arm: (poses[index], angles[index]) for arm, (poses, angles) in arms.items()},
        lying,
        _grasp_angle(active, tip[index[-1]], lying[-1]),
        None if passed is None else passed[index],
    ), segment.stop - segment.start + 1 - len(index)


def _jaw(recording: Recording, arm: str, task: str, config: BagConfig) -> np.ndarray:
    """Return an arm's jaw (N,) [rad], as recorded or as the subtask has it."""
    motion: Arm = recording.arms[arm]
    if motion.jaw is not None:
        return motion.jaw
    active = names.ACTIVE_ARM[task]
    if arm == active and task not in CLOSED:
        wanted = config.all_topics[f"{arm}_jaw"]
        raise InputError(
            f"{task} needs the jaw of {arm}, which is not on {wanted}. "
            f"The topics are {listed(recording.topics, wanted)}."
        )
    holding = (arm == active and task in CLOSED) or (arm == names.PSM2 and task == "handoff")
    return np.full(len(recording), 0.0 if holding else START_JAW)


def _grasp_angle(arm: str, tip: np.ndarray, lying: np.ndarray) -> float:
    """Return the needle's point that lies nearest to an arm's jaws [rad]: the grasp that was
    shown.
    """
    x, y, _ = (np.linalg.inv(lying) @ kinematics.base_in_world(arm) @ tip)[:3, 3]
    return float(np.clip(np.arctan2(y, -x), 0.0, needle.TIP_ANGLE))


def _inferred(tip: np.ndarray, jaw: np.ndarray, task: str, base: TaskConfig) -> np.ndarray:
    """Return T_world_needle (T + 1, 4, 4) of a piece that has no needle: where the task's
    definition puts it.
    """
    if (base.scene.layout, base.scene.hole_pair) != ("simple", 1):
        raise InputError(
            "A bag without the needle's pose can be replayed at hole pair 1 of layout simple alone."
        )
    rpy = np.unwrap([matrix_to_rpy(pose[:3, :3]) for pose in tip], axis=0)
    poses = np.column_stack([tip[:, :3, 3], rpy, jaw])
    nothing = np.zeros(len(poses) - 1)
    episode = Episode(poses, poses[-1], np.zeros((len(nothing), 7)), nothing, nothing > 0)
    error = grip_error(episode, task)
    if error > SLACK:
        raise Unusable(f"with this end the needle would lie {error * 1e3:.0f} mm outside the jaws")
    return needle_path(episode, task)
