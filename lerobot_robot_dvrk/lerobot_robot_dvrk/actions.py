"""Actions: what the values of a LeRobot action mean, and the motions they command.

* increments: dx.vel … dyaw.vel, jaw.vel, steps of the active arm's set point in its base; used by
  our policies, our datasets and `surgicai_page`.
* delta: delta_x, delta_y, delta_z and gripper (0 closes, 1 stays, 2 opens); used by `gamepad` and
  `keyboard_ee`.
* leader: the leader's joints, JOINT.pos; used by `so101_leader`, `koch_leader` and any other arm.
* absolute: both arms' poses and jaws, 16 values; used by policies trained on the field's data.

With delta and leader, the axes are those of the endoscope's view: right, up and away from the
viewer. LeRobot's own delta_x, delta_y and delta_z (forward, left, up) are away, left and up in this
view. A leader joint's motion since the last action is added to the set point, over as many steps as
that takes. For a joint, "-right" reverses the sign, and "PSM1:right" moves only that arm.

Names of values end in `.pos` or `.vel`, since `lerobot-rollout` passes no others to a policy.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Protocol, final

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.envs import poses
from surgicai_vision.envs.control import JAW_OPEN, StepSize
from surgicai_vision.robot.driven import Command, DrivenRobot
from surgicai_vision.robot.simulated import PSM_NAMES
from surgicai_vision.scene import kinematics
from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import matrix_to_quaternion_flat, quaternion_to_matrix_flat

INCREMENTS = "increments"
ABSOLUTE = "absolute"
LEADER = MappingProxyType(
    {
        "shoulder_pan": "right",
        "shoulder_lift": "away",
        "elbow_flex": "-up",
        "wrist_flex": "tilt",
        "wrist_roll": "roll",
        "gripper": "jaw",
    }
)
"""Joint of LeRobot's six-joint leaders → direction in which it moves the tip."""
WAYS: Mapping[str, tuple[int, float, float]] = MappingProxyType(
    {
        "right": (0, -1.0, 5e-4),
        "up": (1, 1.0, 5e-4),
        "away": (2, 1.0, 5e-4),
        "tilt": (3, -1.0, math.radians(0.9)),
        "swing": (4, -1.0, math.radians(0.9)),
        "roll": (5, 1.0, math.radians(0.9)),
        "jaw": (6, 1.0, JAW_OPEN / 100.0),
    }
)
"""Direction → its index among the seven increments, its sign in the view's axes (x left, y up, z
away), and the motion per unit of a joint [m, rad]. Leaders' joints go from -100 to 100, grippers
from 0 to 100, so that the full range of a joint is 100 mm, or 180°."""
MOST_WAITING = 25.0
"""Steps that a leader may be ahead of the tip; any further motion is dropped."""
POSITIONS = tuple(f"{name}.pos" for name in names.ABSOLUTE_STATE_NAMES)
"""The observation's values if the action is "absolute": both arms' tips in the frame of their
`measured_cp`, quaternion x y z w, and the angle between the fingers."""
TARGETS = tuple(f"{name}.pos" for name in names.ABSOLUTE_ACTION_NAMES)
"""The same values for the set points: an absolute action."""

Values = Mapping[str, float]


class Reader(Protocol):
    """Reads actions."""

    @property
    def features(self) -> tuple[str, ...]:
        """Return the names of an action's values."""

    @property
    def arms(self) -> tuple[str, ...]:
        """Return the arms it may move; () means the active one."""

    def moves(self, action: Values, robot: DrivenRobot) -> Mapping[str, Sequence[float]]:
        """Return arm → seven increments in [-1, 1]; empty if the action gives `targets`."""

    def targets(self, action: Values, robot: DrivenRobot) -> Mapping[str, Command]:
        """Return arm → its set point; empty if the action gives `moves`."""

    def forget(self) -> None:
        """Forget earlier actions: they were not sent, or an episode begins."""


@final
class Increments:
    """Our own action: seven increments of the active arm."""

    features = tuple(f"{name}.vel" for name in names.ACTION_NAMES)
    arms = ()

    def __init__(self, step: StepSize, leader: Mapping[str, str]):
        pass

    def moves(self, action: Values, robot: DrivenRobot) -> Mapping[str, Sequence[float]]:
        """Return the increments; missing values are 0."""
        return {robot.active: [float(action.get(name, 0.0)) for name in self.features]}

    def targets(self, action: Values, robot: DrivenRobot) -> Mapping[str, Command]:
        """Return nothing."""
        return {}

    def forget(self) -> None:
        """Do nothing: every action stands for itself."""


@final
class Delta:
    """LeRobot's gamepad and keyboard: three translations and a gripper."""

    features = ("delta_x", "delta_y", "delta_z", "gripper")
    arms = ()

    def __init__(self, step: StepSize, leader: Mapping[str, str]):
        pass

    def moves(self, action: Values, robot: DrivenRobot) -> Mapping[str, Sequence[float]]:
        """Return the increments."""
        forward, left, up = (float(action.get(name, 0.0)) for name in self.features[:3])
        jaw = float(action.get("gripper", 1.0)) - 1.0
        arm = robot.active
        asked = _shortened(robot, arm, [left, up, forward, 0.0, 0.0, 0.0, jaw])
        return {arm: _in_base(robot, arm, asked)}

    def targets(self, action: Values, robot: DrivenRobot) -> Mapping[str, Command]:
        """Return nothing."""
        return {}

    def forget(self) -> None:
        """Do nothing: every action stands for itself."""


@final
class Leader:
    """A leader arm, whose joint motions are added to the set points.

    Args:
        step: the largest step of one action.
        leader: joint → direction; see the module's docstring.

    Raises:
        InputError: `leader` is empty, or names an unknown direction or arm.
    """

    def __init__(self, step: StepSize, leader: Mapping[str, str]):
        if not leader:
            raise InputError("leader is empty; give at least one joint and how it moves the tip.")
        sizes = (step.translation,) * 3 + (step.rotation,) * 3 + (step.jaw,)
        self._ways: dict[str, tuple[str, int, float]] = {}
        for joint, said in leader.items():
            arm, _, way = said.rpartition(":")
            if arm:
                check_name(f"arm of {joint}", arm, PSM_NAMES)
            check_name(f"way of {joint}", way.lstrip("-"), WAYS)
            place, sign, gain = WAYS[way.lstrip("-")]
            turned = -1.0 if way.startswith("-") else 1.0
            self._ways[f"{joint}.pos"] = (arm, place, turned * sign * gain / sizes[place])
        self.features = tuple(self._ways)
        self.arms = tuple(sorted({arm for arm, _, _ in self._ways.values() if arm}))
        self._last: dict[str, float] = {}
        self._waiting: dict[str, list[float]] = {}

    def moves(self, action: Values, robot: DrivenRobot) -> Mapping[str, Sequence[float]]:
        """Return the increments for the joints' motion since the last action."""
        for name, (said, place, steps) in self._ways.items():
            value = float(action.get(name, math.nan))
            if not math.isfinite(value):
                continue
            waiting = self._waiting.setdefault(said or robot.active, [0.0] * 7)
            waiting[place] += (value - self._last.get(name, value)) * steps
            waiting[place] = min(max(waiting[place], -MOST_WAITING), MOST_WAITING)
            self._last[name] = value
        moves: dict[str, Sequence[float]] = {}
        for arm, waiting in self._waiting.items():
            if arm not in self.arms and arm != robot.active:
                waiting[:] = [0.0] * 7
                continue
            sent = _shortened(robot, arm, [min(max(value, -1.0), 1.0) for value in waiting])
            waiting[:] = [value - part for value, part in zip(waiting, sent, strict=True)]
            moves[arm] = _in_base(robot, arm, sent)
        return moves

    def targets(self, action: Values, robot: DrivenRobot) -> Mapping[str, Command]:
        """Return nothing."""
        return {}

    def forget(self) -> None:
        """Forget where the joints were, and motion that has not been sent."""
        self._last.clear()
        self._waiting.clear()


@final
class Absolute:
    """Set points of both arms, named as in the observation or as in the field's datasets."""

    features = TARGETS
    arms = tuple(PSM_NAMES)

    def __init__(self, step: StepSize, leader: Mapping[str, str]):
        pass

    def moves(self, action: Values, robot: DrivenRobot) -> Mapping[str, Sequence[float]]:
        """Return nothing."""
        return {}

    def targets(self, action: Values, robot: DrivenRobot) -> Mapping[str, Command]:
        """Return both arms' set points.

        Raises:
            InputError: a value is missing or a quaternion is zero.
        """
        keys = TARGETS if TARGETS[0] in action else POSITIONS
        missing = [key for key in keys if key not in action]
        if missing:
            raise InputError(f"the action lacks {', '.join(missing[:3])}.")
        found = {}
        for index, arm in enumerate(PSM_NAMES):
            values = [float(action[key]) for key in keys[8 * index : 8 * (index + 1)]]
            x, y, z, qx, qy, qz, qw, jaw = values
            length = math.hypot(qx, qy, qz, qw)
            if not length > 1e-6:
                raise InputError(f"the quaternion of {arm} is zero.")
            turn = quaternion_to_matrix_flat(qw / length, qx / length, qy / length, qz / length)
            _, base = robot.frame(arm)
            pose = poses.compose(poses.invert(base), (x, y, z, *turn))
            found[arm] = Command(pose, jaw * robot.jaw_scale)
        return found

    def forget(self) -> None:
        """Do nothing: every action stands for itself."""


ACTIONS: Mapping[str, Callable[[StepSize, Mapping[str, str]], Reader]] = MappingProxyType(
    {INCREMENTS: Increments, "delta": Delta, "leader": Leader, ABSOLUTE: Absolute}
)
"""Kind of action → its reader."""


def observed(robot: DrivenRobot) -> dict[str, float]:
    """Return the current measured `POSITIONS` of both arms.

    Each quaternion has the sign that is closer to the arm's start.
    """
    values: list[float] = []
    for arm in PSM_NAMES:
        _, base = robot.frame(arm)
        pose: Pose = poses.compose(base, robot.measured(arm))
        turn = matrix_to_quaternion_flat(poses.rotation(pose))
        start = poses.compose(base, poses.flat(kinematics.start_in_base(arm.lower())))
        home = matrix_to_quaternion_flat(poses.rotation(start))
        sign = -1.0 if sum(a * b for a, b in zip(turn, home, strict=True)) < 0.0 else 1.0
        w, x, y, z = (sign * value for value in turn)
        jaw = robot.finger(arm) / robot.jaw_scale
        values += [*poses.position(pose), x, y, z, w, jaw]
    return dict(zip(POSITIONS, values, strict=True))


def _in_base(robot: DrivenRobot, arm: str, values: list[float]) -> list[float]:
    """Return increments in the view's axes, converted to an arm's base."""
    _, base = robot.frame(arm)
    turn = poses.rotation(poses.invert(base))
    a, b, c, d, e, f, jaw = values
    nowhere = (0.0, 0.0, 0.0)
    moved = poses.transform((*nowhere, *turn), (a, b, c))
    turned = poses.transform((*nowhere, *turn), (d, e, f))
    return [*moved, *turned, jaw]


def _shortened(robot: DrivenRobot, arm: str, values: list[float]) -> list[float]:
    """Return increments in the view's axes that are within [-1, 1] in an arm's base.

    Translation and rotation are each shortened as a whole, so that their directions stay.
    """
    turned = _in_base(robot, arm, values)
    shares = [1.0 / max(1.0, *map(abs, part)) for part in (turned[:3], turned[3:6])]
    moved = [shares[0] * value for value in values[:3]]
    return [*moved, *(shares[1] * value for value in values[3:6]), values[6]]
