"""Recipe key `goal_loss`: a policy that learns to tell where the goal lies."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_dataset import FakeDataset, features_of

from policies.base import ACTIONS, Plugin, Recipe
from policies.bc import BC, BCPolicy, GoalBCPolicy
from surgicai_vision.core import names
from surgicai_vision.core.config import to_identity
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.scene.rotations import matrix_to_rotvec, matrix_to_rpy, rotvec_to_matrix
from surgicai_vision.training.data import column, split
from surgicai_vision.training.policies import load_policy
from surgicai_vision.training.train import train

QUICK = Recipe(hidden=(32,), epochs=40, batch_size=32, learning_rate=1e-2, goal_loss=0.3)


def seen_goals() -> tuple[FakeDataset, np.ndarray]:
    """Return a dataset whose features show the goal, and its `GOAL_IN_TIP` as it was drawn."""
    dataset = FakeDataset(episodes=20)
    generator = np.random.default_rng(1)
    states, goals = [], []
    for row in dataset.rows.astype(np.float64):
        now, offset = rotvec_to_matrix(generator.normal(size=3)), row[:3] * 1e-3
        turned = rotvec_to_matrix(row[3:6] * 0.1)
        tip = generator.normal(size=3)
        goal, error = now @ turned, now @ offset * 100.0
        spin = matrix_to_rotvec(goal @ now.T)
        parts = (
            tip,
            matrix_to_rpy(now),
            [0],
            tip + error,
            matrix_to_rpy(goal),
            [0],
            error,
            spin,
            [0],
        )
        states.append(np.concatenate(parts))
        goals.append([*offset, *turned[:, 0], *turned[:, 1]])
    dataset._columns[names.PRIVILEGED_STATE] = np.asarray(states, np.float32)
    return dataset, np.asarray(goals)


def test_the_goal_is_told_in_the_frame_of_the_tip() -> None:
    """Whichever way the tip points, the same offset and turn are the same nine numbers."""
    dataset, goals = seen_goals()
    np.testing.assert_allclose(column(dataset, names.GOAL_IN_TIP), goals, atol=1e-5)


def test_a_policy_tells_goals_that_it_was_not_trained_on(tmp_path: Path) -> None:
    dataset, goals = seen_goals()
    train(dataset, [features_of(dataset)], BC, QUICK, out=tmp_path / "a")
    policy = load_policy(tmp_path / "a")
    assert isinstance(policy, GoalBCPolicy) and not policy.inputs.knows_goal
    _, held, _ = split(dataset.episode_index, QUICK, 0)
    state = dataset.columns()[names.STATE]
    observed = policy.normalise(
        torch.from_numpy(np.concatenate([dataset.rows, state], axis=1)[held].astype(np.float32))
    )
    with torch.no_grad():
        told = policy.eval().network(observed)[1] * policy.goal_std + policy.goal_mean
    meant = goals[held]
    left = ((told.numpy() - meant) ** 2).sum(0) / ((meant - goals.mean(0)) ** 2).sum(0)
    assert left[[0, 1, 2, 4, 5, 6, 8]].max() < 0.25, left  # a cosine, near 1, is the rest


def test_a_policy_acts_on_what_it_tells() -> None:
    torch.manual_seed(0)
    policy = BC.make(QUICK, ((12,),)).eval()
    assert isinstance(policy, GoalBCPolicy)
    observed = torch.randn(4, policy.inputs.dim)
    with torch.no_grad():
        before = policy(observed)
        policy.network.goal[-1].bias += 1.0
        assert (policy(observed) - before).abs().min() > 0.0


def test_the_loss_is_that_of_the_actions_and_the_weighted_one_of_the_goal() -> None:
    policy = BC.make(QUICK, ((12,),)).eval()
    target = torch.randn(64, ACTIONS + names.GOAL_IN_TIP_SIZE)
    policy.measure(target)
    observed = torch.randn(64, policy.inputs.dim)
    with torch.no_grad():
        answers, told = policy.network(observed)  # type: ignore[operator]
        goal = target[:, ACTIONS:]
        meant = (goal - goal.mean(0)) / goal.std(0)
        expected = ((answers.tanh() - target[:, :ACTIONS]) ** 2).mean()
        expected += QUICK.goal_loss * ((told - meant) ** 2).mean()
        assert torch.allclose(policy.loss(observed, target), expected, rtol=1e-4)


def test_without_it_nothing_changes() -> None:
    plain = replace(QUICK, goal_loss=0.0)
    assert isinstance(BC.make(plain, ((12,),)), BCPolicy)
    assert "goal_loss" not in to_identity(plain)
    assert to_identity(QUICK)["goal_loss"] == 0.3


def test_a_training_that_cannot_have_it_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="privileged"):
        replace(QUICK, privileged=True)
    with pytest.raises(InputError, match="goal_loss"):
        replace(QUICK, goal_loss=-1.0)
    dataset, _ = seen_goals()
    plain = Plugin("plain", Recipe, BCPolicy)
    with pytest.raises(InputError, match="does not learn where the goal lies"):
        train(dataset, [features_of(dataset)], plain, QUICK, out=tmp_path / "a")
    unmeasured = FakeDataset()
    with pytest.raises(UnknownName, match=names.PRIVILEGED_STATE):
        train(unmeasured, [features_of(unmeasured)], BC, QUICK, out=tmp_path / "a")
    assert not (tmp_path / "a").exists()
