"""AWAC as in its paper: the critic's target contains no entropy.

Nair et al. (arXiv:2006.09359) evaluate the policy by r + γ Q(s', a'), with a' sampled from it.
d3rlpy 2.8.0 instead uses SAC's target, with the entropy weighted by a temperature of exp(0) = 1. A
policy of seven actions with a standard deviation of .1 has a log-likelihood of about 6, so each
step costs that much in addition to the reward's 1, and the critic falls below any possible return.
The advantages spread with it, and the softmax over them leaves ever fewer transitions of a batch to
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
        """Create the networks; the temperature is not a learned parameter."""
        super().inner_create_impl(observation_shape, action_size)
        with torch.no_grad():
            get_parameter(self.impl.modules.log_temp).fill_(-torch.inf)
