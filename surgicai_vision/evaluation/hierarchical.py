"""Hierarchical policies: the whole procedure by a high-level policy over one policy per subtask.

HLP → LLP → termination → HLP: the high-level policy says which subtask is due, that subtask's
policy moves its arm until the subtask ends, and the high-level policy is queried again. A subtask
ends

* `learned`: when the high-level policy itself names another subtask. It is queried every
  `decide_every` control steps, and believed when it has named the same other subtask `patience`
  times in a row, each time with a probability of at least `confidence`. The env advances when it is
  told to and not before (`TaskConfig.advance`): no measurement of needle or tissue decides
  anything;
* `privileged`: when the env's measured success has held (a grasp's for `grasp_hold` steps), as in
  the released code. This is a control; no robot has this measurement;
* in either case after `steps` control steps (paper: 200): the high-level policy is queried, and its
  most probable subtask begins at once, which may be the same one anew.

After `decisions` decisions (paper: 50) both arms hold still.

A YAML file describes a hierarchical policy; `surgicai-vision evaluate hierarchical.yaml` takes it
(docs/hierarchical.md):

    hlp: outputs/train/suture-hlp-…   # a checkpoint, or `order`: the subtasks in their order
    grasp: outputs/train/grasp-…      # whatever `evaluate` takes for this subtask
    place: …                          # and so on for insert, handoff, pullout
    termination: learned
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, cast, final

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names
from surgicai_vision.core.errors import InputError
from surgicai_vision.evaluation.agent import (
    Actions,
    Agent,
    FeatureTable,
    MakeAgent,
    Observation,
    Robot,
)
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.evaluation.hierarchical_config import HierarchicalConfig
from surgicai_vision.training.threads import one_thread

if TYPE_CHECKING:
    from surgicai_vision.envs.suture import Suture

GRASP = names.SUBTASKS.index("grasp")


@dataclass
class _EpisodeState:
    """State of one episode; replaced with every decision.

    Attributes:
        subtask: the current one; -1 before the first decision.
        steps: control steps it has taken.
        decisions: decisions taken in the episode.
        named: the other subtask that the high-level policy named last; -1 where it named none.
        times: how often in a row it has named it.
    """

    subtask: int = -1
    steps: int = 0
    decisions: int = 0
    named: int = -1
    times: int = 0


@dataclass(frozen=True)
class _Choice:
    """Answer of a high-level policy: a subtask and its probability."""

    subtask: int
    probability: float = 1.0


class _Ends(Protocol):
    """When a subtask ends."""

    def advance(self, state: _EpisodeState, robot: Robot) -> None:
        """Advance the env where a measurement ends the current subtask."""

    def is_asked(self, state: _EpisodeState, robot: Robot) -> bool:
        """Return True if the high-level policy is to be queried now."""

    def believes(self, state: _EpisodeState, choice: _Choice) -> bool:
        """Return True if the policy's answer becomes a decision."""


@final
class _PrivilegedEnds:
    """A subtask ends when the env's measured success has held.

    Args:
        grasp_hold: control steps for which a grasp must hold.
    """

    def __init__(self, grasp_hold: int):
        self._grasp_hold = grasp_hold

    def advance(self, state: _EpisodeState, robot: Robot) -> None:
        """Advance the env from a grasp that has held long enough."""
        leave_held_grasp(_suture(robot), state.subtask, self._grasp_hold)

    def is_asked(self, state: _EpisodeState, robot: Robot) -> bool:
        """Return True if the env has advanced to another subtask."""
        return _suture(robot).phase != state.subtask

    def believes(self, state: _EpisodeState, choice: _Choice) -> bool:
        """Return True: the subtask has ended, whatever comes next."""
        return True


@final
class _LearnedEnds:
    """A subtask ends when the high-level policy keeps naming another one.

    Args:
        config: `confidence`, `patience` and `decide_every`.
        action_repeat: control steps for which an action is held.
    """

    def __init__(self, config: HierarchicalConfig, action_repeat: int):
        self._config = config
        self._action_repeat = action_repeat

    def advance(self, state: _EpisodeState, robot: Robot) -> None:
        """Nothing to advance: no measurement ends a subtask."""

    def is_asked(self, state: _EpisodeState, robot: Robot) -> bool:
        """Return True every `decide_every` control steps, or at the next action after them."""
        return state.steps % self._config.decide_every < self._action_repeat

    def believes(self, state: _EpisodeState, choice: _Choice) -> bool:
        """Return True once the same other subtask has been named often enough in a row."""
        if choice.subtask == state.subtask or choice.probability < self._config.confidence:
            state.named, state.times = -1, 0
            return False
        state.times = state.times + 1 if choice.subtask == state.named else 1
        state.named = choice.subtask
        return state.times >= self._config.patience


def leave_held_grasp(env: "Suture", subtask: int, grasp_hold: int) -> None:
    """Enter the subtask after the grasp, if the grasp is the current subtask and has held.

    Args:
        env: the whole procedure.
        subtask: the subtask whose policy acts.
        grasp_hold: control steps for which a grasp must hold.
    """
    if subtask == env.phase == GRASP and env.dwell >= grasp_hold:
        env.enter(GRASP + 1)


def common_images(agents: Sequence[Agent]) -> tuple[tuple[str, ...], int, bool]:
    """Return what an env in which all of these agents act shows.

    Returns:
        Its cameras, the image size [px], and whether it shows depth too.

    Raises:
        InputError: an agent gives set-points of both arms, or they see images of several sizes.
    """
    if any(agent.action_mode != names.INCREMENTS for agent in agents):
        raise InputError(
            "A low-level policy moves the active arm by increments, but one of these gives "
            "set-points of both arms; evaluate that one by itself."
        )
    sizes = {agent.image_size for agent in agents if agent.cameras}
    if len(sizes) > 1:
        raise InputError(
            f"The policies see images of {sorted(sizes)} pixels; give policies with one image size."
        )
    seen = {camera for agent in agents for camera in agent.cameras}
    cameras = tuple(camera for camera in camera_names() if camera in seen)
    size = sizes.pop() if sizes else Agent.image_size
    return cameras, size, any(agent.depth for agent in agents)


@final
class HierarchicalAgent(Agent):
    """A high-level policy over low-level ones; see the module's docstring.

    It tells its robot the current subtask, and so the active arm, and reads only measured poses
    from it; with a privileged termination, also whether the current subtask has ended.

    Args:
        config: when a subtask ends.
        low: makes the low-level policies, in the order of the subtasks.
        high: makes the high-level policy; None takes the subtasks in their order.
        action_repeat: control steps for which an action is held.
    """

    name = "hierarchical"

    def __init__(
        self,
        config: HierarchicalConfig,
        low: Sequence[MakeAgent],
        high: Callable[[], PolicyAgent] | None = None,
        action_repeat: int = 1,
    ):
        self.config = config
        self._action_repeat = action_repeat
        self._low = [make() for make in low]
        self._high = high() if high is not None else None
        learned = config.termination == "learned"
        self._ends: _Ends = (
            _LearnedEnds(config, action_repeat) if learned else _PrivilegedEnds(config.grasp_hold)
        )
        self._agents = [*self._low, *([self._high] if self._high else [])]
        self.privileged = not learned or any(agent.privileged for agent in self._agents)
        self.cameras, self.image_size, self.depth = common_images(self._agents)
        self._slots: dict[int, _EpisodeState] = {}
        self._features: FeatureTable = {}
        for agent in self._agents:
            agent.share(self._features)

    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Forget the slot's last episode."""
        self._slots[slot] = _EpisodeState()
        for agent in self._low:
            agent.reset(slot, robot, seed)

    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return the actions (n, 7) of the current subtasks; where one has ended, decide anew."""
        self._features.clear()
        states = [self._slots[slot] for slot in slots]
        with one_thread():
            self._decide(slots, states, robots, observations)
        actions = np.zeros((len(slots), len(names.ACTION_NAMES)), np.float32)
        for subtask, agent in enumerate(self._low):
            rows = [
                row
                for row, state in enumerate(states)
                if state.subtask == subtask and self._may_act(state)
            ]
            if rows:
                actions[rows] = agent.act(
                    [slots[row] for row in rows],
                    [robots[row] for row in rows],
                    [observations[row] for row in rows],
                )
        for state in states:
            state.steps += self._action_repeat
        return actions

    def _may_act(self, state: _EpisodeState) -> bool:
        """Return True if a decision is still being carried out; else both arms hold still."""
        return state.decisions <= self.config.decisions

    def _decide(
        self,
        slots: Sequence[int],
        states: list[_EpisodeState],
        robots: Sequence[Robot],
        observations: Sequence[Observation],
    ) -> None:
        """Query the high-level policy wherever it is due, and begin the subtask it decides on.

        Args:
            slots: the running slots.
            states: theirs; replaced in place where a subtask begins.
            robots: theirs.
            observations: theirs.
        """
        for state, robot in zip(states, robots, strict=True):
            self._ends.advance(state, robot)
        due = [
            self._ends.is_asked(state, robot) or self._is_over(state)
            for state, robot in zip(states, robots, strict=True)
        ]
        asked = [row for row, state in enumerate(states) if due[row] and self._may_act(state)]
        if not asked:
            return
        chosen = self._choose([robots[row] for row in asked], [observations[row] for row in asked])
        for row, choice in zip(asked, chosen, strict=True):
            state = states[row]
            if self._is_over(state) or self._ends.believes(state, choice):
                # In the caller's list too, so that the new subtask acts in this very step.
                states[row] = self._slots[slots[row]] = _EpisodeState(
                    choice.subtask, decisions=state.decisions + 1
                )
                self._low[choice.subtask].restart(slots[row])
            if self._may_act(states[row]):
                robots[row].enter(states[row].subtask)

    def _is_over(self, state: _EpisodeState) -> bool:
        """Return True if there is no current subtask, or it has taken all its steps."""
        return state.subtask < 0 or state.steps >= self.config.steps

    def _choose(
        self, robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> list[_Choice]:
        """Return what the high-level policy says for each robot."""
        if self._high is None:
            return [_Choice(_suture(robot).phase) for robot in robots]
        # After the logits it may predict the subtask's progress.
        logits = self._high.answer(robots, observations)[:, : len(names.SUBTASKS)]
        odds = np.exp(logits.astype(np.float64) - logits.max(axis=1, keepdims=True))
        likely = odds.argmax(axis=1)
        return [
            _Choice(int(subtask), float(row[subtask] / row.sum()))
            for subtask, row in zip(likely, odds, strict=True)
        ]


def _suture(robot: Robot) -> "Suture":
    """Return the env that a privileged hierarchical policy is given as its robot."""
    return cast("Suture", robot)
