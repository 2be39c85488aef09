"""An agent that sees through a corruption (`core.corruption`).

The env, its rewards and its films stay clean.
"""

import functools
from collections.abc import Sequence
from typing import final

from surgicai_vision.core.cameras import camera_number
from surgicai_vision.core.corruption import Change, Image, Moment
from surgicai_vision.core.lazy import LazyMapping
from surgicai_vision.evaluation.agent import (
    Actions,
    Agent,
    Observation,
    Robot,
    WrappedAgent,
    frame_of,
    image_of,
)


@final
class CorruptedAgent(WrappedAgent):
    """An agent that sees through a corruption.

    Args:
        agent: who acts.
        change: one of `CORRUPTIONS`.
        strength: 0 to 1.
    """

    def __init__(self, agent: Agent, change: Change, strength: float):
        super().__init__(agent)
        self._change = change
        self._strength = strength
        self._seeds: dict[int, int] = {}
        self._steps: dict[int, int] = {}

    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Count the slot's steps from 0."""
        self._seeds[slot] = seed
        self._steps[slot] = 0
        super().reset(slot, robot, seed)

    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return the agent's actions (n, 7) on what it sees."""
        seen = [
            self._seen(slot, observation)
            for slot, observation in zip(slots, observations, strict=True)
        ]
        for slot in slots:
            self._steps[slot] += 1
        return self.agent.act(slots, robots, seen)

    def _seen(self, slot: int, observation: Observation) -> Observation:
        """Return an observation whose images are corrupted when they are accessed."""
        if not self.cameras:
            return observation
        moments = {
            view: Moment(self._seeds[slot], self._steps[slot], camera_number(view), self.part(view))
            for view in self.cameras
        }

        def changed(view: str) -> Image:
            return self._change(image_of(observation, view), self._strength, moments[view])

        makers = {
            key: functools.partial(changed, key)
            if key in moments
            else functools.partial(frame_of, observation, key)
            for key in observation
        }
        return LazyMapping(makers, {})
