"""Search expert: demonstrates grasps without knowing which point of the needle is the goal.

The goal of a grasp is a point of the needle drawn from 5° to 20° of its arc (2.7 mm), which no
image shows. The tolerance is 1 mm: a grasp in the middle covers at most 11.3° of those 15°, and one
that is 1 mm off covers less. `SearchExpert` grasps in the middle. If the episode has not ended by
the next of its `ATTEMPTS`, it opens and grasps at another angle, also beyond the range, since a
learner does not grasp exactly where it aims. The goals on a needle of another arc lie further along
it (`Stitch.grasps`), and so do the attempts.

Its labels depend only on the images and on the time, so a policy with a clock can learn them
(`benchmarks/grasp_ceiling.py` measures each way). It continues after a success (`persists`), so
that every demonstration shows every attempt. In every other subtask it is the expert.
"""

import math

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.config import CLOCK_PERIOD, SECOND_ATTEMPT_STEP
from surgicai_vision.demos.demonstrator import ON_AIM, Demonstrator, Miss
from surgicai_vision.demos.expert import (
    HOVER,
    OPEN_ABOVE,
    Expert,
    ToolTarget,
    WorldState,
    action_towards,
    approach_and_grasp,
)
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.geometry import grasp_in_needle
from surgicai_vision.envs.starts import GRASP_ANGLES


class SearchExpert(Demonstrator):
    """The expert without the goal of the grasp.

    Args:
        env: the env.
    """

    ATTEMPTS = (12.5, 6.5, 18.5, 2.5, 22.5)
    """Angles at which a needle of 120° is grasped, one attempt after another [deg]."""
    OPENING_STEPS = 8
    OPEN_JAW = 0.22
    """Control steps for which the jaws open before another attempt, and how far [rad], to slide
    along the needle.

    What is done depends on the step, not on what was done before, because a policy without memory
    could not distinguish opening jaws from closing jaws.
    """

    def __init__(self, env: SuturingEnv):
        self.env = env
        self._expert = Expert(env)

    @property
    def persists(self) -> bool:
        """Return True in grasps, whose demonstrations continue to the episode's last step."""
        return self.env.task == "grasp"

    def action(self) -> NDArray[np.float32]:
        """Return the next action for the env's present state, (7,) in [-1, 1]."""
        return self.missing(ON_AIM)

    def missing(self, miss: Miss) -> NDArray[np.float32]:
        """Return the action, (7,), were every attempt that much further along the needle."""
        if self.env.subtask.name != "grasp":
            return self._expert.missing(miss)
        world = WorldState(self.env, miss)
        return action_towards(world, self._target(world, self.env.simulation.task_state.steps))

    def _target(self, world: WorldState, step: int) -> ToolTarget:
        """Grasp the needle as the present attempt does, or open before a new one."""
        period, steps_into_period = divmod(step - SECOND_ATTEMPT_STEP, CLOCK_PERIOD)
        attempt = min(max(0, period + 1), len(self.ATTEMPTS) - 1)
        if attempt and steps_into_period < self.OPENING_STEPS:
            return ToolTarget(world.command, self.OPEN_JAW)
        moved = world.stitch.grasps(*GRASP_ANGLES)[0] - GRASP_ANGLES[0]
        angle = moved + math.radians(self.ATTEMPTS[attempt]) + world.miss
        goal = world.needle @ grasp_in_needle(world.arm, angle, radius=world.stitch.radius)
        if attempt:
            return approach_and_grasp(world, goal, 0.0, self.OPEN_JAW)
        return approach_and_grasp(world, goal, HOVER, OPEN_ABOVE)
