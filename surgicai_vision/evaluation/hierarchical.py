"""Chain: the whole procedure by a high-level policy and one low-level policy for each subtask.

HLP → LLP → termination → HLP: the high-level policy says which subtask is due, that subtask's
policy moves its arm until the subtask ends, and the high-level policy is asked again. A subtask
ends

* `privileged`: when the env's measured success has held (a grasp's for `grasp_hold` steps), as in
  the released code;
* `learned`: when the high-level policy itself names another subtask, `PATIENCE` observations in a
  row;
* in either case after `steps` control steps (paper: 200).

After `decisions` decisions (paper: 50) both arms hold still.

A chain is a YAML file, which `surgicai-vision evaluate chain.yaml` takes (docs/chain.md):

    hlp: outputs/train/suture-hlp-…   # a checkpoint, or `order`: the subtasks in their order
    grasp: outputs/train/grasp-…      # a checkpoint of this subtask, LeRobot's too, or `expert`,
    `random`, `zero` place: …                          # and so on for insert, handoff, pullout
    termination: privileged
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names
from surgicai_vision.core.config import DWELL, TaskConfig, digest, to_mapping
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.evaluation import lerobot_agent
from surgicai_vision.evaluation.agent import Actions, Agent, Env, FeatureTable, Observation
from surgicai_vision.evaluation.agents import BASELINES, PolicyAgent
from surgicai_vision.evaluation.policy_spec import Subject, checkpoint_subject, policy_agent
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource
from surgicai_vision.training.threads import one_thread

ORDER = "order"
GRASP = names.SUBTASKS.index("grasp")
PATIENCE = 5
"""Observations in a row that must name another subtask before a learned termination believes them
(0.1 s).
"""
TERMINATIONS = ("privileged", "learned")
MAX_STEPS = 2000
"""Control steps of an episode: ten subtasks of full length."""


@dataclass(frozen=True)
class Chain:
    """Who decides, who acts, and when a subtask ends.

    Attributes:
        hlp: folder of the high-level policy's checkpoint, or "order".
        grasp: folder of a checkpoint, or a baseline's name; likewise place, insert, handoff and
            pullout.
        termination: one of `TERMINATIONS`.
        steps: control steps a subtask may take.
        decisions: decisions an episode may take.
        max_steps: control steps an episode may take.
        grasp_hold: control steps a grasp must hold before it ends as `privileged`, at most the
            env's own `DWELL`; a policy that learned to search (`demos.searching`) lets go again
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
        for name in ("steps", "decisions", "max_steps"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be at least 1.")
        if not 1 <= self.grasp_hold <= DWELL:
            raise InputError(f"grasp_hold is {self.grasp_hold}; allowed: 1 to {DWELL}.")
        if self.hlp == ORDER and self.termination == "learned":
            raise InputError(
                "A learned termination needs a high-level policy; give hlp: a checkpoint folder."
            )

    @property
    def low(self) -> tuple[str, ...]:
        """The low-level policies in the order of the subtasks."""
        return tuple(getattr(self, subtask) for subtask in names.SUBTASKS)


def subject(chain: Chain, weights: WeightsSource = ANYWHERE) -> Subject:
    """Return the subject of a chain, every checkpoint checked.

    Args:
        chain: who decides and who acts.
        weights: where pretrained weights come from.

    Raises:
        BadFile: a folder that is no checkpoint.
        InputError: a policy of another subtask or scene than it is to act in.
    """
    from surgicai_vision.training.checkpoint import read_checkpoint

    configs = {}
    for subtask, policy in zip(names.SUBTASKS, chain.low, strict=True):
        if policy not in BASELINES:
            configs[subtask] = _low_subject(policy, subtask, weights).config
            if configs[subtask].task != subtask:
                raise InputError(
                    f"{policy} was trained for '{configs[subtask].task}', not for '{subtask}'."
                )
    about: dict[str, Any] = {"chain": to_mapping(chain)}
    if chain.hlp != ORDER:
        checkpoint = read_checkpoint(Path(chain.hlp))
        if checkpoint.policy != "hlp" or checkpoint.task.task != names.SUTURE:
            raise InputError(
                f"{chain.hlp} is '{checkpoint.policy}' of '{checkpoint.task.task}'; hlp: takes an 'hlp'."
            )
        configs["hlp"] = checkpoint.task
    base = configs.values() or [TaskConfig()]
    made = [replace(config, task=names.SUTURE, max_steps=chain.max_steps) for config in base]
    if len(set(made)) > 1:
        raise InputError(
            "The chain's policies were trained in different scenes or with different steps; give one kind."
        )
    about["views"] = list(_views(chain, weights))
    name = f"chain-{chain.termination}-{digest(chain)[:8]}"
    return Subject(name, made[0], functools.partial(ChainAgent, name, chain, weights), about)


def _low_subject(policy: str, subtask: str, weights: WeightsSource) -> Subject:
    """Return the subject of a low-level policy's folder, ours or LeRobot's."""
    lerobot = lerobot_agent.find(Path(policy))
    if lerobot:
        return lerobot_agent.subject(lerobot, subtask, weights)
    return checkpoint_subject(Path(policy), weights)


def _views(chain: Chain, weights: WeightsSource) -> tuple[str, ...]:
    """Every view some policy of the chain sees."""
    from surgicai_vision.training.checkpoint import read_checkpoint

    seen = set() if chain.hlp == ORDER else set(read_checkpoint(Path(chain.hlp)).views)
    for subtask, policy in zip(names.SUBTASKS, chain.low, strict=True):
        if policy not in BASELINES:
            seen.update(_low_subject(policy, subtask, weights).about["views"])
    return tuple(view for view in camera_names() if view in seen)


@dataclass
class _Progress:
    """Where one episode of a chain stands.

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
class ChainAgent(Agent):
    """A high-level policy over low-level ones; see the module's docstring.

    It asks the env for nothing but both arms' measured poses and, with a privileged termination,
    whether the present subtask has ended; it tells it which subtask, and so which arm, is on.
    """

    def __init__(self, name: str, chain: Chain, weights: WeightsSource = ANYWHERE):
        self.name, self.chain = name, chain
        self.cameras = _views(chain, weights)
        self._low: list[Agent] = [
            BASELINES[policy]()
            if policy in BASELINES
            else _low_subject(policy, subtask, weights).make_agent()
            for subtask, policy in zip(names.SUBTASKS, chain.low, strict=True)
        ]
        self._high: PolicyAgent | None = None
        if chain.hlp != ORDER:
            self._high = policy_agent(Path(chain.hlp), weights)
        self._agents = [*self._low, *([self._high] if self._high else [])]
        sizes = {agent.image_size for agent in self._agents if agent.cameras}
        if len(sizes) > 1:
            raise InputError(
                f"The chain's policies see images of {sorted(sizes)} pixels; give policies of one size."
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
        """Return the actions (n, 7) of the subtasks that are on, decided anew where one has
        ended.
        """
        self._features.clear()
        states = [self._slots[slot] for slot in slots]
        with one_thread():
            self._decide(slots, states, envs, observations)
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
        """Say whether a decision is still being carried out; without one both arms hold still."""
        return state.decisions <= self.chain.decisions

    def _decide(
        self,
        slots: Sequence[int],
        states: Sequence[_Progress],
        envs: Sequence[Any],
        observations: Sequence[Any],
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
            state, env = states[row], envs[row]
            if self._believes(state, env, choice):
                state.subtask, state.steps, state.doubts = choice, 0, 0
                state.decisions += 1
                self._low[choice].restart(slots[row])
            if self._may_act(state):
                env.enter(state.subtask)

    def _is_asked(self, state: _Progress, env: Any) -> bool:
        if state.subtask < 0 or state.steps >= self.chain.steps:
            return True
        return self.chain.termination == "learned" or env.phase != state.subtask

    def _has_grasped(self, state: _Progress, env: Any) -> bool:
        """Say whether a grasp has held for as long as this chain asks, before the env itself goes
        on.
        """
        if self.chain.termination != "privileged" or not state.subtask == env.phase == GRASP:
            return False
        return bool(env.dwell >= self.chain.grasp_hold)

    def _believes(self, state: _Progress, env: Any, choice: int) -> bool:
        """Say whether a choice is a decision: always but where a learned termination must wait for
        more.
        """
        if (
            state.subtask < 0
            or state.steps >= self.chain.steps
            or self.chain.termination == "privileged"
        ):
            return True
        state.doubts = state.doubts + 1 if choice != state.subtask else 0
        return state.doubts >= PATIENCE

    def _choose(self, envs: Sequence[Any], observations: Sequence[Any]) -> list[int]:
        """Return the subtask that is due in each env."""
        if self._high is None:
            return [env.phase for env in envs]
        return [int(due) for due in self._high.answer(envs, observations).argmax(axis=1)]
