"""The detector's network: a small image → for each arm, how likely its jaws are at each place.

Convolutions halve the image three times and double it twice again, with the finer maps added back
(as in a U-Net). Every camera has its own last layer; all else is shared. A place is read as the
expected position around the most likely cell, so it is finer than a cell.
"""

import math
from typing import final

import torch
from torch import nn

from surgicai_vision.core import names

CELLS = (60, 80)
"""Rows and columns of the answer: a cell is about 1.6 mm at the holes in "front" and "back"."""
SPREAD = 1.0
"""Standard deviation of the target distribution about the true place [cells]."""
REACH = 3
"""Cells around the most likely one, each way, from which a place is read."""


def _layer(before: int, after: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """Return a 3 × 3 convolution with normalisation and ReLU."""
    convolution = nn.Conv2d(
        before, after, 3, stride, padding=dilation, dilation=dilation, bias=False
    )
    return nn.Sequential(convolution, nn.BatchNorm2d(after), nn.ReLU())


@final
class JawNetwork(nn.Module):
    """Images of several cameras → log-probabilities of each arm's place.

    Args:
        cameras: number of cameras.
    """

    def __init__(self, cameras: int):
        super().__init__()
        self.halved = _layer(3, 16, stride=2)
        self.quartered = nn.Sequential(_layer(16, 32, stride=2), _layer(32, 32))
        self.coarse = nn.Sequential(
            _layer(32, 64, stride=2),
            _layer(64, 64, dilation=2),
            _layer(64, 64, dilation=4),
            _layer(64, 64, dilation=2),
        )
        self.to_quarter = nn.Conv2d(64, 32, 1)
        self.at_quarter = _layer(32, 32)
        self.to_half = nn.Conv2d(32, 16, 1)
        self.at_half = _layer(16, 16)
        self.heads = nn.Conv2d(16, cameras * len(names.ARMS), 1)

    def forward(self, images: torch.Tensor, cameras: torch.Tensor) -> torch.Tensor:
        """Return log-probabilities (B, 2, rows · columns) of psm1's and psm2's cell.

        Args:
            images: (B, 3, 120, 160), from 0 to 1.
            cameras: (B,) index of each image's camera.
        """
        half = self.halved(images - 0.5)
        quarter = self.quartered(half)
        eighth = self.coarse(quarter)
        quarter = self.at_quarter(quarter + self.to_quarter(_double(eighth)))
        half = self.at_half(half + self.to_half(_double(quarter)))
        scores = self.heads(half).unflatten(1, (-1, len(names.ARMS)))
        chosen = scores[torch.arange(len(images), device=images.device), cameras]
        answers: torch.Tensor = chosen.flatten(2).log_softmax(dim=2)
        return answers


def _double(maps: torch.Tensor) -> torch.Tensor:
    """Return maps at twice their height and width."""
    return nn.functional.interpolate(maps, scale_factor=2, mode="bilinear", align_corners=False)


def _centres(device: torch.device) -> torch.Tensor:
    """Return x and y of every cell's centre (rows · columns, 2) [cells]."""
    rows, columns = CELLS
    y, x = torch.meshgrid(
        torch.arange(rows, device=device) + 0.5,
        torch.arange(columns, device=device) + 0.5,
        indexing="ij",
    )
    return torch.stack([x.flatten(), y.flatten()], dim=1)


def _in_cells(places: torch.Tensor) -> torch.Tensor:
    """Return places, shares of width and height, in cells."""
    return places * torch.tensor([CELLS[1], CELLS[0]], device=places.device)


def loss(answers: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Return the mean cross-entropy against a Gaussian about each true place.

    Places outside the image do not count.

    Args:
        answers: log-probabilities (B, 2, rows · columns).
        places: (B, 2, 2), shares of width and height.
    """
    away = _in_cells(places)[:, :, None] - _centres(places.device)
    target = (-away.square().sum(dim=3) / (2 * SPREAD**2)).softmax(dim=2)
    inside = ((places >= 0) & (places <= 1)).all(dim=2)
    entropy = -(target * answers).sum(dim=2)
    return (entropy * inside).sum() / inside.sum().clamp(min=1)


def read_places(answers: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the most likely places (B, 2, 2), shares of width and height, and how likely they are.

    The second result (B, 2) is the probability that lies within `REACH` cells of the place.
    """
    likely = answers.exp()
    centres = _centres(answers.device)
    most = centres[answers.argmax(dim=2)]
    near = ((centres - most[:, :, None]).abs() <= REACH).all(dim=3)
    weight = likely * near
    total = weight.sum(dim=2)
    at = (weight[..., None] * centres).sum(dim=2) / total[..., None].clamp(min=math.ulp(0.0))
    return at / torch.tensor([CELLS[1], CELLS[0]], device=at.device), total
