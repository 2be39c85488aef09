"""Driver: a policy at a dVRK, simulated or real, through its topics alone.

    robot = DrivenRobot(client, views, task)
    driver = Driver(agent, robot, config, log)
    driver.episode(seed, max_steps)

Each control step the agent is given measured poses, jaws and images; its action is added to the
set point that the robot itself publishes, as the envs add it to theirs, and sent as `servo_cp` and
`jaw/servo_jp`, if the guards (`robot.guards`) find nothing against it. A set point is sent in the
frame of the robot's own `setpoint_cp`: a dVRK reads no other, whatever a header says.

Where the high-level policy begins the pull-out, PSM2 lets go, as the envs make it: the jaw opens,
then the tool is drawn back along its axis. Nothing else is done that the policy has not said.
"""

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TextIO, cast, final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.envs import observation, poses
from surgicai_vision.envs.control import JAW_OPEN, StepSize, moved
from surgicai_vision.envs.simulation import RELEASE_JAW, RELEASE_SHIFT, RELEASE_STEPS
from surgicai_vision.envs.suture import PULLOUT_PHASE
from surgicai_vision.evaluation.agent import Agent, Observation
from surgicai_vision.robot import topics
from surgicai_vision.robot.arm import FINGER_SHARE, JAW_NAME
from surgicai_vision.robot.client import Client
from surgicai_vision.robot.frames import T_WORLD_VIEW, VIEW, WORLD, read_pose, write_pose
from surgicai_vision.robot.guards import (
    BASE,
    GuardConfig,
    Input,
    Planned,
    TargetGuard,
    problem_of_inputs,
)
from surgicai_vision.robot.messages import (
    CompressedImage,
    Header,
    Image,
    JointState,
    OperatingState,
    PoseStamped,
    StringStamped,
)
from surgicai_vision.robot.operating_state import DISABLED, FAULT
from surgicai_vision.scene.kinematics import Pose

RELEASED = names.PSM2.upper()
"""The arm that lets go when the pull-out, which is the other one's, begins."""
RELEASE_OPEN = 0.5
"""Finger's angle to which PSM2 opens when it lets go [rad] (`Simulation._let_go`)."""
SAME_M = 0.002
"""Distance within which a set point that was sent still is the one that is obeyed [m]."""
CONTROL_S = 1.0 / names.FPS
STOPS = (DISABLED, FAULT)
"""States after which a run is over: somebody stopped the robot, and a person begins again."""


@dataclass(frozen=True)
class Command:
    """What is sent to an arm: T_base_tip and one finger's angle [rad]."""

    pose: Pose
    jaw: float


@final
class DrivenRobot:
    """What an agent may ask of a dVRK (`evaluation.agent.Robot`), from its topics.

    Args:
        client: hears and sends.
        views: views of the agent.
        task: its task; the active arm follows.
        size: height and width the agent sees [pixel].
    """

    def __init__(self, client: Client, views: tuple[str, ...], task: str, size: int):
        self.client = client
        self.views = views
        self._size = size
        is_whole = task == names.SUTURE
        self.phase = 0 if is_whole else names.SUBTASKS.index(task)
        self._first = self.phase
        self._entered: Callable[[str], object] | None = None
        self.release_steps = 0

    def on_enter(self, tell: Callable[[str], object]) -> None:
        """Tell somebody which subtask is entered: the judge of a served simulation."""
        self._entered = tell

    def begin(self) -> None:
        """Go back to the first subtask: an episode begins."""
        self.phase = self._first
        self.release_steps = 0

    @property
    def subtask(self) -> str:
        """Return the present subtask's name."""
        return names.SUBTASKS[self.phase]

    @property
    def active(self) -> str:
        """Return the active arm's name on the topics."""
        return names.ACTIVE_ARM[self.subtask].upper()

    @property
    def arms(self) -> tuple[str, ...]:
        """Return the arms that may be moved now."""
        return (self.active, RELEASED) if self.release_steps else (self.active,)

    # -- evaluation.agent.Robot --------------------------------------------------------------------

    def agent_pos(self) -> NDArray[np.float32]:
        """Return the active arm's measured tip in its base, (7,), in m and rad."""
        return np.array(self._seven(self.active), np.float32)

    def both_arms(self) -> NDArray[np.float32]:
        """Return both arms' `agent_pos`, psm1 first, (14,)."""
        return np.array([self._seven(arm.upper()) for arm in names.ARMS], np.float32).ravel()

    def enter(self, phase: int) -> None:
        """Make a subtask the present one: its arm is active now."""
        if not 0 <= phase < len(names.SUBTASKS):
            raise InputError(f"There is no subtask {phase}; allowed: 0 to 4.")
        if phase == self.phase:
            return
        self.phase = phase
        self.release_steps = RELEASE_STEPS if phase == PULLOUT_PHASE else 0
        if self._entered is not None:
            self._entered(self.subtask)

    # -- what the guards and the driver read -------------------------------------------------------

    def measured(self, arm: str) -> Pose:
        """Return the measured T_base_tip of an arm."""
        return read_pose(self._pose(f"/{arm}/local/measured_cp"))

    def told(self, arm: str) -> Command:
        """Return an arm's set points as the robot publishes them."""
        pose = read_pose(self._pose(f"/{arm}/local/setpoint_cp"))
        return Command(pose, self._angle(f"/{arm}/jaw/setpoint_js"))

    def frame(self, arm: str) -> tuple[str, Pose]:
        """Return the frame of an arm's `setpoint_cp` and the base in it, T_frame_base.

        It follows from the same set point in the base and in the frame.
        """
        outer = self._pose(f"/{arm}/setpoint_cp")
        inner = read_pose(self._pose(f"/{arm}/local/setpoint_cp"))
        return outer.header.frame, poses.compose(read_pose(outer), poses.invert(inner))

    def base_in(self, arm: str, frame: str) -> Pose:
        """Return the base in a workspace's frame, T_frame_base.

        Raises:
            InputError: the robot's own frame is another one.
        """
        if frame == BASE:
            return poses.IDENTITY
        own, base = self.frame(arm)
        if own == frame:
            return base
        if (own, frame) == (VIEW, WORLD):  # the simulation's world, where its endoscope stands
            return poses.compose(T_WORLD_VIEW, base)
        raise InputError(f"{arm} speaks of '{own}'; the workspace's frame is '{frame}'.")

    def operating(self, arm: str) -> tuple[str, bool]:
        """Return an arm's operating state, "" before the first, and whether it is homed."""
        heard = self.client.newest(f"/{arm}/operating_state")
        if heard is None or not isinstance(heard.message, OperatingState):
            return "", False
        return heard.message.state, heard.message.is_homed

    def input_topics(self) -> tuple[list[str], list[str]]:
        """Return the topics of poses and jaws that are read, and those of images."""
        channels = (
            *("local/measured_cp", "local/setpoint_cp", "setpoint_cp"),
            *("jaw/measured_js", "jaw/setpoint_js"),
        )
        states = [f"/{arm.upper()}/{channel}" for arm in names.ARMS for channel in channels]
        return states, [self.client.image_topic(view) for view in self.views]

    def observation(self) -> Observation:
        """Return the images, view → (height, width, 3), and the active arm's pose."""
        if not self.views:
            return np.zeros(0, np.float32)
        seen: dict[str, NDArray[np.uint8]] = {view: self._image(view) for view in self.views}
        return {**seen, "agent_pos": self.agent_pos()}

    def _seven(self, arm: str) -> list[float]:
        finger = self._angle(f"/{arm}/jaw/measured_js")
        return observation.seven(arm.lower(), self.measured(arm), finger)

    def _pose(self, topic: str) -> PoseStamped:
        heard = self.client.newest(topic)
        assert heard is not None and isinstance(heard.message, PoseStamped), "the guards asked"
        return heard.message

    def _angle(self, topic: str) -> float:
        """Return one finger's angle [rad] of a jaw's joint state."""
        heard = self.client.newest(topic)
        assert heard is not None and isinstance(heard.message, JointState), "the guards asked"
        if len(heard.message.position) != 1 or not math.isfinite(heard.message.position[0]):
            raise InputError(f"{topic} says {heard.message.position}; a jaw has one finite angle.")
        return float(heard.message.position[0]) * FINGER_SHARE

    def _image(self, view: str) -> NDArray[np.uint8]:
        heard = self.client.newest(self.client.image_topic(view))
        assert heard is not None, "the guards asked"
        message = heard.message
        if isinstance(message, CompressedImage):
            frame = _decoded(message)
        else:
            assert isinstance(message, Image)
            shape = (message.height, message.width, 3)
            frame = np.frombuffer(message.data, np.uint8).reshape(shape)
        if frame.shape[:2] != (self._size, self._size):
            height, width = frame.shape[:2]
            raise InputError(
                f"the images of {view} are {height} × {width}; the policy sees "
                f"{self._size} × {self._size}."
            )
        return frame


@dataclass(frozen=True)
class DriveConfig:
    """How a robot is driven.

    Attributes:
        guards: its limits.
        sends: send what the policy says; else it is only told what would be sent.
        is_simulated: a served simulation, which is reset and judges.
        is_stepped: its clock is ours.
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
    """What became of an episode.

    Attributes:
        seed: of a served simulation's start.
        steps: control steps in which something was sent or would have been.
        held: control steps in which the guards held everything back.
        success: as a served simulation judges it; None at a robot.
        progress: subtasks solved, likewise.
        ended: why it ended.
        latencies: time from the newest input to sending, each step [s].
    """

    seed: int
    steps: int
    held: int
    success: bool | None
    progress: int | None
    ended: str
    latencies: tuple[float, ...]


@final
class Driver:
    """Lets an agent drive a robot; see the module's docstring.

    Args:
        agent: what acts.
        robot: the robot.
        task: the agent's task: the step size of its actions.
        config: how.
        dead_man: returns for how long the dead-man's switch was last held [s].
        log: gets one line of JSON a control step.
        tell: told, in one line, what would be sent or why nothing is.

    Raises:
        InputError: an agent that asks for more than a robot can say.
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
        self._dead_man = dead_man
        self._log = log
        self._tell = tell
        self._step_size = StepSize.of(task.step)
        self._guard = TargetGuard(config.guards, self._step_size)
        self._sent: dict[str, Command] = {}
        self._told = ""
        self._next_line = 0.0
        if config.is_simulated:
            robot.on_enter(self._client.enter if config.is_stepped else self._client.tell_subtask)

    def episode(self, seed: int, max_steps: int) -> DrivenEpisode:
        """Drive until the judge sees success, the robot is stopped, or the time is over.

        Args:
            seed: of a served simulation's start, and of the agent's chance.
            max_steps: control steps at most.
        """
        robot = self._robot
        if self._config.is_simulated:
            self._client.reset(seed)
            self._check_judge()
        robot.begin()
        self._guard.forget()
        self._sent.clear()
        self._agent.reset(0, robot, seed)
        steps = held = 0
        latencies: list[float] = []
        ended = "its time was over"
        due = time.monotonic()
        for number in range(max_steps):
            self._client.update()
            problem = self._problem()
            commands: Mapping[str, Command] = {}
            action: NDArray[np.float32] | None = None
            seen: list[float] = []
            if not problem:
                now = number * CONTROL_S if self._config.is_stepped else time.monotonic()
                try:
                    seen = robot.both_arms().tolist()
                    action = self._agent.act([0], [robot], [robot.observation()])[0]
                    commands, problem = self._planned(action, now)
                except InputError as error:  # what has come cannot be used
                    problem = str(error)
                latencies.append(self._youngest())
            self._send(commands if not problem else {})
            steps += not problem
            held += bool(problem)
            latency = latencies[-1] if action is not None else None
            self._write(seed, number, seen, action, commands, problem, latency)
            self._say(commands, problem)
            stop = self._stop(action)
            if stop:
                ended = stop
                break
            if not self._config.is_stepped:
                due = max(due + CONTROL_S, time.monotonic() - CONTROL_S)
                self._sleep_until(due)
        judged = self._judged()
        return DrivenEpisode(
            seed,
            steps,
            held,
            bool(judged["is_success"]) if judged else None,
            cast(int, judged["progress"]) if judged else None,
            ended,
            tuple(latencies),
        )

    def _check_judge(self) -> None:
        """Refuse a served simulation that goes on to the next subtask in another way."""
        served = self._judged().get("advance")
        if self._task.task == names.SUTURE and served != self._task.advance:
            raise InputError(
                f"the simulation is served with --advance {served}; this policy needs "
                f"--advance {self._task.advance}."
            )

    # -- what is asked before ----------------------------------------------------------------------

    def _problem(self) -> str:
        """Return why nothing may be sent now, or ""."""
        limits = self._config.guards
        states, images = self._robot.input_topics()
        inputs = [Input(topic, self._age(topic), limits.max_age) for topic in states]
        inputs += [Input(topic, self._age(topic), limits.max_image_age) for topic in images]
        operating = {arm: self._robot.operating(arm) for arm in self._robot.arms}
        return problem_of_inputs(inputs, operating, self._dead_man())

    def _age(self, topic: str) -> float:
        """Return a message's age [s]; where the clock is ours, all are of the last step."""
        age = self._client.age(topic)
        return 0.0 if self._config.is_stepped and math.isfinite(age) else age

    def _youngest(self) -> float:
        """Return how long ago the newest pose came [s]."""
        states, _ = self._robot.input_topics()
        return min(self._client.age(topic) for topic in states)

    def _planned(self, action: NDArray[np.float32], now: float) -> tuple[dict[str, Command], str]:
        """Return what would be sent to which arm at `now` [s], and why it may not be, or ""."""
        robot = self._robot
        values = np.asarray(action, np.float64).tolist()
        if len(values) != 7 or not all(map(math.isfinite, values)):
            return {}, "the policy's action is not seven finite numbers"
        values = [min(max(value, -1.0), 1.0) for value in values]
        commands = {robot.active: self._moved(robot.told(robot.active), values)}
        if robot.release_steps:
            commands[RELEASED] = self._released()
        planned = {}
        for arm, command in commands.items():
            base = robot.base_in(arm, self._config.guards.frame)
            told = self._present(arm)
            plan = Planned(arm, told.pose, robot.measured(arm), command.pose, base)
            if self._guard.is_outside(plan):  # as an env: the jaw moves, the tip does not
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

    def _released(self) -> Command:
        """Return PSM2's next set point while it lets go (`Simulation._let_go`)."""
        told = self._present(RELEASED)
        jaw = min(told.jaw + RELEASE_JAW, RELEASE_OPEN)
        if jaw < RELEASE_OPEN:
            return Command(told.pose, jaw)
        return Command(poses.shifted_along_z(told.pose, -RELEASE_SHIFT), jaw)

    def _present(self, arm: str) -> Command:
        """Return where an arm is told to be: as it was last sent, where that is still obeyed.

        What is published is drawn back towards what is measured; the active arm goes on from there.
        """
        told = self._robot.told(arm)
        sent = self._sent.get(arm)
        if arm == self._robot.active or sent is None:
            return told
        return sent if poses.distance(sent.pose, told.pose) < SAME_M else told

    # -- what is done ------------------------------------------------------------------------------

    def _send(self, commands: Mapping[str, Command]) -> None:
        """Send commands, and let a clock that is ours go on."""
        stamp = self._client.stamp()
        sent = []
        if self._config.sends:
            for arm, command in commands.items():
                frame, base = self._robot.frame(arm)
                pose = write_pose(poses.compose(base, command.pose), stamp, frame)
                jaw = JointState(Header(stamp), (JAW_NAME,), (command.jaw / FINGER_SHARE,))
                for topic, message in (
                    (f"/{arm}/servo_cp", pose),
                    (f"/{arm}/jaw/servo_jp", jaw),
                ):
                    self._client.send(topic, message)
                    sent.append(topic)
                self._sent[arm] = command
        if self._robot.release_steps and commands:
            self._robot.release_steps -= 1
        if self._config.is_stepped:
            self._client.step(sent, stamp)

    def _stop(self, action: NDArray[np.float32] | None) -> str:
        """Return why the episode is over, or ""."""
        if action is not None and not np.isfinite(action).all():
            return "the policy's action is not finite"
        for arm in names.ARMS:
            state, _ = self._robot.operating(arm.upper())
            if state in STOPS:
                return f"{arm.upper()} is {state}: the robot was stopped"
        judged = self._judged()
        if judged and judged["physics_error"]:
            return "the physics diverged"
        return "the judge sees success" if judged and judged["is_success"] else ""

    def _judged(self) -> Mapping[str, JSON]:
        """Return how a served simulation judges the episode; nothing at a robot."""
        heard = self._client.newest(topics.JUDGEMENT.name)
        if heard is None or not isinstance(heard.message, StringStamped):
            return {}
        judged: dict[str, JSON] = json.loads(heard.message.text)
        return judged

    def _sleep_until(self, due: float) -> None:
        """Take what comes until the next control step is due."""
        while (left := due - time.monotonic()) > 0.0:
            self._client.wait(left)
            self._client.update()

    # -- what is told ------------------------------------------------------------------------------

    def _write(
        self,
        seed: int,
        number: int,
        seen: list[float],
        action: NDArray[np.float32] | None,
        commands: Mapping[str, Command],
        problem: str,
        latency: float | None,
    ) -> None:
        """Write one line of the log: what was measured, said, sent, or held back and why."""
        line = {
            "time": time.time(),
            "episode": seed,
            "step": number,
            "phase": self._robot.phase,
            "both_arms": seen,
            "action": None if action is None else np.asarray(action, np.float64).tolist(),
            "commands": {
                arm: {"pose": list(command.pose), "jaw": command.jaw}
                for arm, command in commands.items()
            },
            "sent": self._config.sends and not problem,
            "held": problem,
            "latency_ms": None if latency is None else round(1e3 * latency, 3),
        }
        self._log.write(json.dumps(line) + "\n")

    def _say(self, commands: Mapping[str, Command], problem: str) -> None:
        """Tell why nothing is sent when that changes, and in a dry run what would be."""
        if problem != self._told:
            self._told = problem
            self._tell(f"held: {problem}" if problem else "the guards let through")
        if self._config.sends or problem or time.monotonic() < self._next_line:
            return
        self._next_line = time.monotonic() + 1.0
        for arm, command in commands.items():
            x, y, z = (1e3 * value for value in poses.position(command.pose))
            self._tell(
                f"dry run, {self._robot.subtask}: {arm} would be told ({x:.1f}, {y:.1f}, {z:.1f}) "
                f"mm in its base, jaw {math.degrees(command.jaw / FINGER_SHARE):.0f}°"
            )


def check_drivable(agent: Agent, task: TaskConfig) -> None:
    """Refuse an agent that asks for more than a robot can say.

    Raises:
        InputError: the agent reads a simulation's state or depth, or its env repeats actions.
    """
    if agent.privileged:
        raise InputError(
            f"{agent.name} reads the state of a simulation, which no robot has; give a policy fed "
            "with images and measured poses, with learned ends."
        )
    if agent.depth:
        raise InputError(f"{agent.name} sees depth, which no topic here has.")
    if task.action_repeat != 1 or task.hold_jaw:
        raise InputError("a policy trained with action_repeat or hold_jaw cannot be driven yet.")
    if task.task not in (*names.SUBTASKS, names.SUTURE):
        raise InputError(f"the task {task.task} is not of a dVRK's two arms.")


def _decoded(message: CompressedImage) -> NDArray[np.uint8]:
    """Return a compressed image as (height, width, 3)."""
    import cv2

    found = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
    if found is None:
        raise InputError(f"an image of format {message.format[:20]} cannot be read.")
    frame: NDArray[np.uint8] = np.ascontiguousarray(found[..., ::-1]).astype(np.uint8, copy=False)
    return frame
