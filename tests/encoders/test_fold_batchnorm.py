"""Folding BatchNorms: outputs stay, BatchNorm passes go, other orders are left alone."""

import copy

import pytest
import torch
import torchvision
from torch import nn

from encoders.fold_batchnorm import fold_batch_norms
from surgicai_vision.features import encoders


def norms(network: nn.Module) -> int:
    """Count the BatchNorms of a network."""
    return sum(isinstance(part, nn.BatchNorm2d) for part in network.modules())


def stirred(network: nn.Module) -> nn.Module:
    """Give every BatchNorm random statistics, scale and shift."""
    generator = torch.Generator().manual_seed(0)
    for part in network.modules():
        if isinstance(part, nn.BatchNorm2d):
            part.running_mean.normal_(0.0, 0.3, generator=generator)
            part.running_var.uniform_(0.5, 2.0, generator=generator)
            nn.init.uniform_(part.weight, 0.5, 1.5, generator=generator)
            nn.init.normal_(part.bias, 0.0, 0.3, generator=generator)
    return network.eval().requires_grad_(False)


def test_a_resnet_answers_as_before_without_one_batch_norm() -> None:
    network = stirred(torchvision.models.resnet18())
    before = copy.deepcopy(network.state_dict())
    folded = fold_batch_norms(network, 64)
    assert norms(network) == 20 and norms(folded) == 0
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items()), (
        "the given one stays"
    )
    images = torch.randn(3, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(folded(images), network(images), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", encoders.OFFLINE_ENCODERS)
def test_every_encoder_that_needs_no_download_folds_whole(name: str) -> None:
    encoder = encoders.load_encoder(name)
    assert norms(encoder._network) == 0


class Backwards(nn.Module):
    """Its BatchNorm is defined after the convolution and runs before it."""

    def __init__(self) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(3, 3, 3)
        self.norm = nn.BatchNorm2d(3)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.convolution(self.norm(images))


def test_what_stands_in_order_but_does_not_run_so_is_left_alone() -> None:
    network = stirred(Backwards())
    assert fold_batch_norms(network, 16) is network and norms(network) == 1
    plain = nn.Conv2d(3, 4, 3).eval()
    assert fold_batch_norms(plain, 16) is plain
