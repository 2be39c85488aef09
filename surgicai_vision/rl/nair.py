"""TD3 with demonstrations, behaviour cloning and a Q-filter, after Nair et al. 2018.

"Overcoming exploration in reinforcement learning with demonstrations" (ICRA 2018,
arXiv:1709.10089) uses DDPG; SurgicAI and this class use TD3, whose critics are trained as usual.
A part of each batch comes from the demonstrations (`buffers`), and the actor ascends

    λ1 ∇J - λ2 ∇L_BC,    L_BC = Σ_i ‖π(s_i | g_i) - a_i‖² · 1[Q(s_i, a_i) > Q(s_i, π(s_i))]

over the demonstrations of the batch, λ1 + λ2 = 1 (SurgicAI). Here the sum is a mean over them, and
with `normalise_q` J is divided by the mean absolute Q (Fujimoto and Gu 2021), so that λ2 has the
same effect at any scale of the reward. With `clip_q` the targets stay within [-1 / (1 - γ), 0], the
returns that the reward allows (Andrychowicz et al. 2017 clip theirs).

`AnchoredTD3` is the part shared with other actors that are kept close to an existing behaviour.
"""

from abc import abstractmethod
from typing import Any, final

import numpy as np
import torch
from stable_baselines3 import TD3
from stable_baselines3.common.utils import polyak_update
from torch import nn

from surgicai_vision.rl.buffers import Demonstrations


def cloning_loss(
    actions: torch.Tensor,
    demonstrated: torch.Tensor,
    values: torch.Tensor,
    demonstrated_values: torch.Tensor,
    q_filter: bool = True,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return L_BC, a mean over demonstrations, and the share of them that passes the filter.

    Args:
        actions: the actor's actions in demonstrated states, (n, 7).
        demonstrated: the demonstrated actions, (n, 7).
        values: Q of the actor's actions, (n, 1).
        demonstrated_values: Q of the demonstrated actions, (n, 1).
        q_filter: clone only where the critic values the demonstrated action above the actor's.
    """
    passes = (demonstrated_values > values).float().detach()
    if not q_filter:
        passes = torch.ones_like(passes)
    squares = (actions - demonstrated).square().sum(dim=1, keepdim=True)
    return (passes * squares).mean(), passes.mean()


class AnchoredTD3(TD3):
    """TD3 whose actor ascends λ1 ∇J - λ2 ∇L, with a loss L that keeps it close to a reference.

    Args:
        *arguments: TD3's.
        bc_weight: λ2; λ1 = 1 - λ2.
        normalise_q: divide J by the mean absolute Q.
        clip_q: clip the targets to the returns that a reward in [-1, 0] allows.
        actor_starts: critic updates before the actor's first update.
        **options: TD3's.
    """

    def __init__(
        self,
        *arguments: Any,
        bc_weight: float = 0.5,
        normalise_q: bool = True,
        clip_q: bool = True,
        actor_starts: int = 0,
        **options: Any,
    ):
        self.bc_weight = bc_weight
        self.normalise_q = normalise_q
        self.clip_q = clip_q
        self.actor_starts = actor_starts
        super().__init__(*arguments, **options)

    @abstractmethod
    def losses(self, batch: Any) -> dict[str, torch.Tensor]:
        """Return "actor_loss" for a batch of the replay buffer, and the parts that are logged."""

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Take updates as TD3 does, but with the actor's loss from `losses`."""
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        logged: dict[str, list[float]] = {"critic_loss": []}
        buffer = self.replay_buffer
        assert buffer is not None
        for _ in range(gradient_steps):
            self._n_updates += 1
            batch = buffer.sample(batch_size)
            targets = self._targets(batch)
            values = self.critic(batch.observations, batch.actions)
            critic_loss = torch.stack([nn.functional.mse_loss(v, targets) for v in values]).sum()
            logged["critic_loss"].append(critic_loss.item())
            self.critic.optimizer.zero_grad()
            critic_loss.backward()
            self.critic.optimizer.step()
            if self._n_updates % self.policy_delay:
                continue
            if self._n_updates > self.actor_starts:
                parts = self.losses(batch)
                self.actor.optimizer.zero_grad()
                parts["actor_loss"].backward()
                self.actor.optimizer.step()
                for name, part in parts.items():
                    logged.setdefault(name, []).append(part.item())
            polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
            polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, parts_of in logged.items():
            self.logger.record(f"train/{name}", float(np.mean(parts_of)))

    def anchored(self, values: torch.Tensor, anchor: torch.Tensor) -> torch.Tensor:
        """Return the actor's loss.

        Args:
            values: Q of the actor's actions, (B, 1).
            anchor: L, a scalar.
        """
        scale = 1.0 / values.abs().mean().detach() if self.normalise_q else 1.0
        return -(1.0 - self.bc_weight) * scale * values.mean() + self.bc_weight * anchor

    @torch.no_grad()
    def _targets(self, batch: Any) -> torch.Tensor:
        """Return the critics' targets (B, 1): TD3's, clipped to the possible returns."""
        noise = torch.empty_like(batch.actions).normal_(0, self.target_policy_noise)
        noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
        actions = (self.actor_target(batch.next_observations) + noise).clamp(-1, 1)
        values = torch.cat(self.critic_target(batch.next_observations, actions), dim=1)
        smallest = values.min(dim=1, keepdim=True).values
        targets: torch.Tensor = batch.rewards + (1 - batch.dones) * self.gamma * smallest
        return targets.clamp(-1.0 / (1.0 - self.gamma), 0.0) if self.clip_q else targets


@final
class DemonstrationTD3(AnchoredTD3):
    """TD3 whose actor also clones the demonstrations of its batches; see the module's docstring.

    Args:
        *arguments: TD3's.
        q_filter: clone only where the critic values the demonstrated action above the actor's.
        **options: `AnchoredTD3`'s; the replay buffer must mix demonstrations (`buffers`).
    """

    def __init__(self, *arguments: Any, q_filter: bool = True, **options: Any):
        self.q_filter = q_filter
        super().__init__(*arguments, **options)

    def losses(self, batch: Any) -> dict[str, torch.Tensor]:
        """Return the parts of the actor's loss; the batch's last rows are demonstrations."""
        buffer = self.replay_buffer
        assert buffer is not None and isinstance(buffer, Demonstrations)
        rows = buffer.rows(len(batch.actions))
        return self.actor_losses(batch.observations, batch.actions, rows)

    def actor_losses(
        self, observations: Any, actions: torch.Tensor, demonstrated: int
    ) -> dict[str, torch.Tensor]:
        """Return the actor's loss, its cloning part, and the share that passes the filter.

        Args:
            observations: the observations of a batch.
            actions: its actions, (B, 7).
            demonstrated: how many of its rows, the last ones, are demonstrations.
        """
        chosen = self.actor(observations)
        values = self.critic.q1_forward(observations, chosen)
        with torch.no_grad():
            seen = self.critic.extract_features(observations, self.critic.features_extractor)
            rows = torch.cat([seen[-demonstrated:], actions[-demonstrated:]], dim=1)
            known = self.critic.q_networks[0](rows)
        cloning, passed = cloning_loss(
            chosen[-demonstrated:],
            actions[-demonstrated:],
            values[-demonstrated:].detach(),
            known,
            self.q_filter,
        )
        loss = self.anchored(values, cloning)
        return {"actor_loss": loss, "cloning_loss": cloning, "q_filter": passed}
