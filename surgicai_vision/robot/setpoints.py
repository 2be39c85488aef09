"""Set points: turns an action into set points, lets the guards check them, and sends them.

    problem = setpoints.problem_of_inputs()
    commands, problem = setpoints.of_action(action, now)
    setpoints.send({} if problem else commands, now)

An action is added to the set point that the robot itself publishes, as the envs add it to theirs.
While the robot still publishes an earlier set point, because the last ones sent have not been
obeyed or reported yet, the action is added to the last one, so that nothing is lost on the way. The
result is sent as `servo_cp` and `jaw/servo_jp`, in the frame of the robot's own `setpoint_cp`: a
dVRK reads no other, whatever a header says.

When the pull-out begins, PSM2 lets go as in the envs: the jaw opens, then the tool is drawn back
along its axis.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.envs import poses
from surgicai_vision.envs.control import JAW_OPEN, StepSize, moved, moved_towards
from surgicai_vision.envs.simulation import RELEASE_JAW, RELEASE_SHIFT
from surgicai_vision.robot.arm import JAW_NAME
from surgicai_vision.robot.driven import RELEASED, Command, DrivenRobot
from surgicai_vision.robot.frames import write_pose
from surgicai_vision.robot.guards import (
    GuardConfig,
    Input,
    Planned,
    TargetGuard,
    problem_of_dead_man,
    problem_of_inputs,
)
from surgicai_vision.robot.messages import Header, JointState

RELEASE_OPEN = 0.5
"""Finger's angle to which PSM2 opens when it lets go [rad] (`Simulation._let_go`)."""
SAME_M = 0.002
"""Distance within which a set point that was sent still counts as the one obeyed [m]."""
PENDING_S = 0.1
"""Time within which a set point that was sent must be published; else it was refused [s]."""
EQUAL_M = 1e-5
EQUAL_RAD = 1e-3
"""Differences within which a published set point counts as one that was sent [m] [rad]."""


@dataclass(frozen=True)
class _Sent:
    """A set point that was sent.

    Attributes:
        time: when it was sent [s].
        heard: the set point that the robot published then.
        command: what was sent.
    """

    time: float
    heard: Command
    command: Command


@final
class Setpoints:
    """Makes, guards and sends set points; see the module's docstring.

    Args:
        robot: the robot.
        step: the step size of actions.
        guards: the limits.
        dead_man: returns the time since the dead-man's switch was last held [s].
        sends: send what the guards let through; else send nothing.
        is_stepped: we set the simulation's clock; sending lets it take one control step.
    """

    def __init__(
        self,
        robot: DrivenRobot,
        step: StepSize,
        guards: GuardConfig,
        dead_man: Callable[[], float],
        *,
        sends: bool,
        is_stepped: bool,
    ):
        self._robot = robot
        self._client = robot.client
        self._step_size = step
        self._limits = guards
        self._guard = TargetGuard(guards, step)
        self._dead_man = dead_man
        self._sends = sends
        self._is_stepped = is_stepped
        self._sent: dict[str, deque[_Sent]] = {}

    def forget(self) -> None:
        """Forget what was sent: an episode begins."""
        self._guard.forget()
        self._sent.clear()

    def problem_of_inputs(self, arms: Iterable[str] | None = None) -> str:
        """Return why nothing may be sent now, or "".

        Args:
            arms: arms to be moved; None: the active one, and one that is letting go.
        """
        limits = self._limits
        states, images = self._robot.input_topics()
        inputs = [Input(topic, self._age(topic), limits.max_age) for topic in states]
        inputs += [Input(topic, self._age(topic), limits.max_image_age) for topic in images]
        moved_arms = self._robot.arms if arms is None else arms
        operating = {arm: self._robot.operating(arm) for arm in moved_arms}
        return problem_of_dead_man(self._dead_man()) or problem_of_inputs(inputs, operating)

    def _age(self, topic: str) -> float:
        """Return a message's age [s]; if we set the clock, all are of the last step."""
        age = self._client.age(topic)
        return 0.0 if self._is_stepped and math.isfinite(age) else age

    def youngest(self) -> float:
        """Return how long ago the newest pose came [s]."""
        states, _ = self._robot.input_topics()
        return min(self._client.age(topic) for topic in states)

    def youngest_image(self) -> float | None:
        """Return how long ago the newest image came [s], None if the policy sees none."""
        _, images = self._robot.input_topics()
        return min((self._client.age(topic) for topic in images), default=None)

    def of_action(
        self, action: NDArray[np.float32], now: float
    ) -> tuple[Mapping[str, Command], str]:
        """Return what would be sent at `now` [s] for an action, and why it may not be, or "".

        Args:
            action: (7,) increments of the active arm, in [-1, 1].
            now: time of the control step [s].
        """
        robot = self._robot
        return self.of_moves({robot.active: np.asarray(action, np.float64).tolist()}, now)

    def of_moves(
        self, moves: Mapping[str, Sequence[float]], now: float
    ) -> tuple[Mapping[str, Command], str]:
        """Return what would be sent at `now` [s] for increments of several arms, as `of_action`.

        Args:
            moves: arm → seven increments in [-1, 1].
            now: time of the control step [s].
        """
        robot = self._robot
        commands: dict[str, Command] = {}
        for arm, values in moves.items():
            if len(values) != 7 or not all(map(math.isfinite, values)):
                return {}, "the policy's action is not seven finite numbers"
            clipped = [min(max(value, -1.0), 1.0) for value in values]
            commands[arm] = self._moved(self._present(arm, now), clipped)
        if robot.release_steps:
            commands[RELEASED] = self._released(now)
        return self.guarded(commands, now)

    def of_targets(
        self, targets: Mapping[str, Command], now: float
    ) -> tuple[Mapping[str, Command], str]:
        """Return what would be sent at `now` [s] on the way to set points, as `of_action`.

        A set point further away than one step is approached by one step per call.

        Args:
            targets: arm → the set point to reach.
            now: time of the control step [s].
        """
        commands: dict[str, Command] = {}
        for arm, target in targets.items():
            if not all(map(math.isfinite, (*target.pose, target.jaw))):
                return {}, "the policy's set points are not finite"
            told = self._present(arm, now)
            pose = moved_towards(told.pose, target.pose, self._step_size)
            jaw = min(max(target.jaw, 0.0), JAW_OPEN)
            limit = self._step_size.jaw
            jaw = min(max(jaw, told.jaw - limit), told.jaw + limit)
            commands[arm] = Command(pose, jaw)
        return self.guarded(commands, now)

    def guarded(
        self, commands: Mapping[str, Command], now: float
    ) -> tuple[Mapping[str, Command], str]:
        """Return which set points would be sent at `now` [s], and why they may not be, or "".

        The dead-man's switch counts as it is now: whoever decided on the commands took some time.
        """
        problem = problem_of_dead_man(self._dead_man())
        if problem:
            return commands, problem
        robot = self._robot
        planned = {}
        for arm, command in commands.items():
            base = robot.base_in(arm, self._limits.frame)
            told = self._present(arm, now)
            plan = Planned(arm, told.pose, robot.measured(arm), command.pose, base)
            if self._guard.is_outside(plan):  # as in an env: the jaw moves, the tip does not
                command = Command(told.pose, command.jaw)
                plan = Planned(arm, told.pose, robot.measured(arm), command.pose, base)
            problem = self._guard.problem_of_target(plan, now)
            if problem:
                return commands, problem
            planned[arm] = (command, plan)
        for _, plan in planned.values():
            self._guard.remember(plan, now)
        return {arm: command for arm, (command, _) in planned.items()}, ""

    def _moved(self, told: Command, values: list[float]) -> Command:
        jaw = min(max(told.jaw + values[6] * self._step_size.jaw, 0.0), JAW_OPEN)
        return Command(moved(told.pose, values, self._step_size), jaw)

    def _released(self, now: float) -> Command:
        """Return PSM2's next set point while it lets go (`Simulation._let_go`)."""
        told = self._present(RELEASED, now)
        jaw = min(told.jaw + RELEASE_JAW, RELEASE_OPEN)
        if jaw < RELEASE_OPEN:
            return Command(told.pose, jaw)
        return Command(poses.shifted_along_z(told.pose, -RELEASE_SHIFT), jaw)

    def _present(self, arm: str, now: float) -> Command:
        """Return an arm's set point at `now` [s]: as published, or as sent while that is pending.

        The published one is drawn back towards the measured pose. The active arm continues from
        there; another arm continues from what was last sent, as long as that is near.
        """
        told = self._robot.told(arm)
        sent = self._sent.get(arm)
        if not sent:
            return told
        last = sent[-1].command
        if arm != self._robot.active:
            return last if poses.distance(last.pose, told.pose) < SAME_M else told
        waiting = [entry for entry in sent if entry.time >= now - PENDING_S]
        if not waiting or _is_same(told, last):
            return told
        before = [waiting[0].heard, *(entry.command for entry in waiting[:-1])]
        return last if any(_is_same(told, entry) for entry in before) else told

    def send(self, commands: Mapping[str, Command], now: float) -> None:
        """Send commands at `now` [s], and take a control step if we set the clock."""
        stamp = self._client.stamp()
        sent = []
        if self._sends:
            for arm, command in commands.items():
                frame, base = self._robot.frame(arm)
                tip = poses.compose(command.pose, self._robot.tip)
                pose = write_pose(poses.compose(base, tip), stamp, frame)
                jaw = JointState(Header(stamp), (JAW_NAME,), (command.jaw / self._robot.jaw_scale,))
                for topic, message in (
                    (f"/{arm}/servo_cp", pose),
                    (f"/{arm}/jaw/servo_jp", jaw),
                ):
                    self._client.send(topic, message)
                    sent.append(topic)
                waiting = self._sent.setdefault(arm, deque())
                waiting.append(_Sent(now, self._robot.told(arm), command))
                while waiting[0].time < now - PENDING_S:
                    waiting.popleft()
        if self._robot.release_steps and commands:
            self._robot.release_steps -= 1
        if self._is_stepped:
            self._client.step(sent, stamp)


def _is_same(one: Command, other: Command) -> bool:
    """Return True if two set points differ only by rounding."""
    return (
        poses.distance(one.pose, other.pose) < EQUAL_M
        and poses.angle(one.pose, other.pose) < EQUAL_RAD
        and abs(one.jaw - other.jaw) < EQUAL_RAD
    )
