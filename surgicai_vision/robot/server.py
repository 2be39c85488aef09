"""Server: the simulation as a dVRK that speaks CRTK.

    with open_transport("cyclonedds") as transport, Server(robot, transport, config) as server:
        server.run(lambda: False)

In real time, a control step of 20 ms begins 50 times a second. The commands that have arrived
become the set points; they are published with the state at the beginning of the step and the images
of that state. The state halfway is published 10 ms later, so that states come 100 times a second. A
set point that arrived in time is thus published before its sender's next control step begins. If
the client sets the clock (`stepped`), nothing moves until a message on `/simulation/step` requests
it. Everything published for a step has the same stamp, which `/simulation/stepped` reports last.
"""

import json
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Self, final

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, PhysicsError, check_name
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.robot import topics
from surgicai_vision.robot.arm import (
    ENDOSCOPE_JOINTS,
    JAW_NAME,
    JOINT_NAMES,
    MAX_AGE_S,
    STATE_COMMAND,
    Arm,
    ArmState,
    Endoscope,
    Psm,
    Target,
)
from surgicai_vision.robot.frames import (
    T_WORLD_ECM,
    VIEW,
    WORLD,
    base_frame,
    twist,
    write_pose,
)
from surgicai_vision.robot.images import Cameras, ImageThread
from surgicai_vision.robot.messages import (
    Header,
    JointState,
    Message,
    OperatingState,
    String,
    StringStamped,
    TwistStamped,
)
from surgicai_vision.robot.operating_state import ENABLED
from surgicai_vision.robot.recorder import Recorder
from surgicai_vision.robot.simulated import PSM_NAMES, SimulatedRobot
from surgicai_vision.robot.transport import Inbox, Publish, Received, Transport
from surgicai_vision.scene.kinematics import Joints, forward_flat

ECM = "ECM"
REAL = "real"
STEPPED = "stepped"
CLOCKS = (REAL, STEPPED)
CONTROL_S = 1.0 / names.FPS
"""Length of a control step [s]."""
PATIENCE_S = 1.0
"""Time for which a step waits for the commands it names [s]."""
MAX_BEHIND_S = 0.1
"""Time by which the clock may lag before it is reset [s]; nothing is caught up in a burst."""
REMEMBERED = 64
"""Requests that are recognised when they come twice; a client repeats one without an answer."""
LONGEST_SEED = 18
"""Digits of the longest seed that a reset may request."""


@dataclass(frozen=True)
class ServeConfig:
    """What a server publishes, and when.

    Attributes:
        clock: "real", or "stepped" by the client.
        views: cameras and crops it publishes.
        size: height and width of their images [pixel].
        image_rate: most images of each view per second, in real time [Hz].
        is_compressed: publish JPEG files in addition to raw images.
        shows_truth: publish the needle's pose and the active subtask, which no robot knows.
    """

    clock: str = REAL
    views: tuple[str, ...] = ()
    size: tuple[int, int] = (224, 224)
    image_rate: float = 50.0
    is_compressed: bool = False
    shows_truth: bool = False

    def __post_init__(self) -> None:
        check_name("clock", self.clock, CLOCKS)


@dataclass(frozen=True)
class _Request:
    """A message that requests something from the simulation.

    Attributes:
        stamp: stamp of its header [ns].
        text: what is requested; for a step, the topics whose messages must come first.
        asked: when it arrived, by the monotonic clock [s].
        sent: when it was sent, as `Received.sent`.
    """

    stamp: int
    text: str
    asked: float
    sent: int


@final
class Server:
    """Serves one simulated robot; a context manager.

    Args:
        robot: the robot, after its first reset.
        transport: carries the messages.
        config: what is published, and when.
        recorder: records what clients do; None records nothing.

    Attributes:
        steps: control steps taken so far, in all episodes.
        lateness: how late each control step of a real-time run began [s].
    """

    def __init__(
        self,
        robot: SimulatedRobot,
        transport: Transport,
        config: ServeConfig,
        recorder: Recorder | None = None,
    ):
        self.robot = robot
        self._recorder = recorder
        self.config = config
        self.steps = 0
        self.lateness: list[float] = []
        self._transport = transport
        max_age = MAX_AGE_S if config.clock == REAL else None
        self._psms = {
            name: Psm(name, robot.base(name), robot.instrument, max_age) for name in PSM_NAMES
        }
        self._ecm = Endoscope(ECM)
        self._arms: dict[str, Arm] = {**self._psms, ECM: self._ecm}
        self._publishers: dict[str, Publish] = {}
        self._inboxes: list[tuple[Arm, str, str, Inbox]] = []
        for arm in self._arms.values():
            of = topics.ecm_topics if arm is self._ecm else topics.psm_topics
            for topic in of(arm.name, heard=False).values():
                self._add(topic)
            for channel, topic in of(arm.name, heard=True).items():
                self._inboxes.append((arm, channel, topic.name, transport.inbox(topic)))
        for topic in (topics.STEPPED, topics.JUDGEMENT):
            self._add(topic)
        if config.shows_truth:
            self._add(topics.NEEDLE)
            self._add(topics.LABEL)
        self._resets = transport.inbox(topics.RESET)
        self._reset_sent = 0
        self._enters = transport.inbox(topics.ENTER)
        self._steps = transport.inbox(topics.STEP)
        self._stamps: dict[str, int] = {}
        self._requests: list[_Request] = []
        self._taken: deque[tuple[int, str]] = deque(maxlen=REMEMBERED)
        self._shown: dict[str, tuple[str, bool, bool]] = {}
        self._diverged: set[str] = set()  # PSMs that a reset enables again
        self._last_stamp = 0
        self._next_image = 0.0
        self._cameras: Cameras | None = None
        self._images: ImageThread | None = None
        self._stack = ExitStack()
        for view in config.views:
            self._add(topics.image_topic(view))
            self._add(topics.info_topic(view))
            if config.is_compressed:
                self._add(topics.compressed_topic(view))

    def __enter__(self) -> Self:
        if self.config.views and self.config.clock == STEPPED:
            self._cameras = self._make_cameras(self.robot.env)
        elif self.config.views:
            thread = ImageThread(self.robot.env.config, self._make_cameras)
            self._images = self._stack.enter_context(thread)
            self._offer_image()
        for name in PSM_NAMES:
            self._publishers[f"/{name}/tool_type"](String(self.robot.instrument))
        self._publish_all(self._stamp())
        return self

    def __exit__(self, *_: object) -> None:
        """Stop publishing images."""
        self._stack.close()

    def run(self, is_over: Callable[[], bool]) -> None:
        """Serve until `is_over` returns True; it is called once per control step."""
        if self.config.clock == STEPPED:
            while not is_over():
                self._transport.wait(CONTROL_S)
                self.poll()
            return
        due = time.monotonic()
        while not is_over():
            self.lateness.append(time.monotonic() - due)
            halfway = self._tick()
            _sleep_until(due + CONTROL_S / 2)
            self._publish_states(halfway, self._stamp())
            due += CONTROL_S
            if time.monotonic() > due + MAX_BEHIND_S:
                due = time.monotonic()
            _sleep_until(due)

    def _tick(self) -> dict[str, ArmState]:
        """Obey, publish the present state, and take a step; return the arms' states halfway."""
        self.poll()
        self._obey()
        stamp = self._stamp()
        self._publish_all(stamp)
        if self._images is not None:
            self._images.release(stamp)
        halfway: dict[str, ArmState] = {}

        def read() -> None:
            halfway.update({name: self.robot.state(name) for name in PSM_NAMES})

        self._move(read)
        self._offer_image()
        return halfway

    # -- what comes --------------------------------------------------------------------------------

    def poll(self) -> None:
        """Take new messages; if the client sets the clock, also step as requested."""
        for request in self._texts(self._resets):
            self._do(request, lambda text: self._reset(_seed(text)))
            # No later than now: a sender's clock may be ahead.
            self._reset_sent = max(self._reset_sent, min(request.sent, time.time_ns()))
        for request in self._texts(self._enters):
            self._do(request, lambda text: self.robot.enter(text) if text else None)
        self._requests += self._texts(self._steps)
        heard = [
            (received.sent, place, received)
            for place, (_, channel, _, inbox) in enumerate(self._inboxes)
            for received in inbox()
            # A motion may have been meant for the previous episode; a stop is always obeyed.
            if received.sent >= self._reset_sent or channel == STATE_COMMAND
        ]
        for _, place, received in sorted(heard, key=lambda entry: entry[:2]):
            arm, channel, topic, _ = self._inboxes[place]
            self._hear(arm, channel, topic, received)
        if self.config.clock == STEPPED:
            while self._requests and self._step_as_asked(self._requests[0]):
                self._requests.pop(0)
        else:
            for request in self._requests:
                self._answer(request, "the clock is real; serve with --clock stepped")
            self._requests.clear()

    def _hear(self, arm: Arm, channel: str, topic: str, received: Received) -> None:
        """Pass a command to its arm, and say so if it is refused."""
        try:
            arm.receive(channel, received.message, received.source, time.time_ns())
        except InputError as error:
            self._say(arm.name, "warning", f"rejected {channel}: {error}")
        if channel == STATE_COMMAND:
            self._diverged.discard(arm.name)  # whoever sent it decides from now on
        self._stamps[topic] = max(self._stamps.get(topic, 0), _stamp_of(received.message))

    def _texts(self, inbox: Inbox) -> list[_Request]:
        """Return the new requests; those with a stamp only once."""
        found: list[_Request] = []
        for received in inbox():
            message = received.message
            if not isinstance(message, StringStamped):
                continue
            request = (message.header.stamp, message.text)
            if not message.header.stamp or request not in self._taken:
                self._taken.append(request)
                found.append(_Request(*request, time.monotonic(), received.sent))
        return found

    def _do(self, request: _Request, act: Callable[[str], None]) -> None:
        """Do what a request says and answer it."""
        try:
            act(request.text)
        except (InputError, PhysicsError) as error:
            self._answer(request, str(error))
        else:
            self._answer(request, "")

    def _answer(self, request: _Request, problem: str) -> None:
        """Publish everything, then that the request was met or why not."""
        stamp = self._stamp()
        self._publish_all(stamp)
        if self._cameras is not None and not problem:
            self._cameras.publish(stamp)
        text = f"{request.stamp} {problem}".rstrip()
        self._publishers[topics.STEPPED.name](StringStamped(Header(stamp), text))

    def _step_as_asked(self, request: _Request) -> bool:
        """Take the requested step; return False while commands that it names are missing."""
        missing = [
            topic for topic in request.text.split() if self._stamps.get(topic, 0) < request.stamp
        ]
        if missing and time.monotonic() < request.asked + PATIENCE_S:
            return False
        if missing:
            self._answer(request, f"no message with that stamp on {', '.join(missing)}")
            return True
        self._obey()
        self._move(None)
        self._answer(request, "")
        return True

    # -- what moves --------------------------------------------------------------------------------

    def _obey(self) -> None:
        """Let the arms obey: the commands become their set points."""
        seconds = self.robot.steps * CONTROL_S
        targets: dict[str, Target] = {}
        for name, psm in self._psms.items():
            target = psm.advance(seconds, self.robot.state(name))
            if target is not None:
                targets[name] = target
        if self._recorder is not None:
            self._recorder.before_step()
        self.robot.tell(targets)

    def _move(self, halfway: Callable[[], None] | None) -> None:
        """Take one control step under the present set points."""
        self.robot.step(halfway)
        self.steps += 1
        if self._recorder is not None:
            self._recorder.after_step()
        if self.robot.info["physics_error"]:
            for name, psm in self._psms.items():
                if psm.operating.may_move:
                    psm.stop("the physics diverged; request a reset")
                    self._diverged.add(name)

    def _reset(self, seed: int) -> None:
        """Begin another episode: arms forget earlier commands and keep their operating states.

        The stamps of earlier commands are forgotten too: another client may have another clock.

        Those that were stopped because the physics diverged are enabled again.
        """
        self.robot.reset(seed)
        if self._recorder is not None:
            self._recorder.begin()
        for psm in self._psms.values():
            psm.forget()
        self._stamps.clear()
        for name in self._diverged:
            self._psms[name].operating.state = ENABLED
        self._diverged.clear()
        if self._images is not None:  # instead of the previous episode's next state
            self._images.offer(self.robot.env.get_state())

    # -- what is said ------------------------------------------------------------------------------

    def _publish_all(self, stamp: int) -> None:
        """Publish the present state of everything but images."""
        self._publish_states({name: self.robot.state(name) for name in PSM_NAMES}, stamp)
        for arm in self._arms.values():
            self._publish_operating(arm, stamp)
        endoscope = (0.0,) * len(ENDOSCOPE_JOINTS)
        for kind in ("measured", "setpoint"):
            joints = JointState(Header(stamp, WORLD), ENDOSCOPE_JOINTS, endoscope, endoscope)
            self._publishers[f"/{ECM}/{kind}_js"](joints)
            self._publishers[f"/{ECM}/{kind}_cp"](write_pose(T_WORLD_ECM, stamp, WORLD))
        still = (0.0, 0.0, 0.0)
        self._publishers[f"/{ECM}/measured_cv"](TwistStamped(Header(stamp, WORLD), still, still))
        if self.config.shows_truth:
            needle = write_pose(self.robot.needle(), stamp, WORLD)
            self._publishers[topics.NEEDLE.name](needle)
            self._publishers[topics.LABEL.name](String(self.robot.env.subtask.name))
        self._publish_judgement(stamp)

    def _publish_states(self, states: dict[str, ArmState], stamp: int) -> None:
        """Publish the measured states and set points of the PSMs."""
        for name, state in states.items():
            self._publish_joints(name, "measured", state.joints, state.velocity, stamp)
            self._publish_joints(name, "setpoint", state.setpoint, (), stamp)
            self._publish_jaw(name, "measured", state.jaw, (state.jaw_velocity,), stamp)
            self._publish_jaw(name, "setpoint", state.jaw_setpoint, (), stamp)
            frames = self._psms[name].frames
            linear, angular = twist(state.joints, state.velocity, self.robot.instrument)
            moving = TwistStamped(
                Header(stamp, VIEW),
                frames.turn_from_base(linear, VIEW),
                frames.turn_from_base(angular, VIEW),
            )
            self._publishers[f"/{name}/measured_cv"](moving)

    def _publish_joints(
        self, name: str, kind: str, joints: Joints, velocity: tuple[float, ...], stamp: int
    ) -> None:
        """Publish joints and the resulting tip pose, in the view and in the base."""
        header = Header(stamp, VIEW)
        publish = self._publishers
        publish[f"/{name}/{kind}_js"](JointState(header, JOINT_NAMES, joints, velocity))
        pose = forward_flat(joints, self.robot.instrument)
        in_view = self._psms[name].frames.from_base(pose, VIEW)
        publish[f"/{name}/{kind}_cp"](write_pose(in_view, stamp, VIEW))
        publish[f"/{name}/local/{kind}_cp"](write_pose(pose, stamp, base_frame(name)))

    def _publish_jaw(
        self, name: str, kind: str, angle: float, velocity: tuple[float, ...], stamp: int
    ) -> None:
        jaw = JointState(Header(stamp, VIEW), (JAW_NAME,), (angle,), velocity)
        self._publishers[f"/{name}/jaw/{kind}_js"](jaw)

    def _publish_operating(self, arm: Arm, stamp: int) -> None:
        """Publish an arm's operating state if it has changed, and its notes."""
        now = (arm.operating.state, arm.operating.is_homed, arm.is_busy)
        header = Header(stamp, WORLD if arm is self._ecm else VIEW)
        if self._shown.get(arm.name) != now:
            self._shown[arm.name] = now
            self._publishers[f"/{arm.name}/operating_state"](OperatingState(header, *now))
            self._publishers[f"/{arm.name}/state"](StringStamped(header, arm.operating.state))
        for note in arm.notes:
            self._say(arm.name, note.level, note.text)
        arm.notes.clear()

    def _say(self, name: str, level: str, text: str) -> None:
        """Publish a text on an arm's info, warning or error."""
        header = Header(time.time_ns(), "")
        self._publishers[f"/{name}/{level}"](StringStamped(header, text))

    def _publish_judgement(self, stamp: int) -> None:
        """Publish the judged state of the episode."""
        info = self.robot.info
        env = self.robot.env
        judged = {
            "task": env.config.task,
            "seed": self.robot.seed,
            "steps": self.robot.steps,
            "subtask": env.subtask.name,
            "advance": env.config.advance,
            "is_success": bool(info["is_success"]),
            "progress": int(info.get("progress", 0) or info["is_success"]),
            "physics_error": bool(info["physics_error"]),
        }
        message = StringStamped(Header(stamp), json.dumps(judged))
        self._publishers[topics.JUDGEMENT.name](message)

    def _offer_image(self) -> None:
        """Give the image thread the coming state, if an image is due and the thread is free."""
        images = self._images
        now = time.monotonic()
        if images is None or now < self._next_image or not images.is_free:
            return
        self._next_image = max(self._next_image + 1.0 / self.config.image_rate, now - CONTROL_S)
        images.offer(self.robot.env.get_state())

    def _make_cameras(self, env: SuturingEnv) -> Cameras:
        config = self.config
        return Cameras(
            env,
            config.views,
            config.size,
            config.is_compressed,
            lambda topic: self._publishers[topic.name],
            lambda topic: self._transport.listeners(topic) > 0,
        )

    def _add(self, topic: topics.Topic) -> None:
        self._publishers[topic.name] = self._transport.publisher(topic)

    def _stamp(self) -> int:
        """Return the present time [ns since the epoch], later than any before."""
        self._last_stamp = max(time.time_ns(), self._last_stamp + 1)
        return self._last_stamp


def _stamp_of(message: Message) -> int:
    """Return a message's stamp [ns], 0 for one without a header."""
    return 0 if isinstance(message, String) else message.header.stamp


def _seed(text: str) -> int:
    """Return the seed that a reset requests."""
    if not text.isdecimal() or len(text) > LONGEST_SEED:
        raise InputError(
            f"a reset's text must be a seed, a whole number of at most {LONGEST_SEED} digits; it "
            f"is '{text[:40]}'."
        )
    return int(text)


def _sleep_until(due: float) -> None:
    """Sleep until a time of the monotonic clock [s]."""
    left = due - time.monotonic()
    if left > 0.0:
        time.sleep(left)
