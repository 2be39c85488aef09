"""Augmentation in training, views joined to one map, and that both are off by default."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_dataset import FakeDataset, features_of

from policies.base import Inputs, Recipe, visual_shapes
from policies.bc import BC
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.training.augment import with_noise, with_overlay, with_shift
from surgicai_vision.training.checkpoint import WEIGHTS
from surgicai_vision.training.policies import load_policy
from surgicai_vision.training.train import train

QUICK = Recipe(hidden=(32,), epochs=6, batch_size=32, learning_rate=1e-2)
MAP = [3, 2, 2]


def test_noise_is_on_the_measured_pose_alone() -> None:
    torch.manual_seed(0)
    inputs = Inputs(((3, 4, 4),), (names.STATE, names.SETPOINT, names.CLOCK, names.PROGRESS))
    observed = torch.zeros(4000, inputs.dim)
    noise = with_noise(observed, inputs, 0.5)
    pose = slice(inputs.features, inputs.features + 7)
    np.testing.assert_allclose(noise[:, pose].std(0), 0.5, rtol=0.1)
    noise[:, pose] = 0
    assert not noise.any() and not observed.any(), "what is exact, or the inputs, were changed"
    alone = Inputs(((3, 4, 4),), ())
    assert not with_noise(torch.zeros(2, alone.dim), alone, 0.5).any()


def test_noise_is_on_both_arms_of_a_high_level_policy() -> None:
    inputs = Inputs((), (names.BOTH_ARMS,))
    assert (with_noise(torch.zeros(9, 14), inputs, 1.0) != 0).all()


def test_a_moved_map_is_the_map_elsewhere() -> None:
    torch.manual_seed(1)
    maps = torch.arange(1.0, 1 + 2 * 5 * 5).view(1, 2, 5, 5).expand(64, 2, 5, 5)
    observed = torch.cat([maps.flatten(1), torch.ones(64, 7)], dim=1)
    moved = with_shift(observed, ((2, 5, 5),), 2)
    assert torch.equal(moved[:, 50:], observed[:, 50:]), "the vector was moved"
    moves = set()
    for row in moved[:, :50].view(64, 2, 5, 5):
        y, x = (int(axis) for axis in (row[0] == maps[0, 0, 2, 2]).nonzero()[0] - 2)
        moves.add((y, x))
        wanted = torch.zeros(2, 9, 9)
        wanted[:, 2 + y : 7 + y, 2 + x : 7 + x] = maps[0]
        assert torch.equal(row, wanted[:, 2:7, 2:7])
    assert len(moves) > 15 and max(max(move) for move in moves) == 2


def test_a_map_may_be_moved_out_of_its_own_sight() -> None:
    torch.manual_seed(4)
    observed = torch.ones(200, 2 * 9 + 7)
    moved = with_shift(observed, ((2, 3, 3),), 8)
    assert (moved[:, 18:] == 1).all(), "the vector was moved"
    left = moved[:, :18].sum(1)
    assert (left == 0).any() and (left > 0).any() and (left <= 18).all()


def test_views_move_together_where_they_are_joined_only() -> None:
    torch.manual_seed(2)
    observed = torch.ones(200, 2 * 16)
    joined = with_shift(observed, ((2, 4, 4),), 1).view(200, 2, 16)
    apart = with_shift(observed, ((1, 4, 4), (1, 4, 4)), 1).view(200, 2, 16)
    assert torch.equal(joined[:, 0], joined[:, 1])
    assert not torch.equal(apart[:, 0], apart[:, 1])


def test_the_moments_of_a_history_move_together() -> None:
    torch.manual_seed(3)
    observed = torch.ones(300, 2 * 16)
    shapes = ((1, 4, 4), (1, 4, 4))
    histories = with_shift(observed, shapes, 1, moments=3).view(100, 3, 32)
    assert torch.equal(histories, histories[:, :1].expand_as(histories))
    assert len(torch.unique(histories[:, 0], dim=0)) > 30, "each history by its own draw"
    assert not torch.equal(histories[..., :16], histories[..., 16:]), "so each view"


def test_an_overlay_is_a_share_of_another_frame_of_the_same_view() -> None:
    torch.manual_seed(5)
    frame = torch.arange(1.0, 201).view(200, 1)
    observed = torch.cat([frame.expand(200, 18), -frame.expand(200, 18), frame], dim=1)
    mixed = with_overlay(observed, ((2, 3, 3), (2, 3, 3)), 0.4)
    assert torch.equal(mixed[:, 36:], observed[:, 36:]), "the vector was mixed"
    first, second = mixed[:, :18], -mixed[:, 18:36]
    assert not torch.equal(first, second), "each view by its own draw"
    for view in (first, second):
        torch.testing.assert_close(view, view[:, :1].expand(200, 18), msg="one share for a map")
        # A share s of frame j leaves (1 - s) i + s j: at most .4 of the way to the farthest frame.
        away = view[:, 0] - frame[:, 0]
        assert (away > 0).any() and (away < 0).any()
        assert (away <= 0.4 * (200 - frame[:, 0]) + 1e-4).all()
        assert (away >= 0.4 * (1 - frame[:, 0]) - 1e-4).all()
    assert torch.equal(with_overlay(observed, ((2, 3, 3), (2, 3, 3)), 0.0), observed)


def test_the_moments_of_a_history_are_mixed_with_those_of_one_other() -> None:
    torch.manual_seed(6)
    history = torch.arange(100.0).view(100, 1, 1).expand(100, 3, 4)
    moment = torch.arange(3.0).view(1, 3, 1) / 10
    observed = (history + moment).flatten(0, 1)
    mixed = with_overlay(observed, ((1, 2, 2),), 0.4, moments=3).view(100, 3, 4)
    torch.testing.assert_close(mixed - moment, (mixed[:, :1]).expand(100, 3, 4))
    assert not torch.equal(mixed[:, 0], observed.view(100, 3, 4)[:, 0])


def test_joined_views_are_one_map_with_all_channels(tmp_path: Path) -> None:
    recipe = replace(QUICK, join_views=True, map_head="convolutions")
    two = ((40, 28, 28), (40, 28, 28))
    assert visual_shapes(recipe, two) == ((80, 28, 28),)
    assert visual_shapes(QUICK, two) == two
    assert visual_shapes(recipe, two[:1]) == two[:1]
    dataset = FakeDataset()
    views = [features_of(dataset, view, shape=MAP) for view in ("front", "back")]
    train(dataset, views, BC, recipe, out=tmp_path / "a")
    policy = load_policy(tmp_path / "a")
    assert len(policy.network.heads) == 1 and policy.network.heads[0].shape == (6, 2, 2)
    both = np.tile(dataset.rows[:4].astype(np.float32), 2)
    both[:, 12:] += 1.0
    state = dataset.columns()[names.STATE][:4]
    swapped = np.concatenate([both[:, 12:], both[:, :12]], axis=1)
    assert not np.array_equal(policy.act(both, state), policy.act(swapped, state))


@pytest.mark.parametrize("other", [(1280,), (40, 14, 14)])
def test_views_of_other_shapes_cannot_be_joined(other: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="join_views needs feature maps of equal size"):
        BC.make(Recipe(join_views=True), ((40, 28, 28), other))


def test_augmentation_is_drawn_from_the_training_seed_and_not_when_acting(tmp_path: Path) -> None:
    dataset = FakeDataset()
    views = [features_of(dataset, view, shape=MAP) for view in ("front", "back")]
    recipes = {
        "plain": QUICK,
        "off": replace(QUICK, proprioception_noise=0.0, map_shift=0),
        "noise": replace(QUICK, proprioception_noise=0.3),
        "shift": replace(QUICK, map_shift=1),
        "again": replace(QUICK, map_shift=1),
        "overlay": replace(QUICK, map_overlay=0.4),
    }
    weights = {}
    for name, recipe in recipes.items():
        torch.manual_seed(len(name))  # the caller's random state must not matter
        train(dataset, views, BC, recipe, out=tmp_path / name)
        weights[name] = (tmp_path / name / WEIGHTS).read_bytes()
    assert weights["plain"] == weights["off"] and weights["shift"] == weights["again"]
    assert len({weights[name] for name in ("plain", "noise", "shift", "overlay")}) == 4
    policy = load_policy(tmp_path / "shift")
    asked = np.tile(dataset.rows[:4].astype(np.float32), 2), dataset.columns()[names.STATE][:4]
    assert np.array_equal(policy.act(*asked), policy.act(*asked))


def test_recipes_refuse_augmentation_of_what_is_not_fed() -> None:
    with pytest.raises(InputError, match="proprioception_noise needs proprioception"):
        Recipe(proprioception_noise=0.1, proprioception=False)
    with pytest.raises(InputError, match="privileged off"):
        Recipe(proprioception_noise=0.1, privileged=True)
    with pytest.raises(InputError, match="map_shift -1"):
        Recipe(map_shift=-1)
    for share in (-0.1, 0.5, 1.0):
        with pytest.raises(InputError, match="map_overlay is"):
            Recipe(map_overlay=share)
