"""Steering: the action that an input means, in the axes of a camera or of the tool, for the arm
that is active.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.envs.control import StepSize
from surgicai_vision.scene.cameras import extrinsics
from surgicai_vision.teleoperation.inputs import JAW, Input, Vector

FRAMES = ("camera", "tool")
FINE = 0.2
"""Speed with the fine modifier, as a share of the usual."""
CLOSE_ABOVE, OPENED = 0.05, 0.4
"""The toggle closes a jaw that is open by more than the first, else opens it to the second [rad]:
room for the needle (0.7 mm) and little else between the pads."""


class Steering:
    """Makes actions of inputs, for the arm that is active.

    Args:
        env: the env.
        frame: "camera", the axes of the leading view, or "tool".
        speed: share of the step size that a full deflection commands, in (0, 1].
    """

    def __init__(self, env: Any, frame: str = "camera", speed: float = 0.5):
        check_name("frame", frame, FRAMES)
        if not 0.0 < speed <= 1.0:
            raise InputError(f"speed is {speed:g}; it must be above 0 and at most 1.")
        self.env, self.frame, self.speed = env, frame, speed
        self._jaw_step = StepSize.of(env.config.step).jaw
        self._jaw_due, self._arm = 0.0, ""

    def reset(self) -> None:
        """Forget a jaw under way: a new attempt begins."""
        self._jaw_due, self._arm = 0.0, ""

    @property
    def busy(self) -> bool:
        """Say whether the jaw is still under way after a toggle."""
        return self._jaw_due != 0.0

    def action(self, given: Input, view: str) -> NDArray[np.float32]:
        """Return the action (7,) in [-1, 1] of an input while `view` leads."""
        arm = self.env.subtask.arm
        if arm != self._arm:
            self._jaw_due, self._arm = 0.0, arm
        speed = self.speed * (FINE if given.fine else 1.0)
        rotation = self.axes(view)
        motions = [speed * rotation @ _limited(vector) for vector in (given.move, given.turn)]
        action: NDArray[np.float32] = np.array(
            [*np.concatenate(motions), self._jaw(given, speed)], dtype=np.float32
        )
        return np.clip(action, -1.0, 1.0)

    def axes(self, view: str) -> NDArray[np.float64]:
        """Return the frame's axes in the base of the active arm, (3, 3), while `view` leads."""
        arm = self.env.subtask.arm
        simulation = self.env.simulation
        if self.frame == "tool":
            return np.array(simulation.commands[arm].pose[3:]).reshape(3, 3)
        base = np.array(simulation.bases[arm][3:]).reshape(3, 3)
        camera: NDArray[np.float64] = extrinsics(self.env.model, self.env.data, view)[:3, :3]
        return base.T @ camera

    def _jaw(self, given: Input, speed: float) -> float:
        """Return the jaw's part of the action [steps]: what is held, else what a toggle still
        owes.
        """
        if JAW in given.events:
            now = float(self.env.simulation.commands[self._arm].jaw)
            self._jaw_due = ((0.0 if now > CLOSE_ABOVE else OPENED) - now) / self._jaw_step
        if given.jaw:
            self._jaw_due = 0.0
            return given.jaw * speed
        move = min(max(self._jaw_due, -1.0), 1.0)
        self._jaw_due -= move
        return move


def _limited(vector: Vector) -> NDArray[np.float64]:
    """Return a vector no longer than 1: a diagonal is no faster than an axis."""
    array: NDArray[np.float64] = np.array(vector, dtype=np.float64)
    return array / max(1.0, float(np.linalg.norm(array)))
