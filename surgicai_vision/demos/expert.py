"""Expert: a scripted policy for every subtask and the whole procedure, in the env's own actions.

`Expert(env).action()` reads the env's present, privileged state and returns the next action, (7,)
float32. It keeps no state between calls, so it can label any state: of its own episodes, of a
learner's (DAgger), or a restored one. Its actions are the same seven numbers as a policy's; it
neither teleports the tool nor applies forces.

Each subtask's rule returns where the commanded tool should be next. `action_towards` turns that
into one action, scaled as a whole so that translation and rotation stay in step on curved paths.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import InputError, UnreachablePose
from surgicai_vision.core.plugins import resolve
from surgicai_vision.demos.demonstrator import ON_AIM, Demonstrator, Miss
from surgicai_vision.envs import control, poses
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.control import StepSize
from surgicai_vision.envs.geometry import (
    EXTRA,
    INSERT_DEPTH,
    Stitch,
    grasp_in_needle,
)
from surgicai_vision.envs.subtask import Subtask
from surgicai_vision.scene import needle
from surgicai_vision.scene.holes import SURFACE
from surgicai_vision.scene.kinematics import forward_flat, inverse_flat
from surgicai_vision.scene.rotations import matrix_to_rotvec, rotvec_to_matrix

Matrix = NDArray[np.float64]

HOVER = 0.010
"""Height over the needle at which the jaws line up before they go in [m]."""
HANDOFF_BACK = 0.009
"""Distance before the handoff grasp at which the jaws line up [m]."""
OPEN_ABOVE = 0.35
OPEN_HANDOFF = 0.18
"""Jaw angles wide enough for the needle and narrow enough for its neighbours [rad]."""
ALIGNED = 0.0006
ALIGNED_ANGLE = math.radians(4.0)
"""Jaws that are off by less than this are lined up [m, rad]."""
CLOSING = 0.002
CLOSING_ANGLE = math.radians(20.0)
"""Closing jaws that are off by less than this go on closing [m, rad]."""
CLEAR = 0.004
"""Height of the needle's lowest point above the tissue at which it may turn and travel [m]."""
LIFT = 0.01
"""How far up the tool is commanded to lift the needle [m], where no joint limit is in the way."""
OUTSIDE = 0.006
"""Distance before the entry at which the tip lines up [m]."""
DRIVE = math.radians(1.8)
"""Rotation of the needle per control step on the circle [rad]."""
LEAD = math.radians(9.0)
"""Largest angle by which the command may run ahead of the needle [rad]."""
BLOCKED = 0.001
"""A needle this far off its path [m] is blocked: in `3dmed_straight` PSM2's wrist touches the
ridge's steep flank."""
WAYPOINTS = (0.2, 0.4, 0.6, 0.8, 1.0)
"""Shares of a straight path at which its joints are checked."""
HANDOFF_ROOM = 0.0008
"""A handoff's tool that is off by up to this much along the needle [m] is lined up: in some worlds
PSM1's wrist touches the phantom before the jaws are at the goal, of which 2 mm are tolerated."""


class ToolTarget(NamedTuple):
    """Where the active tool should be.

    Attributes:
        tip: T_world_tip, (4, 4).
        jaw: jaw angle [rad].
    """

    tip: Matrix
    jaw: float


class Expert(Demonstrator):
    """The scripted expert of an env; see the module's docstring.

    Args:
        env: the env.
        noise: standard deviation of Gaussian noise on the six motions of an action, in units of its
            range; the jaw has none. The expert recovers from where the noise took it, so a
            recording includes states off the path.
        rng: source of the noise; needed with it.

    Raises:
        InputError: negative noise, or noise without `rng`.
    """

    def __init__(
        self, env: SuturingEnv, noise: float = 0.0, rng: np.random.Generator | None = None
    ):
        if noise < 0.0 or (noise and rng is None):
            raise InputError(
                f"Expert got noise {noise} and rng {rng}; noise must be at least 0 and needs a "
                "Generator."
            )
        self.env = env
        self.noise = noise
        self._rng = rng

    def action(self) -> NDArray[np.float32]:
        """Return the next action for the env's present state, with noise, (7,) in [-1, 1]."""
        action = self.label()
        if self._rng is not None and self.noise:
            action[:6] = np.clip(action[:6] + self._rng.normal(0.0, self.noise, 6), -1.0, 1.0)
        return action

    def label(self) -> NDArray[np.float32]:
        """Return the action without noise: the label of the present state, (7,)."""
        return self.missing(ON_AIM)

    def missing(self, miss: Miss) -> NDArray[np.float32]:
        """Return the label, (7,), were the goal of a grasp, or of an insertion, elsewhere."""
        world = WorldState(self.env, miss)
        return action_towards(world, _rule(self.env.subtask)(world))


class WorldState:
    """The present state as the expert needs it: measured poses in the world frame, (4, 4) matrices.

    Args:
        env: the env.
        miss: how far beside its goal a grasp or an insertion aims.

    Attributes:
        arm: the active arm.
        stitch: the path through the holes, as far beside them as an insertion aims whose needle is
            not through both yet.
        task_state: the task's state beyond MuJoCo's.
        step: the step sizes of an action.
        base: T_world_base of the active arm.
        instrument: its instrument.
        needle: T_world_needle.
        tip: T_world_tip of the active arm.
        told: the active arm's command, in the arm's own view.
        command: T_world_tip that this command really means.
        command_jaw: commanded jaw angle [rad].
        holds: whether the active arm's jaws hold the needle.
        miss: how far past its goal a grasp aims, as an angle of the needle [rad].
    """

    def __init__(self, env: SuturingEnv, miss: Miss = ON_AIM):
        simulation = env.simulation
        self.arm = env.subtask.arm
        self.task_state = simulation.task_state
        self.stitch: Stitch = env.stitch
        if env.subtask.name == "insert" and self.task_state.holes_passed < 2:
            self.stitch = self.stitch.beside(*miss)
        self.miss = miss.along / self.stitch.radius
        self.step = StepSize.of(env.config.step)
        self.base = poses.square(simulation.bases[self.arm])
        self.instrument = env.config.scene.instrument
        self.needle = poses.square(simulation.needle())
        self.tip = poses.square(simulation.tip(self.arm))
        command = simulation.pending(self.arm, self.step)
        self.told = command
        self.command = self.base @ poses.square(simulation.true_pose(self.arm, command))
        self.command_jaw = command.jaw
        self.holds = simulation.holds(self.arm)

    def tip_for_needle(self, needle_pose: Matrix) -> Matrix:
        """Return the tip's pose that brings the held needle to `needle_pose`."""
        return needle_pose @ np.linalg.inv(self.needle) @ self.tip

    @property
    def needle_line(self) -> Matrix:
        """Return points of the needle from base to tip in the needle's frame, (13, 3) [m]."""
        return needle.polyline(13, self.stitch.radius, self.stitch.tip_angle)

    @property
    def commanded_needle(self) -> Matrix:
        """Return where the held needle would be if the tool were at its commanded pose."""
        return self.command @ np.linalg.inv(self.tip) @ self.needle


def action_towards(world: WorldState, target: ToolTarget) -> NDArray[np.float32]:
    """Return the action that moves the command towards `target`, scaled to at most 1 as a whole.

    Jaws that should be closed get the full closing action. Their command stays at 0, and a policy
    that learns this label can err without letting go. (With a label of 0, its small errors add up:
    7 of 50 learned placings dropped the needle.)
    """
    way = command_error(world, target.tip)
    move = way / max(1.0, float(np.abs(way).max()))
    if not is_free(world, way):
        move = move_of_joints(world, target.tip, move)
    jaw = (
        -1.0
        if target.jaw <= 0.0
        else np.clip((target.jaw - world.command_jaw) / world.step.jaw, -1.0, 1.0)
    )
    return np.append(move, jaw).astype(np.float32)


def is_free(world: WorldState, way: Matrix) -> bool:
    """Return True if a straight way (6,) from the command, in step sizes, meets no joint limit."""
    steps = max(1.0, float(np.abs(way).max()))
    near = world.told.joints
    for share in (1.0 / steps, *WAYPOINTS):
        action = [*(share * way).tolist(), 0.0]
        pose = control.moved(world.told.pose, action, world.step)
        try:
            near = inverse_flat(pose, world.instrument, near)
        except UnreachablePose:
            return False
    return True


def move_of_joints(world: WorldState, tip: Matrix, otherwise: Matrix) -> Matrix:
    """Return a move (6,) in step sizes along the straight path in joint space to T_world_tip.

    That path never meets a joint limit. `otherwise` is returned if the pose cannot be reached.
    """
    to_base = np.linalg.inv(world.base)
    try:
        now, then = (
            np.array(inverse_flat(poses.flat(to_base @ pose), world.instrument, world.told.joints))
            for pose in (world.command, tip)
        )
    except UnreachablePose:
        return otherwise
    share = 1.0
    while True:
        joints = np.array(world.told.joints) + share * (then - now)
        pose = forward_flat(tuple(joints.tolist()), world.instrument)
        move = error_in_base(poses.square(world.told.pose), poses.square(pose), world.step)
        largest = float(np.abs(move).max())
        if largest <= 1.0:
            return move
        share *= 0.99 / largest


def command_error(world: WorldState, tip: Matrix) -> Matrix:
    """Return the move from the command to T_world_tip in step sizes and the base's axes, (6,)."""
    to_base = np.linalg.inv(world.base)
    return error_in_base(to_base @ world.command, to_base @ tip, world.step)


def error_in_base(pose: Matrix, goal: Matrix, step: StepSize) -> Matrix:
    """Return the move from T_base_tip `pose` to `goal` in step sizes and the base's axes, (6,)."""
    shift = (goal[:3, 3] - pose[:3, 3]) / step.translation
    turn = matrix_to_rotvec(goal[:3, :3] @ pose[:3, :3].T) / step.rotation
    return np.concatenate([shift, turn])


def angle_between(a: Matrix, b: Matrix) -> float:
    """Return the angle of the rotation from one pose to the other [rad]."""
    return float(np.linalg.norm(matrix_to_rotvec(a[:3, :3].T @ b[:3, :3])))


def _shifted(pose: Matrix, shift: Matrix) -> Matrix:
    moved = pose.copy()
    moved[:3, 3] += shift
    return moved


# -- grasping the needle ---------------------------------------------------------------------------


def approach_and_grasp(
    world: WorldState, goal: Matrix, back: float, opened: float, room: float = 0.0
) -> ToolTarget:
    """Line up before the grasp with open jaws, move in, close.

    Args:
        world: the present state.
        goal: T_world_tip of the grasp.
        back: how far before the grasp the tool lines up [m].
        opened: jaw angle on the way [rad].
        room: how far the tool may be off along the needle [m].
    """
    # Where the tool is relative to the grasp, in its axes: along the needle, across it, ahead.
    along, across, depth = (goal[:3, :3].T @ (world.tip[:3, 3] - goal[:3, 3])).tolist()
    beside = math.hypot(max(0.0, abs(along) - room), across)
    turned = angle_between(world.tip, goal)
    lined_up = beside < 2 * ALIGNED and turned < 2 * ALIGNED_ANGLE
    closing = world.command_jaw < opened - 2 * world.step.jaw
    # Close, move in, or line up, whichever is due.
    if closing and beside < CLOSING and abs(depth) < CLOSING and turned < CLOSING_ANGLE:
        return ToolTarget(goal if not world.holds else world.command, 0.0)
    if beside < ALIGNED and abs(depth) < ALIGNED and turned < ALIGNED_ANGLE:
        return ToolTarget(goal, 0.0)
    if lined_up and not closing:
        return ToolTarget(goal, opened)
    return ToolTarget(_shifted(goal, -back * goal[:3, 2]), opened)


def _grasp(world: WorldState) -> ToolTarget:
    goal = world.needle @ grasp_in_needle(
        world.arm, world.task_state.grasp_angle + world.miss, radius=world.stitch.radius
    )
    return approach_and_grasp(world, goal, HOVER, OPEN_ABOVE)


def _handoff(world: WorldState) -> ToolTarget:
    goal = world.needle @ grasp_in_needle(
        world.arm, world.stitch.handoff_angle + world.miss, radius=world.stitch.radius
    )
    return approach_and_grasp(world, goal, HANDOFF_BACK, OPEN_HANDOFF, HANDOFF_ROOM)


# -- carrying the needle ---------------------------------------------------------------------------


def on_path(stitch: Stitch, turned: float) -> Matrix:
    """Return the needle's pose after a turn about the wound that starts at `Stitch.place`.

    The needle turns about its tip, which stays in the entry, until the tangent meets the circle,
    then along the circle.

    Args:
        stitch: the path through the holes.
        turned: the turn so far [rad].
    """
    start = stitch.place()
    pivot = turn_about_wound(start, stitch.on_arc(stitch.tip_angle))
    if turned >= pivot:
        return stitch.on_arc(stitch.tip_angle - (turned - pivot))
    pose = start.copy()
    pose[:3, :3] = rotvec_to_matrix(-turned * stitch.wound) @ start[:3, :3]
    tip = np.asarray(stitch.pair.entry.centre)
    pose[:3, 3] = tip - pose[:3, :3] @ needle.point(stitch.tip_angle, stitch.radius)
    return pose


def turn_about_wound(start: Matrix, pose: Matrix) -> float:
    """Return the turn about the wound from `start` to `pose` [rad], in (-π, π].

    It is positive in the direction in which the needle is driven. The wound is the z axis of
    `start`, the normal of the needle's plane.
    """
    x = start[:3, 0]
    z = start[:3, 1]
    return -math.atan2(float(pose[:3, 0] @ z), float(pose[:3, 0] @ x))


def _place(world: WorldState) -> ToolTarget:
    """Lift the needle, turn it upright before the entry, bring its tip into the entry."""
    goal = world.stitch.place()
    outward = world.stitch.pair.entry.rotation[:, 2]
    line = world.needle[:3, :3] @ world.needle_line.T + world.needle[:3, 3:4]
    is_low = float(line[2].min()) < SURFACE + CLEAR
    if is_low and angle_between(world.needle, goal) > math.radians(20.0):
        lifted = _shifted(world.command, np.array([0.0, 0.0, LIFT]))
        if is_free(world, command_error(world, lifted)):
            return ToolTarget(lifted, 0.0)
    offset = line[:, -1] - np.asarray(world.stitch.pair.entry.centre)
    beside = float(np.linalg.norm(offset - (offset @ outward) * outward))
    away = (
        0.0
        if beside < 0.0015 and angle_between(world.needle, goal) < math.radians(7.0)
        else OUTSIDE
    )
    return ToolTarget(world.tip_for_needle(_shifted(goal, away * outward)), 0.0)


def _insert(world: WorldState) -> ToolTarget:
    """Bring the tip into the entry, then drive the needle along its path."""
    start = world.stitch.place()
    tip = (
        world.needle[:3, :3] @ needle.point(world.stitch.tip_angle, world.stitch.radius)
        + world.needle[:3, 3]
    )
    local = world.stitch.pair.entry.rotation.T @ (tip - np.asarray(world.stitch.pair.entry.centre))
    turned = turn_about_wound(start, world.needle)
    if world.task_state.holes_passed == 0:
        near = float(np.linalg.norm(local)) < 0.0009
        tilt = angle_between(world.needle, on_path(world.stitch, max(turned, 0.0)))
        if not (near and tilt < math.radians(4.0)):
            return _place(world)
    pivot = turn_about_wound(start, world.stitch.on_arc(world.stitch.tip_angle))
    last = (
        pivot
        + world.stitch.tip_angle
        - world.stitch.angle_at_entry(world.stitch.insert_angle, INSERT_DEPTH + EXTRA)
    )
    return _drive(world, turned, last)


def _drive(world: WorldState, turned: float, last: float) -> ToolTarget:
    """Move the needle along its path, up to the turn `last` [rad].

    Once it is through both holes but off the path, it is pressed no further.
    """
    start = world.stitch.place()
    commanded = turn_about_wound(start, world.commanded_needle)
    ahead = max(min(commanded, turned + LEAD), turned - LEAD) + DRIVE
    off = world.needle[:3, 3] - on_path(world.stitch, min(max(turned, 0.0), last))[:3, 3]
    if world.task_state.holes_passed >= 2 and float(np.linalg.norm(off)) > BLOCKED:
        ahead = min(ahead - DRIVE, turned)
    return ToolTarget(world.tip_for_needle(on_path(world.stitch, min(max(ahead, 0.0), last))), 0.0)


def _pullout(world: WorldState) -> ToolTarget:
    """Turn the needle along the circle until its base is out, then carry it to the end point."""
    stitch = world.stitch
    if world.task_state.release_steps > 30:
        return ToolTarget(world.command, 0.0)
    line = (world.needle[:3, :3] @ world.needle_line.T + world.needle[:3, 3:4]).T
    outside = ((line - np.asarray(stitch.pair.exit.centre)) @ stitch.pair.exit.rotation)[:, 2]
    if float(outside.min()) > 0.0005:
        return ToolTarget(world.tip_for_needle(stitch.pulled()), 0.0)
    start = stitch.place()
    turned = turn_about_wound(start, world.needle) % (2 * math.pi)
    commanded = turned + _wrap(turn_about_wound(start, world.commanded_needle) - turned)
    ahead = max(min(commanded, turned + LEAD), turned - LEAD)
    pivot = turn_about_wound(start, stitch.on_arc(stitch.tip_angle))
    last = pivot + stitch.tip_angle + 2 * stitch.half + math.radians(12.0)
    return ToolTarget(world.tip_for_needle(on_path(stitch, min(ahead + DRIVE, last))), 0.0)


def _wrap(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


@functools.cache
def _rule(subtask: Subtask) -> Callable[[WorldState], ToolTarget]:
    """Return a subtask's rule: ours, or the one named by another distribution's task."""
    if subtask.name in _RULES:
        return _RULES[subtask.name]
    if not subtask.expert:
        raise InputError(
            f"The task '{subtask.name}' has no expert; its author must name one "
            '(`expert = "module:function"`), or use demonstrations of another kind.'
        )
    rule: Callable[[WorldState], ToolTarget] = resolve(subtask.expert)
    return rule


_RULES: dict[str, Callable[[WorldState], ToolTarget]] = {
    "grasp": _grasp,
    "place": _place,
    "insert": _insert,
    "handoff": _handoff,
    "pullout": _pullout,
}
