"""Segments: which part of a recording is which subtask, by labels or by what happens to the needle.

    for segment in segments(recording, pair, config, task=None): ...

By labels: the maximal runs of one subtask. By events, in the order of the procedure, repeatedly:

    grasp    until PSM2 holds the needle
    place    until the tip passes the entry
    insert   until the needle is where PSM1 will take it, after the tip has passed the exit
    handoff  until PSM1 holds the needle
    pullout  until the needle's last move in PSM1's jaws, after it has left the exit

An arm holds the needle when its jaw has been closed (0.2 rad, where the surgical robotics challenge
grasps) with the needle within reach of its pads for 0.1 s. Traversed holes are detected by the same
test as in the envs (`envs.hole_crossing`). A recording that starts late begins with the subtask
then under way. A needle held as close to the entry as an insertion may start (5.5 mm, 12°) counts
as being inserted, not placed.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos.dmp.primitive import PAUSE_SPEED, PAUSE_TURN_RATE
from surgicai_vision.demos.imports.rosbag.config import NOTHING, BagConfig
from surgicai_vision.demos.imports.rosbag.resample import RATE, NothingShown, Recording
from surgicai_vision.envs import hole_crossing, poses
from surgicai_vision.envs.geometry import Stitch, needle_frame
from surgicai_vision.envs.insert import START_SHIFT, START_TURN
from surgicai_vision.envs.task_state import TaskState
from surgicai_vision.envs.tissue import Tissue
from surgicai_vision.scene import kinematics, needle
from surgicai_vision.scene.arm import GRASP_DEPTH
from surgicai_vision.scene.holes import HolePair
from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import geodesic_angle

HOLD_JAW = 0.2
"""An arm that holds the needle has its finger below this angle [rad]."""
HOLD_REACH = 0.003
"""An arm that holds the needle has it within this distance of its grasp point [m]."""
STILL = 0.02
"""The finger of an arm that holds the needle closes by less than this in the next 0.2 s [rad]."""
SUSTAINED = 5
"""Samples that an event must last: 0.1 s."""
SHORTEST = 10
"""Samples of the shortest segment that is kept: 0.2 s."""
ARRIVED = 0.0005
ARRIVED_TURN = np.radians(2.0)
"""The needle has arrived when it is this close to where PSM1 takes it [m, rad]."""
PAUSE_JAW_RATE = np.radians(1.0)
"""A jaw slower than this is at rest [rad/s]."""
WINDOW = 5
"""Speeds are measured over this many samples to either side, 0.2 s in all: over fewer samples, the
sensors' noise would dominate.
"""
DRIFT = 0.25e-3
DRIFT_TURN = np.radians(1.0)
"""A sample of a resting arm that has crept this far from the last one kept is kept: half a step."""


@dataclass(frozen=True)
class Segment:
    """Samples `start` to `stop` (inclusive) of one subtask."""

    task: str
    start: int
    stop: int


def segments(
    recording: Recording, pair: HolePair, config: BagConfig, task: str | None
) -> list[Segment]:
    """Return the segments of a recording, or those of one task, in order.

    Args:
        recording: the recording.
        pair: the holes the needle goes through.
        config: how to segment it.
        task: the requested subtask, and what a recording without labels and needle shows; None for
            all.

    Raises:
        NothingShown: nothing found.
        InputError: nothing to segment by, or an unknown label.
    """
    method = config.segmentation
    if method == "auto" and recording.label is not None:
        method = "labels"
    elif method == "auto":
        method = NOTHING if recording.needle is None else "events"
    if method == NOTHING:
        if task is None:
            raise InputError(
                "The recording has neither labels nor a needle pose to segment it by; say what "
                "it shows (--task)."
            )
        return [Segment(task, 0, len(recording) - 1)]
    found = _by_labels(recording, config) if method == "labels" else _by_events(recording, pair)
    wanted = [segment for segment in found if task in (None, segment.task)]
    if not wanted:
        shown = ", ".join(sorted({segment.task for segment in found})) or "none"
        raise NothingShown(
            f"The recording shows no {task or 'subtask'}; segmented by {method} it shows {shown}."
        )
    return wanted


def _by_labels(recording: Recording, config: BagConfig) -> list[Segment]:
    if recording.label is None:
        raise InputError(
            "The recording has no labels; they are expected on the topic "
            f"{config.all_topics['label']}."
        )
    meaning = {label: config.subtask_of(str(label)) for label in np.unique(recording.label)}
    subtasks = np.array([meaning[label] for label in recording.label])
    edges = [0, *(np.flatnonzero(subtasks[1:] != subtasks[:-1]) + 1), len(subtasks)]
    runs = [
        # The state after a run's last action is the first one of the next run.
        Segment(str(subtasks[start]), int(start), min(int(stop), len(subtasks) - 1))
        for start, stop in itertools.pairwise(edges)
    ]
    return [run for run in runs if run.task != NOTHING and run.stop - run.start >= SHORTEST]


# -- events ----------------------------------------------------------------------------------------


def _by_events(recording: Recording, pair: HolePair) -> list[Segment]:
    if recording.needle is None:
        raise InputError(
            "Contact and hole events need the needle's pose; the recording has none. "
            "Segment by labels."
        )
    poses_of_needle = recording.needle
    last = len(recording) - 1
    passed = holes_passed(poses_of_needle, pair)
    inside = (passed == 1.0) | (passed == 2.0)
    held_by_psm1, held_by_psm2 = (holds(recording, arm) for arm in names.ARMS)
    found: list[Segment] = []
    start = 0
    while start < last:
        # The samples at which the subtasks end, in the order of the procedure.
        grasped = _next(held_by_psm2 | inside, start)
        placed = _next(inside, grasped)
        if placed > grasped and inside[placed] and _near_entry(poses_of_needle[grasped], pair):
            placed = grasped
        handed_off = _next(held_by_psm1, _next(passed >= 2.0, placed))
        inserted = handed_off
        end = handed_off
        if held_by_psm1[handed_off]:
            inserted = _arrival(poses_of_needle, placed, handed_off)
            end = _release(held_by_psm1, poses_of_needle, handed_off)
        cuts = [start, grasped, placed, inserted, handed_off, end]
        happened = [
            held_by_psm2[grasped] or inside[grasped],
            True,
            True,
            held_by_psm1[handed_off],
            True,
        ]
        found += [
            Segment(task, begin, stop)
            for task, begin, stop, done in zip(
                names.SUBTASKS, cuts[:-1], cuts[1:], happened, strict=True
            )
            if done and stop - begin >= SHORTEST
        ]
        start = _next(~held_by_psm1, max(end, start + 1))
    return found


def _next(event: NDArray[np.bool_], start: int) -> int:
    """Return the first sample from `start` on in which an event holds, or the last sample."""
    found = np.flatnonzero(event[start:])
    return start + int(found[0]) if len(found) else len(event) - 1


def holds(recording: Recording, arm: str) -> NDArray[np.bool_]:
    """Return for each sample whether an arm holds the needle, by the geometry alone, (N,)."""
    motion = recording.arms.get(arm)
    if motion is None or motion.jaw is None or recording.needle is None:
        return np.zeros(len(recording), bool)
    return held(arm, motion.tip, motion.jaw, recording.needle)


def held(
    arm: str, tip: NDArray[np.float64], jaw: NDArray[np.float64], needle_poses: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return for each sample whether an arm holds the needle, (N,) bool.

    Args:
        arm: the arm.
        tip: T_base_tip, (N, 4, 4).
        jaw: one finger's angle, (N,) [rad].
        needle_poses: T_world_needle, (N, 4, 4).
    """
    tips = kinematics.base_in_world(arm) @ tip
    grasps = tips[:, :3, 3] + GRASP_DEPTH * tips[:, :3, 2]
    # Distance from each grasp point to the nearest point of the needle, in the needle's frame and
    # clamped to its arc.
    x, y, z = np.einsum("nji,nj->in", needle_poses[:, :3, :3], grasps - needle_poses[:, :3, 3])
    angle = np.clip(np.arctan2(y, -x), 0.0, needle.TIP_ANGLE)
    distance = np.sqrt(
        (x + needle.RADIUS * np.cos(angle)) ** 2 + (y - needle.RADIUS * np.sin(angle)) ** 2 + z**2
    )
    # A jaw that is still closing has not closed on anything yet.
    later = np.stack(
        [np.pad(jaw, (0, shift), mode="edge")[shift:] for shift in range(2 * WINDOW)]
    ).min(axis=0)
    return sustained((jaw < HOLD_JAW) & (jaw <= later + STILL) & (distance < HOLD_REACH))


def sustained(event: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return an event (N,) without runs shorter than `SUSTAINED`, except one at the very end."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], event.astype(int), [0]])))
    kept = np.zeros(len(event), bool)
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        kept[start:stop] = stop - start >= SUSTAINED or stop == len(event)
    return kept


class _NeedleAlone:
    """A needle without a simulation, a `hole_crossing.NeedlePose`."""

    radius = needle.RADIUS
    tip_angle = needle.TIP_ANGLE
    tissue: Tissue | None = None

    def __init__(self, pose: Pose):
        self._pose = pose

    def needle(self) -> Pose:
        return self._pose

    def needle_point(self, angle: float) -> tuple[float, float, float]:
        x, y, z = (poses.square(self._pose) @ [*needle.point(angle), 1.0])[:3].tolist()
        return x, y, z


def holes_passed(needle_poses: NDArray[np.float64], pair: HolePair) -> NDArray[np.float64]:
    """Return `TaskState.holes_passed` for each needle pose (N, 4, 4) in an episode, (N,).

    A needle that is out and comes back to the entry begins the next stitch, with no holes passed.
    """
    state = TaskState()
    passed = []
    for index, pose in enumerate(needle_poses):
        seen = _NeedleAlone(poses.flat(pose))
        if index == 0:
            hole_crossing.remember_tip(seen, state)
            state.holes_passed = 2 if hole_crossing.in_both(seen, pair) else 0
        else:
            hole_crossing.update(seen, state, pair)
            tip = np.array(state.needle_tip) - pair.entry.centre
            before = tip @ pair.entry.rotation[:, 2] > 0.0 and np.linalg.norm(tip) < START_SHIFT
            if state.holes_passed == hole_crossing.OUT and before:
                state.holes_passed = 0
        passed.append(state.holes_passed)
    return np.array(passed)


def _near_entry(pose: NDArray[np.float64], pair: HolePair) -> bool:
    """Return True if a needle is as close to the goal of place as an insertion may start."""
    goal = Stitch.of(pair).place()
    tip = needle_frame(needle.TIP_ANGLE)
    away = np.linalg.norm((pose @ tip - goal @ tip)[:3, 3])
    return bool(away <= START_SHIFT and geodesic_angle(pose[:3, :3], goal[:3, :3]) <= START_TURN)


def _arrival(needle_poses: NDArray[np.float64], start: int, stop: int) -> int:
    """Return the sample in [start, stop] from which the needle stays where it is at `stop`."""
    goal = needle_poses[stop]
    path = needle_poses[start : stop + 1]
    away = np.linalg.norm(path[:, :3, 3] - goal[:3, 3], axis=1) > ARRIVED
    turn = Rotation.from_matrix(path[:, :3, :3]) * Rotation.from_matrix(goal[:3, :3]).inv()
    far = np.flatnonzero(away | (turn.magnitude() > ARRIVED_TURN))
    return start + int(far[-1]) + 1 if len(far) else start


def _release(holding: NDArray[np.bool_], needle_poses: NDArray[np.float64], start: int) -> int:
    """Return the sample of the needle's last move in PSM1's jaws."""
    released = np.flatnonzero(~holding[start:])
    end = start + int(released[0]) - 1 if len(released) else len(holding) - 1
    return max(_arrival(needle_poses, start, end), start)


# -- pauses ----------------------------------------------------------------------------------------


def moving(tip: NDArray[np.float64], jaw: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the indices of the samples outside pauses, always including the first and the last.

    Args:
        tip: T_base_tip (N, 4, 4) at `RATE`.
        jaw: one finger's angle (N,) [rad].
    """
    count = len(tip)
    before = np.maximum(np.arange(count) - WINDOW, 0)
    after = np.minimum(np.arange(count) + WINDOW, count - 1)
    time = np.maximum(after - before, 1) / RATE
    turns = Rotation.from_matrix(tip[:, :3, :3])
    speed = np.linalg.norm(tip[after, :3, 3] - tip[before, :3, 3], axis=1) / time
    turning = (turns[after] * turns[before].inv()).magnitude() / time
    active = (
        (speed >= PAUSE_SPEED)
        | (turning >= PAUSE_TURN_RATE)
        | (np.abs(jaw[after] - jaw[before]) / time >= PAUSE_JAW_RATE)
    )
    kept = [0]
    for index in range(1, count):
        last = tip[kept[-1]]
        crept = np.linalg.norm(tip[index, :3, 3] - last[:3, 3]) > DRIFT
        if active[index] or crept or geodesic_angle(tip[index, :3, :3], last[:3, :3]) > DRIFT_TURN:
            kept.append(index)
    if kept[-1] != count - 1:
        kept.append(count - 1)
    return np.array(kept)
