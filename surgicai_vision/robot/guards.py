"""Guards: what keeps a driven robot from harm, whatever a policy outputs.

Before every control step `problem_of_inputs` checks that all inputs of the policy are there and
fresh, and that the arms may be moved. `problem_of_target` checks that a set point to be sent is
near enough to the present one and the measured pose, and not too fast. `problem_of_dead_man` checks
the dead-man's switch before the policy acts, and again before its set points are sent. If any of
them finds a problem, nothing is sent: a dVRK then stays at its last set point. `is_outside` says
whether a tip would leave the workspace. The guards cannot be switched off; limits are numbers in a
file.
"""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import final

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.envs import poses
from surgicai_vision.envs.control import WORKSPACE, StepSize
from surgicai_vision.envs.simulation import RELEASE_SHIFT
from surgicai_vision.robot.frames import VIEW, WORLD
from surgicai_vision.robot.operating_state import ENABLED
from surgicai_vision.scene.kinematics import Pose

BASE = "base"
FRAMES = (WORLD, VIEW, BASE)
ROOM = 1.01
"""Factor by which a set point may exceed the largest step of the policy's preset: rounding."""
SPEED_WINDOW_S = 0.5
"""Time over which the speed of set points is measured [s]."""
DEAD_MAN_S = 0.5
"""Time for which one message or key press of a dead-man's switch counts [s]."""


@dataclass(frozen=True)
class GuardConfig:
    """The limits of a driven robot.

    Attributes:
        frame: whose axes the workspace is given in: "world" (the simulation's), "ECM_view", or
            "base", each arm's own.
        low, high: corners of the box that contains all set points of the tips [m].
        max_speed: largest speed of a tip's set point [m/s].
        max_lead: largest distance of a set point from the measured tip [m].
        max_lead_angle: largest angle between them [rad].
        max_age: largest age of poses and jaws, measured and set points [s].
        max_image_age: largest age of images [s].
    """

    frame: str = WORLD
    low: tuple[float, float, float] = WORKSPACE[0]
    high: tuple[float, float, float] = WORKSPACE[1]
    max_speed: float = 0.15
    max_lead: float = 0.02
    max_lead_angle: float = math.radians(45.0)
    max_age: float = 0.1
    max_image_age: float = 0.1

    def __post_init__(self) -> None:
        check_name("frame of the workspace", self.frame, FRAMES)
        if not all(0.0 < b - a < 1.0 for a, b in zip(self.low, self.high, strict=True)):
            raise InputError(
                f"guards: the box from {self.low} to {self.high} must be above 0 and below 1 m "
                "along each axis."
            )
        for name, value, limit in (
            ("max_speed", self.max_speed, 0.5),
            ("max_lead", self.max_lead, 0.05),
            ("max_lead_angle", self.max_lead_angle, math.pi),
            ("max_age", self.max_age, 0.5),
            ("max_image_age", self.max_image_age, 2.0),
        ):
            if not 0.0 < value <= limit:
                raise InputError(f"guards: {name} is {value:g}; allowed: above 0 to {limit:.3g}.")


@dataclass(frozen=True)
class Input:
    """An input of a policy: its name, how old it is, and how old it may be [s]."""

    name: str
    age: float
    limit: float


@dataclass(frozen=True)
class Planned:
    """A set point that would be sent to an arm.

    Attributes:
        arm: "PSM1" or "PSM2".
        told: its present set point, T_base_tip.
        measured: where it is, T_base_tip.
        target: the set point that would be sent, T_base_tip.
        base: T_frame_base, the base in the workspace's frame.
    """

    arm: str
    told: Pose
    measured: Pose
    target: Pose
    base: Pose


def problem_of_dead_man(age: float) -> str:
    """Return that the dead-man's switch is not held, or "".

    Args:
        age: time since the switch was last seen held [s].
    """
    return "the dead-man's switch is not held" if age > DEAD_MAN_S else ""


def problem_of_inputs(inputs: Iterable[Input], states: dict[str, tuple[str, bool]]) -> str:
    """Return why nothing may be sent now, or "".

    Args:
        inputs: the policy's inputs.
        states: arm → its operating state and whether it is homed; "" if none has arrived.
    """
    for arm, (state, is_homed) in states.items():
        if state != ENABLED:
            return f"{arm} is {state or 'silent about its operating state'}"
        if not is_homed:
            return f"{arm} is not homed"
    for entry in inputs:
        if entry.age > entry.limit:
            age = "has never arrived" if math.isinf(entry.age) else f"is {entry.age:.2f} s old"
            return f"{entry.name} {age}"
    return ""


@final
class TargetGuard:
    """Judges set points before they are sent.

    Args:
        config: the limits.
        step: the policy's step size, which no set point may exceed.
    """

    def __init__(self, config: GuardConfig, step: StepSize):
        self._config = config
        self._max_shift = ROOM * max(math.sqrt(3.0) * step.translation, RELEASE_SHIFT)
        self._max_turn = ROOM * math.sqrt(3.0) * step.rotation
        self._sent: dict[str, deque[tuple[float, Pose]]] = {}

    def is_outside(self, planned: Planned) -> bool:
        """Return True if a set point would take the tip out of the workspace."""
        tip = poses.transform(planned.base, poses.position(planned.target))
        sides = zip(self._config.low, tip, self._config.high, strict=True)
        return not all(low <= value <= high for low, value, high in sides)

    def problem_of_target(self, planned: Planned, now: float) -> str:
        """Return why a set point may not be sent at the time `now` [s], or ""."""
        arm = planned.arm
        if not all(map(math.isfinite, planned.target)):
            return f"{arm} would be sent numbers that are not finite"
        shift = poses.distance(planned.told, planned.target)
        turn = poses.angle(planned.told, planned.target)
        if shift > self._max_shift or turn > self._max_turn:
            return (
                f"{arm} would be sent a step of {1e3 * shift:.1f} mm, {math.degrees(turn):.1f}°; "
                f"allowed: {1e3 * self._max_shift:.1f} mm, {math.degrees(self._max_turn):.1f}°"
            )
        lead = poses.distance(planned.measured, planned.target)
        angle = poses.angle(planned.measured, planned.target)
        if lead > self._config.max_lead or angle > self._config.max_lead_angle:
            return (
                f"{arm} does not follow: it would be sent {1e3 * lead:.1f} mm, "
                f"{math.degrees(angle):.0f}° away from its measured pose"
            )
        speed = self._speed(planned, now)
        if speed > self._config.max_speed:
            return f"{arm} would be commanded to move at {1e3 * speed:.0f} mm/s"
        return ""

    def remember(self, planned: Planned, now: float) -> None:
        """Remember what was sent at the time `now` [s]."""
        sent = self._sent.setdefault(planned.arm, deque())
        sent.append((now, planned.target))
        while sent[0][0] < now - SPEED_WINDOW_S:
            sent.popleft()

    def forget(self) -> None:
        """Forget what was sent: an episode begins."""
        self._sent.clear()

    def _speed(self, planned: Planned, now: float) -> float:
        """Return the length of the set points' path in the window, divided by the window [m/s].

        A single step has its own limit; here it counts as no faster after a pause.
        """
        way = 0.0
        last = planned.target
        for sent, pose in reversed(self._sent.get(planned.arm, ())):
            if sent < now - SPEED_WINDOW_S:
                break
            way += poses.distance(pose, last)
            last = pose
        return way / max(SPEED_WINDOW_S, 1.0 / names.FPS)
