"""A tiny encoder with everything a real one has: convolutions, BatchNorm, a card."""

from dataclasses import replace

import torch

from encoders.card import EncoderCard, Plugin
from encoders.random_resnet import CARD


def build(card: EncoderCard, path: object) -> tuple[EncoderCard, torch.nn.Module]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        layers = (torch.nn.Conv2d(3, 8, 4, 4), torch.nn.BatchNorm2d(8), torch.nn.ReLU())
        return card, torch.nn.Sequential(*layers, torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten())


TINY = Plugin(replace(CARD, name="tiny", input_size=32, dim=8), build)
