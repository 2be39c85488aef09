"""Fit: movement primitives of a subtask from its demonstrations.

    fit = fit_subtask("insert", [read_demo(path)])

Where the needle is carried (place, insert, pullout) the primitives move a frame on the needle;
where it is grasped (grasp, handoff) they move the tool relative to the frame in which it grasps the
needle. Coordinates are those of the goal's frame, so a fit holds wherever the holes are.

An insertion and a pull-out have two phases, because inside the tissue the phantom determines the
path, which cannot be scaled. The start's error must be gone where the needle enters, so the first
phase of an insertion ends there and the second starts where the demonstration did. Likewise the
pull-out is split where the needle's base leaves the exit. The needle is `in_tissue` in the second
phase of an insertion and the first of a pull-out. A demonstration may stray further from the path
through the holes there than the openings allow (SurgicAI's own do, by up to 10 mm: its tissue
offered no resistance). It is then projected onto the path, turn by turn, and determines the timing
only (`SubtaskFit.projected`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.demos.dmp.primitive import (
    MIN_SAMPLES,
    Motion,
    Primitive,
    conjugate,
    exp_quaternion,
    fit_primitive,
    log_quaternion,
    multiply,
    without_pauses,
)
from surgicai_vision.demos.stitch_path import CLEARANCE, OUTSIDE, deviation_from_path, project
from surgicai_vision.demos.store import Demo
from surgicai_vision.envs import poses
from surgicai_vision.envs.geometry import Stitch, grasp_in_needle, needle_frame
from surgicai_vision.scene import needle
from surgicai_vision.scene.rotations import matrix_to_quaternion, quaternion_to_matrix

Array = NDArray[np.float64]

STRAIGHT_DURATION = 0.5
"""Duration of a phase with too few samples left to learn a shape from [s]."""


@dataclass(frozen=True)
class DemoPoses:
    """A demonstration as poses in the world frame.

    Attributes:
        needle: T_world_needle, (T, 4, 4).
        tip: T_world_tip of the active arm, (T, 4, 4).
        jaw: commanded jaw angle, (T,) [rad].
        stitch: the path through the holes.
        arm: the active arm.
        dt: time between samples [s].
    """

    needle: Array
    tip: Array
    jaw: Array
    stitch: Stitch
    arm: str
    dt: float


@dataclass(frozen=True)
class CarryPhase:
    """A phase of a subtask in which the needle is carried.

    Attributes:
        point: angle on the stitch's needle of the frame that moves [rad]; None: the needle's
            origin, the arc's centre.
        goal: where that frame ends when the subtask is done perfectly, T_world_point (4, 4).
        end: index of the demonstration's last sample of the phase.
        in_tissue: the needle is in the tissue.
    """

    point: Callable[[Stitch], float] | None
    goal: Callable[[Stitch], Array]
    end: Callable[[DemoPoses], int]
    in_tissue: bool = False

    def frame(self, stitch: Stitch) -> Array:
        """Return T_needle_point (4, 4) on the stitch's needle."""
        return np.eye(4) if self.point is None else needle_frame(self.point(stitch), stitch.radius)


def _last(demo: DemoPoses) -> int:
    return len(demo.needle) - 1


def _entered(demo: DemoPoses) -> int:
    """Return the first sample after the tip was last outside the entry."""
    tip = needle.point(demo.stitch.tip_angle, demo.stitch.radius)
    tips = demo.needle[:, :3, :3] @ tip + demo.needle[:, :3, 3]
    entry = demo.stitch.pair.entry
    outside = np.flatnonzero((tips - np.asarray(entry.centre)) @ entry.rotation[:, 2] > OUTSIDE)
    return min(int(outside[-1]) + 1, _last(demo)) if len(outside) else 0


def _left(demo: DemoPoses) -> int:
    """Return the first sample with the whole needle beyond the exit."""
    line = needle.polyline(13, demo.stitch.radius, demo.stitch.tip_angle)
    points = np.einsum("tij,pj->tpi", demo.needle[:, :3, :3], line) + demo.needle[:, None, :3, 3]
    leave = demo.stitch.pair.exit
    beyond = ((points - np.asarray(leave.centre)) @ leave.rotation[:, 2]).min(axis=1) > 0.0
    return int(np.argmax(beyond)) if beyond.any() else _last(demo)


_ENTER = CarryPhase(
    lambda stitch: stitch.tip_angle,
    lambda stitch: stitch.place() @ needle_frame(stitch.tip_angle, stitch.radius),
    _entered,
)
CARRY_PHASES: Mapping[str, tuple[CarryPhase, ...]] = MappingProxyType(
    {
        "place": (CarryPhase(_ENTER.point, _ENTER.goal, _last),),
        "insert": (
            _ENTER,
            CarryPhase(None, lambda stitch: stitch.inserted(), _last, in_tissue=True),
        ),
        "pullout": (
            CarryPhase(None, lambda stitch: stitch.inserted(), _left, in_tissue=True),
            CarryPhase(
                lambda stitch: stitch.handoff_angle,
                lambda stitch: stitch.pulled() @ needle_frame(stitch.handoff_angle, stitch.radius),
                _last,
            ),
        ),
    }
)
"""Subtask → the phases in which the needle is carried; the other subtasks grasp the needle."""


@dataclass(frozen=True)
class FittedPhase:
    """A fitted phase.

    Attributes:
        primitive: the movement.
        goal: where it ends, in the coordinates of the phase's goal (4, 4).
    """

    primitive: Primitive
    goal: Array


@dataclass(frozen=True)
class SubtaskFit:
    """What was learned from the demonstrations of a subtask.

    Attributes:
        task: the subtask.
        phases: one per phase of `CARRY_PHASES`, or one where the needle is grasped.
        grasp_angle: the grasped point on a 120° needle; on another needle, the point at the same
            share of its arc [rad]. Only for subtasks that grasp the needle.
        jaw_opening: jaw angle before closing [rad]. Only for subtasks that grasp the needle.
        projected: number of demonstrations that had to be projected onto the path through the
            holes.
    """

    task: str
    phases: tuple[FittedPhase, ...]
    grasp_angle: float = 0.0
    jaw_opening: float = 0.0
    projected: int = 0


def fit_subtask(task: str, demos: Sequence[Demo], scaled: bool = False) -> SubtaskFit:
    """Fit primitives to one or a few demonstrations.

    Args:
        task: a key of `names.SUBTASKS`.
        demos: at least one, of that task; recorded or imported.
        scaled: see `primitive`.

    Raises:
        UnknownName: no subtask.
        InputError: no demonstration, one of another task, one of another version of its scene.
    """
    check_name("subtask", task, names.SUBTASKS)
    if not demos:
        raise InputError("There is no demonstration to learn from; give at least one.")
    for demo in demos:
        if demo.config.task != task:
            raise InputError(
                f"A demonstration of {demo.config.task} cannot teach {task}; give one of {task}."
            )
    measured = [demo_poses(demo) for demo in demos]
    if task in CARRY_PHASES:
        return _fit_carrying(task, measured, scaled)
    return _fit_grasping(task, measured, scaled)


def demo_poses(demo: Demo) -> DemoPoses:
    """Return the poses of a demonstration.

    Raises:
        InputError: it was recorded in a scene that is compiled differently now.
    """
    env = envs.make(demo.config)
    if env.scene.hash != demo.scene_hash:
        raise InputError(
            f"The demonstration was recorded in another scene (hash {demo.scene_hash[:12]}, now "
            f"{env.scene.hash[:12]}); record or import it again."
        )
    arm = names.ACTIVE_ARM[demo.config.task]
    simulation = env.simulation
    needles = []
    tips = []
    jaws = []
    for state in demo.state:
        env.set_state_vector(state)
        needles.append(poses.square(simulation.needle()))
        tips.append(poses.square(simulation.tip(arm)))
        jaws.append(simulation.commands[arm].jaw)
    dt = env.dt * demo.config.action_repeat
    return DemoPoses(np.array(needles), np.array(tips), np.array(jaws), env.stitch, arm, dt)


# -- the needle is carried -------------------------------------------------------------------------


def _fit_carrying(task: str, demos: list[DemoPoses], scaled: bool) -> SubtaskFit:
    phases = CARRY_PHASES[task]
    motions: list[list[Motion]] = [[] for _ in phases]
    goals: list[list[Array]] = [[] for _ in phases]
    projected = 0
    for demo in demos:
        # Split the needle's path into phases, and project those that stray in the tissue.
        paths = []
        first = 0
        for phase in phases:
            last = max(phase.end(demo), first)
            path = demo.needle[first : last + 1]
            if phase.in_tissue and deviation_from_path(demo.stitch, path) > CLEARANCE:
                path = project(demo.stitch, path)
                projected += 1
            paths.append(path)
            first = last
        # Express each phase in the coordinates of its goal.
        for index, phase in enumerate(phases):
            inverse = np.linalg.inv(phase.goal(demo.stitch))
            frame = phase.frame(demo.stitch)
            motions[index].append(as_motion(inverse @ paths[index] @ frame, demo.dt))
            # A phase before one in the tissue ends where the latter, projected or not, begins.
            before_tissue = index + 1 < len(paths) and phases[index + 1].in_tissue
            end = paths[index + 1][0] if before_tissue else paths[index][-1]
            goals[index].append(inverse @ end @ frame)
    fitted = tuple(
        _fit_phase(phase_motions, phase_goals, scaled)
        for phase_motions, phase_goals in zip(motions, goals, strict=True)
    )
    return SubtaskFit(task, fitted, projected=projected)


def _fit_phase(motions: list[Motion], goals: list[Array], scaled: bool) -> FittedPhase:
    """Fit one phase to the motions without their pauses."""
    moving = [without_pauses(motion) for motion in motions]
    primitive = fit_primitive(moving, scaled=scaled)
    if max(map(len, moving)) < MIN_SAMPLES:
        primitive = Primitive(STRAIGHT_DURATION, primitive.weights, primitive.drift, scaled)
    return FittedPhase(primitive, _mean(goals))


def _mean(nearby: list[Array]) -> Array:
    """Return the mean of poses (4, 4) that are close to each other."""
    first = matrix_to_quaternion(nearby[0][:3, :3])
    turns = [
        log_quaternion(multiply(matrix_to_quaternion(pose[:3, :3]), conjugate(first)))
        for pose in nearby
    ]
    return as_pose(
        np.mean([pose[:3, 3] for pose in nearby], axis=0),
        multiply(exp_quaternion(np.mean(turns, axis=0)), first),
    )


# -- the needle is grasped -------------------------------------------------------------------------


def _fit_grasping(task: str, demos: list[DemoPoses], scaled: bool) -> SubtaskFit:
    motions = []
    angles = []
    openings = []
    for demo in demos:
        in_needle = np.linalg.inv(demo.needle[0]) @ demo.tip
        last = closing(demo.jaw)
        angle = float(np.arctan2(in_needle[last, 1, 3], -in_needle[last, 0, 3]))
        goal = np.linalg.inv(grasp_in_needle(demo.arm, angle, radius=demo.stitch.radius))
        motions.append(as_motion(goal @ in_needle[: last + 1], demo.dt))
        angles.append(angle * (needle.TIP_ANGLE / demo.stitch.tip_angle))
        openings.append(float(demo.jaw[last]))
    phase = _fit_phase(motions, [np.eye(4)], scaled)
    return SubtaskFit(
        task, (phase,), grasp_angle=float(np.mean(angles)), jaw_opening=float(np.mean(openings))
    )


def closing(jaw: Array) -> int:
    """Return the index from which a commanded jaw (T,) [rad] only closes, up to its last motion.

    A demonstration may go on after that: closed jaws then stand still.
    """
    moves = np.flatnonzero(np.diff(jaw))
    moving = jaw[: moves[-1] + 2] if len(moves) else jaw
    opens = np.flatnonzero(np.diff(moving) >= 0.0)
    return int(opens[-1]) + 1 if len(opens) else 0


# -- poses -----------------------------------------------------------------------------------------


def as_motion(path: Array, dt: float) -> Motion:
    """Return poses (T, 4, 4) as a motion."""
    rotations = np.array([matrix_to_quaternion(pose[:3, :3]) for pose in path])
    return Motion(path[:, :3, 3].copy(), rotations, dt)


def as_pose(position: Array, rotation: Array) -> Array:
    """Return a position (3,) and a quaternion (4,) as a pose (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(rotation)
    pose[:3, 3] = position
    return pose
