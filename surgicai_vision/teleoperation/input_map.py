"""Input mapping: the env's action for an input, in the axes of a camera or of the tool."""

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.envs import poses
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.control import StepSize
from surgicai_vision.scene.cameras import extrinsics
from surgicai_vision.teleoperation.inputs import JAW, Input, Vector

FRAMES = ("camera", "tool")
FINE = 0.2
"""Speed with the fine modifier, as a share of the usual speed."""
CLOSE_ABOVE = 0.05
OPENED = 0.4
"""The toggle closes a jaw that is open by more than the first, and opens any other to the second
[rad]: enough for the needle (0.7 mm) and little else between the pads."""


class InputMapping:
    """Maps inputs to actions of the active arm.

    Args:
        env: the env.
        frame: "camera", the axes of the leading view, or "tool".
        speed: share of the step size that a full deflection commands, in (0, 1].
    """

    def __init__(self, env: SuturingEnv, frame: str = "camera", speed: float = 0.5):
        check_name("frame", frame, FRAMES)
        if not 0.0 < speed <= 1.0:
            raise InputError(f"speed is {speed:g}; it must be above 0 and at most 1.")
        self.env = env
        self.frame = frame
        self.speed = speed
        self._jaw_step = StepSize.of(env.config.step).jaw
        self.reset()

    def reset(self) -> None:
        """Forget a toggle under way: a new attempt starts."""
        self._jaw_remaining = 0.0
        self._arm = ""

    @property
    def is_busy(self) -> bool:
        """Return True while the jaw still moves after a toggle."""
        return self._jaw_remaining != 0.0

    def action(self, user_input: Input, view: str) -> NDArray[np.float32]:
        """Return the action (7,) in [-1, 1] for an input while `view` leads."""
        arm = self.env.subtask.arm
        if arm != self._arm:
            self.reset()
            self._arm = arm
        speed = self.speed * (FINE if user_input.fine else 1.0)
        rotation = self.axes(view)
        motions = [
            speed * rotation @ _limited(vector) for vector in (user_input.move, user_input.turn)
        ]
        action: NDArray[np.float32] = np.array(
            [*np.concatenate(motions), self._jaw(user_input, speed)], dtype=np.float32
        )
        return np.clip(action, -1.0, 1.0)

    def axes(self, view: str) -> NDArray[np.float64]:
        """Return the frame's axes in the base of the active arm, (3, 3), while `view` leads."""
        arm = self.env.subtask.arm
        simulation = self.env.simulation
        if self.frame == "tool":
            return np.reshape(poses.rotation(simulation.commands[arm].pose), (3, 3))
        base = np.reshape(poses.rotation(simulation.bases[arm]), (3, 3))
        camera: NDArray[np.float64] = extrinsics(self.env.model, self.env.data, view)[:3, :3]
        return base.T @ camera

    def _jaw(self, user_input: Input, speed: float) -> float:
        """Return the jaw's part of the action [step]: what is held, or the rest of a toggle."""
        if JAW in user_input.events:
            jaw = float(self.env.simulation.commands[self._arm].jaw)
            goal = 0.0 if jaw > CLOSE_ABOVE else OPENED
            self._jaw_remaining = (goal - jaw) / self._jaw_step
        if user_input.jaw:
            self._jaw_remaining = 0.0
            return user_input.jaw * speed
        move = min(max(self._jaw_remaining, -1.0), 1.0)
        self._jaw_remaining -= move
        return move


def _limited(vector: Vector) -> NDArray[np.float64]:
    """Return a vector no longer than 1: a diagonal is no faster than an axis."""
    array: NDArray[np.float64] = np.array(vector, dtype=np.float64)
    return array / max(1.0, float(np.linalg.norm(array)))
