"""Control: turn an action of the env into joint commands of one arm.

The command is a pose of the tool tip in the arm's own base frame plus the jaw angle. An action in
[-1, 1]⁷ moves it by at most one step size: translation along the base's axes, rotation by a
rotation vector in the base's axes (for steps of 2° this equals the released code's roll-pitch-yaw
increments to first order, and it has no singularity), and the jaw. A pose outside the workspace or
the joint limits is rejected: the arm keeps its commanded pose, and only the jaw changes.

It uses plain floats throughout: a pose is the tuple of twelve floats of `scene.kinematics`; numpy
on 3 × 3 arrays would cost more than the physics saves.
"""

import math
from typing import NamedTuple, cast

from surgicai_vision.core.config import STEPS
from surgicai_vision.core.errors import UnreachablePose
from surgicai_vision.envs import poses
from surgicai_vision.scene.kinematics import Joints, Pose, inverse_flat
from surgicai_vision.scene.rotations import (
    matrix_to_rotvec_flat,
    multiply_flat,
    rotvec_to_matrix_flat,
    transpose_flat,
)

JAW_OPEN = 1.0
"""Largest commanded jaw angle [rad]; 0 is closed."""
SQUEEZE = 0.3
"""How far the jaw servo's set point goes beyond the command of a closed jaw [rad].

The motor's torque limit then sets the grip force.
"""
SQUEEZE_BELOW = 0.1
"""Commands below which this sets in [rad], gradually, so that the pads do not slam."""
WORKSPACE = ((-0.09, -0.09, 0.060), (0.09, 0.14, 0.165))
"""Corners of the box the tips may move in [m, world]."""
COMMAND_SIZE = 12 + 1 + 6
"""Number of values in a packed command."""


class Command(NamedTuple):
    """What an arm is commanded to do.

    Attributes:
        pose: tip pose in the arm's base.
        jaw: jaw angle [rad].
        joints: the joints that put the tip there.
    """

    pose: Pose
    jaw: float
    joints: Joints

    def pack(self) -> list[float]:
        """Return the command as `COMMAND_SIZE` numbers."""
        return [*self.pose, self.jaw, *self.joints]

    @classmethod
    def unpack(cls, values: list[float]) -> "Command":
        """Return the command that `pack` wrote as `values`."""
        return cls(cast(Pose, tuple(values[:12])), values[12], cast(Joints, tuple(values[13:])))


class StepSize(NamedTuple):
    """The largest move of one action: translation [m], rotation [rad], jaw [rad]."""

    translation: float
    rotation: float
    jaw: float

    @classmethod
    def of(cls, preset: str) -> "StepSize":
        """Return the step size of a preset in `config.STEPS`."""
        translation, degrees, jaw = STEPS[preset]
        return cls(translation, math.radians(degrees), jaw)


def moved(pose: Pose, action: list[float], step: StepSize) -> Pose:
    """Return `pose` moved by the first six numbers of `action`."""
    x, y, z, a, b, c, _ = action
    px, py, pz = poses.position(pose)
    rotation = poses.rotation(pose)
    shift = step.translation
    if a or b or c:
        turn = step.rotation
        rotation = multiply_flat(rotvec_to_matrix_flat(a * turn, b * turn, c * turn), rotation)
    return (px + x * shift, py + y * shift, pz + z * shift, *rotation)


def moved_towards(start: Pose, goal: Pose, step: StepSize) -> Pose:
    """Return `goal` if one step from `start` reaches it, else the end of one step towards it.

    Translation and rotation cover the same share of their distances, so that both arrive together.
    """
    far = poses.distance(start, goal) / step.translation
    turn = matrix_to_rotvec_flat(
        multiply_flat(poses.rotation(goal), transpose_flat(poses.rotation(start)))
    )
    share = max(far, math.hypot(*turn) / step.rotation)
    if share <= 1.0:
        return goal
    x, y, z = (
        a + (b - a) / share
        for a, b in zip(poses.position(start), poses.position(goal), strict=True)
    )
    u, v, w = (angle / share for angle in turn)
    return (x, y, z, *multiply_flat(rotvec_to_matrix_flat(u, v, w), poses.rotation(start)))


def follow(
    command: Command, action: list[float], step: StepSize, base: Pose, instrument: str
) -> Command:
    """Return the command after `action`; the pose stays if the new one cannot be reached.

    Args:
        command: the present command.
        action: seven floats in [-1, 1].
        step: size of an action of 1.
        base: T_world_base of the arm.
        instrument: its instrument.
    """
    jaw = command.jaw + action[6] * step.jaw
    jaw = 0.0 if jaw < 0.0 else JAW_OPEN if jaw > JAW_OPEN else jaw
    pose = moved(command.pose, action, step)
    if in_workspace(pose, base):
        try:
            return Command(pose, jaw, inverse_flat(pose, instrument, command.joints))
        except UnreachablePose:
            pass
    return Command(command.pose, jaw, command.joints)


def in_workspace(pose: Pose, base: Pose) -> bool:
    """Return True if a tip pose in the base lies in the workspace."""
    (x0, y0, z0), (x1, y1, z1) = WORKSPACE
    x, y, z = poses.transform(base, poses.position(pose))
    return x0 <= x <= x1 and y0 <= y <= y1 and z0 <= z <= z1


def jaw_servo(jaw: float) -> float:
    """Return the servo's set point for a commanded jaw angle [rad]."""
    return jaw - SQUEEZE * max(0.0, 1.0 - jaw / SQUEEZE_BELOW) ** 2
