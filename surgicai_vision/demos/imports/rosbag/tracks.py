"""Tracks: the subtasks found in a bag, each as a track that can be replayed.

tracks, skipped = extract_tracks(Path("trial.bag"), None, BagConfig(), TaskConfig())
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, TaskConfig
from surgicai_vision.core.errors import InputError, SurgicaiError
from surgicai_vision.demos.imports.replay import Episode, Track, grip_error, needle_path
from surgicai_vision.demos.imports.rosbag.config import BagConfig, topic_list
from surgicai_vision.demos.imports.rosbag.resample import (
    Arm,
    Arrays,
    NothingShown,
    Recording,
    resample,
)
from surgicai_vision.demos.imports.rosbag.segments import Segment, holes_passed, moving, segments
from surgicai_vision.demos.imports.sandbox import read_sandboxed
from surgicai_vision.scene import kinematics, needle
from surgicai_vision.scene.holes import PAIRS
from surgicai_vision.scene.rotations import matrix_to_rpy

CLOSED = ("place", "insert", "pullout")
"""Subtasks whose arm holds the needle throughout: a jaw that was not recorded is taken as closed.
"""
MAX_GRIP_ERROR = 0.005
"""Largest distance of an inferred needle outside the jaws that hold it [m]: the paper lets place
and insert end that far from their goals."""
START_JAW = kinematics.STARTS[names.PSM1].jaw
"""Jaw of an arm that does not hold the needle and whose jaw was not recorded [rad]."""


class UnusableSegment(SurgicaiError):
    """A part of a recording that cannot be replayed."""


@dataclass(frozen=True)
class SegmentTrack:
    """One subtask found in a bag.

    Attributes:
        bag: the bag's name.
        task: the subtask.
        begin, end: its first and last time in the recording [s].
        track: what is replayed.
        pauses: samples left out because the arm rested.
    """

    bag: str
    task: str
    begin: float
    end: float
    track: Track
    pauses: int

    def row(self, reason: str) -> dict[str, JSON]:
        """Return the row of a skipped segment."""
        return _row(self.bag, self.task, self.begin, self.end, reason)


def extract_tracks(
    bag: Path, task: str | None, config: BagConfig, base: TaskConfig
) -> tuple[list[SegmentTrack], list[dict[str, JSON]]]:
    """Return the tracks of a bag's segments, and what is skipped.

    A skipped segment is {"bag", "task", "from", "to", "reason"}. So is a recording that shows
    nothing of what is requested; its task is "" if all were requested.

    Args:
        bag: the bag.
        task: the requested subtask; None for all.
        config: how to read the bag.
        base: the scene.

    Raises:
        BadFile: an unreadable bag.
        InputError: topics that are not there, nothing to segment by.
    """
    arrays = read_sandboxed(
        bag, "bag", topics=config.all_topics, needed=list(config.topics.given())
    )
    return tracks_of(arrays, bag, task, config, base)


def tracks_of(
    arrays: Arrays, path: Path, task: str | None, config: BagConfig, base: TaskConfig
) -> tuple[list[SegmentTrack], list[dict[str, JSON]]]:
    """Return the tracks of a recording's segments, and what is skipped, as `extract_tracks` does.

    Args:
        arrays: see `reader.read`.
        path: what the recording was read from, for messages; its name becomes the tracks' `bag`.
        task: the requested subtask; None for all.
        config: how to read the recording.
        base: the scene.
    """
    begin = 0.0
    end = 0.0
    try:
        recording = resample(arrays, config, base.scene.instrument)
        pair = PAIRS[base.scene.layout][base.scene.hole_pair - 1]
        begin = float(recording.time[0])
        end = float(recording.time[-1])
        found = segments(recording, pair, config, task)
        passed = None if recording.needle is None else holes_passed(recording.needle, pair)
        tracks = []
        skipped = []
        for segment in found:
            begin = float(recording.time[segment.start])
            end = float(recording.time[segment.stop])
            try:
                track, pauses = _track(recording, passed, segment, config, base)
                tracks.append(SegmentTrack(path.name, segment.task, begin, end, track, pauses))
            except UnusableSegment as error:
                skipped.append(_row(path.name, segment.task, begin, end, str(error)))
    except NothingShown as error:
        return [], [_row(path.name, task or "", begin, end, str(error).rstrip("."))]
    except InputError as error:
        raise type(error)(f"{path}: {error}") if type(error) is InputError else error from None
    return tracks, skipped


def _row(bag: str, task: str, begin: float, end: float, reason: str) -> dict[str, JSON]:
    return {
        "bag": bag,
        "task": task,
        "from": round(begin, 2),
        "to": round(end, 2),
        "reason": reason,
    }


def _track(
    recording: Recording,
    passed: NDArray[np.float64] | None,
    segment: Segment,
    config: BagConfig,
    base: TaskConfig,
) -> tuple[Track, int]:
    """Return a segment's track without its pauses, and how many samples were left out."""
    whole = slice(segment.start, segment.stop + 1)
    if not recording.valid[whole].all():
        raise UnusableSegment(f"a topic is silent for over {config.max_gap:g} s")
    active = names.ACTIVE_ARM[segment.task]
    arms = {
        arm: (motion.tip, _jaw(recording, arm, segment.task, config))
        for arm, motion in recording.arms.items()
    }
    if active not in arms:
        wanted = config.all_topics[f"{active}_pose"]
        raise InputError(
            f"{segment.task} is done by {active}, whose pose is not on {wanted}. "
            f"The topics are {topic_list(recording.topics, wanted)}."
        )
    tip, jaw = arms[active]
    index: NDArray[np.int64] = np.arange(segment.start, segment.stop + 1)
    if config.drop_pauses:
        index = segment.start + moving(tip[whole], jaw[whole])
    if len(index) < 3:
        raise UnusableSegment("the arm does not move")
    if recording.needle is None:
        needle_poses = _inferred(tip[index], jaw[index], segment.task, base)
    else:
        needle_poses = recording.needle[index]
    return Track(
        {arm: (poses[index], angles[index]) for arm, (poses, angles) in arms.items()},
        needle_poses,
        _grasp_angle(active, tip[index[-1]], needle_poses[-1]),
        None if passed is None else passed[index],
    ), segment.stop - segment.start + 1 - len(index)


def _jaw(recording: Recording, arm: str, task: str, config: BagConfig) -> NDArray[np.float64]:
    """Return an arm's jaw (N,) [rad], as recorded or as implied by the subtask."""
    motion: Arm = recording.arms[arm]
    if motion.jaw is not None:
        return motion.jaw
    active = names.ACTIVE_ARM[task]
    if arm == active and task not in CLOSED:
        wanted = config.all_topics[f"{arm}_jaw"]
        raise InputError(
            f"{task} needs the jaw of {arm}, which is not on {wanted}. "
            f"The topics are {topic_list(recording.topics, wanted)}."
        )
    holding = (arm == active and task in CLOSED) or (arm == names.PSM2 and task == "handoff")
    return np.full(len(recording), 0.0 if holding else START_JAW)


def _grasp_angle(arm: str, tip: NDArray[np.float64], needle_pose: NDArray[np.float64]) -> float:
    """Return the needle's point nearest to an arm's jaws, the demonstrated grasp [rad]."""
    x, y, _ = (np.linalg.inv(needle_pose) @ kinematics.base_in_world(arm) @ tip)[:3, 3]
    return float(np.clip(np.arctan2(y, -x), 0.0, needle.TIP_ANGLE))


def _inferred(
    tip: NDArray[np.float64], jaw: NDArray[np.float64], task: str, base: TaskConfig
) -> NDArray[np.float64]:
    """Return T_world_needle (T + 1, 4, 4) where the task's definition puts an unrecorded needle."""
    if (base.scene.layout, base.scene.hole_pair) != ("simple", 1):
        raise InputError(
            "A bag without the needle's pose can be replayed only at hole pair 1 of layout simple."
        )
    rpy = np.unwrap([matrix_to_rpy(pose[:3, :3]) for pose in tip], axis=0)
    poses = np.column_stack([tip[:, :3, 3], rpy, jaw])
    zeros = np.zeros(len(poses) - 1)
    episode = Episode(poses, poses[-1], np.zeros((len(zeros), 7)), zeros, zeros > 0)
    error = grip_error(episode, task)
    if error > MAX_GRIP_ERROR:
        raise UnusableSegment(
            f"with this end the needle would lie {error * 1e3:.0f} mm outside the jaws"
        )
    return needle_path(episode, task)
