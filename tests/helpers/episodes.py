"""Short episodes for the tests of envs and expert."""

import numpy as np

from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.expert import Expert


def make(task, *, obs_type="state", **fields):
    return envs.make(
        TaskConfig(task, **fields), obs_type=obs_type, cameras=("back",), image_size=32
    )


def flat(observation):
    """Every array of an observation or of an info, keyed by its path."""
    if not isinstance(observation, dict):
        return {"": observation}
    parts = {key: flat(value) for key, value in observation.items()}
    return {
        f"{key}.{rest}".rstrip("."): part
        for key, rests in parts.items()
        for rest, part in rests.items()
    }


def same(one, other):
    one, other = flat(one), flat(other)
    return one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)


def actions(count, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (count, 7)).astype(np.float32)


def play(env, steps):
    """Let the expert take `steps` control steps; return the observations and actions."""
    expert, seen, done = Expert(env), [], []
    for _ in range(steps):
        done.append(expert.action())
        seen.append(env.step(done[-1])[0])
    return seen, done
