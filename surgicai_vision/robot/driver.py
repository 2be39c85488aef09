"""Driver: lets a policy drive a dVRK, simulated or real, through its topics alone.

    robot = DrivenRobot(client, views, task, size)
    driver = Driver(agent, robot, task, config, dead_man, log, tell)
    driver.episode(seed, max_steps)

At each control step the agent gets measured poses, jaws and images (`robot.driven`).
`robot.setpoints` turns its action into set points and decides whether they are sent. In real time,
the beginning of a control step is pulled towards the moment just after images arrive
(`drawn_to_images`). The only motion that the policy does not command is that of PSM2 when it lets
go at the beginning of the pull-out.
"""

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TextIO, final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.envs import poses
from surgicai_vision.envs.control import StepSize
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.robot.driven import Command, DrivenRobot
from surgicai_vision.robot.frames import WORLD
from surgicai_vision.robot.guards import GuardConfig
from surgicai_vision.robot.operating_state import DISABLED, FAULT
from surgicai_vision.robot.setpoints import Setpoints

CONTROL_S = 1.0 / names.FPS
AFTER_IMAGE_S = 0.002
"""Time from an image's arrival to the control step that sees it, once they are aligned [s]."""
DRAWN_S = 0.002
"""Most by which a control step begins earlier or later, to come just after images [s]."""
STOPS = (DISABLED, FAULT)
"""States that end a run: the robot was stopped, and a person has to start it again."""

TELL_AGAIN_S = 1.0
"""Time until the same reason for holding back is reported again [s]; the log has every step."""
_WITHOUT_NUMBERS = str.maketrans("", "", "0123456789.")


@dataclass(frozen=True)
class DriveConfig:
    """How a robot is driven.

    Attributes:
        guards: the robot's limits.
        sends: send what the policy commands; else only say what would be sent.
        is_simulated: the robot is a served simulation, which is reset and judges.
        is_stepped: we set the simulation's clock.
    """

    guards: GuardConfig
    sends: bool = False
    is_simulated: bool = False
    is_stepped: bool = False

    def __post_init__(self) -> None:
        if not self.is_simulated and self.guards.frame == WORLD:
            raise InputError(
                "guards: say where this robot's tips may be: frame (ECM_view or base), low and "
                "high; the default box is that of the simulation."
            )
        if self.is_stepped and not self.is_simulated:
            raise InputError("only a served simulation has a clock that can be stepped.")


@dataclass(frozen=True)
class DrivenEpisode:
    """The outcome of an episode.

    Attributes:
        seed: seed of a served simulation's start.
        steps: control steps in which something was sent or would have been.
        held: control steps in which the guards held everything back.
        success: as a served simulation judges it; None at a robot.
        progress: subtasks solved, likewise.
        ended: why it ended.
        latencies: time from the newest pose to sending, for each step [s].
        image_latencies: time from the newest image to sending, likewise; empty without images.
    """

    seed: int
    steps: int
    held: int
    success: bool | None
    progress: int | None
    ended: str
    latencies: tuple[float, ...]
    image_latencies: tuple[float, ...]


@dataclass(frozen=True)
class _Step:
    """What is decided in one control step.

    Attributes:
        problem: why nothing may be sent, or "".
        seen: measured poses and jaws of both arms, as `DrivenRobot.both_arms`; empty before the
            agent is asked.
        action: the agent's action, (7,); None if it was not asked or its input cannot be used.
        commands: arm → what the action commands.
        latency: age of the newest pose after the decision [s]; None if the agent was not asked.
        image_latency: age of the newest image, likewise; None also without images.
    """

    problem: str
    seen: Sequence[float] = ()
    action: NDArray[np.float32] | None = None
    commands: Mapping[str, Command] = field(default_factory=dict)
    latency: float | None = None
    image_latency: float | None = None


@final
class Driver:
    """Lets an agent drive a robot; see the module's docstring.

    Args:
        agent: what acts.
        robot: the robot.
        task: the agent's task, which gives the step size of its actions.
        config: how the robot is driven.
        dead_man: returns the time since the dead-man's switch was last held [s].
        log: gets one line of JSON per control step.
        tell: gets one line that says what would be sent, or why nothing is.

    Raises:
        InputError: the agent needs more than a robot can tell.
    """

    def __init__(
        self,
        agent: Agent,
        robot: DrivenRobot,
        task: TaskConfig,
        config: DriveConfig,
        dead_man: Callable[[], float],
        log: TextIO,
        tell: Callable[[str], None],
    ):
        check_drivable(agent, task)
        self._agent = agent
        self._robot = robot
        self._client = robot.client
        self._task = task
        self._config = config
        self._log = log
        self._tell = tell
        self._setpoints = Setpoints(
            robot,
            StepSize.of(task.step),
            config.guards,
            dead_man,
            sends=config.sends,
            is_stepped=config.is_stepped,
        )
        self._told = ""
        self._told_at: dict[str, float] = {}
        self._next_line = 0.0
        if config.is_simulated:
            robot.on_enter(self._client.enter if config.is_stepped else self._client.tell_subtask)

    def episode(self, seed: int, max_steps: int) -> DrivenEpisode:
        """Drive until the judge sees success, the robot is stopped, or the time is over.

        Args:
            seed: seed of a served simulation's start, and of the agent's random numbers.
            max_steps: maximum number of control steps.
        """
        robot = self._robot
        if self._config.is_simulated:
            self._client.reset(seed)
            self._check_judge()
        robot.begin()
        self._setpoints.forget()
        self._agent.reset(0, robot, seed)
        steps = held = 0
        latencies: list[float] = []
        image_latencies: list[float] = []
        ended = "its time was up"
        due = time.monotonic()
        for number in range(max_steps):
            self._client.update()
            image_age = self._setpoints.youngest_image()
            begun = time.monotonic()
            now = number * CONTROL_S if self._config.is_stepped else begun
            step = self._decide(now)
            self._setpoints.send({} if step.problem else step.commands, now)
            steps += not step.problem
            held += bool(step.problem)
            latencies += [] if step.latency is None else [step.latency]
            image_latencies += [] if step.image_latency is None else [step.image_latency]
            self._write(seed, number, step)
            self._say(step)
            stop = self._stop(step.action)
            if stop:
                ended = stop
                break
            if not self._config.is_stepped:
                due = max(due + CONTROL_S, time.monotonic() - CONTROL_S)
                if image_age is not None and math.isfinite(image_age):
                    due += drawn_to_images(due - (begun - image_age))
                self._sleep_until(due)
        judged = self._client.judgement()
        progress = judged.get("progress")
        return DrivenEpisode(
            seed,
            steps,
            held,
            bool(judged.get("is_success")) if judged else None,
            progress if isinstance(progress, int) else None,
            ended,
            tuple(latencies),
            tuple(image_latencies),
        )

    def _check_judge(self) -> None:
        """Refuse a served simulation of another task, or one that advances in a different way."""
        judged = self._client.judgement()
        task = judged.get("task", self._task.task)
        if task != self._task.task:
            raise InputError(
                f"the simulation is served with --task {task}; this policy needs "
                f"--task {self._task.task}."
            )
        served = judged.get("advance")
        if self._task.task == names.SUTURE and served != self._task.advance:
            raise InputError(
                f"the simulation is served with --advance {served}; this policy needs "
                f"--advance {self._task.advance}."
            )

    # -- what is done ------------------------------------------------------------------------------

    def _decide(self, now: float) -> _Step:
        """Let the agent act at `now` [s], and the guards judge; nothing is sent yet."""
        problem = self._setpoints.problem_of_inputs()
        if problem:
            return _Step(problem)
        robot = self._robot
        seen: list[float] = []
        action: NDArray[np.float32] | None = None
        commands: Mapping[str, Command] = {}
        try:
            seen = robot.both_arms().tolist()
            action = self._agent.act([0], [robot], [robot.observation()])[0]
            commands, problem = self._setpoints.of_action(action, now)
        except InputError as error:  # the input cannot be used
            problem = str(error)
        return _Step(
            problem,
            seen,
            action,
            commands,
            self._setpoints.youngest(),
            self._setpoints.youngest_image(),
        )

    def _stop(self, action: NDArray[np.float32] | None) -> str:
        """Return why the episode is over, or ""."""
        if action is not None and not np.isfinite(action).all():
            return "the policy's action is not finite"
        judged = self._client.judgement()
        if judged.get("physics_error"):  # it also stops the arms
            return "the physics diverged"
        for arm in names.ARMS:
            state, _ = self._robot.operating(arm.upper())
            if state in STOPS:
                return f"{arm.upper()} is {state}: the robot was stopped"
        return "the judge reports success" if judged.get("is_success") else ""

    def _sleep_until(self, due: float) -> None:
        """Take messages until the next control step is due."""
        while (left := due - time.monotonic()) > 0.0:
            self._client.wait(left)
            self._client.update()

    # -- what is told ------------------------------------------------------------------------------

    def _write(self, seed: int, number: int, step: _Step) -> None:
        """Write one line of the log: what was measured, commanded, sent, or held back and why."""
        action = step.action
        latency = None if action is None else step.latency
        line = {
            "time": time.time(),
            "episode": seed,
            "step": number,
            "phase": self._robot.phase,
            "both_arms": step.seen,
            "action": None if action is None else np.asarray(action, np.float64).tolist(),
            "commands": {
                arm: {"pose": list(command.pose), "jaw": command.jaw}
                for arm, command in step.commands.items()
            },
            "sent": self._config.sends and not step.problem,
            "held": step.problem,
            "latency_ms": None if latency is None else round(1e3 * latency, 3),
        }
        self._log.write(json.dumps(line) + "\n")

    def _say(self, step: _Step) -> None:
        """Say why nothing is sent when the reason changes, and in a dry run what would be sent."""
        problem = step.problem
        kind = problem.translate(_WITHOUT_NUMBERS)
        now = time.monotonic()
        if kind != self._told:
            self._told = kind
            if now >= self._told_at.get(kind, -math.inf) + TELL_AGAIN_S:
                self._told_at[kind] = now
                self._tell(f"held: {problem}" if problem else "the guards let commands through")
        if self._config.sends or problem or time.monotonic() < self._next_line:
            return
        self._next_line = time.monotonic() + 1.0
        for arm, command in step.commands.items():
            x, y, z = (1e3 * value for value in poses.position(command.pose))
            self._tell(
                f"dry run, {self._robot.subtask}: {arm} would be sent to ({x:.1f}, {y:.1f}, "
                f"{z:.1f}) mm in its base, jaw "
                f"{math.degrees(command.jaw / self._robot.jaw_scale):.0f}°"
            )


def drawn_to_images(after: float) -> float:
    """Return by how much a control step should begin earlier or later [s].

    A policy that looks just after images arrive acts a step sooner than one that looks just before.

    Args:
        after: time from some image's arrival to the beginning of the step [s].
    """
    ahead = (after - AFTER_IMAGE_S + CONTROL_S / 2) % CONTROL_S - CONTROL_S / 2
    return min(max(-ahead, -DRAWN_S), DRAWN_S)


def check_drivable(agent: Agent, task: TaskConfig) -> None:
    """Refuse an agent that needs more than a robot can tell.

    Raises:
        InputError: the agent reads a simulation's state or depth, or its env repeats actions.
    """
    if agent.privileged:
        raise InputError(
            f"{agent.name} reads the state of a simulation, which no robot has; give a policy "
            "that uses images and measured poses, with learned ends."
        )
    if agent.depth:
        raise InputError(f"{agent.name} sees depth, which no topic here has.")
    if task.action_repeat != 1 or task.hold_jaw:
        raise InputError("a policy trained with action_repeat or hold_jaw cannot be driven yet.")
    if task.task not in (*names.SUBTASKS, names.SUTURE):
        raise InputError(f"the task {task.task} is not for a dVRK's two arms.")
