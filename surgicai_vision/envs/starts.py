"""Starts: put the needle into an arm's jaws by solving for the pose.

The jaws are posed closed around the needle and the physics settles for `SETTLE` steps; a start that
is then not a grasp, or that touches the phantom where it should not, is refused and drawn again.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import UnreachablePose
from surgicai_vision.envs import poses
from surgicai_vision.envs.geometry import FIRST_GRASP, grasp_in_needle
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.scene import needle
from surgicai_vision.scene.arm import GRASP_DEPTH, PAD_OFFSET
from surgicai_vision.scene.rotations import rotvec_to_matrix

Matrix = NDArray[np.float64]

SETTLE = 60
"""Physics steps (2 ms) for which a start state settles."""
REST_SPEED = 0.010
"""A held needle faster than this [m/s] is slipping out, as in one of 150 closings of the jaws."""
REST_TURN = 1.0
"""The same for its rotation [rad/s]."""
PUSHED = 0.0005
"""An arm that is this far from where it was put has been pushed [m]."""
CLOSED_JAW = (needle.BODY_RADIUS - PAD_OFFSET) / GRASP_DEPTH
"""Finger angle [rad] at which the pads touch the needle."""
GRASP_ANGLES = (math.radians(5.0), math.radians(20.0))
"""Needle angle of PSM2's grasp (released code, Approach)."""
SAFE_ANGLES = (FIRST_GRASP, math.radians(27.0))
"""Needle angles at which an imperfect grasp still holds the needle and passes the entry."""


class GraspError(NamedTuple):
    """How far a grasp is from the nominal one."""

    along: float
    """Along the needle [m]."""
    depth: float
    """Along the jaws; negative is shallower [m]."""
    tilt: tuple[float, float]
    """Rotation vector about the tool's x and y axis, through the grasped point [rad]."""


def draw_grasp_error(rng: np.random.Generator, shift: float, angle: float) -> GraspError:
    """Draw how far a grasp is off: at most `shift` [m] and `angle` [rad].

    The shift is along the needle and in depth, the angle about two axes. The jaws' flat pads remove
    the third translation and the third rotation when they close.
    """
    along = rng.uniform(-shift, shift)
    depth = rng.uniform(-0.6, 0.2) * math.sqrt(shift**2 - along**2)
    size = angle * math.sqrt(rng.uniform())
    direction = rng.uniform(0.0, 2 * math.pi)
    return GraspError(along, depth, (size * math.cos(direction), size * math.sin(direction)))


def grasp_pose(
    arm: str,
    needle_pose: Matrix,
    angle: float,
    error: GraspError | None = None,
    radius: float = needle.RADIUS,
) -> Matrix:
    """Return T_world_tip (4, 4) of a grasp of an arc's point at `angle` [rad], off by `error`."""
    if error is None:
        return needle_pose @ grasp_in_needle(arm, angle, radius=radius)
    grasp = needle_pose @ grasp_in_needle(
        arm, angle + error.along / radius, GRASP_DEPTH - error.depth, radius
    )
    pivot = np.eye(4)
    pivot[2, 3] = GRASP_DEPTH - error.depth
    turn = np.eye(4)
    turn[:3, :3] = rotvec_to_matrix([*error.tilt, 0.0])
    return grasp @ pivot @ turn @ np.linalg.inv(pivot)


def hold_needle(
    simulation: Simulation,
    arm: str,
    needle_pose: Matrix,
    tip: Matrix,
    turn: float = math.radians(8.0),
) -> bool:
    """Put `arm` around the needle, close and settle; return True if it holds the needle there.

    Args:
        simulation: already reset.
        arm: the holding arm.
        needle_pose: T_world_needle (4, 4).
        tip: T_world_tip (4, 4) of the arm.
        turn: how far the closing jaws may turn the needle [rad].
    """
    simulation.pose_needle(poses.flat(needle_pose))
    try:
        simulation.pose_arm(arm, simulation.to_base(arm, poses.flat(tip)), 0.0, CLOSED_JAW)
    except UnreachablePose:
        return False
    simulation.settle(SETTLE)
    now = simulation.needle()
    wanted = poses.flat(needle_pose)
    near = poses.distance(now, wanted) < 0.002 and poses.angle(now, wanted) < turn
    return near and simulation.holds(arm) and _at_rest(simulation)


def stands_free(simulation: Simulation, arm: str) -> bool:
    """Return True if an arm is still where it was put: nothing has pushed it away.

    An arm that was put into the tissue is off by some millimetres once it has settled, touches
    nothing, and strikes the tissue when it comes back.
    """
    wanted = simulation.true_pose(arm, simulation.commands[arm])
    return poses.distance(simulation.to_base(arm, simulation.tip(arm)), wanted) < PUSHED


def _at_rest(simulation: Simulation) -> bool:
    """Return True if the needle is at rest, that is, not slipping out of the jaws."""
    first = simulation.model.joint("needle").dofadr[0]
    velocity = simulation.data.qvel[first : first + 6]
    return bool(
        np.linalg.norm(velocity[:3]) < REST_SPEED and np.linalg.norm(velocity[3:]) < REST_TURN
    )


def draw_rotation(rng: np.random.Generator, angle: float) -> Matrix:
    """Draw a rotation (3, 3) by at most `angle` [rad] about a random axis."""
    axis = rng.normal(size=3)
    return rotvec_to_matrix(axis / np.linalg.norm(axis) * rng.uniform(0.0, angle))


def about_point(pose: Matrix, point: Matrix, rotation: Matrix, shift: Matrix) -> Matrix:
    """Return `pose` turned by `rotation` about `point` (world) and shifted by `shift` (world)."""
    moved = pose.copy()
    moved[:3, :3] = rotation @ pose[:3, :3]
    moved[:3, 3] = point + rotation @ (pose[:3, 3] - point) + shift
    return moved
