"""Expert: a scripted surgeon for every subtask and for the whole, in the env's own actions.

`Expert(env).action()` looks at the env's present state, privileged as it is, and returns the next
action, (7,) float32. It keeps nothing between calls, so it answers on any state: from its own
episodes, from a learner's (DAgger), from a restored one. No teleporting, no forces: the same seven
numbers a policy has.

Each subtask's rule says where the commanded tool should be next; `toward` makes that one action,
scaled as a whole so that translation and rotation stay in step on curved paths.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import InputError
from surgicai_vision.envs import poses
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.control import StepSize
from surgicai_vision.envs.geometry import (
    EXTRA,
    HANDOFF_ANGLE,
    INSERT_ANGLE,
    INSERT_DEPTH,
    WOUND,
    Stitch,
    grasp_in_needle,
)
from surgicai_vision.scene import needle
from surgicai_vision.scene.holes import SURFACE
from surgicai_vision.scene.rotations import matrix_to_rotvec, rotvec_to_matrix

Matrix = NDArray[np.float64]

HOVER, HANDOFF_BACK = 0.010, 0.009
"""Where the jaws wait before they go in: above the needle, before the handoff grasp [m]."""
OPEN_ABOVE, OPEN_HANDOFF = 0.35, 0.18
"""Jaw angles [rad] wide enough for the needle and narrow enough for its neighbours."""
ALIGNED, ALIGNED_ANGLE = 0.0006, math.radians(4.0)
CLOSING, CLOSING_ANGLE = 0.002, math.radians(20.0)
"""Off by less than this the jaws, once closing, go on closing [m, rad]."""
CLEAR = 0.004
"""Height of the needle's lowest point over the tissue at which it may turn and travel [m]."""
OUTSIDE = 0.006
"""How far before the entry the tip gets into line [m]."""
DRIVE = math.radians(1.8)
"""Rotation of the needle per control step on the circle [rad]."""
LEAD = math.radians(9.0)
"""Furthest the command may run ahead of the needle [rad]."""
BLOCKED = 0.001
"""A needle this far off its path [m] is held back: in `3dmed_straight` PSM2's wrist meets the
ridge's steep flank.
"""
HANDOFF_OFFSET = math.radians(4.0)
"""The expert takes the needle a little nearer to the tip than the goal, away from the tissue."""


class Wish(NamedTuple):
    """Where the active tool should be: T_world_tip (4, 4) and jaw angle [rad]."""

    tip: Matrix
    jaw: float


class Expert:
    """The scripted expert of an env; see the module's docstring.

    Args:
        env: the env.
        noise: standard deviation of Gaussian noise on the six motions of an action, in units of its
            range. The jaw stays as meant. The expert sees where the noise took it and recovers:
            recordings with states off the path.
        rng: source of the noise; needed with it.
    """

    def __init__(
        self, env: SuturingEnv, noise: float = 0.0, rng: np.random.Generator | None = None
    ):
        if noise < 0.0 or (noise and rng is None):
            raise InputError(
                f"Expert got noise {noise} and rng {rng}; noise is at least 0 and comes from a Generator."
            )
        self.env, self.noise, self._rng = env, noise, rng

    def action(self) -> NDArray[np.float32]:
        """Return the next action for the env's present state, (7,) float32 in [-1, 1], noise
        included.
        """
        action = self.meant()
        if self._rng is not None and self.noise:
            action[:6] = np.clip(action[:6] + self._rng.normal(0.0, self.noise, 6), -1.0, 1.0)
        return action

    def meant(self) -> NDArray[np.float32]:
        """Return the action without noise: the label of the present state."""
        scene = Sight(self.env)
        return toward(scene, _RULES[self.env.subtask.name](scene))


class Sight:
    """What the expert sees: measured poses in world as (4, 4) matrices."""

    def __init__(self, env: SuturingEnv):
        simulation = env.simulation
        self.arm = env.subtask.arm
        self.stitch: Stitch = env.stitch
        self.memory = simulation.memory
        self.step = StepSize.of(env.config.step)
        self.base = poses.square(simulation.bases[self.arm])
        self.needle = poses.square(simulation.needle())
        self.tip = poses.square(simulation.tip(self.arm))
        command = simulation.pending(self.arm, self.step)
        self.command = self.base @ poses.square(simulation.true_pose(self.arm, command))
        self.command_jaw = command.jaw
        self.holds = simulation.holds(self.arm)

    def carrying(self, needle_pose: Matrix) -> Matrix:
        """Return the tip's pose that brings the held needle to `needle_pose`."""
        return needle_pose @ np.linalg.inv(self.needle) @ self.tip

    @property
    def commanded_needle(self) -> Matrix:
        """Return where the held needle would be if the tool were where it is told to be."""
        return self.command @ np.linalg.inv(self.tip) @ self.needle


def toward(scene: Sight, wish: Wish) -> NDArray[np.float32]:
    """Return the action that moves the command towards `wish`, scaled to at most 1 as a whole.

    Closed jaws are closed with all of the range: the command stays at 0, and a policy that learns
    from it may be off without letting go. (With a label of 0, its small errors add up: 7 of 50
    learned placings dropped the needle.)
    """
    move = moves(scene, wish.tip)
    move /= max(1.0, float(np.abs(move).max()))
    jaw = (
        -1.0
        if wish.jaw <= 0.0
        else np.clip((wish.jaw - scene.command_jaw) / scene.step.jaw, -1.0, 1.0)
    )
    return np.append(move, jaw).astype(np.float32)


def moves(scene: Sight, tip: Matrix) -> Matrix:
    """Return how many step sizes the command is from T_world_tip (4, 4), along and about the base's
    axes, (6,).
    """
    inverse = scene.base[:3, :3].T
    shift = inverse @ (tip[:3, 3] - scene.command[:3, 3]) / scene.step.translation
    turn = matrix_to_rotvec(inverse @ tip[:3, :3] @ scene.command[:3, :3].T @ scene.base[:3, :3])
    return np.concatenate([shift, turn / scene.step.rotation])


def _angle(a: Matrix, b: Matrix) -> float:
    return float(np.linalg.norm(matrix_to_rotvec(a[:3, :3].T @ b[:3, :3])))


def _shifted(pose: Matrix, shift: Matrix) -> Matrix:
    moved = pose.copy()
    moved[:3, 3] += shift
    return moved


# -- taking the needle -----------------------------------------------------------------------------


def take(scene: Sight, goal: Matrix, back: float, opened: float) -> Wish:
    """Go before the grasp with open jaws, go in, close.

    Args:
        scene: what is seen.
        goal: T_world_tip of the grasp.
        back: how far before it the tool gets into line [m].
        opened: jaw angle on the way [rad].
    """
    axis = goal[:3, 2]
    offset = scene.tip[:3, 3] - goal[:3, 3]
    depth = float(offset @ axis)
    beside = float(np.linalg.norm(offset - depth * axis))
    turned = _angle(scene.tip, goal)
    lined_up = beside < 2 * ALIGNED and turned < 2 * ALIGNED_ANGLE
    closing = scene.command_jaw < opened - 2 * scene.step.jaw
    if closing and beside < CLOSING and abs(depth) < CLOSING and turned < CLOSING_ANGLE:
        return Wish(goal if not scene.holds else scene.command, 0.0)
    if beside < ALIGNED and abs(depth) < ALIGNED and turned < ALIGNED_ANGLE:
        return Wish(goal, 0.0)
    if lined_up and not closing:
        return Wish(goal, opened)
    retreat = min(depth, -back) if not lined_up and depth > -back else -back
    return Wish(_shifted(goal, retreat * axis), opened)


def _grasp(scene: Sight) -> Wish:
    goal = scene.needle @ grasp_in_needle(
        scene.arm, scene.memory.grasp_angle, radius=scene.stitch.radius
    )
    return take(scene, goal, HOVER, OPEN_ABOVE)


def _handoff(scene: Sight) -> Wish:
    goal = scene.needle @ grasp_in_needle(
        scene.arm, HANDOFF_ANGLE + HANDOFF_OFFSET, radius=scene.stitch.radius
    )
    return take(scene, goal, HANDOFF_BACK, OPEN_HANDOFF)


# -- carrying the needle ---------------------------------------------------------------------------


def on_path(stitch: Stitch, turned: float) -> Matrix:
    """Return the needle's pose after turning by `turned` [rad] about the wound since
    `Stitch.place`.

    First about the tip, which stays in the entry, until the tangent meets the circle; then along
    the circle.
    """
    start, circle = stitch.place(), stitch.on_arc(needle.TIP_ANGLE)
    pivot = turn_about_wound(start, circle)
    if turned >= pivot:
        return stitch.on_arc(needle.TIP_ANGLE - (turned - pivot))
    pose = start.copy()
    pose[:3, :3] = rotvec_to_matrix(-turned * WOUND) @ start[:3, :3]
    tip = np.asarray(stitch.pair.entry.centre)
    pose[:3, 3] = tip - pose[:3, :3] @ needle.point(needle.TIP_ANGLE, stitch.radius)
    return pose


def turn_about_wound(start: Matrix, pose: Matrix) -> float:
    """Return the turn about the wound from `start` to `pose` in the needle's driving direction
    [rad], in (-π, π].
    """
    x, z = start[:3, 0], np.cross(WOUND, start[:3, 0])
    return -math.atan2(float(pose[:3, 0] @ z), float(pose[:3, 0] @ x))


def _place(scene: Sight) -> Wish:
    """Lift the needle, turn it upright before the entry, bring its tip in."""
    goal = scene.stitch.place()
    outward = scene.stitch.pair.entry.rotation[:, 2]
    line = scene.needle[:3, :3] @ needle.polyline(13, scene.stitch.radius).T + scene.needle[:3, 3:4]
    if float(line[2].min()) < SURFACE + CLEAR and _angle(scene.needle, goal) > math.radians(20.0):
        return Wish(_shifted(scene.command, np.array([0.0, 0.0, 0.01])), 0.0)
    offset = line[:, -1] - np.asarray(scene.stitch.pair.entry.centre)
    beside = float(np.linalg.norm(offset - (offset @ outward) * outward))
    away = 0.0 if beside < 0.0015 and _angle(scene.needle, goal) < math.radians(7.0) else OUTSIDE
    return Wish(scene.carrying(_shifted(goal, away * outward)), 0.0)


def _insert(scene: Sight) -> Wish:
    """Bring the tip in, then drive the needle along its path."""
    start = scene.stitch.place()
    tip = (
        scene.needle[:3, :3] @ needle.point(needle.TIP_ANGLE, scene.stitch.radius)
        + scene.needle[:3, 3]
    )
    local = scene.stitch.pair.entry.rotation.T @ (tip - np.asarray(scene.stitch.pair.entry.centre))
    turned = turn_about_wound(start, scene.needle)
    if scene.memory.passed == 0.0:
        near = float(np.linalg.norm(local)) < 0.0009
        tilt = _angle(scene.needle, on_path(scene.stitch, max(turned, 0.0)))
        if not (near and tilt < math.radians(4.0)):
            return _place(scene)
    pivot = turn_about_wound(start, scene.stitch.on_arc(needle.TIP_ANGLE))
    last = (
        pivot + needle.TIP_ANGLE - scene.stitch.angle_at_entry(INSERT_ANGLE, INSERT_DEPTH + EXTRA)
    )
    return _drive(scene, turned, last)


def _drive(scene: Sight, turned: float, last: float) -> Wish:
    """Move the needle on along its path, up to `last` [rad]; once it is through and off the path,
    press no further.
    """
    start = scene.stitch.place()
    commanded = turn_about_wound(start, scene.commanded_needle)
    ahead = max(min(commanded, turned + LEAD), turned - LEAD) + DRIVE
    off = scene.needle[:3, 3] - on_path(scene.stitch, min(max(turned, 0.0), last))[:3, 3]
    if scene.memory.passed >= 2.0 and float(np.linalg.norm(off)) > BLOCKED:
        ahead = min(ahead - DRIVE, turned)
    return Wish(scene.carrying(on_path(scene.stitch, min(max(ahead, 0.0), last))), 0.0)


def _pullout(scene: Sight) -> Wish:
    """Turn the needle on along the circle until its base is out, then carry it to the end point."""
    stitch = scene.stitch
    if scene.memory.release > 30:
        return Wish(scene.command, 0.0)
    line = (
        scene.needle[:3, :3] @ needle.polyline(13, scene.stitch.radius).T + scene.needle[:3, 3:4]
    ).T
    outside = ((line - np.asarray(stitch.pair.exit.centre)) @ stitch.pair.exit.rotation)[:, 2]
    if float(outside.min()) > 0.0005:
        return Wish(scene.carrying(stitch.pulled()), 0.0)
    start = stitch.place()
    turned = turn_about_wound(start, scene.needle) % (2 * math.pi)
    commanded = turned + _wrap(turn_about_wound(start, scene.commanded_needle) - turned)
    ahead = max(min(commanded, turned + LEAD), turned - LEAD)
    pivot = turn_about_wound(start, stitch.on_arc(needle.TIP_ANGLE))
    last = pivot + needle.TIP_ANGLE + 2 * stitch.half + math.radians(12.0)
    return Wish(scene.carrying(on_path(stitch, min(ahead + DRIVE, last))), 0.0)


def _wrap(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


_RULES: dict[str, Callable[[Sight], Wish]] = {
    "grasp": _grasp,
    "place": _place,
    "insert": _insert,
    "handoff": _handoff,
    "pullout": _pullout,
}
