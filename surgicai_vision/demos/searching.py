"""Searching: an expert that does not know which point of the needle is asked for, as a policy does not.

The goal of a grasp is a point of the needle drawn from 5° to 20° (2.7 mm of its arc), which no picture shows. Success
is 1 mm: whoever takes the needle in the middle meets at most 11.3° of those 15°, and who sees it 1 mm off, fewer.
`Searcher` takes it in the middle, and where the episode then has not ended by the next of its `ATTEMPTS`, opens, and
takes it at another angle; beyond the range too, for a learner does not see exactly where it takes it. Its labels
depend on what is seen and on the time, so that a policy with a clock can learn them (`benchmarks/grasp_ceiling.py`
measures each way). It goes on after a success (`persists`), so that every demonstration shows every attempt. In every
other subtask it is the expert.
"""

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.demos.expert import HOVER, OPEN_ABOVE, Expert, Sight, Wish, take, toward
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.geometry import grasp_in_needle

BESIDE = 0.004
"""How far back the jaws go before another attempt [m]."""


class Searcher:
    """The expert without the goal of the grasp; made anew for every episode.

    Args:
        env: the env.
    """

    ATTEMPTS: Mapping[int, float] = MappingProxyType({0: 12.5, 95: 6.5, 120: 18.5, 145: 2.5, 170: 22.5})
    """Control step from which on the needle is taken at so many degrees: the expert's own grasp takes 70 to 85 steps,
    another attempt about 20."""

    def __init__(self, env: SuturingEnv):
        self.env, self._expert = env, Expert(env)
        self._attempt, self._opened = 0, True

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
        attempt = max(begin for begin in self.ATTEMPTS if begin <= step)
        if attempt != self._attempt:
            self._attempt, self._opened = attempt, False
        if not self._opened:
            if scene.command_jaw < OPEN_ABOVE - scene.step.jaw:
                return Wish(scene.command, OPEN_ABOVE)
            self._opened = True
        goal = scene.needle @ grasp_in_needle(scene.arm, math.radians(self.ATTEMPTS[attempt]))
        return take(scene, goal, BESIDE if attempt else HOVER, OPEN_ABOVE)
