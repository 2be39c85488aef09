"""Recorder: turns what a client does to a served simulation into demonstrations.

An episode lasts from a reset to the judge's success. It has whole states and actions like any other
(`demos.store`), and `render-demos` accepts it. An action is the motion of the active arm's set
point within a control step, in units of the step preset. What a client commands beyond that is
clipped, and these steps are counted. What is done to the other arm is in the states only. Episodes
from starts that are reserved for validation or tests are not recorded (`core.banks`).
"""

import math
from collections.abc import Callable
from typing import final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.banks import TRAINING, USES, bank_of
from surgicai_vision.core.files import code_version
from surgicai_vision.demos.store import Demo
from surgicai_vision.envs import poses
from surgicai_vision.envs.control import Command, StepSize
from surgicai_vision.robot.simulated import SimulatedRobot
from surgicai_vision.scene.rotations import matrix_to_rotvec_flat, multiply_flat, transpose_flat
from surgicai_vision.teleoperation.recordings import Recordings

DEMONSTRATOR = "robot"
ROUNDING = 1e-6
"""How far past 1 an action may be before it counts as clipped."""


def action_between(before: Command, after: Command, step: StepSize) -> NDArray[np.float64]:
    """Return the action (7,) that takes an arm from one command to another (`control.follow`).

    It is not clipped: beyond 1 no action of the preset does this in one step.
    """
    turn = multiply_flat(poses.rotation(after.pose), transpose_flat(poses.rotation(before.pose)))
    shift = np.subtract(poses.position(after.pose), poses.position(before.pose))
    return np.array(
        [
            *(shift / step.translation),
            *(np.array(matrix_to_rotvec_flat(turn)) / step.rotation),
            (after.jaw - before.jaw) / step.jaw,
        ]
    )


@final
class Recorder:
    """Records the episodes of one served simulation.

    Args:
        robot: the simulation.
        recordings: the folder that keeps those that succeed.
        tell: gets the outcome of an episode as text.
    """

    def __init__(self, robot: SimulatedRobot, recordings: Recordings, tell: Callable[[str], None]):
        self._robot = robot
        self._recordings = recordings
        self._tell = tell
        self._step_size = StepSize.of(robot.env.config.step)
        self._is_on = False
        self.begin()

    def begin(self) -> None:
        """Begin an episode, after a reset of the robot; a previous one not kept is dropped."""
        bank = bank_of(self._robot.seed)
        self._is_on = bank == TRAINING
        if not self._is_on:
            self._tell(
                f"start {self._robot.seed} is not kept: it is in {USES[bank]}; request a seed "
                f"below {names.VALIDATION_SEED}"
            )
        self._clipped = 0
        self._states = [self._robot.env.get_state()]
        self._actions: list[NDArray[np.float64]] = []
        self._phases: list[int] = []
        self._rewards: list[float] = []
        self._successes: list[bool] = []
        self._contacts: list[bool] = []

    def before_step(self) -> None:
        """Remember the active arm's set point."""
        env = self._robot.env
        self._phase = env.phase
        self._arm = env.subtask.arm
        self._told = env.simulation.within_reach(self._arm)

    def after_step(self) -> None:
        """Record the step, and keep the episode if it succeeded."""
        if not self._is_on:
            return
        env = self._robot.env
        info = self._robot.info
        action = action_between(self._told, env.simulation.commands[self._arm], self._step_size)
        self._clipped += bool((np.abs(action) > 1.0 + ROUNDING).any())
        self._actions.append(np.clip(action, -1.0, 1.0))
        self._states.append(env.get_state())
        self._phases.append(self._phase)
        self._rewards.append(env.reward(info))
        self._successes.append(bool(info["is_success"]))
        self._contacts.append(bool(info["contact"]))
        if info["physics_error"] or len(self._actions) > env.config.max_steps:
            why = "the physics diverged" if info["physics_error"] else "it took too long"
            self._tell(f"start {self._robot.seed} is not kept: {why}")
            self._is_on = False
        elif info["is_success"]:
            self._keep()

    def _keep(self) -> None:
        """Write the episode; the next one begins with a reset."""
        self._is_on = False
        self._recordings.keep(self.demo())
        share = math.ceil(100.0 * self._clipped / len(self._actions))
        self._tell(
            f"start {self._robot.seed} is kept: {len(self._actions)} steps, {share} % of them "
            "clipped to the step preset"
        )

    def demo(self) -> Demo:
        """Return the episode so far."""
        env = self._robot.env
        return Demo(
            config=env.config,
            seed=self._robot.seed,
            demonstrator=DEMONSTRATOR,
            scene_hash=env.scene.hash,
            code_version=code_version(),
            state=np.stack(self._states).astype(np.float64),
            action=np.stack(self._actions).astype(np.float32),
            phase=np.asarray(self._phases, dtype=np.int8),
            reward=np.asarray(self._rewards, dtype=np.float32),
            success=np.asarray(self._successes, dtype=bool),
            contact=np.asarray(self._contacts, dtype=bool),
        )
