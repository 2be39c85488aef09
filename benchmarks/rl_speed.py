"""Measure the speed of reinforcement learning against the bare library.

    python benchmarks/rl_speed.py --turns 3 --steps 300

Measures updates and control steps per second of CPU time in the training loop: Stable-Baselines3's
TD3 with its own HER buffer on a trivial env of the same shapes, whose step only copies an array,
against `train --algo td3-her` on Grasp with its relative features and its physics. Networks, batch
and updates per step are the same. The two take turns, and the ratio is the median of the turns'
ratios. Learning has begun before the clock is started.
"""

import argparse
import time
from typing import Any

import gymnasium
import numpy as np
import torch
from common import emit, median
from stable_baselines3 import TD3, HerReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.envs.observation import ObservationConfig
from surgicai_vision.rl.online import OnlineLearner
from surgicai_vision.rl.settings import Request, settings_of

WARM_UP = 230
"""Control steps before the clock starts: an episode, which hindsight needs, and some updates."""


class Trivial(gymnasium.Env):
    """An env of the same shapes whose step costs next to nothing."""

    def __init__(self) -> None:
        self.observation_space = ObservationConfig("goal").space()
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (7,), np.float32)
        self._seen = {key: space.sample() for key, space in self.observation_space.items()}
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode."""
        self._steps = 0
        return dict(self._seen), {}

    def step(self, action: Any) -> Any:
        """End an episode after 200 steps."""
        self._steps += 1
        return dict(self._seen), -1.0, False, self._steps >= 200, {}

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        """Return -1 for each goal."""
        return -np.ones(len(achieved))


def bare(settings: Any) -> TD3:
    """Return the library's model on the trivial env, with our settings."""
    return TD3(
        "MultiInputPolicy",
        Trivial(),
        learning_rate=settings.learning_rate,
        batch_size=settings.batch_size,
        train_freq=settings.train_every,
        gradient_steps=settings.updates,
        learning_starts=210,
        buffer_size=10_000,
        action_noise=NormalActionNoise(np.zeros(7), 0.1 * np.ones(7)),
        replay_buffer_class=HerReplayBuffer,
        policy_kwargs={"net_arch": list(settings.hidden)},
        device="cpu",
        seed=0,
    )


def rate(model: Any, steps: int) -> float:
    """Return control steps per second of CPU time."""
    began = time.process_time()
    model.learn(steps, reset_num_timesteps=False)
    return steps / (time.process_time() - began)


def main() -> None:
    """Measure and print one row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--steps", type=int, default=300)
    options = parser.parse_args()
    torch.set_num_threads(1)
    settings = settings_of("td3-her", {"learning_starts": 210})
    request = Request("td3-her", TaskConfig("grasp"), settings=settings, env_steps=10_000)
    ours = OnlineLearner(request, None, np.zeros(24), np.ones(24)).model
    theirs = bare(settings)
    for model in (ours, theirs):
        model.learn(WARM_UP, reset_num_timesteps=False)
    rates = [(rate(theirs, options.steps), rate(ours, options.steps)) for _ in range(options.turns)]
    share = settings.updates / settings.train_every
    emit(
        "rl_speed",
        {
            "bare_steps_per_s": median([one for one, _ in rates], 1),
            "our_steps_per_s": median([own for _, own in rates], 1),
            "our_updates_per_s": median([own * share for _, own in rates], 1),
            "ratio": median([own / one for one, own in rates]),
        },
    )


if __name__ == "__main__":
    main()
