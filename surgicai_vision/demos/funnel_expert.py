"""Funnel expert: demonstrates handoffs without a place at which to wait.

The expert lines its jaws up 9 mm before the needle and goes in once they are off by little more
than a millimetre; otherwise it goes back. A policy that sees the needle to about a millimetre never
knows that they are, and stands there until time is up (docs/results/unmoved.md). `FunnelExpert`
goes in along a cone: how far before the grasp it holds the jaws grows with how far they are off, so
that its labels change gradually with what is seen. In every other subtask it is the expert.
"""

import math

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.demos.demonstrator import Demonstrator
from surgicai_vision.demos.expert import (
    ALIGNED,
    ALIGNED_ANGLE,
    HANDOFF_BACK,
    OPEN_HANDOFF,
    Expert,
    Offset,
    ToolTarget,
    WorldState,
    action_towards,
    before,
    close_when_there,
    handoff_goal,
    offset_from,
)
from surgicai_vision.envs.base import SuturingEnv

WIDE = 0.004
WIDE_ANGLE = math.radians(24.0)
"""Off by so much the jaws are held `HANDOFF_BACK` before the grasp [m, rad]; off by `ALIGNED` and
`ALIGNED_ANGLE` they go all the way in."""


class FunnelExpert(Demonstrator):
    """The expert that goes in gradually where it takes the needle over.

    Args:
        env: the env.
    """

    def __init__(self, env: SuturingEnv):
        self.env = env
        self._expert = Expert(env)

    def action(self) -> NDArray[np.float32]:
        """Return the next action for the env's present state, (7,) in [-1, 1]."""
        if self.env.subtask.name != "handoff":
            return self._expert.action()
        world = WorldState(self.env)
        return action_towards(world, _target(world))


def _target(world: WorldState) -> ToolTarget:
    """Close where the jaws are at the grasp, else go as far in as they are lined up."""
    goal = handoff_goal(world)
    off = offset_from(world, goal)
    closed = close_when_there(world, goal, off, OPEN_HANDOFF)
    return closed or ToolTarget(before(goal, HANDOFF_BACK * misalignment(off)), OPEN_HANDOFF)


def misalignment(off: Offset) -> float:
    """Return how far jaws are out of line: 0 (`ALIGNED`) to 1 (`WIDE`), the worse of both."""
    beside = (off.beside - ALIGNED) / (WIDE - ALIGNED)
    turned = (off.turned - ALIGNED_ANGLE) / (WIDE_ANGLE - ALIGNED_ANGLE)
    return min(max(beside, turned, 0.0), 1.0)
