"""The high-level policy: progress alongside the subtask, calibration, errors on held-out frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_dataset import fake_procedures as procedures
from fake_dataset import features_of

from policies.hlp import HLP, HLPRecipe, fit_temperature
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.training.checkpoint import read_checkpoint, read_tensors, write_checkpoint
from surgicai_vision.training.policies import load_policy, load_recipe
from surgicai_vision.training.stage_errors import stage_errors
from surgicai_vision.training.train import train
from surgicai_vision.training.visits import UNKNOWN, stages

RECIPE = HLPRecipe(hidden=(32, 32), epochs=40, batch_size=32, learning_rate=1e-2, progress=1.0)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the checkpoint of a policy that learned subtasks and progress."""
    out = tmp_path_factory.mktemp("hlp") / "a"
    train(procedures(), [], HLP, RECIPE, out=out)
    return out


def test_it_learns_the_subtask_that_is_due_and_the_progress(trained: Path) -> None:
    policy = load_policy(trained)
    columns = procedures().columns()
    answers = policy.act(None, columns[names.BOTH_ARMS])
    assert answers.shape == (1200, 6)
    target = stages(columns, procedures().episode_index)
    assert (answers[:, :5].argmax(axis=1) == target[:, 0]).mean() > 0.9
    assert ((answers[:, 5] >= 0) & (answers[:, 5] <= 1)).all()
    guess = np.abs(target[:, 1] - target[:, 1].mean()).mean()
    assert np.abs(answers[:, 5] - target[:, 1]).mean() < 0.5 * guess


def test_its_errors_are_those_on_the_episodes_held_out(trained: Path) -> None:
    checkpoint = read_checkpoint(trained)
    dataset = procedures()
    held = np.isin(dataset.episode_index, checkpoint.validation_episodes)
    target = stages(dataset.columns(), dataset.episode_index)[held]
    answers = load_policy(trained).act(None, dataset.columns()[names.BOTH_ARMS][held])
    found = checkpoint.stage_errors
    again = stage_errors(answers, target)
    assert found is not None and found.frames == held.sum() == 200
    assert found.confusion == again.confusion
    assert found.right == (answers[:, :5].argmax(axis=1) == target[:, 0]).sum()
    assert found.progress_error == pytest.approx(np.abs(answers[:, 5] - target[:, 1]).mean(), 1e-4)
    assert found.calibration_error == pytest.approx(again.calibration_error, abs=1e-4)


@pytest.mark.parametrize("name", ["privileged", "setpoint", "progress_input"])
def test_inputs_that_it_does_not_read_are_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"leave '{name}' off"):
        HLPRecipe(**{name: True})


def test_a_speed_is_refused() -> None:
    with pytest.raises(InputError, match="leave 'speed' at 1"):
        HLPRecipe(speed=0.5)
    with pytest.raises(InputError, match="leave 'jaw_speed' at 1"):
        HLPRecipe(jaw_speed=0.5)
    with pytest.raises(InputError, match="leave 'clock_speed' at 1"):
        HLPRecipe(clock_speed=0.5)


def test_without_progress_it_is_the_policy_it_was(tmp_path: Path) -> None:
    recipe = replace(RECIPE, progress=0.0, epochs=2)
    train(procedures(), [], HLP, recipe, out=tmp_path / "a")
    policy = load_policy(tmp_path / "a")
    arms = procedures().columns()[names.BOTH_ARMS][:9]
    answers = policy.act(None, arms)
    assert answers.shape == (9, 5)
    np.testing.assert_array_equal(policy.choose(None, arms), answers.argmax(axis=1))
    checkpoint = read_checkpoint(tmp_path / "a")
    assert checkpoint.stage_errors is not None and checkpoint.stage_errors.progress_error is None


def test_checkpoints_from_before_progress_and_calibration_load(trained: Path) -> None:
    checkpoint = read_checkpoint(trained)
    tensors = read_tensors(checkpoint)
    del tensors["temperature"]
    tensors["network.layers.6.weight"] = tensors["network.layers.6.weight"][:5]
    tensors["network.layers.6.bias"] = tensors["network.layers.6.bias"][:5]
    recipe = {key: value for key, value in checkpoint.recipe.items() if key != "progress"}
    old = trained.parent / "old"
    write_checkpoint(old, replace(checkpoint, recipe=recipe, stage_errors=None), tensors)
    arms = procedures().columns()[names.BOTH_ARMS][::7]
    now = load_policy(trained)
    before = load_policy(old).act(None, arms)
    np.testing.assert_allclose(
        before, now.act(None, arms)[:, :5] * float(now.temperature), rtol=1e-5
    )


def test_the_temperature_makes_chances_of_overconfident_logits() -> None:
    rng = np.random.default_rng(0)
    logits = rng.normal(size=(20_000, 5)) * 2
    chances = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    classes = (chances.cumsum(1) > rng.random((len(logits), 1))).argmax(1)
    assert fit_temperature(logits, classes) == pytest.approx(1.0, abs=0.03)
    assert fit_temperature(3 * logits, classes) == pytest.approx(3.0, abs=0.1)
    target = np.stack([classes, np.full(len(classes), UNKNOWN)], axis=1)
    assert stage_errors(logits, target).calibration_error < 0.02
    assert stage_errors(3 * logits, target).calibration_error > 0.1


def test_calibration_changes_no_choice_and_is_undone_by_none(trained: Path) -> None:
    policy = load_policy(trained)
    assert policy.temperature != 1.0
    arms = procedures().columns()[names.BOTH_ARMS]
    hot = policy.act(None, arms)
    target = torch.from_numpy(stages(procedures().columns(), procedures().episode_index))
    policy.calibrate(torch.from_numpy(hot), target)
    policy.calibrate(torch.from_numpy(policy.train(False).act(None, arms)), target)
    twice = float(policy.temperature)
    policy.calibrate(torch.from_numpy(policy.train(False).act(None, arms)), target)
    assert float(policy.temperature) == pytest.approx(twice, rel=1e-4)
    chosen = policy.act(None, arms)[:, :5].argmax(1)
    np.testing.assert_array_equal(chosen, hot[:, :5].argmax(1))


def test_unknown_progress_teaches_nothing() -> None:
    torch.manual_seed(0)
    policy = HLP.make(RECIPE, ())
    observed = torch.randn(8, 14)
    due = torch.arange(8) % 5
    target = torch.stack([due.float(), torch.full((8,), UNKNOWN)], dim=1)
    plain = torch.nn.functional.cross_entropy(policy(observed)[:, :5], due)
    assert policy.loss(observed, target).item() == pytest.approx(plain.item())
    target[3, 1] = 0.25
    error = (policy(observed)[3, 5] - 0.25) ** 2
    assert policy.loss(observed, target).item() == pytest.approx((plain + error).item(), rel=1e-5)


def test_it_sees_images_and_learns_progress_of_one_subtask_too(tmp_path: Path) -> None:
    dataset = procedures(3)
    dataset._columns[names.PHASE][:] = 2
    recipe = replace(RECIPE, epochs=1)
    train(dataset, [features_of(dataset)], HLP, recipe, out=tmp_path / "a")
    policy = load_policy(tmp_path / "a")
    assert policy.act(dataset.rows[:4].astype(np.float32), np.zeros((4, 14))).shape == (4, 6)


def test_its_recipe_is_found_and_refuses_what_cannot_be() -> None:
    recipe = load_recipe("hlp", "high-level")
    assert isinstance(recipe, HLPRecipe) and recipe.progress == 1.0 and not recipe.clock
    with pytest.raises(InputError, match="progress is -1"):
        HLPRecipe(progress=-1.0)
    with pytest.raises(InputError, match="privileged"):
        load_recipe("hlp", "paper", {"privileged": True})
