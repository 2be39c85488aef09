"""AWAC as its paper has it: the critic's target holds no entropy.

Nair et al. (arXiv:2006.09359) evaluate the policy by r + γ Q(s', a'), a' drawn from it. d3rlpy
2.8.0 takes the target of SAC for it, whose entropy it weighs with a temperature of exp(0) = 1. A
policy of seven actions with a standard deviation of .1 has a log-likelihood of about 6, so each
step costs that beside the reward's 1, the critic falls below what any return can be, the
advantages spread with it, and the softmax over them leaves ever fewer transitions of a batch to
learn from (docs/results/rl.md).
"""

from typing import final

import torch
from d3rlpy.algos import AWAC
from d3rlpy.models.torch import get_parameter


@final
class PlainAWAC(AWAC):  # type: ignore[misc]
    """d3rlpy's AWAC with a temperature of 0 in its critic's target."""

    def inner_create_impl(self, observation_shape: tuple[int, ...], action_size: int) -> None:
        """Make the networks; the temperature is none of the learned parameters."""
        super().inner_create_impl(observation_shape, action_size)
        with torch.no_grad():
            get_parameter(self.impl.modules.log_temp).fill_(-torch.inf)
