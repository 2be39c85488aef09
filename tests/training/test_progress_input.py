"""Progress as an input: what another policy predicts, in training and when the policy acts."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fake_dataset import DIM, fake_procedures, features_of

from policies.base import Recipe
from policies.hlp import HLP, HLPRecipe
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.core.progress import silent_stage
from surgicai_vision.dataset.subset import of_subtask
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.evaluation.policy_spec import open_policy, policy_agent
from surgicai_vision.experiments.run import train_run
from surgicai_vision.training.augment import with_noise
from surgicai_vision.training.checkpoint import read_checkpoint
from surgicai_vision.training.hub import push_policy
from surgicai_vision.training.policies import load_policy
from surgicai_vision.training.progress_input import check_progress_policy, with_progress
from surgicai_vision.training.run_config import RunConfig
from surgicai_vision.training.train import train

QUICK = HLPRecipe(hidden=(16,), epochs=2, batch_size=64, progress=1.0)
RUN = RunConfig(TaskConfig(names.SUTURE), changes=("epochs=1", "progress_input=true"))


@pytest.fixture(scope="module")
def says(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the checkpoint of a policy that predicts the progress."""
    out = tmp_path_factory.mktemp("says") / "hlp"
    train(fake_procedures(2), [], HLP, QUICK, out=out)
    return out


@pytest.fixture(scope="module")
def fed(says: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the checkpoint of a grasping policy that gets this progress as an input."""
    out = tmp_path_factory.mktemp("fed") / "grasp"
    train_run(RUN, fake_procedures(2), out, silent_stage, progress_from=says, subtask="grasp")
    return out


def test_it_is_trained_on_predictions_and_not_on_labels(says: Path) -> None:
    dataset = fake_procedures(2)
    policy = load_policy(says)
    told = with_progress(dataset, policy, [])
    columns = told.columns()
    expected = policy.act(None, dataset.columns()[names.BOTH_ARMS])[:, 5]
    np.testing.assert_array_equal(columns[names.PROGRESS][:, 0], expected)
    assert told.fingerprint != dataset.fingerprint and told.length == dataset.length
    part = of_subtask(told, "insert")
    rows = np.flatnonzero(dataset.columns()[names.PHASE] == 2)
    np.testing.assert_array_equal(part.columns()[names.PROGRESS][:, 0], expected[rows])


def test_a_policy_of_progress_sees_its_own_views(says: Path, tmp_path: Path) -> None:
    dataset = fake_procedures(2)
    seen = [features_of(dataset, view) for view in ("front", "back")]
    train(dataset, seen, HLP, QUICK, out=tmp_path / "a")
    policy = load_policy(tmp_path / "a")
    told = with_progress(dataset, policy, seen).columns()[names.PROGRESS]
    rows = np.tile(dataset.rows[:50].astype(np.float32), 2)
    assert rows.shape[1] == 2 * DIM
    expected = policy.act(rows, dataset.columns()[names.BOTH_ARMS][:50])[:, 5]
    np.testing.assert_array_equal(told[:50, 0], expected)


def test_a_policy_of_progress_may_see_images_alone(tmp_path: Path) -> None:
    dataset = fake_procedures(2)
    seen = [features_of(dataset)]
    train(dataset, seen, HLP, replace(QUICK, proprioception=False), out=tmp_path / "a")
    policy = load_policy(tmp_path / "a")
    told = with_progress(dataset, policy, seen).columns()[names.PROGRESS]
    rows = dataset.rows[:50].astype(np.float32)
    expected = policy.act(rows, dataset.columns()[names.STATE][:50])[:, 5]
    np.testing.assert_array_equal(told[:50, 0], expected)


def test_when_it_acts_it_is_fed_the_same(says: Path, fed: Path) -> None:
    columns = fake_procedures(2).columns()
    rows = range(0, 40, 8)
    robots = [
        SimpleNamespace(
            agent_pos=lambda row=row: columns[names.STATE][row],
            both_arms=lambda row=row: columns[names.BOTH_ARMS][row],
        )
        for row in rows
    ]
    agent = policy_agent(fed)
    for slot in range(5):
        agent.reset(slot, robots[slot], 0)
    acted = agent.act(range(5), robots, [{}] * 5)
    said = load_policy(says).act(None, columns[names.BOTH_ARMS][rows])[:, 5:]
    vectors = np.concatenate([columns[names.STATE][rows], said], axis=1)
    np.testing.assert_array_equal(acted, load_policy(fed).act(None, vectors))


def test_its_checkpoint_has_the_policy_that_says_it(says: Path, fed: Path, tmp_path: Path) -> None:
    checkpoint = read_checkpoint(fed)
    assert checkpoint.progress_sha256 == read_checkpoint(says).policy_sha256
    moved = tmp_path / "moved"
    shutil.copytree(fed, moved)
    assert open_policy(moved, task="grasp").make_agent()
    shutil.rmtree(moved / "progress")
    with pytest.raises(BadFile, match="not a checkpoint"):
        open_policy(moved)
    other = tmp_path / "other"
    train(fake_procedures(2), [], HLP, QUICK, seed=1, out=other)
    shutil.copytree(other, moved / "progress")
    with pytest.raises(BadFile, match="its hash differs"):
        open_policy(moved)


def test_the_cameras_are_those_of_both() -> None:
    inner = PolicyAgent("hlp", None, None, ("front",), 32, (names.BOTH_ARMS,))
    outer = PolicyAgent("bc", None, None, ("back",), 32, (names.STATE, names.PROGRESS), inner)
    assert outer.cameras == ("back", "front") and outer.views == ("back",)
    table: dict = {}
    outer.share(table)
    assert inner._shared is table


def test_noise_leaves_the_progress_as_it_is(fed: Path) -> None:
    import torch

    inputs = load_policy(fed).inputs
    observed = torch.zeros(50, 8)
    noisy = with_noise(observed, inputs, 1.0)
    assert (noisy[:, 7] == 0).all() and (noisy[:, :7] != 0).all()


def test_what_does_not_go_together_is_refused(says: Path, fed: Path, tmp_path: Path) -> None:
    dataset = fake_procedures(2)
    for changes, given, words in (
        (("progress_input=true",), None, "--progress-from DIR"),
        ((), says, "does not use progress as an input"),
        (("progress_input=true",), fed, "does not predict progress"),
    ):
        run = replace(RUN, changes=changes)
        with pytest.raises(InputError, match=words):
            train_run(run, dataset, tmp_path / "a", silent_stage, progress_from=given)
    with pytest.raises(InputError, match="replaces the clock"):
        Recipe(progress_input=True, clock=True)
    checkpoint = read_checkpoint(says)
    place = replace(checkpoint, run=replace(checkpoint.run, env=TaskConfig("place")))
    with pytest.raises(InputError, match="progress of 'place'; allowed here: suture"):
        check_progress_policy(place, dataset)
    assert not (tmp_path / "a").exists()
    with pytest.raises(InputError, match="one repository holds one"):
        push_policy(fed, "user/name")
