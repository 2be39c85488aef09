"""`surgicai_page`: keyboard and gamepad in a browser page, as a LeRobot teleoperator.

The page is that of `surgicai-vision teleoperate`: it listens on the loopback under a random token,
needs no X server, and works with a gamepad on the viewer's own machine. It shows the latest
observation of this process's robot `dvrk` (`board`). → or Enter requests the next start of a served
simulation, ← the same start again.

The actions are the increments of `dvrk` in the active arm's base. Keys follow the endoscope's axes
(`envs.absolute.T_WORLD_VIEW`); its position above the arms is that of the simulation.
"""

import logging
import time
from contextlib import ExitStack
from typing import final

import numpy as np
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from numpy.typing import NDArray

from lerobot_robot_dvrk.actions import Increments
from lerobot_robot_dvrk.board import BOARD
from lerobot_robot_dvrk.config_surgicai_page import SurgicaiPageConfig
from lerobot_robot_dvrk.dvrk import NEXT, RESET, SAME
from surgicai_vision.envs import poses
from surgicai_vision.envs.absolute import T_WORLD_VIEW
from surgicai_vision.envs.control import StepSize
from surgicai_vision.robot.simulated import PSM_NAMES
from surgicai_vision.scene import kinematics
from surgicai_vision.teleoperation.input_map import CLOSE_ABOVE, FINE, OPENED
from surgicai_vision.teleoperation.inputs import DISCARD, JAW, KEEP, START, Device, Input, Vector
from surgicai_vision.teleoperation.session import Status
from surgicai_vision.teleoperation.web import WebView

SHOWN_S = 0.04
"""Shortest time between two images shown on the page [s]."""

logger = logging.getLogger(__name__)


@final
class SurgicaiPage(Teleoperator):  # type: ignore[misc]  # mypy skips LeRobot
    """The page as a teleoperator; see the module's docstring.

    Args:
        config: its settings.
    """

    config_class = SurgicaiPageConfig
    name = "surgicai_page"

    def __init__(self, config: SurgicaiPageConfig):
        super().__init__(config)
        self.config = config
        self._jaw_step = StepSize.of(config.step).jaw
        self._jaw_remaining = 0.0
        self._arm = ""
        self._steps = 0
        self._shown = 0.0
        self._stack: ExitStack | None = None

    @property
    def action_features(self) -> dict[str, type]:
        """Return the action's values → `float`: seven increments."""
        return dict.fromkeys(Increments.features, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """Return nothing."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Return True between `connect` and `disconnect`."""
        return self._stack is not None

    @property
    def is_calibrated(self) -> bool:
        """Return True."""
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    def send_feedback(self, feedback: dict[str, float]) -> None:
        """Do nothing."""

    def connect(self, calibrate: bool = True) -> None:
        """Serve the page and log its address.

        Raises:
            DeviceAlreadyConnectedError: it is already served.
            InputError: the port is not free.
        """
        if self._stack is not None:
            raise DeviceAlreadyConnectedError(f"{self} is already connected.")
        with ExitStack() as stack:
            title = "dVRK, driven by LeRobot"
            self._page = stack.enter_context(
                WebView(tuple(self.config.views), title, self.config.port)
            )
            self._stack = stack.pop_all()
        self._device: Device = self._page
        for line in self._page.server.invitation:
            logger.warning(line)  # LeRobot's scripts hide lower levels

    def disconnect(self) -> None:
        """Close the page.

        Raises:
            DeviceNotConnectedError: it is not served.
        """
        if self._stack is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        stack = self._stack
        self._stack = None
        stack.close()

    def get_action(self) -> dict[str, float]:
        """Return the increments of the held inputs, and a requested start."""
        if self._stack is None:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect() first.")
        given = self._device.poll()
        arm = BOARD.arm or self.config.arm
        if arm != self._arm:
            self._arm = arm
            self._jaw_remaining = 0.0
        values = self._increments(given)
        self._steps += 1
        self._show(given)
        action = dict(zip(Increments.features, values, strict=True))
        if DISCARD in given.events:
            action[RESET] = SAME
        elif KEEP in given.events or START in given.events:
            action[RESET] = NEXT
        return action

    def _increments(self, given: Input) -> list[float]:
        """Return the seven increments for an input."""
        speed = self.config.speed * (FINE if given.fine else 1.0)
        axes = self._axes()
        moved = axes @ _limited(given.move) * speed
        turned = axes @ _limited(given.turn) * speed
        values = [*moved.tolist(), *turned.tolist(), self._jaw(given, speed)]
        return [min(max(value, -1.0), 1.0) for value in values]

    def _axes(self) -> NDArray[np.float64]:
        """Return the image's axes, x right, y down, z away, in the active arm's base (3, 3)."""
        if self.config.axes == "base":
            return np.eye(3)
        base = poses.flat(kinematics.base_in_world(PSM_NAMES[self._arm]))
        view = np.reshape(poses.rotation(T_WORLD_VIEW), (3, 3)) * [-1.0, -1.0, 1.0]
        found: NDArray[np.float64] = np.reshape(poses.rotation(base), (3, 3)).T @ view
        return found

    def _jaw(self, given: Input, speed: float) -> float:
        """Return the jaw's increment: from the held input, or the rest of a toggle."""
        if JAW in given.events:
            goal = 0.0 if BOARD.jaw > CLOSE_ABOVE else OPENED
            self._jaw_remaining = (goal - BOARD.jaw) / self._jaw_step
        if given.jaw:
            self._jaw_remaining = 0.0
            return given.jaw * speed
        move = min(max(self._jaw_remaining, -1.0), 1.0)
        self._jaw_remaining -= move
        return move

    def _show(self, given: Input) -> None:
        """Show the robot's latest observation."""
        now = time.monotonic()
        if now - self._shown < SHOWN_S or not self._page.wants_image():
            return
        self._shown = now
        status = Status(
            state="driving",
            message=BOARD.message,
            success=BOARD.success,
            episode=0,
            seed=0,
            kept=0,
            discarded=0,
            skipped=0,
            steps=self._steps,
            limit=0,
            subtask="",
            arm=self._arm.lower(),
            distance=0.0,
            angle=0.0,
            contact=False,
            view=self.config.views[0] if self.config.views else "",
            fine=given.fine,
        )
        images = {view: image for view, image in BOARD.images.items() if view in self.config.views}
        self._page.show(images, status)


def _limited(vector: Vector) -> NDArray[np.float64]:
    """Limit a vector's length to 1, so that a diagonal is no faster than an axis."""
    array: NDArray[np.float64] = np.array(vector, dtype=np.float64)
    return array / max(1.0, float(np.linalg.norm(array)))
