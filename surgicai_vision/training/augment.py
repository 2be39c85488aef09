"""Augmentation: what is done to normalised inputs in training, and never when a policy acts.

* `with_noise(observed, inputs, deviation)`: Gaussian noise on the measured poses (the recipe's
  `proprioception_noise`), so that a policy does not trust the joints further than they can be
  trusted. What stands beside them (`EXACT`) stays as it is.
* `with_shift(observed, shapes, places)`: feature maps moved by whole places (the recipe's
  `map_shift`), as where a crop lies beside the jaws; DrQ moves images so (Kostrikov et al., Image
  augmentation is all you need, ICLR 2021).

Both draw from torch's own random state, which `train` seeds, stores and restores.
"""

import math
from collections.abc import Sequence

import torch

from policies.base import VECTORS, Inputs
from surgicai_vision.core import names

EXACT = (names.SETPOINT, names.CLOCK, names.PROGRESS)
"""What is fed beside features and is not off where the joints are."""


def with_noise(observed: torch.Tensor, inputs: Inputs, deviation: float) -> torch.Tensor:
    """Add noise to the measured poses, whatever else is fed left as it is.

    Args:
        observed: (B, inputs.dim) normalised inputs, the views' features first.
        inputs: what they are.
        deviation: standard deviation of the noise, in standard deviations of each value.
    """
    noisy = observed.clone()
    at = inputs.features
    for key in inputs.vector:
        end = at + VECTORS[key]
        if key not in EXACT:
            noise = torch.randn(len(observed), VECTORS[key]).to(observed.device)
            noisy[:, at:end] += deviation * noise
        at = end
    return noisy


def with_shift(
    observed: torch.Tensor, shapes: Sequence[tuple[int, ...]], places: int, moments: int = 1
) -> torch.Tensor:
    """Move every feature map by up to `places` places each way, each by a draw of its own.

    What comes in from outside is the channel's mean, which is 0 in normalised inputs. The moments
    of a history move together: what a camera is off by does not change from one to the next, and
    the way the needle has gone between them is what a history is there to show.

    Args:
        observed: (B, inputs.dim) normalised inputs, the views' features first.
        shapes: of the features, in their order; only maps (C, h, w) are moved.
        places: largest move [places].
        moments: rows one after the other that are one history; B is a multiple of it.
    """
    moved = torch.zeros_like(observed)
    at = 0
    for shape in shapes:
        size = math.prod(shape)
        if len(shape) == 3:
            maps = observed[:, at : at + size].unflatten(1, shape)
            target = moved[:, at : at + size].unflatten(1, shape)
            moves = torch.randint(-places, places + 1, (len(maps) // moments, 2))
            for row, (down, right) in enumerate(moves.repeat_interleave(moments, 0).tolist()):
                to_y, from_y = _overlap(down, shape[1])
                to_x, from_x = _overlap(right, shape[2])
                target[row, :, to_y, to_x] = maps[row, :, from_y, from_x]
        else:
            moved[:, at : at + size] = observed[:, at : at + size]
        at += size
    moved[:, at:] = observed[:, at:]
    return moved


def _overlap(move: int, length: int) -> tuple[slice, slice]:
    """Return where an axis that is moved lands, and what of it does."""
    low = max(move, 0)
    high = length + min(move, 0)
    return slice(low, high), slice(low - move, high - move)
