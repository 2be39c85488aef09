"""Absolute: both arms' poses and jaws as sixteen values, as the field's robot data have them.

PSM1's position x y z [m], unit quaternion x y z w and jaw [rad], then PSM2's. `measured` is what an
observation shows; `setpoints` is what the arms are told; in action mode "absolute" an action is the
set-point of both arms (`follow`).

* Frame: `ECM_view`, what a surgeon sees: x left, y up, z away from the viewer. A dVRK reports
  `measured_cp` and `setpoint_cp` in it, and those are what the datasets hold ("psm1_pose",
  "psm1_sp"). It is the endoscope's nominal pose: randomised cameras do not move it.
* Jaw: the angle between the fingers, as a dVRK reports it: twice one finger's, which the rest of
  the product takes.
* Quaternion: of its two signs the one nearer to the arm's start, so that it does not jump within an
  episode and needs no memory. An action may have either, of any length but 0.

The first action of an episode is free to be anywhere, and a robot is not: a set-point further from
the present one than `LEAP` is approached by one `LEAP` a control step. One outside the workspace or
the joints' limits is not taken; the arm then keeps its pose and takes the jaw alone.

Sources: layout, order and jaws from `scripts/conversion/dvrk_zarr_to_lerobot.py` of
open-h/open-h-embodiment; the frame from docs/ros_crtk_contract.md of dvrk_simulator_base ("PSM
Cartesian topics use the live `ECM_view` frame when an ECM is configured").
"""

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, UnreachablePose
from surgicai_vision.envs import poses
from surgicai_vision.envs.control import (
    JAW_OPEN,
    Command,
    StepSize,
    in_workspace,
    moved_towards,
)
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.scene import kinematics
from surgicai_vision.scene.cameras import ENDOSCOPE, ENDOSCOPE_DIRECTION, look_at
from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import (
    matrix_to_quaternion_flat,
    quaternion_to_matrix_flat,
)

SIZE = len(names.ABSOLUTE_STATE_NAMES)
ARM_SIZE = SIZE // len(names.ARMS)
JAW_SCALE = 2.0
"""A dVRK's jaw angle over one finger's."""
LEAP = StepSize(0.002, math.radians(6.0), 0.2)
"""Furthest a set-point moves in a control step: tip [m], turn [rad], finger [rad].

Our choice: 0.1 m/s and 300°/s, twice what PSM2 does when it lets go after the handoff, which is the
fastest any demonstrator moves.
"""
REACH = 0.5
"""Bound of a position's coordinates in the action space [m]; the workspace is far within it."""
SHORTEST = 1e-6
"""Length of the shortest quaternion that says a direction."""


def _view() -> Pose:
    """Return T_world_view of the endoscope, which stands still."""
    camera = look_at(ENDOSCOPE_DIRECTION, (0.0, 0.0, 1.0))  # x right, y down, z forward
    view = np.eye(4)
    view[:3, :3] = camera * [-1.0, -1.0, 1.0]
    view[:3, 3] = ENDOSCOPE
    return poses.flat(view)


T_WORLD_VIEW = _view()
"""`ECM_view` in world."""
T_BASE_VIEW: Mapping[str, Pose] = MappingProxyType(
    {
        arm: poses.compose(poses.invert(poses.flat(kinematics.base_in_world(arm))), T_WORLD_VIEW)
        for arm in names.ARMS
    }
)
"""Arm → `ECM_view` in its base."""
_T_VIEW_BASE = {arm: poses.invert(pose) for arm, pose in T_BASE_VIEW.items()}
_HOME = {
    arm: matrix_to_quaternion_flat(
        poses.rotation(poses.compose(_T_VIEW_BASE[arm], poses.flat(kinematics.start_in_base(arm))))
    )
    for arm in names.ARMS
}
"""Arm → quaternion (w, x, y, z) of its start, which decides a quaternion's sign."""


def space() -> spaces.Box:
    """Return the space of actions in action mode "absolute"."""
    high = np.tile(np.array([REACH] * 3 + [1.0] * 4 + [JAW_SCALE * JAW_OPEN], np.float32), 2)
    low = -high
    low[ARM_SIZE - 1 :: ARM_SIZE] = -np.float32(math.radians(20.0))  # a dVRK presses closed jaws
    return spaces.Box(low, high, dtype=np.float32)


def measured(simulation: Simulation) -> NDArray[np.float32]:
    """Return where both arms report their tips and jaws to be, (16,)."""
    values: list[float] = []
    for arm in names.ARMS:
        values += _eight(arm, simulation.tip_in_base(arm), simulation.jaw(arm))
    return np.array(values, dtype=np.float32)


def setpoints(simulation: Simulation) -> NDArray[np.float32]:
    """Return where both arms are told to be, (16,)."""
    values: list[float] = []
    for arm in names.ARMS:
        command = simulation.commands[arm]
        values += _eight(arm, command.pose, command.jaw)
    return np.array(values, dtype=np.float32)


def _eight(arm: str, pose: Pose, jaw: float) -> list[float]:
    """Return an arm's eight values of a tip pose in its base and one finger's angle [rad]."""
    seen = poses.compose(_T_VIEW_BASE[arm], pose)
    w, x, y, z = matrix_to_quaternion_flat(poses.rotation(seen))
    home = _HOME[arm]
    sign = -1.0 if w * home[0] + x * home[1] + y * home[2] + z * home[3] < 0.0 else 1.0
    return [*poses.position(seen), sign * x, sign * y, sign * z, sign * w, jaw * JAW_SCALE]


def read(arm: str, values: list[float]) -> tuple[Pose, float]:
    """Return T_base_tip and one finger's angle [rad] of an arm's eight values.

    Raises:
        InputError: a quaternion without a direction.
    """
    x, y, z, qx, qy, qz, qw, jaw = values
    length = math.hypot(qx, qy, qz, qw)
    if length < SHORTEST:
        raise InputError(f"The quaternion x y z w of {arm} is {values[3:7]}; it must not be zero.")
    turn = quaternion_to_matrix_flat(qw / length, qx / length, qy / length, qz / length)
    return poses.compose(T_BASE_VIEW[arm], (x, y, z, *turn)), jaw / JAW_SCALE


def follow(action: NDArray[np.float32], simulation: Simulation) -> dict[str, Command]:
    """Return both arms' commands after an absolute action; see the module's docstring.

    Args:
        action: (16,).
        simulation: whose present commands it starts from.

    Raises:
        InputError: not sixteen finite numbers, or a quaternion without a direction.
    """
    values = np.asarray(action).ravel().tolist()
    if len(values) != SIZE or not math.isfinite(sum(values)):
        raise InputError(f"The absolute action must be {SIZE} finite numbers; got {values}.")
    commands = {}
    for index, arm in enumerate(names.ARMS):
        pose, jaw = read(arm, values[ARM_SIZE * index : ARM_SIZE * (index + 1)])
        present = simulation.commands[arm]
        instrument = simulation.scene.config.instrument
        commands[arm] = _toward(present, pose, jaw, simulation.bases[arm], instrument)
    return commands


def _toward(present: Command, pose: Pose, jaw: float, base: Pose, instrument: str) -> Command:
    """Return the command that follows `present` on the way to a pose and a finger's angle."""
    jaw = min(max(jaw, 0.0), JAW_OPEN)
    jaw = min(max(jaw, present.jaw - LEAP.jaw), present.jaw + LEAP.jaw)
    aim = moved_towards(present.pose, pose, LEAP)
    if in_workspace(aim, base):
        try:
            return Command(aim, jaw, kinematics.inverse_flat(aim, instrument, present.joints))
        except UnreachablePose:
            pass
    return present._replace(jaw=jaw)
