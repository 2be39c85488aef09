"""Augmentation of normalised inputs, applied only in training and never when a policy acts.

* `with_noise(observed, inputs, deviation)`: Gaussian noise on the measured poses (the recipe's
  `proprioception_noise`), so that a policy does not rely on the joints beyond their accuracy. The
  other inputs (`EXACT`) stay unchanged.
* `with_shift(observed, shapes, places)`: feature maps shifted by whole places (the recipe's
  `map_shift`), as if a crop missed the jaws; DrQ shifts images in the same way (Kostrikov et al.,
  Image augmentation is all you need, ICLR 2021).
* `with_overlay(observed, shapes, share)`: feature maps with that of another frame laid over them
  (the recipe's `map_overlay`), so that a policy finds the needle among patterns that do not belong
  there; Hansen and Wang lay random images over theirs (Generalization in reinforcement learning by
  soft data augmentation, ICRA 2021).

All draw from torch's global random state, which `train` seeds, stores and restores.
"""

import math
from collections.abc import Sequence

import torch

from policies.base import VECTORS, Inputs
from surgicai_vision.core import names

EXACT = (names.SETPOINT, names.CLOCK, names.PROGRESS)
"""Inputs fed alongside the features that errors of the joints do not affect."""


def with_noise(observed: torch.Tensor, inputs: Inputs, deviation: float) -> torch.Tensor:
    """Add noise to the measured poses and leave all other inputs unchanged.

    Args:
        observed: (B, inputs.dim) normalised inputs, the views' features first.
        inputs: the layout of these inputs.
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
    """Shift every feature map by up to `places` places each way, each by its own random draw.

    Places from outside the map get the channel's mean, which is 0 in normalised inputs. The moments
    of a history shift together: a camera's offset does not change from one to the next, and a
    history must still show how the needle moved between them.

    Args:
        observed: (B, inputs.dim) normalised inputs, the views' features first.
        shapes: shapes of the features, in order; only maps (C, h, w) are shifted.
        places: largest shift [places].
        moments: consecutive rows that form one history; B is a multiple of it.
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


def with_overlay(
    observed: torch.Tensor, shapes: Sequence[tuple[int, ...]], share: float, moments: int = 1
) -> torch.Tensor:
    """Mix every feature map with the same view's map of another frame of the batch.

    Which frame, and its share, are drawn anew for each frame and view.

    Args:
        observed: (B, inputs.dim) normalised inputs, the views' features first.
        shapes: shapes of the features, in order; only maps (C, h, w) are mixed.
        share: largest share of the other map, from 0 to 1.
        moments: consecutive rows that form one history; B is a multiple of it. A history is mixed
            with another one, moment by moment, by the same share.
    """
    mixed = observed.clone()
    at = 0
    for shape in shapes:
        size = math.prod(shape)
        if len(shape) == 3:
            maps = observed[:, at : at + size].unflatten(0, (-1, moments))
            other = maps[torch.randperm(len(maps)).to(maps.device)]
            weight = share * torch.rand(len(maps), 1, 1).to(maps.device)
            mixed[:, at : at + size] = maps.lerp(other, weight).flatten(0, 1)
        at += size
    return mixed


def _overlap(move: int, length: int) -> tuple[slice, slice]:
    """Return the target and the source slice of an axis of `length` places shifted by `move`.

    Both are empty if the shift leaves nothing of the axis.
    """
    move = min(max(move, -length), length)
    low = max(move, 0)
    high = length + min(move, 0)
    return slice(low, high), slice(low - move, high - move)
