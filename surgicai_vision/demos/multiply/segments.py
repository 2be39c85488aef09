"""Segments: a demonstration cut into pieces that belong to one object each, and their re-posing.

    source = read_source("demos/episode_000000.safetensors")    # `cuts`
    for segment in source.segments["insert"]:
        path = segment.reposed(moment)      # (n, 4, 4) in world, where the objects are now

As in MimicGen (Mandlekar et al., CoRL 2023), a piece is a path relative to the pose that its object
has when the piece begins. The motion before a piece is not copied but interpolated, so a piece is
only the part of a motion that matters, its end (SkillMimicGen, Garrett et al., CoRL 2024). What
moves is the tool or, once it holds the needle, a frame on the needle: from another start the tool
holds the needle elsewhere and at another tilt, and the same tool path would miss the hole.

| subtask | piece | what moves | relative to |
|---|---|---|---|
| grasp | in to the needle, close | tool | the grasp on the lying needle |
| place | up | needle | where it lies |
| | to the entry | needle's tip | the entry |
| insert | in to the entry | needle's tip | the entry |
| | through the tissue | needle | the path through the holes |
| handoff | in to the needle, close | tool | the grasp on the needle that PSM2 holds |
| pullout | out of the tissue | needle | the path through the holes |
| | to the end | needle's grasped point | the end point |

As in MimicGen, paths are those of the commands, not of the measured tool, so they include how far
a command presses or leads. In the tissue the holes leave no choice, so a path there consists of the
turn about the wound and the offset from the ideal path (`demos.expert.on_path`). For a needle of
another size, the turns keep their shares between entry, exit and end. A recording that strays
further from the ideal path than the openings allow (SurgicAI's own do) keeps only its turns.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.demos.expert import on_path, turn_about_wound
from surgicai_vision.envs import poses
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.geometry import (
    EXTRA,
    INSERT_DEPTH,
    Stitch,
    grasp_in_needle,
    needle_frame,
)

Array = NDArray[np.float64]

OUT_TURN = np.radians(12.0)
"""How far past the exit the pull-out turns the needle's base [rad], as the expert does."""
STILL = 1e-6
"""A command that changes by less than this is a pause [m, rad]."""


@dataclass(frozen=True)
class Moment:
    """Where the objects are.

    Attributes:
        arm: the active arm.
        needle: T_world_needle (4, 4).
        tip: T_world_tip of the active arm (4, 4).
        stitch: the path through the holes.
        grasp_angle: the needle's point to be grasped [rad].
    """

    arm: str
    needle: Array
    tip: Array
    stitch: Stitch
    grasp_angle: float


Frame = Callable[[Moment], Array]
"""Where a frame is: (4, 4) in world, or in the needle's frame."""


def lying_needle(moment: Moment) -> Array:
    """Return T_world_needle."""
    return moment.needle


def grasp_of(moment: Moment) -> Array:
    """Return T_world_tip of the requested grasp."""
    return moment.needle @ grasp_in_needle(
        moment.arm, moment.grasp_angle, radius=moment.stitch.radius
    )


def at_entry(moment: Moment) -> Array:
    """Return the frame of the needle's tip in the entry, perpendicular to it, in world."""
    return moment.stitch.place() @ tip_of_needle(moment)


def at_end(moment: Moment) -> Array:
    """Return the frame of the needle's grasped point at the end of the pull-out, in world."""
    return moment.stitch.pulled() @ grasped_point(moment)


def tip_of_needle(moment: Moment) -> Array:
    """Return the frame at the needle's tip, in the needle's frame."""
    return needle_frame(moment.stitch.tip_angle, moment.stitch.radius)


def grasped_point(moment: Moment) -> Array:
    """Return the frame at the point that PSM1 grasps, in the needle's frame."""
    return needle_frame(moment.stitch.handoff_angle, moment.stitch.radius)


def centre(_: Moment) -> Array:
    """Return the needle's own frame, at the centre of its arc."""
    return np.eye(4)


@dataclass(frozen=True)
class FreeSegment:
    """A piece of a path relative to an object.

    Attributes:
        object: where the object is, T_world_object.
        body: the frame on the needle that moves, T_needle_body; None: the tool moves.
        path: T_object_body (n, 4, 4).
        jaw: commanded jaw angle, (n,) [rad].
        step: control step of each pose in the demonstration, (n,).
        keeps_pauses: whether its pauses are kept.
    """

    object: Frame
    body: Frame | None
    path: Array
    jaw: Array
    step: NDArray[np.int64]
    keeps_pauses: bool = False

    def reposed(self, moment: Moment) -> Array:
        """Return where the body goes in world, (n, 4, 4)."""
        path: Array = self.object(moment) @ self.path
        return path


@dataclass(frozen=True)
class TissueSegment:
    """A piece of a path through the holes.

    Attributes:
        turn: turn of the needle about the wound, (n,) [rad].
        off: its pose relative to that on the ideal path, (n, 4, 4).
        knots: turns of the demonstration's needle at entry, circle, exit and end, (4,) [rad].
        jaw: commanded jaw angle, (n,) [rad].
        step: control step of each pose in the demonstration, (n,).
    """

    turn: Array
    off: Array
    knots: Array
    jaw: Array
    step: NDArray[np.int64]
    body: Frame = centre
    keeps_pauses: bool = True

    def reposed(self, moment: Moment) -> Array:
        """Return where the needle goes in world, (n, 4, 4)."""
        knots = turn_knots(moment.stitch)
        turns = np.interp(self.turn, self.knots, knots)
        turns = turns + np.maximum(self.turn - self.knots[-1], 0.0)
        path = np.array([on_path(moment.stitch, float(turn)) for turn in turns])
        moved: Array = path @ self.off
        return moved


Segment = FreeSegment | TissueSegment


@dataclass(frozen=True)
class Source:
    """A demonstration that is re-posed.

    Attributes:
        digest: sha256 of its file.
        keeps_time: whether its actions are tied to the times at which they happened.
        start: where the objects were at its start.
        segments: subtask → its pieces, in order.
    """

    digest: str
    keeps_time: bool
    start: Moment
    segments: Mapping[str, tuple[Segment, ...]]


def turn_knots(stitch: Stitch) -> Array:
    """Return the turns about the wound at which a needle's motion changes, (4,) [rad].

    They are: tip in the entry, on the circle, driven through the exit, completely out.
    """
    pivot = turn_about_wound(stitch.place(), stitch.on_arc(stitch.tip_angle))
    driven = stitch.angle_at_entry(stitch.insert_angle, INSERT_DEPTH + EXTRA)
    out = 2 * stitch.half + OUT_TURN
    return np.array([0.0, pivot, pivot + stitch.tip_angle - driven, pivot + stitch.tip_angle + out])


def moment_of(env: SuturingEnv, arm: str, subtask: str, keeps_time: bool) -> Moment:
    """Return where the objects are in an env's present state.

    Args:
        env: the env.
        arm: the active arm.
        subtask: the present subtask.
        keeps_time: the goal of a grasp is unknown, so angles are measured from the needle's base.
    """
    simulation = env.simulation
    angle = env.stitch.handoff_angle
    if subtask == "grasp":
        angle = 0.0 if keeps_time else simulation.task_state.grasp_angle
    return Moment(
        arm,
        poses.square(simulation.needle()),
        poses.square(simulation.tip(arm)),
        env.stitch,
        angle,
    )
