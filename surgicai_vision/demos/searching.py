"""Searching: an expert that does not know which point of the needle is asked for, as a policy does not.

The goal of a grasp is a point of the needle drawn from 5° to 20° (2.7 mm of its arc), which no picture shows. Success
is 1 mm: whoever takes the needle in the middle meets at most 11.3° of those 15°. `Searcher` takes it at 8.75°, and
where the episode then has not ended by its step `AGAIN`, opens, and takes it at 16.25°: each attempt reaches 5.6° to
both sides. Its labels depend on what is seen and on the time, so that a policy with a clock can learn them
(`benchmarks/grasp_ceiling.py` measures both ways). In every other subtask it is the expert.
"""

import math

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.demos.expert import HOVER, OPEN_ABOVE, Expert, Sight, Wish, take, toward
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.geometry import grasp_in_needle

BESIDE = 0.004
"""How far back the jaws go before the second attempt [m]."""


class Searcher:
    """The expert without the goal of the grasp; made anew for every episode.

    Args:
        env: the env.
    """

    ATTEMPTS = (math.radians(8.75), math.radians(16.25))
    """Needle angles of the two attempts [rad]: the quarters of the range 5° to 20°."""
    AGAIN = 95
    """Control step of the second attempt: the expert's own grasp takes 70 to 85."""

    def __init__(self, env: SuturingEnv):
        self.env, self._expert = env, Expert(env)
        self._opened = False

    def action(self) -> NDArray[np.float32]:
        """Return the next action for the env's present state, (7,) float32 in [-1, 1]."""
        if self.env.subtask.name != "grasp":
            return self._expert.action()
        scene = Sight(self.env)
        return toward(scene, self._grasp(scene, self.env.simulation.memory.steps >= self.AGAIN))

    def _grasp(self, scene: Sight, again: bool) -> Wish:
        """Take the needle at the first angle, later at the second; open in between."""
        if again and not self._opened:
            if scene.command_jaw < OPEN_ABOVE - scene.step.jaw:
                return Wish(scene.command, OPEN_ABOVE)
            self._opened = True
        goal = scene.needle @ grasp_in_needle(scene.arm, self.ATTEMPTS[int(again)])
        return take(scene, goal, BESIDE if again else HOVER, OPEN_ABOVE)
