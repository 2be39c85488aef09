"""Absolute: both arms' poses and jaws as sixteen values, laid out as in the field's robot data.

PSM1's position x y z [m], unit quaternion x y z w and jaw [rad], then PSM2's. `measured` is what an
observation shows; `setpoints` is what the arms are commanded to do; in action mode "absolute" an
action is the set-point of both arms (`follow`).

* Frame: `ECM_view`, the surgeon's view: x left, y up, z away from the viewer. A dVRK reports
  `measured_cp` and `setpoint_cp` in it, and the datasets contain these two ("psm1_pose",
  "psm1_sp"). It is the endoscope's nominal pose: randomised cameras do not move it.
* Jaw: the angle between the fingers, as a dVRK reports it: twice the angle of one finger, which the
  rest of the product uses.
* Quaternion: its sign is the one nearer to the arm's start, so that it does not jump within an
  episode and depends on no history. An action may use either sign and any length except 0.

The first action of an episode may be anywhere, but a robot cannot jump there: a set-point further
from the present one than `LEAP` is approached by one `LEAP` per control step. A set-point outside
the workspace or the joint limits is rejected; the arm then keeps its pose and only the jaw follows.

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
"""Largest move of a set-point per control step: tip [m], turn [rad], finger [rad].

Our choice: 0.1 m/s and 300°/s, twice the speed at which PSM2 lets go after the handoff, the fastest
motion of any demonstrator.
"""
REACH = 0.5
"""Bound of the position coordinates in the action space [m]; the workspace is well inside it."""
SHORTEST = 1e-6
"""Shortest length at which a quaternion still defines a rotation."""


def _view() -> Pose:
    """Return T_world_view of the endoscope, which does not move."""
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
"""Arm → quaternion (w, x, y, z) of its start, which determines the sign of a quaternion."""


def space() -> spaces.Box:
    """Return the space of actions in action mode "absolute"."""
    high = np.tile(np.array([REACH] * 3 + [1.0] * 4 + [JAW_SCALE * JAW_OPEN], np.float32), 2)
    low = -high
    low[ARM_SIZE - 1 :: ARM_SIZE] = -np.float32(math.radians(20.0))  # a dVRK squeezes closed jaws
    return spaces.Box(low, high, dtype=np.float32)


def measured(simulation: Simulation) -> NDArray[np.float32]:
    """Return both arms' tips and jaws as the arms report them, (16,)."""
    values: list[float] = []
    for arm in names.ARMS:
        values += _eight(arm, simulation.tip_in_base(arm), simulation.jaw(arm))
    return np.array(values, dtype=np.float32)


def setpoints(simulation: Simulation) -> NDArray[np.float32]:
    """Return both arms' commanded tips and jaws, (16,)."""
    values: list[float] = []
    for arm in names.ARMS:
        command = simulation.commands[arm]
        values += _eight(arm, command.pose, command.jaw)
    return np.array(values, dtype=np.float32)


def _eight(arm: str, pose: Pose, jaw: float) -> list[float]:
    """Return an arm's eight values from a tip pose in its base and one finger's angle [rad]."""
    seen = poses.compose(_T_VIEW_BASE[arm], pose)
    w, x, y, z = matrix_to_quaternion_flat(poses.rotation(seen))
    home = _HOME[arm]
    sign = -1.0 if w * home[0] + x * home[1] + y * home[2] + z * home[3] < 0.0 else 1.0
    return [*poses.position(seen), sign * x, sign * y, sign * z, sign * w, jaw * JAW_SCALE]


def read(arm: str, values: list[float]) -> tuple[Pose, float]:
    """Return T_base_tip and one finger's angle [rad] from an arm's eight values.

    Raises:
        InputError: a quaternion shorter than `SHORTEST`.
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
        simulation: provides the present commands, from which the action starts.

    Raises:
        InputError: not sixteen finite numbers, or a quaternion shorter than `SHORTEST`.
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
    """Return the next command after `present` on the way to a pose and a finger's angle."""
    jaw = min(max(jaw, 0.0), JAW_OPEN)
    jaw = min(max(jaw, present.jaw - LEAP.jaw), present.jaw + LEAP.jaw)
    aim = moved_towards(present.pose, pose, LEAP)
    if in_workspace(aim, base):
        try:
            return Command(aim, jaw, kinematics.inverse_flat(aim, instrument, present.joints))
        except UnreachablePose:
            pass
    return present._replace(jaw=jaw)
