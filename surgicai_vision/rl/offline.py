"""Offline learning with d3rlpy: from demonstrations alone, without a step in an env."""

import io
import logging
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, final

import d3rlpy
import numpy as np
import structlog
import torch
from d3rlpy.algos import AWACConfig, BCConfig, BCQConfig, CalQLConfig, IQLConfig
from d3rlpy.models.encoders import VectorEncoderFactory
from numpy.typing import NDArray
from torch import nn

from policies.actor import FLEXIBILITY, Actor, BatchConstrained
from policies.base import Policy
from surgicai_vision.rl.awac import PlainAWAC
from surgicai_vision.rl.learner import (
    Learner,
    State,
    linear,
    random_state,
    set_random_state,
)
from surgicai_vision.rl.settings import Request, Settings
from surgicai_vision.rl.transitions import Transitions


def _actor_critic(settings: Settings) -> dict[str, Any]:
    """Return the options that all configurations with actor and critics share."""
    encoder = VectorEncoderFactory(list(settings.hidden))
    return {
        "actor_learning_rate": settings.learning_rate,
        "critic_learning_rate": settings.learning_rate,
        "actor_encoder_factory": encoder,
        "critic_encoder_factory": encoder,
        "batch_size": settings.batch_size,
        "gamma": settings.gamma,
        "tau": settings.tau,
    }


def _bc(settings: Settings) -> Any:
    return BCConfig(
        learning_rate=settings.learning_rate,
        batch_size=settings.batch_size,
        encoder_factory=VectorEncoderFactory(list(settings.hidden)),
    ).create()


def _awac(settings: Settings) -> Any:
    config = AWACConfig(n_critics=settings.critics, **_actor_critic(settings))
    return PlainAWAC(config, device=False, enable_ddp=False)


def _bcq(settings: Settings) -> Any:
    encoder = VectorEncoderFactory(list(settings.hidden))
    return BCQConfig(
        imitator_learning_rate=settings.learning_rate,
        imitator_encoder_factory=encoder,
        n_critics=settings.critics,
        n_action_samples=settings.samples,
        action_flexibility=FLEXIBILITY,
        **_actor_critic(settings),
    ).create()


def _iql(settings: Settings) -> Any:
    encoder = VectorEncoderFactory(list(settings.hidden))
    return IQLConfig(
        n_critics=settings.critics, value_encoder_factory=encoder, **_actor_critic(settings)
    ).create()


def _cal_ql(settings: Settings) -> Any:
    return CalQLConfig(
        n_critics=settings.critics, n_action_samples=settings.samples, **_actor_critic(settings)
    ).create()


UNTRAINED: Mapping[str, Callable[[Settings], Any]] = MappingProxyType(
    {"BC": _bc, "AWAC": _awac, "BCQ": _bcq, "IQL": _iql, "CalQL": _cal_ql}
)
"""`Algorithm.kind` → the library's algorithm with settings, on the CPU."""


@final
class OfflineLearner(Learner):
    """An algorithm of d3rlpy and its dataset.

    Args:
        request: what is trained.
        transitions: the demonstrations.
        mean: mean subtracted from each input, (n,).
        std: standard deviation each input is then divided by, (n,).
    """

    def __init__(
        self,
        request: Request,
        transitions: Transitions,
        mean: NDArray[np.float64],
        std: NDArray[np.float64],
    ):
        self.request = request
        self.mean = torch.from_numpy(mean).float()
        self.std = torch.from_numpy(std).float()
        # The library logs every step to stdout, where --json prints.
        structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
        d3rlpy.seed(request.seed)
        rows = ((transitions.vector - mean) / std).astype(np.float32)
        self._dataset = d3rlpy.dataset.MDPDataset(
            observations=rows,
            actions=transitions.action,
            rewards=transitions.reward,
            terminals=transitions.terminated.astype(np.float32),
        )
        self._algo = UNTRAINED[request.algorithm.kind](request.settings)
        self._algo.create_impl((rows.shape[1],), transitions.action.shape[1])

    @property
    def done(self) -> int:
        """Return the updates taken."""
        return self.updates

    @property
    def updates(self) -> int:
        """Return the updates of the weights."""
        return int(self._algo.grad_step)

    def advance(self, target: int) -> dict[str, float]:
        """Take updates until there are `target`; return the mean losses."""
        losses: dict[str, list[float]] = {}
        while self.updates < target:
            batch = self._dataset.sample_transition_batch(self.request.settings.batch_size)
            for name, value in self._algo.update(batch).items():
                losses.setdefault(name, []).append(float(value))
        return {name: float(np.mean(values)) for name, values in losses.items()}

    def fill(self, policy: Policy) -> None:
        """Copy the weights of the library's actor into our policy."""
        impl = self._algo.impl
        if isinstance(policy, BatchConstrained):
            parts = (impl.modules.vae_decoder, impl.modules.policy, impl.modules.q_funcs[0])
            policy.take([_layers(part) for part in parts], self.mean, self.std)
            return
        assert isinstance(policy, Actor)
        policy.take(_layers(impl.policy), self.mean, self.std)

    def greedy(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the library's own greedy actions for standardised inputs (B, n)."""
        actions: NDArray[np.float32] = self._algo.predict(rows)
        return actions

    def get_state(self) -> State:
        """Return networks, optimisers, counter and random state."""
        content = io.BytesIO()
        self._algo.impl.save_model(content)
        content.seek(0)
        return {
            "model": torch.load(content, weights_only=True),
            "updates": self.updates,
            "random": random_state(),
        }

    def set_state(self, state: State) -> None:
        """Restore what `get_state` returned."""
        content = io.BytesIO()
        torch.save(state["model"], content)
        content.seek(0)
        self._algo.impl.load_model(content)
        self._algo.set_grad_step(state["updates"])
        set_random_state(state["random"])

    def close(self) -> None:
        """Nothing to free."""


def _layers(module: Any) -> list[nn.Linear]:
    """Return the linear layers of one of the library's networks, from input to output."""
    head = module._mu if hasattr(module, "_mu") else module._fc
    return [*linear(module._encoder), head]
