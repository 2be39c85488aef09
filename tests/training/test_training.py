"""Training: from the cache to a checkpoint that is read back or refused."""

import io
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fake_dataset import DIM, FakeDataset, features_of

from policies.base import ACTIONS, Inputs, Plugin, Policy, Recipe
from policies.bc import BC
from policies.chunks import ChunkRecipe
from policies.layers import MAP_HEADS, FeatureMLP, Keypoints, MapConvolutions, SpatialSoftmax
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig, to_identity
from surgicai_vision.core.errors import BadFile, InputError, OutputExists, UnknownName
from surgicai_vision.core.files import TEMPORARY
from surgicai_vision.training import policies
from surgicai_vision.training.checkpoint import (
    CARD,
    LOCK,
    REQUEST,
    WEIGHTS,
    check_encoder,
    check_task,
    read_checkpoint,
    read_tensors,
    write_checkpoint,
)
from surgicai_vision.training.data import split
from surgicai_vision.training.folder import STATE, read_state, write_state
from surgicai_vision.training.policies import (
    load_policy,
    load_recipe,
    policy_names,
    recipe_names,
)
from surgicai_vision.training.train import train

QUICK = Recipe(hidden=(32,), epochs=12, batch_size=32, learning_rate=1e-2)


def tensors_of(folder: Path) -> bytes:
    return (folder / WEIGHTS).read_bytes()


def stop(done: int, total: int) -> None:
    """Interrupt a training after its seventh epoch, as its `progress`."""
    if done == 7:
        raise KeyboardInterrupt


def test_paper_recipe_is_the_paper() -> None:
    assert load_recipe("bc", "paper") == Recipe()
    assert Recipe().hidden == (256, 256, 256) and Recipe().learning_rate == 1e-3
    assert Recipe().epochs == 30 and Recipe().batch_size == 256 and Recipe().batch_norm


@pytest.mark.parametrize("name", recipe_names())
def test_every_recipe_loads(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = "hlp" if name == "high-level" else "bc"
    if name in policy_names():  # LeRobot's, which are slow to import
        plugin = Plugin(name, ChunkRecipe, BC.make)
        monkeypatch.setattr(policies, "policy_plugin", lambda _: plugin)
    assert isinstance(load_recipe(policy, name), Recipe)


def test_recipes_refuse_unknown_keys_and_values(tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match="learning_rate"):
        load_recipe("bc", "paper", {"learnin_rate": 1.0})
    with pytest.raises(UnknownName, match="paper"):
        load_recipe("bc", "papre")
    with pytest.raises(InputError, match="epochs"):
        load_recipe("bc", "paper", {"epochs": 0})
    (tmp_path / "bad.yaml").write_text("[")
    with pytest.raises(BadFile):
        load_recipe("bc", tmp_path / "bad.yaml")


@pytest.mark.parametrize(
    ("policy", "change", "told"),
    [
        ("bc", {"proprioception_noise": math.inf}, "proprioception_noise is inf"),
        ("bc", {"learning_rate": math.inf}, "learning_rate is inf"),
        ("bc", {"weight_decay": math.nan}, "weight_decay is nan"),
        ("bc", {"hidden": [8, 99_999_999_999]}, "at most 65536"),
        ("bc", {"epochs": 10**400}, "is too large"),
        ("bc", {"epochs": 10**9}, "at most 1000000"),
        ("bc", {"map_shift": 10**9}, "at most 1024"),
        ("act", {"minutes": math.inf}, "minutes is inf"),
        ("act", {"chunk": 10**9}, "at most 1000"),
    ],
)
def test_recipes_refuse_numbers_that_no_training_has(
    policy: str, change: dict[str, Any], told: str
) -> None:
    with pytest.raises(InputError, match=told):
        load_recipe(policy, "paper" if policy == "bc" else policy, change)


def test_a_network_that_memory_has_no_room_for_is_refused(tmp_path: Path) -> None:
    def full(recipe: Recipe, visual: object) -> Policy:
        raise RuntimeError("[enforce fail] not enough memory\nat …")

    with pytest.raises(InputError, match=r"cannot be built .*not enough memory\)"):
        train(FakeDataset(), [], replace(BC, make=full), QUICK, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_network_is_three_layers_each_preceded_by_batch_norm() -> None:
    kinds = [type(layer).__name__ for layer in BC.make(Recipe(), ((2048,),)).network.layers]
    assert kinds == ["BatchNorm1d", "Linear", "ReLU"] * 3 + ["Linear"]


def test_split_is_by_episode() -> None:
    index = np.repeat(np.arange(20), 7)
    rows, held, episodes = split(index, Recipe(), seed=3)
    assert len(episodes) == 2 and set(index[held]) == set(episodes)
    assert not set(index[rows]) & set(index[held])
    assert sorted([*rows, *held]) == list(range(len(index)))
    again = split(index, Recipe(), seed=3)[2]
    assert again == episodes and split(index, Recipe(), seed=4)[2] != episodes


def test_a_single_episode_is_trained_on_whatever_the_share_held_out() -> None:
    rows, held, episodes = split(np.zeros(7, np.int64), Recipe(validation=0.6), seed=0)
    assert (len(rows), len(held), episodes) == (7, 0, ())


def test_a_policy_acts_by_the_weights_that_it_was_given_last() -> None:
    first, second = (BC.make(QUICK, ((4,),)).eval() for _ in range(2))
    seen = np.ones((2, 4), np.float32), np.ones((2, 7), np.float32)
    assert not np.array_equal(first.act(*seen), second.act(*seen))
    first.load_state_dict(second.state_dict())
    np.testing.assert_array_equal(first.act(*seen), second.act(*seen))


class Averaged(Policy):
    """A policy whose average is kept, and that notes the first answer it is calibrated on."""

    answer: torch.Tensor
    averaging = 0.99

    def __init__(self, recipe: Recipe, visual: tuple[tuple[int, ...], ...]):
        super().__init__(Inputs(visual))
        self.layer = torch.nn.Linear(self.inputs.dim, ACTIONS)
        self.register_buffer("answer", torch.zeros(ACTIONS))

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        actions: torch.Tensor = self.layer(observed)
        return actions

    def loss(self, observed: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.mse_loss(self(observed), target)

    def calibrate(self, answers: torch.Tensor, target: torch.Tensor) -> None:
        self.answer.copy_(answers[0])


def test_a_policy_is_calibrated_with_the_weights_that_are_kept(tmp_path: Path) -> None:
    dataset = FakeDataset()
    plugin = Plugin("averaged", Recipe, Averaged)
    checkpoint = train(dataset, [], plugin, QUICK, out=tmp_path / "a")
    held = np.isin(dataset.episode_index, checkpoint.validation_episodes)
    policy = Averaged(QUICK, ())
    policy.load_state_dict(read_tensors(checkpoint))
    (answer,) = policy.act(None, dataset.columns()[names.STATE][held][:1].astype(np.float32))
    np.testing.assert_allclose(policy.answer, answer, atol=1e-5)


def test_training_learns_and_reads_back(tmp_path: Path) -> None:
    dataset = FakeDataset()
    checkpoint = train(dataset, [features_of(dataset)], BC, QUICK, out=tmp_path / "a")
    assert checkpoint.train_losses[-1] < 0.5 * checkpoint.train_losses[0]
    assert len(checkpoint.validation_losses) == QUICK.epochs == checkpoint.epoch
    assert read_checkpoint(tmp_path / "a") == checkpoint
    policy = load_policy(tmp_path / "a")
    rows, state = dataset.rows[:9].astype(np.float32), dataset.columns()[names.STATE][:9]
    action = policy.act(rows, state)
    assert action.shape == (9, 7) and action.dtype == np.float32 and np.abs(action).max() <= 1
    assert np.array_equal(action, load_policy(tmp_path / "a").act(rows, state))
    alone = np.concatenate([policy.act(rows[i : i + 1], state[i : i + 1]) for i in range(9)])
    assert np.array_equal(action, alone), "an action depends on the batch it was asked in"


def test_statistics_are_those_of_the_training_frames(tmp_path: Path) -> None:
    dataset = FakeDataset()
    train(dataset, [features_of(dataset)], BC, QUICK, out=tmp_path / "a")
    policy = load_policy(tmp_path / "a")
    rows, _, _ = split(dataset.episode_index, QUICK, 0)
    inputs = np.concatenate(
        [dataset.rows.astype(np.float32), dataset.columns()[names.STATE]], axis=1
    )[rows]
    np.testing.assert_allclose(policy.input_mean, inputs.mean(0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(policy.input_std, inputs.std(0), rtol=1e-4)


def test_a_maps_statistics_are_its_channels(tmp_path: Path) -> None:
    dataset = FakeDataset()
    entry = features_of(dataset, shape=[3, 2, 2])
    checkpoint = train(dataset, [entry], BC, QUICK, out=tmp_path / "map")
    index = np.asarray(dataset.episode_index)
    rows = (
        entry.rows[~np.isin(index, checkpoint.validation_episodes)]
        .astype(np.float64)
        .reshape(-1, 3, 4)
    )
    policy = load_policy(tmp_path / "map")
    np.testing.assert_allclose(
        policy.input_mean[:12].view(3, 4), rows.mean((0, 2))[:, None].repeat(4, 1), rtol=1e-4
    )
    np.testing.assert_allclose(
        policy.input_std[:12].view(3, 4), rows.std((0, 2))[:, None].repeat(4, 1), rtol=1e-4
    )


def test_same_seed_same_weights_other_seed_others(tmp_path: Path) -> None:
    dataset = FakeDataset()
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        torch.manual_seed(hash(name) % 1000)  # the caller's random state must not matter
        train(dataset, [features_of(dataset)], BC, QUICK, seed=seed, out=tmp_path / name)
    assert tensors_of(tmp_path / "a") == tensors_of(tmp_path / "b") != tensors_of(tmp_path / "c")


def test_training_leaves_the_callers_random_state(tmp_path: Path) -> None:
    before = torch.get_rng_state()
    dataset = FakeDataset()
    train(dataset, [], BC, QUICK, out=tmp_path / "a")
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize("changes", [{}, {"schedule": "one_cycle", "weight_decay": 1e-3}])
def test_broken_off_training_resumes_to_the_same_weights(
    tmp_path: Path, changes: dict[str, Any]
) -> None:
    recipe = replace(QUICK, **changes)
    dataset = FakeDataset()

    train(dataset, [features_of(dataset)], BC, recipe, out=tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        train(dataset, [features_of(dataset)], BC, recipe, out=tmp_path / "broken", progress=stop)
    with pytest.raises(BadFile, match="has not ended"):
        read_checkpoint(tmp_path / "broken")
    seen: list[int] = []
    train(
        dataset,
        [features_of(dataset)],
        BC,
        recipe,
        out=tmp_path / "broken",
        progress=lambda d, t: seen.append(d),
    )
    assert seen[0] == 5 and seen[-1] == recipe.epochs
    assert tensors_of(tmp_path / "whole") == tensors_of(tmp_path / "broken")
    assert not (tmp_path / "broken" / "training_state.pt").exists()


def test_a_training_that_was_begun_on_a_gpu_goes_on_without_one(tmp_path: Path) -> None:
    dataset = FakeDataset()

    with pytest.raises(KeyboardInterrupt):
        train(dataset, [features_of(dataset)], BC, QUICK, out=tmp_path, progress=stop)
    state = read_state(tmp_path)
    assert state is not None
    write_state(tmp_path, {**state, "random": {**state["random"], "cuda": torch.zeros(16)}})
    checkpoint = train(dataset, [features_of(dataset)], BC, QUICK, out=tmp_path)
    assert checkpoint.epoch == QUICK.epochs


def test_a_damaged_state_is_begun_again(tmp_path: Path) -> None:
    write_state(tmp_path, {"policy": {"weight": torch.arange(6.0)}, "losses": [0.5]})
    whole = (tmp_path / STATE).read_bytes()
    assert read_state(tmp_path) is not None
    other = io.BytesIO()
    torch.save([1, 2, 3], other)
    flipped = [
        whole[:at] + bytes([whole[at] ^ 1 << at % 8]) + whole[at + 1 :]
        for at in range(0, len(whole), 7)
    ]
    for content in (b"", whole[:9], whole[:-1], whole + b"x", other.getvalue(), *flipped):
        (tmp_path / STATE).write_bytes(content)
        assert read_state(tmp_path) is None

    dataset = FakeDataset()
    train(dataset, [], BC, QUICK, out=tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        train(dataset, [], BC, QUICK, out=tmp_path / "broken", progress=stop)
    (tmp_path / "broken" / STATE).write_bytes(other.getvalue())
    train(dataset, [], BC, QUICK, out=tmp_path / "broken")
    assert tensors_of(tmp_path / "whole") == tensors_of(tmp_path / "broken")


def test_a_training_that_was_killed_at_its_first_write_is_begun_again(tmp_path: Path) -> None:
    (tmp_path / f"{TEMPORARY}0-{REQUEST}").write_text("{")
    train(FakeDataset(), [], BC, QUICK, out=tmp_path)
    assert not list(tmp_path.glob(f"{TEMPORARY}*"))


def test_what_a_killed_training_left_is_removed(tmp_path: Path) -> None:
    dataset = FakeDataset()
    with pytest.raises(KeyboardInterrupt):
        train(dataset, [], BC, QUICK, out=tmp_path, save_every=2, progress=stop)
    state = (tmp_path / STATE).read_bytes()
    for name in (LOCK, f"{TEMPORARY}0-{STATE}", f"epochs/epoch_0002/{TEMPORARY}0-{WEIGHTS}"):
        (tmp_path / name).write_bytes(b"torn")

    train(dataset, [], BC, QUICK, out=tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {REQUEST, WEIGHTS, CARD, "epochs"}
    assert not list(tmp_path.rglob(f"{TEMPORARY}*"))
    (tmp_path / STATE).write_bytes(state)  # killed between the checkpoint and the end
    train(dataset, [], BC, QUICK, out=tmp_path)
    assert not (tmp_path / STATE).exists()


def test_a_folder_in_which_another_process_trains_is_refused(tmp_path: Path) -> None:
    dataset = FakeDataset()

    def again(done: int, total: int) -> None:
        with pytest.raises(InputError, match="Another run is training"):
            train(dataset, [], BC, QUICK, out=tmp_path)

    train(dataset, [], BC, QUICK, out=tmp_path, progress=again)


def test_training_again_does_nothing_and_another_request_is_refused(tmp_path: Path) -> None:
    dataset = FakeDataset()
    first = train(dataset, [], BC, QUICK, out=tmp_path / "a")
    assert (
        train(
            dataset, [], BC, QUICK, out=tmp_path / "a", progress=lambda d, t: pytest.fail("trained")
        )
        == first
    )
    with pytest.raises(OutputExists):
        train(dataset, [], BC, QUICK, seed=1, out=tmp_path / "a")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").write_text("x")
    with pytest.raises(OutputExists):
        train(dataset, [], BC, QUICK, out=tmp_path / "foreign")


def test_proprioception_alone_and_several_views(tmp_path: Path) -> None:
    dataset = FakeDataset()
    state = dataset.columns()[names.STATE][:4]
    train(dataset, [], BC, QUICK, out=tmp_path / "none")
    assert load_policy(tmp_path / "none").act(None, state).shape == (4, 7)
    views = [features_of(dataset, "front"), features_of(dataset, "back")]
    checkpoint = train(dataset, views, BC, QUICK, out=tmp_path / "two")
    assert checkpoint.views == ("front", "back") and checkpoint.visual == ((DIM,), (DIM,))
    both = np.tile(dataset.rows[:4].astype(np.float32), 2)
    assert load_policy(tmp_path / "two").act(both, state).shape == (4, 7)


@pytest.mark.parametrize(("shape", "width"), [([3, 2, 2], 64), ([4, 3], 3), ([12], 12)])
def test_maps_and_tokens_pass_a_trained_layer(tmp_path: Path, shape: list[int], width: int) -> None:
    dataset = FakeDataset()
    checkpoint = train(dataset, [features_of(dataset, shape=shape)], BC, QUICK, out=tmp_path / "a")
    policy = load_policy(tmp_path / "a")
    assert checkpoint.visual == (tuple(shape),) and policy.network.heads[0].dim == width
    state = dataset.columns()[names.STATE][:4]
    assert policy.act(dataset.rows[:4].astype(np.float32), state).shape == (4, 7)


def test_spatial_softmax_finds_the_bright_place() -> None:
    head = SpatialSoftmax(1, 5, 5)
    torch.nn.init.constant_(head.patterns.weight, 50.0)
    image = torch.zeros(1, 1, 5, 5)
    image[0, 0, 4, 0] = 1.0
    np.testing.assert_allclose(head(image.flatten(1)).detach()[0, :2], [-1, 1], atol=1e-5)


@pytest.mark.parametrize("name", ["convolutions", "keypoints"])
def test_heads_read_where_an_arc_lies_after_little_training(name: str) -> None:
    torch.manual_seed(0)
    reader = MAP_HEADS[name](1, 28, 28)
    head = torch.nn.Sequential(reader, torch.nn.Linear(reader.dim, 2))
    places = torch.randint(4, 24, (600, 2))
    maps = torch.zeros(600, 28, 28)
    for index, (y, x) in enumerate(places.tolist()):
        maps[index, y - 3 : y + 4, x] = maps[index, y, x - 3 : x + 1] = 1.0
    rows, wanted = maps.flatten(1), places.float() / 14 - 1
    optimiser = torch.optim.Adam(head.parameters(), 1e-3)
    for _ in range(150):
        batch = torch.randint(500, (64,))
        optimiser.zero_grad()
        torch.nn.functional.mse_loss(head(rows[batch]), wanted[batch]).backward()
        optimiser.step()
    with torch.no_grad():
        error = (head(rows[500:]) - wanted[500:]).abs().mean() * 14
    assert error < 1.0, "in places of the map; a guess errs by 5"


@pytest.mark.parametrize("side", [7, 14, 28, 56])
def test_keypoints_of_a_shifted_map_are_shifted(side: int) -> None:
    """What a pattern sees decides where it lies, whatever the size of the map."""
    torch.manual_seed(0)
    head = Keypoints(2, side, side)
    step = -(-side // 14)  # places of the map to one place of a keypoint
    with torch.no_grad():
        head.patterns[-1].weight *= 1e4  # type: ignore[operator]
        maps = torch.zeros(2, 2, side, side)
        middle = side // 2
        maps[0, :, middle - step : middle, middle - step : middle] = 1.0
        maps[1, :, middle : middle + step, middle - step : middle] = 1.0
        first, second = head(maps.flatten(1)).view(2, -1, 2)
    assert first.shape == (head.dim // 2, 2) and first.abs().max() < 1.001
    near = first.abs().max(dim=1).values < 0.5  # the border does not decide
    assert near.any()
    x, y = (second - first)[near].median(dim=0).values.tolist()
    assert x == pytest.approx(0, abs=1e-3)
    assert y == pytest.approx(2 / (min(side, 14) - 1), abs=0.02)


def test_instance_norm_hides_what_a_look_does_to_a_whole_channel() -> None:
    """Another gain and offset of each channel change what the head reads without it alone."""
    rng = torch.Generator().manual_seed(0)
    shape = (6, 14, 14)
    maps = torch.randn((4, *shape), generator=rng)
    gain = 0.5 + 1.5 * torch.rand((4, 6, 1, 1), generator=rng)
    other = gain * maps + torch.randn((4, 6, 1, 1), generator=rng)
    vector = torch.zeros(4, 7)
    moved = {}
    for on in (False, True):
        torch.manual_seed(0)
        recipe = Recipe(map_head="convolutions", instance_norm=on)
        network = FeatureMLP(recipe, Inputs((shape,)), 7).eval()
        with torch.no_grad():
            one, two = (network.seen(torch.cat([of.flatten(1), vector], 1)) for of in (maps, other))
        moved[on] = float((two - one).abs().mean() / one.abs().mean())
    assert moved[False] > 0.3 and moved[True] < 0.1 * moved[False], moved


def test_instance_norm_leaves_what_is_no_map() -> None:
    shown = torch.randn(3, 5 + 8)
    answers = []
    for on in (False, True):
        torch.manual_seed(0)
        network = FeatureMLP(Recipe(instance_norm=on), Inputs(((5,), (2, 4)), ()), 7).eval()
        with torch.no_grad():
            answers.append(network(shown))
    assert torch.equal(*answers)


def test_a_recipe_without_instance_norm_keeps_its_identity() -> None:
    assert "instance_norm" not in to_identity(Recipe())
    assert to_identity(Recipe(instance_norm=True))["instance_norm"] is True


@pytest.mark.parametrize("key", ["speed", "jaw_speed", "pinch_speed", "clock_speed"])
def test_a_recipe_at_full_speed_keeps_its_identity(key: str) -> None:
    assert key not in to_identity(Recipe())
    for wrong in (0.0, -0.5, 1.5, float("nan")):
        with pytest.raises(InputError, match=f"^{key} is"):
            Recipe(**{key: wrong})  # type: ignore[arg-type]


def test_recipes_name_how_maps_are_taken_in_and_how_many_frames() -> None:
    best = load_recipe("bc", "best")
    assert BC.make(best, ((40, 28, 28),)).network.heads[0].dim == MapConvolutions.FEATURES  # type: ignore[attr-defined]
    with pytest.raises(UnknownName, match="convolutions"):
        Recipe(map_head="convolution")
    with pytest.raises(InputError, match="frame_stride is 0"):
        Recipe(frame_stride=0)


def test_epoch_checkpoints_and_fine_tuning(tmp_path: Path) -> None:
    dataset = FakeDataset()
    train(dataset, [], BC, QUICK, out=tmp_path / "a", save_every=5)
    kept = sorted(path.name for path in (tmp_path / "a" / "epochs").iterdir())
    assert kept == ["epoch_0005", "epoch_0010"]
    early = load_policy(tmp_path / "a" / "epochs" / "epoch_0005")
    assert early.checkpoint.epoch == 5
    tuned = train(dataset, [], BC, QUICK, out=tmp_path / "b", start=load_policy(tmp_path / "a"))
    assert tuned.train_losses[0] < read_checkpoint(tmp_path / "a").train_losses[0]


@pytest.mark.parametrize(
    "axes", [{"appearance": "heldout"}, {"appearance": "liver"}, {"appearance_shift": 0.1}]
)
def test_held_out_looks_are_refused(tmp_path: Path, axes: dict[str, Any]) -> None:
    """With images of them; a policy that sees no images may train."""

    def recorded(**axes: Any) -> FakeDataset:
        randomisation = RandomisationConfig(**axes)
        return FakeDataset(config=TaskConfig("grasp", randomisation=randomisation))

    dataset = recorded(**axes)
    with pytest.raises(InputError, match=r"held out.*appearance: train"):
        train(dataset, [features_of(dataset)], BC, QUICK, out=tmp_path / "a")
    train(dataset, [], BC, QUICK, out=tmp_path / "b")
    shown = recorded(appearance="train")
    train(shown, [features_of(shown)], BC, QUICK, out=tmp_path / "c")


def test_wrong_inputs_are_refused(tmp_path: Path) -> None:
    dataset = FakeDataset()
    with pytest.raises(InputError, match="another dataset"):
        train(dataset, [features_of(dataset, dataset="other")], BC, QUICK, out=tmp_path / "a")
    mixed = [features_of(dataset), features_of(dataset, "front", encoder_fingerprint="g")]
    with pytest.raises(InputError, match="several encoders"):
        train(dataset, mixed, BC, QUICK, out=tmp_path / "a")
    with pytest.raises(InputError, match="blind"):
        BC.make(Recipe(proprioception=False), ())
    assert not (tmp_path / "a").exists()
    dataset.columns()[names.ACTION][3] = np.nan
    with pytest.raises(InputError, match="not finite"):
        train(dataset, [], BC, QUICK, out=tmp_path / "a")


def test_policy_refuses_wrong_observations(tmp_path: Path) -> None:
    policy = BC.make(QUICK, ((DIM,),))
    policy.eval()
    good, state = np.zeros((2, DIM), np.float32), np.zeros((2, 7), np.float32)
    for features, pose in (
        (None, state),
        (good[:, 1:], state),
        (good, state[:1]),
        (good, state[:, 1:]),
    ):
        with pytest.raises(InputError):
            policy.act(features, pose)
    with pytest.raises(InputError, match="not finite"):
        policy.act(good * np.nan, state)


def test_tampered_checkpoints_are_refused(tmp_path: Path) -> None:
    dataset = FakeDataset()
    folder = tmp_path / "a"
    train(dataset, [], BC, QUICK, out=folder)
    card, weights = (folder / CARD).read_text(), tensors_of(folder)
    (folder / WEIGHTS).write_bytes(weights[:-4] + b"abcd")
    with pytest.raises(BadFile, match="sha256"):
        load_policy(folder)
    (folder / WEIGHTS).unlink()
    with pytest.raises(BadFile, match="Cannot read"):
        load_policy(folder)
    (folder / WEIGHTS).write_bytes(weights)
    for change in ({"seed": 5}, {"format": 99}):
        (folder / CARD).write_text(json.dumps({**json.loads(card), **change}))
        with pytest.raises(BadFile):
            load_policy(folder)
    (folder / CARD).write_text(card[:50])
    with pytest.raises(BadFile, match="JSON"):
        load_policy(folder)
    with pytest.raises(BadFile, match="not a checkpoint"):
        load_policy(tmp_path)
    (tmp_path / "hierarchical.yaml").write_text("hlp: order")
    with pytest.raises(BadFile, match="is a file, not the folder of a checkpoint"):
        load_policy(tmp_path / "hierarchical.yaml")
    seeing = train(dataset, [features_of(dataset)], BC, QUICK, out=tmp_path / "seeing")
    assert seeing.encoder is not None
    card_alone = replace(seeing, encoder=replace(seeing.encoder, card={"mean": 0}))
    write_checkpoint(tmp_path / "seeing", card_alone, load_policy(tmp_path / "seeing").state_dict())
    with pytest.raises(BadFile, match="card of its encoder has no input_size, input_range, std, "):
        read_checkpoint(tmp_path / "seeing")


def test_another_encoder_or_task_is_refused(tmp_path: Path) -> None:
    dataset = FakeDataset()
    checkpoint = train(dataset, [features_of(dataset)], BC, QUICK, out=tmp_path / "a")
    with pytest.raises(InputError, match="needs encoder 'fake'"):
        check_encoder(checkpoint, None)
    with pytest.raises(InputError, match="not 'place'"):
        check_task(checkpoint, "place")


def odd_policy(recipe: Recipe, visual: tuple[tuple[int, ...], ...]) -> Policy:
    """Return a policy that gives two values too few."""
    policy = BC.make(recipe, visual)
    forward = policy.forward
    policy.forward = lambda observed: forward(observed)[:, :5]  # type: ignore[method-assign]
    return policy


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda *_: 1 / 0, "failed: ZeroDivisionError"),
        (lambda *_: None, "makes what is None; it must be an instance"),
        (odd_policy, r"answers of shape \(2, 5\).*must be \(2, 7\)"),
    ],
)
def test_a_policy_that_cannot_be_used_is_named(make: Any, message: str) -> None:
    policies.register_policy("odd", replace(BC, make=make), "theirs")
    try:
        with pytest.raises(InputError, match=rf"^The policy 'odd' of 'theirs' .*{message}"):
            policies.policy_plugin("odd").make(QUICK, ())
    finally:
        policies.POLICIES.unregister("odd")


def test_a_policy_has_the_name_it_is_offered_under() -> None:
    policies.register_policy("odd", replace(BC, name="something-else"), "theirs")
    try:
        assert policies.policy_plugin("odd").name == "odd"
    finally:
        policies.POLICIES.unregister("odd")
