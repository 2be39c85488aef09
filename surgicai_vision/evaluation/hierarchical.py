"""Hierarchical policies: the whole procedure by a high-level policy over a policy a subtask.

HLP → LLP → termination → HLP: the high-level policy says which subtask is due, that subtask's
policy moves its arm until the subtask ends, and the high-level policy is asked again. A subtask
ends

* `privileged`: when the env's measured success has held (a grasp's for `grasp_hold` steps), as in
  the released code;
* `learned`: when the high-level policy itself names another subtask, `PATIENCE` observations in a
  row;
* in either case after `steps` control steps (paper: 200).

After `decisions` decisions (paper: 50) both arms hold still.

A hierarchical policy is a YAML file, which `surgicai-vision evaluate hierarchical.yaml` takes
(docs/hierarchical.md):

    hlp: outputs/train/suture-hlp-…   # a checkpoint, or `order`: the subtasks in their order
    grasp: outputs/train/grasp-…      # whatever `evaluate` takes for this subtask
    place: …                          # and so on for insert, handoff, pullout
    termination: privileged
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast, final

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names
from surgicai_vision.core.config import DWELL
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.evaluation.agent import (
    Actions,
    Agent,
    Env,
    FeatureTable,
    MakeAgent,
    Observation,
)
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.training.run_config import TERMINATIONS
from surgicai_vision.training.threads import one_thread

if TYPE_CHECKING:
    from surgicai_vision.envs.suture import Suture

ORDER = "order"
SUFFIXES = (".yaml", ".yml")
GRASP = names.SUBTASKS.index("grasp")
PATIENCE = 5
"""Observations in a row that must name another subtask before a learned termination believes them
(0.1 s).
"""
MAX_STEPS = 2000
"""Control steps of an episode: ten subtasks of full length."""


@dataclass(frozen=True)
class HierarchicalConfig:
    """Who decides, who acts, and when a subtask ends.

    Attributes:
        hlp: folder of the high-level policy's checkpoint, "released:hlp", or "order".
        grasp: what acts in the subtask, a checkpoint's folder, a released policy or a baseline;
            likewise place, insert, handoff and pullout. A file names no code: "module:factory" is
            refused.
        termination: one of `TERMINATIONS`.
        steps: control steps a subtask may take.
        decisions: decisions an episode may take.
        max_steps: control steps an episode may take.
        grasp_hold: control steps a grasp must hold before it ends as `privileged`, at most the
            env's own `DWELL`; a policy that learned to search (`demos.search_expert`) lets go again
            sooner than that.
    """

    hlp: str
    grasp: str
    place: str
    insert: str
    handoff: str
    pullout: str
    termination: str = "privileged"
    steps: int = 200
    decisions: int = 50
    max_steps: int = MAX_STEPS
    grasp_hold: int = DWELL

    def __post_init__(self) -> None:
        check_name("termination", self.termination, TERMINATIONS)
        limits = {"steps": self.steps, "decisions": self.decisions, "max_steps": self.max_steps}
        for name, limit in limits.items():
            if limit < 1:
                raise InputError(f"{name} is {limit}; it must be at least 1.")
        if not 1 <= self.grasp_hold <= DWELL:
            raise InputError(f"grasp_hold is {self.grasp_hold}; allowed: 1 to {DWELL}.")
        if self.hlp == ORDER and self.termination == "learned":
            raise InputError(
                "A learned termination needs a high-level policy; give hlp: a checkpoint folder."
            )

    @property
    def low(self) -> dict[str, str]:
        """Subtask → what acts in it, in the order of the subtasks."""
        policies = (self.grasp, self.place, self.insert, self.handoff, self.pullout)
        return dict(zip(names.SUBTASKS, policies, strict=True))


@dataclass
class _Progress:
    """Where one episode stands.

    Attributes:
        subtask: the one that is on; -1 before the first decision.
        steps: control steps it has taken.
        decisions: decisions taken.
        doubts: observations in a row that named another subtask.
    """

    subtask: int = -1
    steps: int = 0
    decisions: int = 0
    doubts: int = 0


@final
class HierarchicalAgent(Agent):
    """A high-level policy over low-level ones; see the module's docstring.

    It asks the env for nothing but both arms' measured poses and, with a privileged termination,
    whether the present subtask has ended; it tells it which subtask, and so which arm, is on.

    Args:
        config: when a subtask ends.
        low: makes the low-level policies, in the order of the subtasks.
        high: makes the high-level policy; None takes the subtasks in their order.
    """

    name = "hierarchical"

    def __init__(
        self,
        config: HierarchicalConfig,
        low: Sequence[MakeAgent],
        high: Callable[[], PolicyAgent] | None = None,
    ):
        self.config = config
        self._low = [make() for make in low]
        self._high = high() if high is not None else None
        self._agents = [*self._low, *([self._high] if self._high else [])]
        seen = {camera for agent in self._agents for camera in agent.cameras}
        self.cameras = tuple(camera for camera in camera_names() if camera in seen)
        sizes = {agent.image_size for agent in self._agents if agent.cameras}
        if len(sizes) > 1:
            raise InputError(
                f"The policies see images of {sorted(sizes)} pixels; give policies of one size."
            )
        self.image_size = sizes.pop() if sizes else 224
        self._slots: dict[int, _Progress] = {}
        self._features: FeatureTable = {}
        for agent in self._agents:
            agent.share(self._features)

    def reset(self, slot: int, env: Env, seed: int) -> None:
        """Forget the slot's last episode."""
        self._slots[slot] = _Progress()
        for agent in self._low:
            agent.reset(slot, env, seed)

    def act(
        self, slots: Sequence[int], envs: Sequence[Env], observations: Sequence[Observation]
    ) -> Actions:
        """Return the actions (n, 7) of the subtasks that are on, decided anew where one ended."""
        self._features.clear()
        states = [self._slots[slot] for slot in slots]
        with one_thread():
            self._decide(slots, states, cast("Sequence[Suture]", envs), observations)
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
                    [envs[row] for row in rows],
                    [observations[row] for row in rows],
                )
        for state in states:
            state.steps += 1
        return actions

    def _may_act(self, state: _Progress) -> bool:
        """Return True if a decision is still being carried out; else both arms hold still."""
        return state.decisions <= self.config.decisions

    def _decide(
        self,
        slots: Sequence[int],
        states: Sequence[_Progress],
        envs: "Sequence[Suture]",
        observations: Sequence[Observation],
    ) -> None:
        """Ask the high-level policy wherever it is due, and begin what it says."""
        for state, env in zip(states, envs, strict=True):
            if self._has_grasped(state, env):
                env.enter(GRASP + 1)
        asked = [
            row
            for row, state in enumerate(states)
            if self._may_act(state) and self._is_asked(state, envs[row])
        ]
        if not asked:
            return
        chosen = self._choose([envs[row] for row in asked], [observations[row] for row in asked])
        for row, choice in zip(asked, chosen, strict=True):
            state = states[row]
            env = envs[row]
            if self._believes(state, env, choice):
                state.subtask = choice
                state.steps = 0
                state.doubts = 0
                state.decisions += 1
                self._low[choice].restart(slots[row])
            if self._may_act(state):
                env.enter(state.subtask)

    def _is_asked(self, state: _Progress, env: "Suture") -> bool:
        if state.subtask < 0 or state.steps >= self.config.steps:
            return True
        return self.config.termination == "learned" or env.phase != state.subtask

    def _has_grasped(self, state: _Progress, env: "Suture") -> bool:
        """Return True if a grasp has held for `grasp_hold` steps, before the env itself goes on."""
        if self.config.termination != "privileged" or not state.subtask == env.phase == GRASP:
            return False
        return bool(env.dwell >= self.config.grasp_hold)

    def _believes(self, state: _Progress, env: "Suture", choice: int) -> bool:
        """Return True if a choice is a decision; a learned termination must wait for more."""
        if (
            state.subtask < 0
            or state.steps >= self.config.steps
            or self.config.termination == "privileged"
        ):
            return True
        state.doubts = state.doubts + 1 if choice != state.subtask else 0
        return state.doubts >= PATIENCE

    def _choose(self, envs: "Sequence[Suture]", observations: Sequence[Observation]) -> list[int]:
        """Return the subtask that is due in each env."""
        if self._high is None:
            return [env.phase for env in envs]
        return [int(due) for due in self._high.answer(envs, observations).argmax(axis=1)]
