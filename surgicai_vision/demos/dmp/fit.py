"""Lesson: what demonstrations of a subtask teach, as movement primitives.

    lesson = learn_lesson("insert", [read_demo(path)])

Where the needle is carried (place, insert, pullout) the primitives move a frame on the needle;
where it is taken (grasp, handoff) they move the tool relative to the frame in which it grasps the
needle. Coordinates are those of the goal's frame, so a lesson holds wherever the holes are.

An insertion and a pull-out have two pieces, because inside the tissue the way is the phantom's and
not a matter of scaling: the start's error must be gone where the needle enters, so the first piece
ends there and the second starts where the demonstration did; likewise the pull-out is cut where the
needle's base leaves the exit. In the second and the first of them the needle is `bound`. A
demonstration that there strays further from the path through the holes than the openings leave room
(SurgicAI's own do, by up to 10 mm: its tissue offered no resistance) is put onto the path, turn by
turn: it then teaches the timing, and `Lesson.bent` says so.
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
    FEWEST,
    Motion,
    Primitive,
    conjugate,
    filtered,
    learn,
    multiply,
    quaternion_of,
    turn_of,
)
from surgicai_vision.demos.expert import on_path, turn_about_wound
from surgicai_vision.demos.store import Demo
from surgicai_vision.envs import poses
from surgicai_vision.envs.geometry import HANDOFF_ANGLE, Stitch, grasp_in_needle, needle_frame
from surgicai_vision.scene import needle
from surgicai_vision.scene.rotations import matrix_to_quaternion, quaternion_to_matrix

Array = NDArray[np.float64]

ROOM = 0.0009
"""Clearance of the needle on the path from the openings' edges [m]; see `envs.geometry`."""
OUTSIDE = 0.0003
"""The needle enters when its tip was last further than this outside the entry [m]."""
STRAIGHT = 0.5
"""Time of a piece of which too few samples are left to learn a shape [s]."""


@dataclass(frozen=True)
class Seen:
    """A demonstration as poses in world.

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
class Piece:
    """A part of a subtask in which the needle is carried.

    Attributes:
        point: the frame that moves is the needle's at this angle [rad]; None: at its origin, the
            arc's centre.
        goal: where that frame ends when the subtask is done perfectly, T_world_point (4, 4).
        end: index of the demonstration's last sample of the piece.
        bound: the needle is in the tissue.
    """

    point: float | None
    goal: Callable[[Stitch], Array]
    end: Callable[[Seen], int]
    bound: bool = False

    def frame(self) -> Array:
        """Return T_needle_point (4, 4)."""
        return np.eye(4) if self.point is None else needle_frame(self.point)


def _last(seen: Seen) -> int:
    return len(seen.needle) - 1


def _entered(seen: Seen) -> int:
    """Return the first sample after the tip was last outside the entry."""
    tips = seen.needle[:, :3, :3] @ needle.point(needle.TIP_ANGLE) + seen.needle[:, :3, 3]
    entry = seen.stitch.pair.entry
    outside = np.flatnonzero((tips - np.asarray(entry.centre)) @ entry.rotation[:, 2] > OUTSIDE)
    return min(int(outside[-1]) + 1, _last(seen)) if len(outside) else 0


def _left(seen: Seen) -> int:
    """Return the first sample with the whole needle beyond the exit."""
    points = (
        np.einsum("tij,pj->tpi", seen.needle[:, :3, :3], needle.polyline(13))
        + seen.needle[:, None, :3, 3]
    )
    leave = seen.stitch.pair.exit
    beyond = ((points - np.asarray(leave.centre)) @ leave.rotation[:, 2]).min(axis=1) > 0.0
    return int(np.argmax(beyond)) if beyond.any() else _last(seen)


_ENTER = Piece(
    needle.TIP_ANGLE, lambda stitch: stitch.place() @ needle_frame(needle.TIP_ANGLE), _entered
)
CARRIED: Mapping[str, tuple[Piece, ...]] = MappingProxyType(
    {
        "place": (Piece(_ENTER.point, _ENTER.goal, _last),),
        "insert": (_ENTER, Piece(None, lambda stitch: stitch.inserted(), _last, bound=True)),
        "pullout": (
            Piece(None, lambda stitch: stitch.inserted(), _left, bound=True),
            Piece(
                HANDOFF_ANGLE, lambda stitch: stitch.pulled() @ needle_frame(HANDOFF_ANGLE), _last
            ),
        ),
    }
)
"""Subtask → the pieces in which its needle is carried; the other subtasks take the needle."""


@dataclass(frozen=True)
class Part:
    """A learned piece.

    Attributes:
        primitive: the movement.
        goal: where it ends, in the coordinates of the piece's goal (4, 4).
    """

    primitive: Primitive
    goal: Array


@dataclass(frozen=True)
class Lesson:
    """What demonstrations taught.

    Attributes:
        task: the subtask.
        parts: one per piece of `CARRIED`, or one where the needle is taken.
        angle: the needle's point that was grasped [rad]; where the needle is taken.
        opening: jaw angle before closing [rad]; where the needle is taken.
        bent: demonstrations that had to be put onto the path through the holes.
    """

    task: str
    parts: tuple[Part, ...]
    angle: float = 0.0
    opening: float = 0.0
    bent: int = 0


def learn_lesson(task: str, demos: Sequence[Demo], scaled: bool = False) -> Lesson:
    """Learn from one or a few demonstrations.

    Args:
        task: a key of `names.SUBTASKS`.
        demos: at least one, of that task; recorded or imported.
        scaled: see `movement`.

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
    seen = [watch(demo) for demo in demos]
    return _carried(task, seen, scaled) if task in CARRIED else _taken(task, seen, scaled)


def watch(demo: Demo) -> Seen:
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
    rows = []
    arm = names.ACTIVE_ARM[demo.config.task]
    for state in demo.state:
        env.set_state_vector(state)
        simulation = env.simulation
        rows.append(
            (
                poses.square(simulation.needle()),
                poses.square(simulation.tip(arm)),
                simulation.commands[arm].jaw,
            )
        )
    needles, tips, jaws = (np.array(column) for column in zip(*rows, strict=True))
    return Seen(needles, tips, jaws, env.stitch, arm, env.dt)


# -- the needle is carried -------------------------------------------------------------------------


def _carried(task: str, seen: list[Seen], scaled: bool) -> Lesson:
    motions: list[list[Motion]] = [[] for _ in CARRIED[task]]
    ends: list[list[Array]] = [[] for _ in CARRIED[task]]
    bent = 0
    for one in seen:
        first = 0
        paths = []
        for piece in CARRIED[task]:
            last = max(piece.end(one), first)
            paths.append(one.needle[first : last + 1])
            first = last
        for index, piece in enumerate(CARRIED[task]):
            if piece.bound and _stray(one.stitch, paths[index]) > ROOM:
                paths[index] = _on_path(one.stitch, paths[index])
                bent += 1
        for index, piece in enumerate(CARRIED[task]):
            inverse = np.linalg.inv(piece.goal(one.stitch))
            motions[index].append(as_motion(inverse @ paths[index] @ piece.frame(), one.dt))
            # A piece before a bent one ends where that one begins.
            follows = index + 1 < len(paths) and CARRIED[task][index + 1].bound
            end = paths[index + 1][0] if follows else paths[index][-1]
            ends[index].append(inverse @ end @ piece.frame())
    parts = tuple(_part(some, goals, scaled) for some, goals in zip(motions, ends, strict=True))
    return Lesson(task, parts, bent=bent)


def _on_path(stitch: Stitch, path: Array) -> Array:
    """Return needle poses (T, 4, 4) put onto the path through the holes, at the same turn about the
    wound.
    """
    turns = np.unwrap([turn_about_wound(stitch.place(), pose) for pose in path])
    turns += 2 * np.pi * (turns[-1] < 0.0)
    return np.array([on_path(stitch, max(float(turn), 0.0)) for turn in turns])


def _stray(stitch: Stitch, path: Array) -> float:
    """Return the furthest that a point of the needle gets from where it would be on the path
    [m].
    """
    line = np.column_stack([needle.polyline(5), np.ones(5)])
    apart = np.einsum("tij,pj->tpi", path - _on_path(stitch, path), line)
    return float(np.linalg.norm(apart[..., :3], axis=-1).max())


def _part(motions: list[Motion], goals: list[Array], scaled: bool) -> Part:
    """Return what the motions of one piece teach, their pauses left out."""
    moving = [filtered(motion) for motion in motions]
    primitive = learn(moving, scaled=scaled)
    if max(map(len, moving)) < FEWEST:
        primitive = Primitive(STRAIGHT, primitive.weights, primitive.drift, scaled)
    return Part(primitive, _mean(goals))


def _mean(some: list[Array]) -> Array:
    """Return the mean of poses (4, 4) that lie near each other."""
    first = matrix_to_quaternion(some[0][:3, :3])
    turns = [
        turn_of(multiply(matrix_to_quaternion(pose[:3, :3]), conjugate(first))) for pose in some
    ]
    return as_pose(
        np.mean([pose[:3, 3] for pose in some], axis=0),
        multiply(quaternion_of(np.mean(turns, axis=0)), first),
    )


# -- the needle is taken ---------------------------------------------------------------------------


def _taken(task: str, seen: list[Seen], scaled: bool) -> Lesson:
    motions, angles, openings = [], [], []
    for one in seen:
        in_needle = np.linalg.inv(one.needle[0]) @ one.tip
        last = closing(one.jaw)
        angle = float(np.arctan2(in_needle[last, 1, 3], -in_needle[last, 0, 3]))
        goal = np.linalg.inv(grasp_in_needle(one.arm, angle))
        motions.append(as_motion(goal @ in_needle[: last + 1], one.dt))
        angles.append(angle)
        openings.append(float(one.jaw[last]))
    part = _part(motions, [np.eye(4)], scaled)
    return Lesson(task, (part,), angle=float(np.mean(angles)), opening=float(np.mean(openings)))


def closing(jaw: Array) -> int:
    """Return the index from which a commanded jaw (T,) [rad] only closes, to the end."""
    opens = np.flatnonzero(np.diff(jaw) >= 0.0)
    return int(opens[-1]) + 1 if len(opens) else 0


# -- poses -----------------------------------------------------------------------------------------


def as_motion(path: Array, dt: float) -> Motion:
    """Return poses (T, 4, 4) as a motion."""
    return Motion(
        path[:, :3, 3].copy(), np.array([matrix_to_quaternion(pose[:3, :3]) for pose in path]), dt
    )


def as_pose(position: Array, rotation: Array) -> Array:
    """Return a position (3,) and a quaternion (4,) as a pose (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = quaternion_to_matrix(rotation), position
    return pose
