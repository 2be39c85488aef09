"""Observation: what a policy may see, chosen by one argument.

* `state`: (21,) float32, three times seven values: the tip now, the tip that would meet the goal,
  and the error. Seven values are x y z [cm], roll pitch yaw [rad], jaw [rad] in the active arm's
  base (the released code's layout). The error's rotation is the rotation vector from now to the
  goal, so it never wraps.
* `goal`: Dict for hindsight relabelling: `observation` (7,), `achieved_goal` (8,) and
  `desired_goal` (8,). The goals are the measured frame that success is judged by and its goal, in
  world: x y z [m], rotation vector, jaw, and 1 if the success conditions other than the pose hold
  (contact, holes passed, needle out), else 0.
* `relative`: (24,) float32: the content of `goal`, relative and in the active arm's base, in a form
  suited to learning; see `envs.relative`.
* `pixels`: Dict of images: "front" is (height, width, 3) uint8 RGB; with depth=True also
  "front_depth" (height, width, 1) float32 [m], with segmentation=True also "front_segmentation"
  (height, width, 1) uint8.
* `pixels_agent_pos`: the same plus `agent_pos` (7,) float32: x y z [m], roll pitch yaw [rad], jaw
  [rad] of the active arm's measured tip in its own base, as a dVRK reports it. In action mode
  "absolute" `agent_pos` is both arms' (16,); see `envs.absolute`.

Vision types hold images and proprioception only: no goal, no needle pose.
"""

import struct
from dataclasses import dataclass
from math import atan2, pi, sqrt

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names, check_camera
from surgicai_vision.core.errors import InputError, check_name, shown
from surgicai_vision.envs import poses
from surgicai_vision.scene.kinematics import STARTS, Pose
from surgicai_vision.scene.rotations import (
    GIMBAL,
    LARGEST_ROLL,
    matrix_to_rotvec_flat,
    matrix_to_rpy_flat,
    multiply_flat,
    transpose_flat,
)

_TWENTY_ONE = struct.Struct("21f").pack_into


@dataclass(frozen=True)
class ObservationConfig:
    """What an env shows.

    Attributes:
        obs_type: one of `names.OBS_TYPES`.
        cameras: views, in order.
        image_size: height and width of an image.
        depth: add depth images.
        segmentation: add segmentation images.
        action_mode: one of `names.ACTION_MODES`; decides what `agent_pos` is.
    """

    obs_type: str = "state"
    cameras: tuple[str, ...] = ("front", "back")
    image_size: tuple[int, int] = (224, 224)
    depth: bool = False
    segmentation: bool = False
    action_mode: str = names.INCREMENTS

    def __post_init__(self) -> None:
        check_name("obs_type", self.obs_type, names.OBS_TYPES)
        check_name("action mode", self.action_mode, names.ACTION_MODES)
        for camera in self.cameras:
            check_camera(camera)
        for name, asked in (("depth", self.depth), ("segmentation", self.segmentation)):
            if not isinstance(asked, bool):
                raise InputError(f"{name} is {shown(asked)}; allowed: True or False.")
        if len(set(self.cameras)) != len(self.cameras):
            raise InputError(f"cameras names one view twice: {', '.join(self.cameras)}.")
        if self.visual and not self.cameras:
            raise InputError(f"cameras is empty; allowed: {', '.join(camera_names())}.")
        if min(self.image_size) < 16 or self.image_size[0] > 960 or self.image_size[1] > 1280:
            raise InputError(
                f"image_size is {self.image_size}; allowed: 16 × 16 to 960 × 1280 (height × width)."
            )

    @property
    def visual(self) -> bool:
        """Return True if observations contain images."""
        return self.obs_type in ("pixels", "pixels_agent_pos")

    @property
    def shows_agent_pos(self) -> bool:
        """Return True if `agent_pos` is given alongside the images."""
        return self.obs_type == "pixels_agent_pos"

    @property
    def modalities(self) -> tuple[str, ...]:
        """Return what is rendered for each camera, a subset of `names.MODALITIES`."""
        asked = {names.RGB: True, names.DEPTH: self.depth, names.SEGMENTATION: self.segmentation}
        return tuple(modality for modality in names.MODALITIES if asked[modality])

    def space(self) -> spaces.Space[object]:
        """Return the observation space."""
        if self.obs_type == "state":
            return _box(21)
        if self.obs_type == "goal":
            return spaces.Dict(
                {"observation": _box(7), "achieved_goal": _box(8), "desired_goal": _box(8)}
            )
        if self.obs_type == "relative":
            return _box(len(names.RELATIVE_NAMES))
        height, width = self.image_size
        frame_spaces: dict[str, spaces.Space[object]] = {
            names.RGB: spaces.Box(0, 255, (height, width, 3), np.uint8),
            names.DEPTH: spaces.Box(0.0, np.inf, (height, width, 1), np.float32),
            names.SEGMENTATION: spaces.Box(0, len(names.PARTS) - 1, (height, width, 1), np.uint8),
        }
        parts: dict[str, spaces.Space[object]] = {
            names.frame_key(camera, modality): frame_spaces[modality]
            for camera in self.cameras
            for modality in self.modalities
        }
        if self.shows_agent_pos:
            is_absolute = self.action_mode == names.ABSOLUTE
            parts["agent_pos"] = _box(len(names.ABSOLUTE_STATE_NAMES) if is_absolute else 7)
        return spaces.Dict(parts)


def _box(size: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (size,), np.float32)


def seven(arm: str, pose: Pose, jaw: float, scale: float = 1.0) -> list[float]:
    """Return x y z (times `scale`), roll pitch yaw, jaw of a tip pose in the arm's base.

    Roll is in (-2π, 0] as in the released code; yaw is unwrapped about the arm's start, half a turn
    either way.
    """
    x, y, z = poses.position(pose)
    roll, pitch, yaw = matrix_to_rpy_flat(poses.rotation(pose))
    home = STARTS[arm].yaw
    yaw = home + (yaw - home + pi) % (2 * pi) - pi
    return [x * scale, y * scale, z * scale, roll, pitch, yaw, jaw]


def setpoint(now: Pose, jaw: float, told: Pose, told_jaw: float) -> NDArray[np.float32]:
    """Return the offset of a set point from what is measured, (7,) [m, rad].

    Args:
        now: measured tip pose in the arm's base.
        jaw: measured jaw angle [rad].
        told: commanded tip pose in the arm's base.
        told_jaw: commanded jaw angle [rad].
    """
    shift = [b - a for a, b in zip(poses.position(now), poses.position(told), strict=True)]
    turn = multiply_flat(poses.rotation(told), transpose_flat(poses.rotation(now)))
    return np.array([*shift, *matrix_to_rotvec_flat(turn), told_jaw - jaw], dtype=np.float32)


def state_vector(arm: str, now: Pose, goal: Pose, jaw: float) -> NDArray[np.float32]:
    """Return the 21 values of obs_type "state"; poses in the arm's base."""
    current = seven(arm, now, jaw, 100.0)
    wanted = seven(arm, goal, 0.0, 100.0)
    turn = multiply_flat(poses.rotation(goal), transpose_flat(poses.rotation(now)))
    error = [b - a for a, b in zip(current[:3], wanted[:3], strict=True)]
    return np.array(
        [*current, *wanted, *error, *matrix_to_rotvec_flat(turn), -jaw], dtype=np.float32
    )


def state_vector_in_world(
    arm: str, base: Pose, tip: Pose, achieved: Pose, desired: Pose, jaw: float
) -> NDArray[np.float32]:
    """Return what `state_vector` does, from poses in world and with a third of the multiplications.

    Args:
        arm: the active arm.
        base: T_world_base.
        tip: T_world_tip; the goal is the tip pose at which `achieved`, moving with the tip, is at
            `desired`.
        achieved: the frame that success is judged by.
        desired: where it should be.
        jaw: [rad].
    """
    bx, by, bz, b0, b1, b2, b3, b4, b5, b6, b7, b8 = base
    tx, ty, tz, r0, r1, r2, r3, r4, r5, r6, r7, r8 = tip
    ax, ay, az, a0, a1, a2, a3, a4, a5, a6, a7, a8 = achieved
    gx, gy, gz, g0, g1, g2, g3, g4, g5, g6, g7, g8 = desired
    # The turn from achieved to desired, the tip in the base, the translation to the goal in world
    # and in the base.
    d0 = g0 * a0 + g1 * a1 + g2 * a2
    d1 = g0 * a3 + g1 * a4 + g2 * a5
    d2 = g0 * a6 + g1 * a7 + g2 * a8
    d3 = g3 * a0 + g4 * a1 + g5 * a2
    d4 = g3 * a3 + g4 * a4 + g5 * a5
    d5 = g3 * a6 + g4 * a7 + g5 * a8
    d6 = g6 * a0 + g7 * a1 + g8 * a2
    d7 = g6 * a3 + g7 * a4 + g8 * a5
    d8 = g6 * a6 + g7 * a7 + g8 * a8
    x, y, z = tx - bx, ty - by, tz - bz
    px, py, pz = b0 * x + b3 * y + b6 * z, b1 * x + b4 * y + b7 * z, b2 * x + b5 * y + b8 * z
    x, y, z = tx - ax, ty - ay, tz - az
    ex = gx + d0 * x + d1 * y + d2 * z - tx
    ey = gy + d3 * x + d4 * y + d5 * z - ty
    ez = gz + d6 * x + d7 * y + d8 * z - tz
    ex, ey, ez = (
        b0 * ex + b3 * ey + b6 * ez,
        b1 * ex + b4 * ey + b7 * ez,
        b2 * ex + b5 * ey + b8 * ez,
    )
    vx, vy, vz = matrix_to_rotvec_flat((d0, d1, d2, d3, d4, d5, d6, d7, d8))
    # Of both rotations in the base, what roll, pitch and yaw need: the first column and the end of
    # the last row.
    cx = b0 * r0 + b3 * r3 + b6 * r6
    cy = b1 * r0 + b4 * r3 + b7 * r6
    cz = b2 * r0 + b5 * r3 + b8 * r6
    x, y, z = d0 * r0 + d1 * r3 + d2 * r6, d3 * r0 + d4 * r3 + d5 * r6, d6 * r0 + d7 * r3 + d8 * r6
    fx, fy, fz = b0 * x + b3 * y + b6 * z, b1 * x + b4 * y + b7 * z, b2 * x + b5 * y + b8 * z
    x, y, z = b2 * d0 + b5 * d3 + b8 * d6, b2 * d1 + b5 * d4 + b8 * d7, b2 * d2 + b5 * d5 + b8 * d8
    cos_pitch = sqrt(cx * cx + cy * cy)
    goal_cos_pitch = sqrt(fx * fx + fy * fy)
    if cos_pitch < GIMBAL or goal_cos_pitch < GIMBAL:
        to_base = poses.invert(base)
        goal = poses.compose(desired, poses.relative(achieved, tip))
        return state_vector(arm, poses.compose(to_base, tip), poses.compose(to_base, goal), jaw)
    home = STARTS[arm].yaw - pi
    seen = np.empty(21, np.float32)
    _TWENTY_ONE(
        seen,
        0,
        px * 100.0,
        py * 100.0,
        pz * 100.0,
        _roll(b2 * r1 + b5 * r4 + b8 * r7, b2 * r2 + b5 * r5 + b8 * r8),
        atan2(-cz, cos_pitch),
        home + (atan2(cy, cx) - home) % (2 * pi),
        jaw,
        (px + ex) * 100.0,
        (py + ey) * 100.0,
        (pz + ez) * 100.0,
        _roll(x * r1 + y * r4 + z * r7, x * r2 + y * r5 + z * r8),
        atan2(-fz, goal_cos_pitch),
        home + (atan2(fy, fx) - home) % (2 * pi),
        0.0,
        ex * 100.0,
        ey * 100.0,
        ez * 100.0,
        b0 * vx + b3 * vy + b6 * vz,
        b1 * vx + b4 * vy + b7 * vz,
        b2 * vx + b5 * vy + b8 * vz,
        -jaw,
    )
    return seen


def _roll(sine: float, cosine: float) -> float:
    """Return a roll in (-2π, 0], as `matrix_to_rpy_flat` does."""
    roll = atan2(sine, cosine)
    return roll if roll <= 0.0 else max(roll - 2.0 * pi, -LARGEST_ROLL)


def goal_vector(pose: Pose, jaw: float, met: bool) -> NDArray[np.float32]:
    """Return a pose in world as a goal (8,).

    x y z [m], rotation vector [rad], jaw [rad], and 1 if the other success conditions hold.
    """
    turn = matrix_to_rotvec_flat(poses.rotation(pose))
    return np.array([*poses.position(pose), *turn, jaw, met], dtype=np.float32)


def goal_errors(
    achieved: NDArray[np.float32], desired: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return distance [m] and geodesic angle [rad] between goal vectors, (8,) or (batch, 8)."""
    from scipy.spatial.transform import Rotation

    one = np.atleast_2d(achieved).astype(np.float64)
    other = np.atleast_2d(desired).astype(np.float64)
    distance = np.linalg.norm(one[:, :3] - other[:, :3], axis=1)
    turn = (
        Rotation.from_rotvec(other[:, 3:6]) * Rotation.from_rotvec(one[:, 3:6]).inv()
    ).magnitude()
    return (distance, turn) if np.ndim(achieved) > 1 else (distance[0], turn[0])
