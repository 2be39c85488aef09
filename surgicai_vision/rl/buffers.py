"""Replay buffers of Stable-Baselines3 that mix in demonstrations; hindsight ends episodes.

* `MixedBuffer`: a `ReplayBuffer`. A part of every batch comes from demonstrations: half of it in
  RLPD's symmetric sampling (Ball et al. 2023), R_D in Nair et al. 2018.
* `HindsightBuffer`: a `HerReplayBuffer` that mixes in the same way. It differs from the library's
  in two ways. A relabelled success ends the episode, as a real one does; otherwise the value of
  reaching a goal would be that of staying there, which no episode shows. And a relabelled goal may
  keep what the task requires besides the pose (`keeps_demand`).

    buffer.mix(demonstrations, share=0.5)

The demonstrations are the last rows of a batch.
"""

from typing import Any, final

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from surgicai_vision.core.errors import InputError
from surgicai_vision.rl.export import ACTIONS, fill, space_of
from surgicai_vision.rl.settings import demonstration_rows
from surgicai_vision.rl.transitions import Transitions

DEMAND = 7
"""Index of a goal's element that says what success requires besides the pose."""
Samples = ReplayBufferSamples | DictReplayBufferSamples
Observations = torch.Tensor | dict[str, torch.Tensor]


class Demonstrations:
    """The part of a batch that comes from demonstrations."""

    _source: ReplayBuffer | None = None
    _share = 0.0

    def mix(self, source: ReplayBuffer, share: float) -> None:
        """Draw a share of every batch from `source`."""
        if not 0 < share < 1:
            raise InputError(f"share is {share}; it must be above 0 and below 1.")
        self._source = source
        self._share = share

    def rows(self, batch_size: int) -> int:
        """Return how many rows of a batch, the last ones, are demonstrations."""
        return demonstration_rows(self._share, batch_size)

    def mixed(self, own: Samples, batch_size: int) -> Samples:
        """Return `own` followed by the demonstrations of a batch of `batch_size`."""
        if self._source is None:
            return own
        return joined(own, self._source.sample(self.rows(batch_size)))


@final
class MixedBuffer(Demonstrations, ReplayBuffer):
    """A replay buffer of arrays; see the module's docstring."""

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None
    ) -> Samples:
        """Return a batch, demonstrations last."""
        return self.mixed(super().sample(batch_size - self.rows(batch_size), env), batch_size)


@final
class HindsightBuffer(Demonstrations, HerReplayBuffer):
    """A replay buffer of goal dicts; see the module's docstring.

    Args:
        buffer_size: transitions it holds, over all envs.
        observation_space: that of obs_type "goal".
        action_space: (7,).
        env: provides `compute_reward`, of the sparse reward.
        keeps_demand: a relabelled goal keeps the requirement of the task.
        n_sampled_goal: relabelled transitions for each real one.
        device: device of the batches.
        n_envs: envs whose transitions are added in parallel.
        optimize_memory_usage: as in the library.
        handle_timeout_termination: as in the library.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space[object],
        env: VecEnv,
        keeps_demand: bool = False,
        n_sampled_goal: int = 4,
        device: torch.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
    ):
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            env,
            device,
            n_envs,
            optimize_memory_usage,
            handle_timeout_termination,
            n_sampled_goal,
        )
        self.keeps_demand = keeps_demand

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None
    ) -> Samples:
        """Return a batch, demonstrations last."""
        return self.mixed(super().sample(batch_size - self.rows(batch_size), env), batch_size)

    def _sample_goals(
        self, batch_indices: NDArray[np.int64], env_indices: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        goals: NDArray[np.float32] = super()._sample_goals(batch_indices, env_indices).copy()
        if self.keeps_demand:
            asked = self.observations["desired_goal"][batch_indices, env_indices]
            goals[:, DEMAND] = asked[:, DEMAND]
        return goals

    def _get_virtual_samples(
        self,
        batch_indices: NDArray[np.int64],
        env_indices: NDArray[np.int64],
        env: VecNormalize | None = None,
    ) -> DictReplayBufferSamples:
        samples = super()._get_virtual_samples(batch_indices, env_indices, env)
        # The sparse reward is 0 where a goal is reached, which is `compute_terminated`.
        return samples._replace(dones=(samples.rewards == 0).float())


def demonstrations_of(transitions: Transitions) -> ReplayBuffer:
    """Return a buffer that holds only demonstrations, with the goals they reached.

    They are not relabelled: they are the examples of success at the goals that the task sets. With
    four of five relabelled, a batch would hardly contain one.
    """
    space = space_of(transitions)
    buffer: ReplayBuffer
    if isinstance(space, spaces.Dict):
        buffer = DictReplayBuffer(len(transitions), space, ACTIONS, device="cpu")
    else:
        buffer = ReplayBuffer(len(transitions), space, ACTIONS, device="cpu")
    fill(buffer, transitions)
    return buffer


def joined(first: Any, second: Any) -> Samples:
    """Return two batches of the same kind, joined into one."""
    batch: Samples = first._replace(
        observations=_both(first.observations, second.observations),
        actions=torch.cat([first.actions, second.actions]),
        next_observations=_both(first.next_observations, second.next_observations),
        dones=torch.cat([first.dones, second.dones]),
        rewards=torch.cat([first.rewards, second.rewards]),
    )
    return batch


def _both(first: Any, second: Any) -> Observations:
    if isinstance(first, torch.Tensor):
        return torch.cat([first, second])
    return {key: torch.cat([part, second[key]]) for key, part in first.items()}
