"""A policy that plans chunks, in an evaluation.

Interface:

* `ChunkAgent(policy, senses, step)`: an agent; `senses` is the same policy's `PolicyAgent`, which
  reads vectors and features and never acts.

Each slot plans by itself, in a batch of one, with random numbers drawn from its own seed and step.
A result therefore depends neither on the batch nor on the processes. An image is read and encoded
when its observation arrives, and only if this plan or a later one needs it: an env that renders
images on access cannot show one later. `restart` forgets what is planned.

With `ChunkRecipe.measure_delay` it measures how late its actions take effect (`evaluation.delay`).
Where the delay is d, the observation of step t shows what t - d actions have done. The policy is
then told the time t - d, and of its plan, which begins there, the action d steps ahead is executed.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import NDArray

from policies.chunks import ChunkPolicy
from surgicai_vision.evaluation.agent import Actions, Agent, FeatureTable, Observation, Robot
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.evaluation.delay import DelayMeter
from surgicai_vision.evaluation.pace import at_pace
from surgicai_vision.evaluation.policy_clock import PolicyClock
from surgicai_vision.training.threads import one_thread

SEED_STRIDE = 1_000_003
"""A prime beyond any step limit: no two steps of two episodes draw the same numbers."""


@dataclass(frozen=True)
class _Moment:
    """What is kept of an observation.

    Attributes:
        features: of its images (F,), float32; None where no plan needs them, or without views.
        vector: the other inputs (n,).
    """

    features: NDArray[np.float32] | None
    vector: NDArray[np.float32]


@dataclass
class _Episode:
    """What a slot remembers.

    Attributes:
        seed: the episode's.
        tick: actions since its subtask began.
        meter: measures the delay; None if it is not asked for.
        past: the last moments, the present one last.
        clock: tells the policy the time.
        plans: (tick at which its first action is due, its actions (chunk, 7)), the oldest first.
    """

    seed: int
    past: deque[_Moment]
    clock: PolicyClock
    tick: int = 0
    meter: DelayMeter | None = None
    plans: list[tuple[int, NDArray[np.float32]]] = field(default_factory=list)

    @property
    def late(self) -> int:
        """By how many actions the newest observation is behind those sent."""
        return 0 if self.meter is None else min(self.meter.delay, self.tick)


@final
class ChunkAgent(Agent):
    """Plans a chunk of actions, executes its beginning and plans anew.

    Args:
        policy: makes the plans.
        senses: reads the same policy's features and vectors.
        step: way that an action of 1 commands in a control step [m]; a delay is measured by it.
    """

    def __init__(self, policy: ChunkPolicy, senses: PolicyAgent, step: float):
        self.name = senses.name
        self.cameras = senses.cameras
        self.image_size = senses.image_size
        self.depth = senses.depth
        self.privileged = senses.privileged
        self._policy = policy
        self._senses = senses
        self._sees = bool(senses.views)
        self._step = step * senses.action_repeat
        # Actions, not control steps, from one observation of the history to the next.
        self._spacing = policy.spacing // senses.action_repeat
        self._episodes: dict[int, _Episode] = {}

    def share(self, features: FeatureTable) -> None:
        """Look features up in a table that agents share, and put new ones there."""
        self._senses.share(features)

    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Forget everything; random numbers are drawn from `seed`."""
        self._begin(slot, seed)

    def _begin(self, slot: int, seed: int) -> None:
        """Give the slot a new memory."""
        moments = (self._policy.history - 1) * self._spacing + 1
        longest = self._policy.chunk - 1  # the delay that a chunk spans
        meter = DelayMeter(self._step, longest) if self._policy.measure_delay else None
        clock = self._senses.new_clock()
        self._episodes[slot] = _Episode(seed, deque(maxlen=moments), clock, meter=meter)

    def restart(self, slot: int) -> None:
        """Forget what the slot has planned and seen: its subtask begins."""
        self._begin(slot, self._episodes[slot].seed)

    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return the planned actions of this step (n, 7), at the policy's pace."""
        episodes = [self._episodes[slot] for slot in slots]
        for episode, robot in zip(episodes, robots, strict=True):
            if episode.meter is not None:
                episode.meter.see(robot.agent_pos())
        with one_thread():
            times = [
                episode.clock.read(episode.tick - episode.late, robot)
                for episode, robot in zip(episodes, robots, strict=True)
            ]
            vectors = self._senses.vectors(robots, observations, times)
            features = self._features(episodes, observations)
            for episode, seen, vector in zip(episodes, features, vectors, strict=True):
                episode.past.append(_Moment(seen, vector))
            self._plan([episode for episode in episodes if self._is_due(episode.tick)])
        actions = np.stack([self._action(episode) for episode in episodes])
        executed = at_pace(actions, robots, self._senses.pace)
        for episode, action in zip(episodes, executed, strict=True):
            episode.tick += 1
            if episode.meter is not None:
                episode.meter.send(action)
        return executed

    def _is_due(self, tick: int) -> bool:
        """Return True if a plan is made at `tick`: every `execute` actions, from 0 on."""
        return tick % self._policy.execute == 0

    def _is_planned_from(self, tick: int) -> bool:
        """Return True if a plan made at `tick` or later sees the observation of `tick`."""
        moments = range(self._policy.history)
        return any(self._is_due(tick + moment * self._spacing) for moment in moments)

    def _features(
        self, episodes: Sequence[_Episode], observations: Sequence[Observation]
    ) -> list[NDArray[np.float32] | None]:
        """Return each observation's features (F,), None where no plan needs them.

        The images of all slots are encoded at once.
        """
        rows: list[NDArray[np.float32] | None] = [None] * len(episodes)
        needed = [
            row for row, episode in enumerate(episodes) if self._is_planned_from(episode.tick)
        ]
        if self._sees and needed:
            encoded = self._senses.features([observations[row] for row in needed])
            assert encoded is not None, "a policy with views has an encoder"
            for row, features in zip(needed, encoded, strict=True):
                rows[row] = features
        return rows

    def _plan(self, episodes: Sequence[_Episode]) -> None:
        """Plan for some slots, each from its own moments."""
        for episode in episodes:
            history = self._history(episode)
            features = [moment.features for moment in history if moment.features is not None]
            chunk = self._policy.plan(
                np.stack(features)[None] if features else None,
                np.stack([moment.vector for moment in history])[None],
                episode.seed * SEED_STRIDE + episode.tick,
            )[0]
            kept = [(at, plan) for at, plan in episode.plans if episode.tick - at < len(plan)]
            # A slower arm has come less far in the same time.
            ahead = round(episode.late * self._senses.pace.speed)
            episode.plans = [*kept, (episode.tick - ahead, chunk)]

    def _history(self, episode: _Episode) -> list[_Moment]:
        """Return the moments that the policy sees, the present one last.

        At the start, the first moment is repeated for those before it.
        """
        past = episode.past
        back = [
            (len(past) - 1) - moment * self._spacing
            for moment in range(self._policy.history - 1, -1, -1)
        ]
        return [past[max(0, at)] for at in back]

    def _action(self, episode: _Episode) -> NDArray[np.float32]:
        """Return the action of this step (7,), from the newest plan or averaged over all plans.

        Where a delay and `execute` reach beyond a plan's end, its last action is repeated.
        """
        held = [
            plan[episode.tick - begin]
            for begin, plan in episode.plans
            if episode.tick - begin < len(plan)
        ] or [episode.plans[-1][1][-1]]
        if self._policy.ensemble is None:
            newest: NDArray[np.float32] = held[-1]
            return newest
        weights = np.exp(-self._policy.ensemble * np.arange(len(held)))
        return np.asarray(np.average(np.stack(held), axis=0, weights=weights), np.float32)
