"""Searching: an expert that does not know which point of the needle is asked for, as a policy does
not.

The goal of a grasp is a point of the needle drawn from 5° to 20° (2.7 mm of its arc), which no
image shows. Success is 1 mm: whoever takes the needle in the middle meets at most 11.3° of those
15°, and who sees it 1 mm off, fewer. `Searcher` takes it in the middle, and where the episode then
has not ended by the next of its `ATTEMPTS`, opens, and takes it at another angle; beyond the range
too, for a learner does not see exactly where it takes it. Its labels depend on what is seen and on
the time, so that a policy with a clock can learn them (`benchmarks/grasp_ceiling.py` measures each
way). It goes on after a success (`persists`), so that every demonstration shows every attempt. In
every other subtask it is the expert.
"""

import math

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.config import CLOCK_PERIOD
from surgicai_vision.demos.expert import HOVER, OPEN_ABOVE, Expert, Sight, Wish, take, toward
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.geometry import grasp_in_needle


class Searcher:
    """The expert without the goal of the grasp; made anew for every episode.

    Args:
        env: the env.
    """

    ATTEMPTS = (12.5, 6.5, 18.5, 2.5, 22.5)
    """Angles at which the needle is taken [deg], one attempt after the other."""
    AGAIN = 100
    """Control step of the second attempt, for the expert's own grasp takes 70 to 85. Another
    follows every `CLOCK_PERIOD`, in which the clock that policies have goes round once."""
    LOOSEN, LOOSE = 8, 0.22
    """Steps for which the jaws open before another attempt, and how far [rad]: to slide along the
    needle.

    What is done depends on the step, not on what was done before: a policy without a memory could
    not tell jaws that open from jaws that close.
    """

    def __init__(self, env: SuturingEnv):
        self.env, self._expert = env, Expert(env)

    @property
    def persists(self) -> bool:
        """Whether a demonstration goes on after its success, to the episode's last step."""
        return self.env.task == "grasp"

    def action(self) -> NDArray[np.float32]:
        """Return the next action for the env's present state, (7,) float32 in [-1, 1]."""
        if self.env.subtask.name != "grasp":
            return self._expert.action()
        scene = Sight(self.env)
        return toward(scene, self._grasp(scene, int(self.env.simulation.memory.steps)))

    def _grasp(self, scene: Sight, step: int) -> Wish:
        """Take the needle as the present attempt does; open before a new one."""
        later, into = divmod(step - self.AGAIN, CLOCK_PERIOD)
        attempt = min(max(0, later + 1), len(self.ATTEMPTS) - 1)
        if attempt and into < self.LOOSEN:
            return Wish(scene.command, self.LOOSE)
        goal = scene.needle @ grasp_in_needle(scene.arm, math.radians(self.ATTEMPTS[attempt]))
        return (
            take(scene, goal, 0.0, self.LOOSE) if attempt else take(scene, goal, HOVER, OPEN_ABOVE)
        )
