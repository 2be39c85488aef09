"""`dvrk`: a da Vinci Research Kit over CRTK, or the served simulation, as a LeRobot robot.

    lerobot-teleoperate --robot.type=dvrk --robot.simulated=true --robot.task=grasp \
        --teleop.type=surgicai_page --fps=50

Every command passes the guards of `robot drive` (`robot.guards`). If they find a problem, or an arm
is paused or stopped, nothing is sent, the log says why, and the arm stays at its set point. What a
leader arm does meanwhile is not made up for. An action is meant for one control step of 20 ms: run
LeRobot's loops at 50 frames per second.

A served simulation begins its next start some time after a success, when an action requests it
(`surgicai_page`), and when only observations are read, as `lerobot-rollout` does between episodes.
"""

import logging
import time
from collections.abc import Mapping
from contextlib import ExitStack
from typing import final

import numpy as np
from lerobot.robots import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from numpy.typing import NDArray

from lerobot_robot_dvrk.actions import ABSOLUTE, ACTIONS, POSITIONS, Reader, observed
from lerobot_robot_dvrk.board import BOARD
from lerobot_robot_dvrk.config_dvrk import DvrkConfig
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.envs.control import StepSize
from surgicai_vision.robot.client import Client, ClientConfig
from surgicai_vision.robot.dead_man import HeldPedal
from surgicai_vision.robot.driven import Command, DrivenRobot
from surgicai_vision.robot.setpoints import Setpoints
from surgicai_vision.robot.transport import RenamedTransport, open_transport

RESET = "simulation.reset"
"""Action key that requests the next start (1) or the same start (2) of a served simulation."""
NEXT, SAME = 1.0, 2.0
OBSERVED_ONLY = 5
"""Consecutive observations without an action after which an episode counts as over."""

logger = logging.getLogger(__name__)


@final
class Dvrk(Robot):  # type: ignore[misc]  # mypy skips LeRobot
    """A dVRK; see the module's docstring.

    Args:
        config: its settings.
    """

    config_class = DvrkConfig
    name = "dvrk"

    def __init__(self, config: DvrkConfig):
        super().__init__(config)
        self.config = config
        self.cameras: dict[str, object] = dict.fromkeys(config.views)  # LeRobot counts them
        step = StepSize.of(config.step)
        self._reader: Reader = ACTIONS[config.action](step, config.leader)
        self._step = step
        self._stack: ExitStack | None = None
        self._seed = config.seed
        self._observations = 0
        self._steps = 0
        self._solved: float | None = None
        self._told = ""
        self._seen: dict[str, float | NDArray[np.uint8]] = {}

    # -- what LeRobot requires of any robot --------------------------------------------------------

    @property
    def observation_features(self) -> dict[str, type | tuple[int, ...]]:
        """Return the observation's values → `float` or an image's shape."""
        size = self.config.image_size
        images = dict.fromkeys(self.config.views, (size, size, 3))
        return {**dict.fromkeys(self._state_names, float), **images}

    @property
    def action_features(self) -> dict[str, type]:
        """Return the action's values → `float`."""
        return dict.fromkeys(self._reader.features, float)

    @property
    def is_connected(self) -> bool:
        """Return True between `connect` and `disconnect`."""
        return self._stack is not None

    @property
    def is_calibrated(self) -> bool:
        """Return True: a dVRK homes its joints itself, and the guards check it."""
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    def connect(self, calibrate: bool = True) -> None:
        """Find the robot; a served simulation begins the episode of the first seed.

        Raises:
            DeviceAlreadyConnectedError: it is already connected.
            InputError: the settings cannot be used.
            SurgicaiError: no robot answers.
        """
        if self._stack is not None:
            raise DeviceAlreadyConnectedError(f"{self} is already connected.")
        config = self.config
        drive = config.drive_config()
        with ExitStack() as stack:
            opened = stack.enter_context(
                open_transport(config.transport, config.interface, config.domain)
            )
            transport = RenamedTransport(opened, config.topics, config.views)
            views = tuple(config.views)
            self._client = Client(
                transport,
                ClientConfig(
                    views=views,
                    is_compressed=config.compressed,
                    is_simulated=config.simulated,
                ),
            )
            dead_man = HeldPedal(transport, config.dead_man).age if config.dead_man else _held
            self._robot = DrivenRobot(
                self._client, views, config.task, config.image_size, config.frames, config.jaw_scale
            )
            self._setpoints = Setpoints(
                self._robot,
                self._step,
                config.guards,
                dead_man,
                sends=drive.sends,
                is_stepped=drive.is_stepped,
            )
            self._client.connect()
            self._stack = stack.pop_all()
        self._reader.forget()
        self._seen = {}
        if config.simulated:
            self._begin(config.seed)
        elif not drive.sends:
            logger.warning("dry run: nothing is sent; --robot.send=true sends it")

    def disconnect(self) -> None:
        """Disconnect from the robot, which stays at its last set point.

        Raises:
            DeviceNotConnectedError: it is not connected.
        """
        if self._stack is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        stack = self._stack
        self._stack = None
        stack.close()

    def get_observation(self) -> dict[str, float | NDArray[np.uint8]]:
        """Return the current measurements and the newest images.

        While they cannot be used, the last that could be are returned, and the log says why.

        Raises:
            DeviceNotConnectedError: the robot is not connected.
            InputError: the measurements cannot be used, and none could be since it was connected.
        """
        self._check_connected()
        self._client.update()
        self._observations += 1
        if self.config.simulated:
            self._follow_the_judge()
        try:
            self._seen = self._measured()
        except InputError as error:
            if not self._seen:
                raise
            self._tell(str(error))
        return dict(self._seen)

    def _measured(self) -> dict[str, float | NDArray[np.uint8]]:
        seen: dict[str, float | NDArray[np.uint8]] = {}
        if self.config.action == ABSOLUTE:
            seen.update(observed(self._robot))
        else:
            seven = self._robot.agent_pos().tolist()
            seen.update(zip(self._state_names, seven, strict=True))
        images = self._robot.images()
        BOARD.images = images
        BOARD.arm = self._robot.active
        BOARD.jaw = self._robot.told(self._robot.active).jaw
        return {**seen, **images}

    def send_action(self, action: Mapping[str, float]) -> Mapping[str, float]:
        """Send an action if the guards let it through; return it in any case.

        Args:
            action: values of `action_features`; missing ones command no motion. An action that has
                values, but none of these, is held back: it is of another kind.
        """
        self._check_connected()
        self._observations = 0
        asked = float(action.get(RESET, 0.0))
        if self.config.simulated and asked:
            self._begin(self._seed + (1 if asked == NEXT else 0))
            return action
        self._client.update()
        now = self._steps / names.FPS if self.config.clock == "stepped" else time.monotonic()
        commands: Mapping[str, Command] = {}
        problem = self._setpoints.problem_of_inputs(self._arms())
        if not problem:
            try:
                commands, problem = self._planned(action, now)
            except InputError as error:
                problem = str(error)
        if problem:
            self._reader.forget()
        self._tell(problem)
        self._setpoints.send({} if problem else commands, now)
        self._steps += 1
        return action

    # -- the rest ----------------------------------------------------------------------------------

    @property
    def _state_names(self) -> tuple[str, ...]:
        if self.config.action == ABSOLUTE:
            return POSITIONS
        return tuple(f"{name}.pos" for name in names.STATE_NAMES)

    def _arms(self) -> tuple[str, ...]:
        """Return the arms that an action may move now."""
        return tuple(dict.fromkeys((*self._reader.arms, *self._robot.arms)))

    def _planned(
        self, action: Mapping[str, float], now: float
    ) -> tuple[Mapping[str, Command], str]:
        kind = self.config.action
        if self._reader.arms and kind == ABSOLUTE:
            return self._setpoints.of_targets(self._reader.targets(action, self._robot), now)
        if action and not any(name in action for name in self._reader.features):
            given, taken = (", ".join(list(of)[:3]) for of in (action, self._reader.features))
            return {}, f"the action has {given}, but --robot.action={kind} takes {taken}"
        return self._setpoints.of_moves(self._reader.moves(action, self._robot), now)

    def _follow_the_judge(self) -> None:
        """Enter the subtask that the judge reports, and begin the next start if one is due."""
        judged = self._client.judgement()
        if not judged:
            return
        subtask = judged.get("subtask")
        if self.config.task == names.SUTURE and subtask in names.SUBTASKS:
            self._robot.enter(names.SUBTASKS.index(str(subtask)))
        BOARD.success = bool(judged.get("is_success"))
        now = time.monotonic()
        if not BOARD.success:
            self._solved = None
        elif self._solved is None:
            self._solved = now
            logger.info("start %d: success", self._seed)
        after = self.config.reset_after
        is_due = self._solved is not None and after and now - self._solved >= after
        is_over = self._steps and self._observations >= OBSERVED_ONLY
        if is_due or is_over:
            self._begin(self._seed + 1)

    def _begin(self, seed: int) -> None:
        """Begin an episode of a served simulation."""
        self._seed = seed
        self._client.reset(seed)
        self._robot.begin()
        self._setpoints.forget()
        self._reader.forget()
        self._steps = 0
        self._observations = 0
        self._solved = None
        logger.info("start %d", seed)

    def _tell(self, problem: str) -> None:
        """Log the reason why nothing is sent, when it changes."""
        if problem == self._told:
            return
        self._told = problem
        BOARD.message = problem
        if problem:
            logger.warning("held: %s", problem)
        else:
            logger.info("the guards let commands through")

    def _check_connected(self) -> None:
        if self._stack is None:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect() first.")


def _held() -> float:
    """Return 0, the time since the switch was held [s]: a served simulation needs no switch."""
    return 0.0
