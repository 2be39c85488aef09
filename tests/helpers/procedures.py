"""A whole procedure by the expert, step by step, for tests that replay it."""

import functools
from dataclasses import dataclass

import numpy as np

from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.expert import Expert


@dataclass(frozen=True)
class Procedure:
    """What the expert did from a start: actions (T, 7), the phase of each, qpos after each."""

    actions: np.ndarray
    phases: list[int]
    qpos: list[np.ndarray]


@functools.cache
def expert_procedure(seed: int) -> Procedure:
    """Return the expert's procedure from a start; the env advances by measured success."""
    env = envs.make(TaskConfig("suture"))
    env.reset(seed=seed)
    expert = Expert(env)
    actions, phases, qpos = [], [], []
    over = False
    while not over:
        phases.append(env.phase)
        actions.append(expert.action().astype(np.float32))
        *_, over, _, info = env.step(actions[-1])
        qpos.append(env.data.qpos.copy())
    env.close()
    assert info["is_success"] and info["progress"] == 5
    return Procedure(np.stack(actions), phases, qpos)
