"""Arm: what a CRTK command does to one arm, without ROS and without physics.

    arm.receive("servo_cp", message, source, now)   # validate and queue; InputError: refused
    target = arm.advance(time, state)               # every control step: obey, return the target

As in docs/ros_crtk_contract.md of dvrk_simulator_base: "Servo commands are superseding depth-one
setpoints. Move and state commands remain ordered in a bounded queue. Invalid commands and queue
overflow produce a warning without mutating backend state." A state command, which may be a stop,
takes the place of the oldest waiting motion when the queue is full.

Beyond the contract, since a wrong set point moves a robot: a motion command is refused if its stamp
is older than `MAX_AGE_S`, or older than that of a command already accepted since the last reset
(`forget`). If two clients move one arm within `CONTROL_S` of each other, it pauses until `resume`.
A message without a stamp is as old as its arrival.

An arm that may not move stays where it was measured; its jaw keeps its set point, so that what it
holds is not dropped.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol, final

from surgicai_vision.core.errors import InputError, UnreachablePose
from surgicai_vision.demos.imports.rosbag.config import CONVENTIONS
from surgicai_vision.envs.control import JAW_OPEN
from surgicai_vision.robot.frames import Frames
from surgicai_vision.robot.messages import JointState, Message, PoseStamped, StringStamped
from surgicai_vision.robot.operating_state import FAULT, PAUSED, OperatingStates
from surgicai_vision.robot.trajectory import Trajectory, is_within
from surgicai_vision.scene.kinematics import INSTRUMENTS, Joints, Pose, inverse_flat

QUEUE = 32
"""Most move and state commands that may wait (dvrk_simulator_base/command_mailbox.py)."""
MAX_AGE_S = 0.25
"""Age beyond which a motion command is late (share/arms/PSM.yaml: command_timeout_s)."""
CONTROL_S = 0.5
"""Time for which the client that last moved an arm keeps control of it [s]."""
MOVE_SPEEDS = (0.5, 0.5, 0.05, 1.75, 1.75, 1.75)
"""Highest speeds of `move_jp` and `move_cp` [rad/s, the third m/s].

Those of insertion and wrist are 1 mm and 2° per control step, within the envs' own step sizes. The
first two joints move the tip as fast as the insertion does when it is 100 mm below the remote
centre. A dVRK allows ten times as much (share/arms/PSM.yaml).
"""
JAW_SPEED = 2.5
"""Highest speed of `jaw/move_jp` [rad/s], 0.05 rad of the angle between the fingers per step."""
FINGER_SHARE = CONVENTIONS["dvrk"].jaw_scale
"""Ratio of one finger's angle to a dVRK's jaw angle, which is that between the fingers."""
JAW_LIMITS = (-0.349066, JAW_OPEN / FINGER_SHARE)
"""Accepted jaw angles [rad]. The lower limit is a dVRK's (share/arms/PSM.yaml), where commands
below 0 squeeze a closed jaw; ours squeezes by itself (`envs.control.SQUEEZE`), so they mean 0."""
JOINT_NAMES = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")
"""Joints of a PSM as share/arms/PSM.yaml names them."""
JAW_NAME = "jaw"
ENDOSCOPE_JOINTS = ("yaw", "pitch", "insertion", "roll")
"""Joints of an ECM (share/arms/ECM.yaml)."""

SERVO_JP = "servo_jp"
SERVO_CP = "servo_cp"
MOVE_JP = "move_jp"
MOVE_CP = "move_cp"
JAW_SERVO_JP = "jaw/servo_jp"
JAW_MOVE_JP = "jaw/move_jp"
STATE_COMMAND = "state_command"
MOTIONS = (SERVO_JP, SERVO_CP, MOVE_JP, MOVE_CP, JAW_SERVO_JP, JAW_MOVE_JP)
SERVOS = (SERVO_JP, SERVO_CP, JAW_SERVO_JP)


@dataclass(frozen=True)
class ArmState:
    """The measured state of a PSM, and its set points.

    Attributes:
        joints: measured joints [rad, m].
        velocity: their velocities [rad/s, m/s].
        jaw: measured angle between the fingers [rad].
        jaw_velocity: its velocity [rad/s].
        setpoint: set points of the joints [rad, m].
        jaw_setpoint: set point of the jaw angle [rad].
    """

    joints: Joints
    velocity: Joints
    jaw: float
    jaw_velocity: float
    setpoint: Joints
    jaw_setpoint: float


@dataclass(frozen=True)
class Target:
    """The set point of a PSM: six joints [rad, m] and the angle between the fingers [rad]."""

    joints: Joints
    jaw: float


@dataclass(frozen=True)
class Note:
    """A text for an arm's topic "info", "warning" or "error"."""

    level: str
    text: str


class Arm(Protocol):
    """What a server needs of any arm."""

    name: str
    operating: OperatingStates
    notes: list[Note]

    def receive(self, channel: str, message: Message, source: str, now: int) -> None:
        """Queue a command that arrived at `now` [ns]; InputError if it is refused."""

    @property
    def is_busy(self) -> bool:
        """Return True while a move is under way."""


@dataclass(frozen=True)
class _Command:
    """A queued command: its channel and what it requests."""

    channel: str
    payload: "Joints | Pose | float | str"


@final
class Psm:
    """A patient-side manipulator; see the module's docstring.

    Args:
        name: "PSM1" or "PSM2", the first part of its topics.
        base: T_world_base.
        instrument: its instrument, a key of `INSTRUMENTS`.
        max_age: age beyond which a motion command is late [s]; None: any age is accepted, since
            the client sets the clock.

    Attributes:
        operating: its operating state.
        frames: the frames of its Cartesian messages.
        notes: texts to publish; whoever publishes them empties the list.
    """

    def __init__(self, name: str, base: Pose, instrument: str, max_age: float | None = MAX_AGE_S):
        self.name = name
        self._max_age = max_age
        self.instrument = instrument
        self.operating = OperatingStates()
        self.frames = Frames.of_psm(name, base)
        self.notes: list[Note] = []
        self._limits = INSTRUMENTS[instrument].limits
        self._queue: deque[_Command] = deque()
        self._trajectory: Trajectory | None = None
        self._jaw_trajectory: Trajectory | None = None
        self._last_stamp: dict[str, int] = {}
        self._last_source: dict[str, tuple[str, int]] = {}
        self._readers: Mapping[str, Callable[[Message], Joints | Pose | float | str]]
        self._readers = MappingProxyType(
            {
                SERVO_JP: self._read_joints,
                MOVE_JP: self._read_joints,
                SERVO_CP: self._read_pose,
                MOVE_CP: self._read_pose,
                JAW_SERVO_JP: _read_jaw,
                JAW_MOVE_JP: _read_jaw,
                STATE_COMMAND: _read_text,
            }
        )

    @property
    def is_busy(self) -> bool:
        """Return True while a move of the arm or of its jaw is under way."""
        return self._trajectory is not None or self._jaw_trajectory is not None

    def receive(self, channel: str, message: Message, source: str, now: int) -> None:
        """Validate a command and queue it.

        Args:
            channel: a topic below the arm's name.
            message: what arrived.
            source: who sent it.
            now: when it arrived [ns since the epoch].

        Raises:
            InputError: the command is refused; nothing has changed.
        """
        payload = self._readers[channel](message)
        if channel in MOTIONS:
            self._check_time(channel, message, now)
            if self._is_contested(channel, source, now):
                return
        if channel in SERVOS:
            waiting = [entry for entry in self._queue if entry.channel != channel]
            self._queue = deque(waiting)
        elif len(self._queue) >= QUEUE:
            self._make_room(channel)
        self._queue.append(_Command(channel, payload))

    def stop(self, reason: str) -> None:
        """Enter FAULT: the arm stays where it is until `clear_fault` and `enable`."""
        self.operating.state = FAULT
        self.notes.append(Note("error", reason))
        self._forget_motions()

    def forget(self) -> None:
        """Forget all motions and the stamps of earlier ones; the operating state stays."""
        self._forget_motions()
        self._last_stamp.clear()

    def advance(self, time: float, state: ArmState) -> Target | None:
        """Obey queued commands and return the arm's new set point, None for no change.

        Args:
            time: time of the control step [s], which moves follow.
            state: the state measured now.
        """
        joints = state.setpoint
        jaw = state.jaw_setpoint
        changed = False
        while self._queue:
            command = self._queue.popleft()
            try:
                if command.channel == STATE_COMMAND:
                    was_moving = self.operating.may_move
                    self.operating.command(str(command.payload))
                    self.notes.append(Note("info", f"{command.payload}: {self.operating.state}"))
                    if was_moving and not self.operating.may_move:
                        self._trajectory = self._jaw_trajectory = None
                        joints = state.joints
                        changed = True
                elif not self.operating.may_move:
                    raise InputError(f"the arm is {self.operating.state}")
                else:
                    joints, jaw = self._begin(command, joints, jaw, time)
                    changed = True
            except (InputError, UnreachablePose) as error:
                self.notes.append(Note("warning", f"rejected {command.channel}: {error}"))
        if not self.operating.may_move:
            if self.is_busy:
                self._forget_motions()
                joints = state.joints
                changed = True
        elif self.is_busy:
            joints, jaw = self._follow(joints, jaw, time)
            changed = True
        return Target(joints, jaw) if changed else None

    def _begin(
        self, command: _Command, joints: Joints, jaw: float, time: float
    ) -> tuple[Joints, float]:
        """Begin a motion and return the set points for now."""
        channel = command.channel
        payload = command.payload
        if isinstance(payload, float):
            if channel == JAW_SERVO_JP:
                self._jaw_trajectory = None
                return joints, payload
            self._jaw_trajectory = Trajectory([jaw], [payload], [JAW_SPEED], time)
            return joints, jaw
        assert isinstance(payload, tuple)
        goal = _six(payload) if len(payload) == 6 else self._inverse(_twelve(payload), joints)
        if not is_within(goal, self._limits):
            raise InputError(
                "joints outside the limits of the instrument: "
                + ", ".join(f"{value:.4g}" for value in goal)
            )
        if channel in SERVOS:
            self._trajectory = None
            return goal, jaw
        self._trajectory = Trajectory(joints, goal, MOVE_SPEEDS, time)
        return joints, jaw

    def _follow(self, joints: Joints, jaw: float, time: float) -> tuple[Joints, float]:
        """Return the set points of the moves under way, and end those that have arrived."""
        if self._trajectory is not None:
            sample = self._trajectory.sample(time)
            joints = _six(sample.position)
            if sample.is_end:
                self._trajectory = None
        if self._jaw_trajectory is not None:
            sample = self._jaw_trajectory.sample(time)
            jaw = sample.position[0]
            if sample.is_end:
                self._jaw_trajectory = None
        return joints, jaw

    def _inverse(self, pose: Pose, near: Joints) -> Joints:
        return inverse_flat(pose, self.instrument, near)

    def _make_room(self, channel: str) -> None:
        """Drop the oldest waiting motion for a state command, which may be a stop.

        Raises:
            InputError: the command is a motion, or only state commands are waiting.
        """
        oldest = next((entry for entry in self._queue if entry.channel != STATE_COMMAND), None)
        if channel != STATE_COMMAND or oldest is None:
            raise InputError(f"{QUEUE} commands are already waiting; this one is dropped.")
        self._queue.remove(oldest)
        self.notes.append(
            Note("warning", f"rejected {oldest.channel}: {QUEUE} commands were waiting")
        )

    def _forget_motions(self) -> None:
        """Drop moves and all waiting motions."""
        self._trajectory = self._jaw_trajectory = None
        self._queue = deque(entry for entry in self._queue if entry.channel == STATE_COMMAND)

    def _check_time(self, channel: str, message: Message, now: int) -> None:
        """Refuse a motion command that is late, or older than one already accepted."""
        assert isinstance(message, JointState | PoseStamped)
        stamp = message.header.stamp
        if not stamp:
            return
        age = (now - stamp) / 1e9
        if self._max_age is not None and age > self._max_age:
            raise InputError(f"the message is {age:.2f} s old; allowed: {self._max_age:g} s.")
        if self._max_age is not None and age < -self._max_age:
            raise InputError(
                f"its stamp is {-age:.2f} s ahead of this clock; synchronise the clocks."
            )
        if stamp < self._last_stamp.get(channel, 0):
            raise InputError("the message is out of order: a newer one was already obeyed.")
        self._last_stamp[channel] = stamp

    def _is_contested(self, channel: str, source: str, now: int) -> bool:
        """Return True, and pause, if another client moves the same part of the arm."""
        part = channel.partition("/")[0] if "/" in channel else "arm"
        owner, since = self._last_source.get(part, (source, now))
        if source != owner and now - since < CONTROL_S * 1e9:
            if self.operating.may_move:
                self.operating.state = PAUSED
                text = f"two clients move the {part}; it pauses until 'resume'"
                self.notes.append(Note("error", text))
            return True
        self._last_source[part] = (source, now)
        return False

    def _read_joints(self, message: Message) -> Joints:
        """Return six joints in the model's order, whatever order the message names them in."""
        assert isinstance(message, JointState)
        values = message.position
        given = message.names
        numbers = tuple(str(index) for index in range(len(JOINT_NAMES)))  # cisst's joint vectors
        if given and given not in (JOINT_NAMES, numbers):
            if sorted(given) != sorted(JOINT_NAMES) or len(values) != len(given):
                raise InputError(f"joints {', '.join(given)}; allowed: {', '.join(JOINT_NAMES)}.")
            values = tuple(values[given.index(name)] for name in JOINT_NAMES)
        if len(values) != len(JOINT_NAMES):
            raise InputError(f"{len(values)} positions; a PSM has {len(JOINT_NAMES)} joints.")
        if not is_within(values, self._limits):
            raise InputError("positions that are not finite or outside the joint limits.")
        return _six(values)

    def _read_pose(self, message: Message) -> Pose:
        assert isinstance(message, PoseStamped)
        return self.frames.to_base(message)


@final
class Endoscope:
    """The ECM of a scene whose endoscope is fixed: it has a state and refuses to move.

    Args:
        name: "ECM".
    """

    is_busy = False

    def __init__(self, name: str):
        self.name = name
        self.operating = OperatingStates()
        self.notes: list[Note] = []

    def receive(self, channel: str, message: Message, source: str, now: int) -> None:
        """Obey a state command.

        Raises:
            InputError: a motion, or a state command that is not possible.
        """
        if channel != STATE_COMMAND:
            raise InputError("the endoscope of this scene is fixed.")
        self.operating.command(_read_text(message))
        self.notes.append(Note("info", f"{_read_text(message)}: {self.operating.state}"))


def _read_jaw(message: Message) -> float:
    """Return a jaw angle [rad]; below 0 it means closed."""
    assert isinstance(message, JointState)
    if len(message.position) != 1:
        raise InputError(f"{len(message.position)} positions; a jaw has one.")
    if not is_within(message.position, (JAW_LIMITS,)):
        low, high = JAW_LIMITS
        raise InputError(
            f"a jaw angle of {message.position[0]:g} rad; allowed: {low:.2f} to {high:.2f}."
        )
    return max(0.0, float(message.position[0]))


def _read_text(message: Message) -> str:
    assert isinstance(message, StringStamped)
    return message.text


def _six(values: tuple[float, ...]) -> Joints:
    a, b, c, d, e, f = values
    return a, b, c, d, e, f


def _twelve(values: tuple[float, ...]) -> Pose:
    a, b, c, d, e, f, g, h, i, j, k, m = values
    return a, b, c, d, e, f, g, h, i, j, k, m
