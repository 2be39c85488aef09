"""Agents: the expert, the baselines, blind replay, and a policy with its frozen encoder."""

import functools
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import FULL_SPEED, Pace, clock
from surgicai_vision.core.errors import UnreachablePose
from surgicai_vision.demos.demonstrator import make_demonstrator
from surgicai_vision.evaluation.agent import (
    Actions,
    Agent,
    FeatureTable,
    Observation,
    Robot,
    frame_of,
    image_of,
    simulated,
)
from surgicai_vision.evaluation.pace import at_pace
from surgicai_vision.evaluation.policy_clock import PolicyClock
from surgicai_vision.training.progress_input import PROGRESS_AT
from surgicai_vision.training.threads import one_thread

if TYPE_CHECKING:
    from encoders.base import Encoder
    from policies.base import Policy
    from surgicai_vision.demos.demonstrator import Demonstrator

EXPERT = "expert"
RECOVER = "recover"
"""The expert, and the expert of the whole procedure that goes back after a loss."""


@final
class ExpertAgent(Agent):
    """A scripted expert: reads the env's state, needs no images.

    Args:
        name: which one, a key of `demos.demonstrator.DEMONSTRATORS`.
    """

    privileged = True

    def __init__(self, name: str = EXPERT) -> None:
        self.name = self._kind = name
        self._experts: dict[int, Demonstrator] = {}

    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Make an expert for the slot's episode."""
        self._experts[slot] = make_demonstrator(self._kind, simulated(robot))

    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return the experts' actions (n, 7); NaN where an expert's next pose is unreachable."""
        actions = np.full((len(slots), 7), np.nan, np.float32)
        for row, slot in enumerate(slots):
            try:
                actions[row] = self._experts[slot].action()
            except UnreachablePose:
                continue
        return actions


@final
class RandomAgent(Agent):
    """Uniform actions, drawn from the episode's own seed."""

    name = "random"

    def __init__(self) -> None:
        self._generators: dict[int, np.random.Generator] = {}

    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Seed the slot's generator."""
        self._generators[slot] = np.random.default_rng(seed)

    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return actions (n, 7) in [-1, 1]."""
        return np.stack(
            [self._generators[slot].uniform(-1, 1, 7).astype(np.float32) for slot in slots]
        )


@final
class ZeroAgent(Agent):
    """Zero actions."""

    name = "zero"

    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Nothing to forget."""

    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return zeros (n, 7)."""
        return np.zeros((len(slots), 7), np.float32)


@final
class ReplayAgent(Agent):
    """Blind replay: the same actions in every episode, then zeros.

    Args:
        actions: (T, 7), one for each control step.
    """

    name = "replay"

    def __init__(self, actions: NDArray[np.float32]):
        self._actions = np.concatenate([actions, np.zeros((1, 7), np.float32)])
        self._steps: dict[int, int] = {}

    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Start from the first action."""
        self._steps[slot] = 0

    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return the actions of the slots' steps (n, 7)."""
        steps = [min(self._steps[slot], len(self._actions) - 1) for slot in slots]
        self._steps.update({slot: self._steps[slot] + 1 for slot in slots})
        return self._actions[steps]


def mean_demonstration(
    action: NDArray[np.generic], episode_index: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Return the mean action of each control step (T, 7).

    The mean is over the demonstrations that still run at that step.

    Args:
        action: (N, 7) actions of all frames.
        episode_index: (N,) their episodes.
    """
    actions = action.astype(np.float32, copy=False)
    episodes = [actions[episode_index == episode] for episode in np.unique(episode_index)]
    longest = max(map(len, episodes))
    steps = [
        np.mean([e[step] for e in episodes if len(e) > step], axis=0) for step in range(longest)
    ]
    return np.stack(steps).astype(np.float32)


VECTORS: Mapping[str, Callable[[Robot], NDArray[np.float32]]] = MappingProxyType(
    {
        names.STATE: lambda robot: robot.agent_pos(),
        names.SETPOINT: lambda robot: robot.setpoint(),
        names.BOTH_ARMS: lambda robot: robot.both_arms(),
        names.PRIVILEGED_STATE: lambda robot: simulated(robot).state_vector(),
        names.RELATIVE_STATE: lambda robot: simulated(robot).relative_state(),
    }
)
"""Inputs besides features that a policy may get from its robot.

The clock and the progress come from the agent itself and are appended last.
"""

BASELINES: Mapping[str, Callable[[], Agent]] = MappingProxyType(
    {
        EXPERT: ExpertAgent,
        RECOVER: functools.partial(ExpertAgent, RECOVER),
        RandomAgent.name: RandomAgent,
        ZeroAgent.name: ZeroAgent,
    }
)
"""Name → agent that needs no checkpoint."""


@final
class PolicyAgent(Agent):
    """A trained policy; it sees the images of its views and the measured pose of its tip.

    Args:
        name: its name in tables.
        policy: has `act(features (B, F) or None, agent_pos (B, 7)) -> (B, 7)`.
        encoder: frames (B, H, W, 3) → features (B, dim), or None for a policy without images.
        views: the policy's views, in the order of its features.
        image_size: height and width the policy was trained on [px].
        vector: its inputs besides features, keys of `policies.base.VECTORS`.
        progress: predicts the progress, for a policy with `names.PROGRESS` as an input.
        action_repeat: control steps for which an action was held in its training.
        pace: how fast it acts.
    """

    def __init__(
        self,
        name: str,
        policy: "Policy",
        encoder: "Encoder | None",
        views: tuple[str, ...],
        image_size: int,
        vector: tuple[str, ...] = (names.STATE,),
        progress: "PolicyAgent | None" = None,
        action_repeat: int = 1,
        pace: Pace = FULL_SPEED,
    ):
        self.name = name
        self.views = views
        self.image_size = image_size
        seen = (*views, *(progress.views if progress else ()))
        self.cameras = tuple(dict.fromkeys(map(names.camera_of, seen)))
        self.depth = any(map(names.is_depth_view, seen))
        self.privileged = not set(vector).isdisjoint(names.STATES_WITH_GOAL)
        self.policy = policy
        self._encoder = encoder
        self._told = tuple(VECTORS[key] for key in vector if key in VECTORS)
        self._clocked = names.CLOCK in vector
        self._progress = progress
        self.action_repeat = action_repeat
        self.pace = pace
        self._ticks: dict[int, int] = {}
        self._clocks: dict[int, PolicyClock] = {}
        self._shared: FeatureTable | None = None

    def share(self, features: FeatureTable) -> None:
        """Look features up in a table that agents share, and put new ones there."""
        self._shared = features
        if self._progress is not None:
            self._progress.share(features)

    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Start the slot's clock; the policy has no other memory."""
        self.restart(slot)

    def restart(self, slot: int) -> None:
        """Restart the slot's clock: a subtask begins."""
        self._ticks[slot] = 0
        self._clocks[slot] = self.new_clock()

    def new_clock(self) -> PolicyClock:
        """Return a clock that begins with a subtask and runs at the policy's pace."""
        return PolicyClock(self.pace, self.action_repeat)

    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return the policy's actions (n, 7), at its pace."""
        times = self.times(slots, robots)
        return at_pace(self.answer(robots, observations, times), robots, self.pace)

    def times(self, slots: Sequence[int], robots: Sequence[Robot]) -> list[float]:
        """Return what each slot's clock says, and let it run on; called once for each action."""
        times = [
            self._clocks[slot].read(self._ticks[slot], robot)
            for slot, robot in zip(slots, robots, strict=True)
        ]
        self._ticks.update({slot: self._ticks[slot] + 1 for slot in slots})
        return times

    def answer(
        self,
        robots: Sequence[Robot],
        observations: Sequence[Observation],
        times: Sequence[float] | None = None,
    ) -> NDArray[np.float32]:
        """Return the policy's answers (n, …): actions, or a high-level policy's logits.

        Args:
            robots: the robots, for proprioception.
            observations: their observations.
            times: what each robot's clock says (`PolicyClock`), for a policy with a clock.
        """
        with one_thread():
            vectors = self.vectors(robots, observations, times)
            return np.asarray(self.policy.act(self.features(observations), vectors), np.float32)

    def vectors(
        self,
        robots: Sequence[Robot],
        observations: Sequence[Observation],
        times: Sequence[float] | None = None,
    ) -> NDArray[np.float32]:
        """Return the inputs besides the features, (n, …); see `answer`."""
        vectors = np.stack(
            [np.concatenate([told(robot) for told in self._told]) for robot in robots]
        )
        if self._clocked and times is not None:
            vectors = np.concatenate([vectors, clock(np.array(times))], axis=1, dtype=np.float32)
        if self._progress is not None:
            said = self._progress.answer(robots, observations)[:, PROGRESS_AT:]
            vectors = np.concatenate([vectors, said], axis=1, dtype=np.float32)
        return vectors

    def features(self, observations: Sequence[Observation]) -> NDArray[np.float32] | None:
        """Encode all views of all slots in one call, (n, views · dim)."""
        encoder = self._encoder
        if encoder is None:
            return None
        known: FeatureTable = {} if self._shared is None else self._shared
        keys = [
            [(encoder.fingerprint, view, id(observation)) for view in self.views]
            for observation in observations
        ]
        new = {
            key: _image(observation, view)
            for observation, row in zip(observations, keys, strict=True)
            for view, key in zip(self.views, row, strict=True)
            if key not in known
        }
        if new:
            features = np.asarray(encoder(np.stack(list(new.values()))), np.float32)
            known.update(zip(new, features.reshape(len(new), -1), strict=True))
        return np.stack([np.concatenate([known[key] for key in row]) for row in keys])


def _image(observation: Observation, view: str) -> NDArray[np.uint8]:
    """Return what a policy sees of a view, (height, width, 3)."""
    if names.is_depth_view(view):
        from surgicai_vision.dataset.codecs import grey

        return grey(frame_of(observation, view).astype(np.float32, copy=False))
    return image_of(observation, view)
