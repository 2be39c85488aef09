"""Online learning with Stable-Baselines3: models from a request, and their complete state."""

import json
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, cast, final

import numpy as np
import torch
from numpy.typing import NDArray
from sb3_contrib import TQC
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr, recursive_setattr
from torch import nn

from policies.actor import Actor
from policies.base import Policy
from surgicai_vision.core.errors import InputError
from surgicai_vision.rl.buffers import HindsightBuffer, MixedBuffer, demonstrations_of
from surgicai_vision.rl.extractor import FeatureMemo, RelativeExtractor, StandardExtractor
from surgicai_vision.rl.learner import (
    Arrays,
    Diverged,
    Learner,
    State,
    linear,
    random_state,
    set_random_state,
)
from surgicai_vision.rl.nair import DemonstrationTD3
from surgicai_vision.rl.rlpd import LayerNormPolicy
from surgicai_vision.rl.settings import Request
from surgicai_vision.rl.transitions import Transitions
from surgicai_vision.rl.vec_env import SuturingVecEnv

KINDS: Mapping[str, type[BaseAlgorithm]] = MappingProxyType(
    {"PPO": PPO, "DDPG": DDPG, "SAC": SAC, "TD3": TD3, "TQC": TQC}
)
"""`Algorithm.kind` → the library's class."""
BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
EPISODES = ("ep_start", "ep_length")
COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")


@final
class OnlineLearner(Learner):
    """A model of Stable-Baselines3 and its envs.

    Args:
        request: what is trained.
        transitions: the demonstrations; None for an algorithm that uses none.
        mean: mean subtracted from each input, (n,).
        std: standard deviation each input is then divided by, (n,).
        workers: worker processes of the envs.
    """

    def __init__(
        self,
        request: Request,
        transitions: Transitions | None,
        mean: NDArray[np.float64],
        std: NDArray[np.float64],
        workers: int = 0,
    ):
        self.request = request
        self.mean = torch.from_numpy(mean).float()
        self.std = torch.from_numpy(std).float()
        settings = request.settings
        has_goal = request.algorithm.has_hindsight
        obs_type = "goal" if has_goal else request.observation
        self.env = SuturingVecEnv.of(request.env, obs_type, settings.envs, workers)
        self.env.set_attr("success_rule", settings.success_rule)
        self.model = self._model()
        self.log_to(Logger(None, []))  # without it `learn` creates a log folder at every call
        if transitions is not None:
            buffer = self._buffer
            assert isinstance(buffer, MixedBuffer | HindsightBuffer)
            buffer.mix(demonstrations_of(transitions), settings.demo_share)
        self.squash = "clip" if isinstance(self.model, PPO) else "tanh"

    # -- the model ---------------------------------------------------------------------------------

    def _model(self) -> BaseAlgorithm:
        """Return the untrained model of the request."""
        settings = self.request.settings
        algorithm = self.request.algorithm
        kind = KINDS[algorithm.kind]
        options: dict[str, Any] = {
            "learning_rate": settings.learning_rate,
            "gamma": settings.gamma,
            "batch_size": settings.batch_size,
            "seed": self.request.seed,
            "device": "cpu",
        }
        network = self._network()
        hidden = list(settings.hidden)
        if kind is PPO:
            network["net_arch"] = {"pi": hidden, "vf": hidden}
            options["n_steps"] = max(settings.rollout // settings.envs, 1)
            return PPO("MlpPolicy", self.env, policy_kwargs=network, **options)
        network["net_arch"] = {"pi": hidden, "qf": hidden}
        network["n_critics"] = settings.critics
        options |= self._replay() | self._exploration()
        if algorithm.is_cloning:
            kind = DemonstrationTD3
            for name in ("bc_weight", "q_filter", "normalise_q", "clip_q"):
                options[name] = getattr(settings, name)
        policy: Any = "MultiInputPolicy" if algorithm.has_hindsight else "MlpPolicy"
        if algorithm.has_layer_norm:
            policy = LayerNormPolicy
        return kind(policy, self.env, policy_kwargs=network, **options)

    def _network(self) -> dict[str, Any]:
        """Return the options for how the networks see an observation."""
        inputs: dict[str, Any] = {"mean": self.mean.tolist(), "std": self.std.tolist()}
        has_goal = self.request.algorithm.has_hindsight
        if has_goal:
            inputs |= {"task": self.request.env.task, "memo": FeatureMemo()}
        return {
            "activation_fn": nn.ReLU,
            "features_extractor_class": RelativeExtractor if has_goal else StandardExtractor,
            "features_extractor_kwargs": inputs,
        }

    def _replay(self) -> dict[str, Any]:
        """Return the options of the replay buffer and of the updates."""
        request = self.request
        settings = request.settings
        options: dict[str, Any] = {
            "tau": settings.tau,
            "buffer_size": request.env_steps + settings.envs,
            "train_freq": settings.train_every,
            "gradient_steps": settings.updates * settings.envs,
            "learning_starts": request.random_steps,
            "replay_buffer_class": MixedBuffer,
        }
        if request.algorithm.has_hindsight:
            options["replay_buffer_class"] = HindsightBuffer
            options["replay_buffer_kwargs"] = {
                "keeps_demand": request.keeps_demand,
                "n_sampled_goal": settings.goals,
            }
        return options

    def _exploration(self) -> dict[str, Any]:
        """Return the options of the noise on actions and on the targets of twin critics."""
        settings = self.request.settings
        read = self.request.algorithm.settings
        options: dict[str, Any] = {}
        if "exploration_noise" in read:
            spread = settings.exploration_noise * np.ones(7)
            options["action_noise"] = NormalActionNoise(np.zeros(7), spread)
        if "policy_delay" in read:
            options["policy_delay"] = settings.policy_delay
            options["target_policy_noise"] = settings.target_noise
            options["target_noise_clip"] = settings.target_noise_clip
        return options

    @property
    def _buffer(self) -> MixedBuffer | HindsightBuffer | None:
        if not isinstance(self.model, OffPolicyAlgorithm):
            return None
        return cast(MixedBuffer | HindsightBuffer, self.model.replay_buffer)

    # -- learning ----------------------------------------------------------------------------------

    @property
    def done(self) -> int:
        """Return the control steps taken: an action is held for `action_repeat` of them."""
        return self.model.num_timesteps * self.request.env.action_repeat

    @property
    def updates(self) -> int:
        """Return the updates of the weights."""
        return int(self.model._n_updates)

    def log_to(self, logger: Logger) -> None:
        """Log to TensorBoard."""
        self.model.set_logger(logger)

    def advance(self, target: int) -> dict[str, float]:
        """Learn until `target` control steps are done."""
        decisions = -(-target // self.request.env.action_repeat)
        try:
            self.model.learn(
                decisions - self.model.num_timesteps, reset_num_timesteps=False, log_interval=4
            )
        except InputError as error:  # an env refuses such actions
            if np.isfinite(self.env.actions).all():
                raise
            raise Diverged from error
        successes = self.model.ep_success_buffer
        return {"training success": float(np.mean(successes))} if successes else {}

    def fill(self, policy: Policy) -> None:
        """Copy the weights of the model's actor into ours."""
        model: Any = self.model.policy
        if isinstance(self.model, PPO):
            parts = [model.mlp_extractor.policy_net, model.action_net]
        elif isinstance(self.model, TD3):  # DDPG too
            parts = [model.actor.mu]
        else:
            parts = [model.actor.latent_pi, model.actor.mu]
        assert isinstance(policy, Actor)
        policy.take([layer for part in parts for layer in linear(part)], self.mean, self.std)

    # -- the complete state ------------------------------------------------------------------------

    def get_state(self) -> State:
        """Return networks, optimisers, replay buffer, envs, counters and random state."""
        model = self.model
        snapshots, returns, lengths = self.env.get_state()
        _, variables = model._get_torch_save_params()
        state: State = {
            "parameters": model.get_parameters(),
            "variables": {name: recursive_getattr(model, name) for name in variables},
            "counters": {name: int(getattr(model, name)) for name in COUNTERS},
            "last": _tensors(model._last_obs),
            "starts": _tensors(model._last_episode_starts),
            "successes": [float(value) for value in model.ep_success_buffer or ()],
            "episodes": [_plain(value) for value in model.ep_info_buffer or ()],
            "envs": [torch.from_numpy(vector) for vector, _ in snapshots],
            "generators": json.dumps([generator for _, generator in snapshots]),
            "returns": torch.from_numpy(returns),
            "lengths": torch.from_numpy(lengths),
            "actions": json.dumps(model.action_space.np_random.bit_generator.state),
            "random": random_state(),
        }
        buffer = self._buffer
        if buffer is not None:
            rows = buffer.buffer_size if buffer.full else buffer.pos
            names = (*BUFFER, *EPISODES) if isinstance(buffer, HindsightBuffer) else BUFFER
            state["buffer"] = Arrays.of(buffer, names, rows)
            state["position"] = [int(buffer.pos), int(buffer.full)]
            if isinstance(buffer, HindsightBuffer):
                state["episode"] = torch.from_numpy(buffer._current_ep_start.copy())
        return state

    def set_state(self, state: State) -> None:
        """Restore what `get_state` returned."""
        model = self.model
        if model._last_obs is None:
            model._setup_learn(0, None, reset_num_timesteps=False)
        model.set_parameters(state["parameters"], exact_match=True)
        for name, value in state["variables"].items():
            recursive_setattr(model, f"{name}.data", value.data)
        for name, value in state["counters"].items():
            setattr(model, name, value)
        model._last_obs = _arrays(state["last"])
        model._last_episode_starts = _arrays(state["starts"])
        assert model.ep_success_buffer is not None and model.ep_info_buffer is not None
        model.ep_success_buffer.extend(state["successes"])
        model.ep_info_buffer.extend(state["episodes"])
        buffer = self._buffer
        if buffer is not None:
            Arrays.put(buffer, state["buffer"])
            buffer.pos, full = state["position"]
            buffer.full = bool(full)
            if isinstance(buffer, HindsightBuffer):
                buffer._current_ep_start = state["episode"].numpy().copy()
        generators = json.loads(state["generators"])
        vectors = [vector.numpy() for vector in state["envs"]]
        snapshots = list(zip(vectors, generators, strict=True))
        self.env.set_state(snapshots, state["returns"].numpy(), state["lengths"].numpy())
        model.action_space.np_random.bit_generator.state = json.loads(state["actions"])
        set_random_state(state["random"])

    def close(self) -> None:
        """End the workers."""
        self.env.close()


def _tensors(value: Any) -> Any:
    """Return an array, or a dict of arrays, as tensors."""
    if isinstance(value, Mapping):
        return {key: _tensors(part) for key, part in value.items()}
    return torch.from_numpy(np.array(value))


def _arrays(value: Any) -> Any:
    """Return the result of `_tensors` as arrays again."""
    if isinstance(value, Mapping):
        return {key: _arrays(part) for key, part in value.items()}
    return value.numpy().copy()


def _plain(episode: Mapping[str, float]) -> dict[str, float]:
    """Return an episode's statistics as plain numbers."""
    return {name: float(value) for name, value in episode.items()}
