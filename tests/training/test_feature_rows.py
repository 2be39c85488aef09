"""Feature rows: a training sees the same features whether the disk or a GPU has them."""

import dataclasses

import numpy as np
import pytest
import torch
from fake_dataset import features_of, recorded

from surgicai_vision.features.devices import CPU, CUDA
from surgicai_vision.training.feature_rows import FeatureRows

NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")


@pytest.mark.parametrize(
    ("device", "free", "home"),
    [
        (CPU, None, CPU),
        pytest.param(CUDA, None, CUDA, marks=NEEDS_GPU),
        pytest.param(CUDA, 0, CPU, marks=NEEDS_GPU, id="no room"),
    ],
)
def test_the_views_follow_one_another_in_the_rows_that_are_asked_for(
    device: str, free: int | None, home: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if free is not None:
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (free, free))
    whole = recorded()
    first = features_of(whole)
    second = dataclasses.replace(first, rows=first.rows[::-1, :5] / 2)
    features = FeatureRows([first, second], torch.device(device))
    assert features.home.type == home
    order = np.random.default_rng(0).permutation(whole.length)[:40]
    width = first.dim + second.dim
    observed = torch.full((len(order), width + 3), 7.0, device=features.home)
    assert features.write(order, observed) == width
    expected = np.concatenate([first.rows[order], second.rows[order]], axis=1)
    np.testing.assert_array_equal(observed[:, :width].cpu().numpy(), expected)
    assert (observed[:, width:] == 7).all()


def test_there_may_be_no_views() -> None:
    features = FeatureRows([], torch.device(CPU))
    assert features.write(np.arange(3), torch.zeros(3, 2)) == 0
