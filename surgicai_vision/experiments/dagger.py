"""DAgger (Ross et al. 2011): a learner acts, and the expert labels the states it reaches.

    learner = learner_of(Path("outputs/train/grasp-…"), config)
    record(config, episodes=350, demonstrator="search", learner=learner, out=Path("demos"))

The learner acts until a step drawn uniformly within the episode's step limit; then the expert takes
over and recovers. As always, only episodes that succeed are kept. Rendered together with the
demonstrations the learner was trained on, they train the next one (`render-demos --demos A,B`).
"""

import atexit
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.config import JSON, TaskConfig, from_mapping
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.executor import job
from surgicai_vision.demos.demonstrator import BehaviourPolicy
from surgicai_vision.demos.record import Learner, record_into
from surgicai_vision.evaluation.agent import Agent, Env, Observation
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.slot import env_of
from surgicai_vision.training import released


@final
class MixturePolicy(BehaviourPolicy):
    """An agent until a randomly drawn step of each episode, then the expert."""

    def __init__(self, agent: Agent):
        self._agent = agent
        self._left = 0

    def reset(self, env: Env, seed: int, rng: np.random.Generator) -> None:
        """Draw the step at which the expert takes over."""
        self._agent.reset(0, env, seed)
        self._left = int(rng.integers(0, env.config.max_steps, endpoint=True))

    def action(self, env: Env, observation: Observation) -> NDArray[np.float32] | None:
        """Return the agent's action (7,) in [-1, 1], or None once the expert has taken over."""
        if not self._left:
            return None
        self._left -= 1
        action = np.asarray(self._agent.act([0], [env], [observation])[0])
        return np.clip(action, -1.0, 1.0).astype(np.float32)


def learner_of(folder: Path, config: TaskConfig) -> Learner:
    """Return the learner in a checkpoint folder.

    Raises:
        BadFile: no checkpoint folder.
        InputError: a policy of another task, or one that is not trained or does not act.
        MissingWeights: the encoder's weights are not at hand.
    """
    folder = released.resolve(folder)
    spec = open_policy(folder, task=config.task)
    checkpoint = spec.about.get("checkpoint")
    if not isinstance(checkpoint, Mapping):
        raise InputError(f"--learner {folder} is not one trained policy; give a checkpoint folder.")
    return Learner(folder, str(checkpoint["policy_sha256"]))


@job(
    "drive-episode",
    stages=(
        "scene",
        "envs",
        "demos",
        "dataset",
        "features",
        "training",
        "evaluation",
        "experiments",
        "encoders",
        "policies",
    ),
    packages=("mujoco", "numpy", "torch", "timm", "lerobot"),
)
def record_driven(folder: Path, task: Mapping[str, JSON], learner: str, **how: Any) -> None:
    """Job "drive-episode": as "record-episode", with a learner that acts first."""
    env, mixture = _driven(from_mapping(TaskConfig, task), learner)
    record_into(folder, env, behaviour=mixture, **how)


@functools.lru_cache(maxsize=1)
def _driven(config: TaskConfig, learner: str) -> tuple[Env, MixturePolicy]:
    """Return this process's environment with what the learner sees, and the learner."""
    atexit.register(_driven.cache_clear)  # the GL context must be freed before Python exits
    agent = open_policy(learner, task=config.task).make_agent()
    return env_of(agent, config), MixturePolicy(agent)
