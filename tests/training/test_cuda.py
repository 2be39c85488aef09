"""Training and encoding on a GPU; skipped where torch finds none."""

from pathlib import Path

import numpy as np
import pytest
import torch
from fake_dataset import fake_procedures, features_of, recorded
from photographs import hopper
from tiny_encoder import TINY

from encoders.base import Encoder
from surgicai_vision.dataset.protocol import Dataset
from surgicai_vision.features.devices import CPU, CUDA
from surgicai_vision.training.chunks import timeline_of, with_chunks
from surgicai_vision.training.policies import load_policy, load_recipe, policy_plugin
from surgicai_vision.training.train import train

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")

RECIPES = {
    "bc": "endoscope",
    "act": "act",
    "diffusion": "diffusion",
    "vqbet": "vqbet",
    "hlp": "high-level",
}
"""A recipe of each kind of policy."""


def train_small(policy: str, out: Path, device: str, stop_after: int = 0) -> None:
    """Train a policy for seven epochs on maps; a stopped training leaves its state in `out`."""

    def stop(epoch: int, _: dict[str, float]) -> None:
        if epoch == stop_after:
            raise KeyboardInterrupt

    recipe = load_recipe(policy, RECIPES[policy], {"epochs": 7, "batch_size": 64, "map_shift": 1})
    plugin = policy_plugin(policy)
    whole = fake_procedures() if policy == "hlp" else recorded()
    dataset: Dataset = whole
    if plugin.offsets:
        dataset = with_chunks(whole, timeline_of(whole), plugin.offsets(recipe))
    entry = features_of(whole, shape=[3, 2, 2]).part(np.arange(whole.length), dataset.fingerprint)
    train(dataset, [entry], plugin, recipe, out=out, device=device, log=stop)


@pytest.mark.parametrize("policy", RECIPES)
def test_a_broken_off_training_ends_the_same_on_a_gpu(policy: str, tmp_path: Path) -> None:
    train_small(policy, tmp_path / "whole", CUDA)
    with pytest.raises(KeyboardInterrupt):
        train_small(policy, tmp_path / "broken", CUDA, stop_after=6)
    train_small(policy, tmp_path / "broken", CUDA)
    whole, broken = (load_policy(tmp_path / name).state_dict() for name in ("whole", "broken"))
    for key, value in whole.items():
        assert torch.equal(value, broken[key]), key


@pytest.mark.parametrize("policy", RECIPES)
def test_a_policy_of_a_gpu_acts_on_the_cpu(policy: str, tmp_path: Path) -> None:
    train_small(policy, tmp_path, CUDA)
    loaded = load_policy(tmp_path)
    assert {tensor.device.type for tensor in loaded.state_dict().values()} == {CPU}
    action = loaded(torch.zeros(3, loaded.inputs.dim))
    assert action.shape[0] == 3 and torch.isfinite(action).all()


def test_a_gpu_and_the_cpu_encode_alike() -> None:
    image = hopper()[0]
    frames = np.stack([np.roll(image, shift, axis=1) for shift in range(0, 50, 10)])
    in_float32 = Encoder(
        *TINY.build(TINY.card, None), device=torch.device(CPU), dtype=torch.float32
    )
    encoder = Encoder(*TINY.build(TINY.card, None), device=torch.device(CUDA))
    on_cpu, on_gpu = in_float32(frames), encoder(frames)
    assert encoder.device.type == CUDA
    np.testing.assert_allclose(on_gpu, on_cpu, rtol=0.02, atol=0.02)  # bfloat16 has 8 bits
    np.testing.assert_array_equal(encoder(frames[2:3])[0], on_gpu[2])
