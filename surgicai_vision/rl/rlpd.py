"""The networks of RLPD: SAC whose critics have LayerNorm.

Ball et al., Efficient online reinforcement learning with offline data (ICML 2023,
arXiv:2302.02948): SAC off the shelf, half of every batch from offline data (`buffers`), and
LayerNorm after each hidden layer of the critics, which bounds the values of actions absent from the
data. Their ensembles of ten critics and 20 updates per step are settings (`critics`, `updates`).
`residual` uses such critics in TD3.
"""

from typing import Any, final

from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn


class LayerNormCritics:
    """A mixin, placed before a Stable-Baselines3 policy, that adds LayerNorm to its critics."""

    def make_critic(self, features_extractor: Any = None) -> ContinuousCritic:
        """Return the library's critics with LayerNorm between each hidden layer and its ReLU."""
        critic: ContinuousCritic = super().make_critic(features_extractor)  # type: ignore[misc]
        for index, network in enumerate(critic.q_networks):
            normed = _with_layer_norm(network)
            critic.q_networks[index] = normed
            critic.add_module(f"qf{index}", normed)
        return critic.to(critic.device)


@final
class LayerNormPolicy(LayerNormCritics, SACPolicy):
    """SAC's policy with LayerNorm in its critics."""


@final
class LayerNormTD3Policy(LayerNormCritics, TD3Policy):
    """TD3's policy with LayerNorm in its critics."""


def _with_layer_norm(network: nn.Module) -> nn.Sequential:
    """Return the layers of an MLP with LayerNorm before each ReLU."""
    layers: list[nn.Module] = []
    for layer in network.children():
        if isinstance(layer, nn.ReLU):
            before = layers[-1]
            assert isinstance(before, nn.Linear)
            layers.append(nn.LayerNorm(before.out_features))
        layers.append(layer)
    return nn.Sequential(*layers)
