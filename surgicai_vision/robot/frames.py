"""Frames: the frames of Cartesian messages, and how poses become messages.

* `world`: the scene's frame.
* `PSM1_base`, `PSM2_base`: an arm's base, whose origin is its remote centre of motion.
* `ECM`: the endoscope's optical frame, x forward, y left, z up.
* `ECM_view`: what a surgeon sees: x left, y up, z forward, away from the viewer.

Sources: docs/ros_crtk_contract.md of dvrk_simulator_base ("PSM Cartesian topics use the live
`ECM_view` frame when an ECM is configured. PSM `local/*` poses remain in the static configured PSM
base frame"), and for the axes its cartesian_frames.py. An empty frame means `ECM_view`
(cartesian_command.py). The tip of a PSM is the wrist's yaw axis, as in a dVRK's tool files 400006
and 420006.
"""

import math
from collections.abc import Mapping

from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.envs import poses
from surgicai_vision.envs.absolute import T_WORLD_VIEW
from surgicai_vision.robot.messages import Header, PoseStamped
from surgicai_vision.scene.kinematics import Pose, forward_flat
from surgicai_vision.scene.rotations import (
    matrix_to_quaternion_flat,
    matrix_to_rotvec_flat,
    multiply_flat,
    quaternion_to_matrix_flat,
    transpose_flat,
)

WORLD = "world"
VIEW = "ECM_view"
UNIT_TOLERANCE = 1e-3
"""How far a quaternion's length may be from 1; it is then normalised to 1."""
STEP = 1e-5
"""Half the time between the two poses that give a velocity [s]; its error is of second order."""


T_VIEW_ECM: Pose = (0.0, 0.0, 0.0, *(0.0, 1.0, 0.0), *(0.0, 0.0, 1.0), *(1.0, 0.0, 0.0))
"""The endoscope's optical frame in its view: x is the view's z, y its x, z its y."""
T_WORLD_ECM = poses.compose(T_WORLD_VIEW, T_VIEW_ECM)
"""The endoscope's optical frame in world."""


def base_frame(name: str) -> str:
    """Return the name of an arm's base frame."""
    return f"{name}_base"


class Frames:
    """The frames that one arm's Cartesian messages may be in.

    Args:
        frames: name → T_base_frame, the frame in the arm's base; "" is the default.
    """

    def __init__(self, frames: Mapping[str, Pose]):
        self._from_base = {name: poses.invert(pose) for name, pose in frames.items()}
        self._to_base = dict(frames)

    @classmethod
    def of_psm(cls, name: str, base: Pose) -> "Frames":
        """Return the frames of a PSM whose T_world_base is `base`."""
        from_world = poses.invert(base)
        view = poses.compose(from_world, T_WORLD_VIEW)
        known = {"": view, VIEW: view, WORLD: from_world, base_frame(name): poses.IDENTITY}
        return cls(known)

    def to_base(self, message: PoseStamped) -> Pose:
        """Return a message's pose in the arm's base.

        Raises:
            InputError: non-finite numbers, not a unit quaternion, or an unknown frame.
        """
        pose = read_pose(message)
        frame = message.header.frame
        check_name("frame", frame, self._to_base)
        return poses.compose(self._to_base[frame], pose)

    def from_base(self, pose: Pose, frame: str) -> Pose:
        """Return a pose in the arm's base as one in `frame`."""
        return poses.compose(self._from_base[frame], pose)

    def turn_from_base(
        self, vector: tuple[float, float, float], frame: str
    ) -> tuple[float, float, float]:
        """Return a vector in the arm's base, such as a velocity, in the axes of `frame`."""
        turn = poses.rotation(self._from_base[frame])
        return poses.transform((0.0, 0.0, 0.0, *turn), vector)


def write_pose(pose: Pose, stamp: int, frame: str) -> PoseStamped:
    """Return a pose as a message."""
    w, x, y, z = matrix_to_quaternion_flat(poses.rotation(pose))
    return PoseStamped(Header(stamp, frame), poses.position(pose), (x, y, z, w))


def read_pose(message: PoseStamped) -> Pose:
    """Return a message's pose in its own frame.

    Raises:
        InputError: non-finite numbers, or not a unit quaternion.
    """
    if len(message.position) != 3 or len(message.quaternion) != 4:
        raise InputError("A pose needs three numbers of position and four of orientation.")
    if not all(map(math.isfinite, (*message.position, *message.quaternion))):
        raise InputError("A pose must have finite numbers.")
    length = math.hypot(*message.quaternion)
    if abs(length - 1.0) > UNIT_TOLERANCE:
        raise InputError(f"The quaternion has length {length:.4g}; give a unit quaternion x y z w.")
    qx, qy, qz, qw = (value / length for value in message.quaternion)
    x, y, z = message.position
    return (x, y, z, *quaternion_to_matrix_flat(qw, qx, qy, qz))


def twist(
    joints: tuple[float, ...], velocity: tuple[float, ...], instrument: str
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return the tip's linear [m/s] and angular [rad/s] velocity in the base's axes.

    Args:
        joints: six joints [rad, m].
        velocity: their velocities [rad/s, m/s].
        instrument: the PSM's instrument.
    """

    def tip(seconds: float) -> Pose:
        a, b, c, d, e, f = (
            joint + seconds * speed for joint, speed in zip(joints, velocity, strict=True)
        )
        return forward_flat((a, b, c, d, e, f), instrument)

    before = tip(-STEP)
    after = tip(STEP)
    u, v, w = (
        (b - a) / (2.0 * STEP)
        for a, b in zip(poses.position(before), poses.position(after), strict=True)
    )
    turn = multiply_flat(poses.rotation(after), transpose_flat(poses.rotation(before)))
    x, y, z = (angle / (2.0 * STEP) for angle in matrix_to_rotvec_flat(turn))
    return (u, v, w), (x, y, z)
