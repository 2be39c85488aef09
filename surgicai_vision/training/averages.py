"""A moving average of a policy's weights in training; the average is what is kept.

The decay grows with the number of updates as in Diffusion Policy's code (Chi et al., RSS 2023,
`diffusion_policy/model/diffusion/ema_model.py`): 1 - (1 + n)^-0.75, up to the recipe's `ema`.

    average = MovingAverage(policy, 0.999)
    average.update(policy)              # after each update
    with average.applied(policy): …     # validate or write the average
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import final

import torch
from torch import nn

POWER = 0.75


@final
class MovingAverage:
    """The moving average of a module's parameters; buffers are the module's own.

    Args:
        module: the module that is trained.
        decay: the largest decay, from 0 to below 1.
    """

    def __init__(self, module: nn.Module, decay: float):
        self._decay = decay
        self._updates = 0
        self._mean = {name: value.detach().clone() for name, value in module.named_parameters()}

    @torch.no_grad()
    def update(self, module: nn.Module) -> None:
        """Add the weights after one update to the average."""
        self._updates += 1
        decay = min(self._decay, 1 - (1 + self._updates) ** -POWER)
        for name, value in module.named_parameters():
            self._mean[name].lerp_(value, 1 - decay)

    @contextmanager
    def applied(self, module: nn.Module) -> Iterator[None]:
        """Give the module the averaged weights within a `with` block."""
        own = {name: value.detach().clone() for name, value in module.named_parameters()}
        _fill(module, self._mean)
        try:
            yield
        finally:
            _fill(module, own)

    def state(self) -> dict[str, object]:
        """Return the state as plain data and tensors, for `restore`."""
        return {"updates": self._updates, "mean": self._mean}

    def restore(self, updates: int, mean: dict[str, torch.Tensor]) -> None:
        """Continue from a state."""
        self._updates = updates
        for name, value in mean.items():
            self._mean[name].copy_(value)


@torch.no_grad()
def _fill(module: nn.Module, values: dict[str, torch.Tensor]) -> None:
    """Copy values into a module's parameters."""
    for name, parameter in module.named_parameters():
        parameter.copy_(values[name])
