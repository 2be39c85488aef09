"""A residual policy: the frozen policy where nothing is learned, and what it learns on top."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.checkpoints import checkpoint

from policies.bc import BC
from policies.residual import Residual, ResidualRecipe
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, to_mapping
from surgicai_vision.core.errors import InputError, OutputExists
from surgicai_vision.core.files import read_json
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.rollout import run_share
from surgicai_vision.rl import residual
from surgicai_vision.rl.learner import linear
from surgicai_vision.rl.residual import CorrectionEnv, train_residual
from surgicai_vision.rl.residual_config import ResidualRequest, residual_settings
from surgicai_vision.rl.settings import Settings
from surgicai_vision.training.checkpoint import read_checkpoint, write_checkpoint
from surgicai_vision.training.policies import load_policy

STILL = np.zeros(7, np.float32)


def request_of(base, **changes):
    small = {"hidden": [8], "batch_size": 8, "learning_starts": 4, "actor_starts": 2}
    settings = residual_settings({**small, **changes.pop("settings", {})})
    return ResidualRequest(
        base, 0.2, settings, env_steps=24, validation=0, save_every=12, **changes
    )


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return checkpoint(tmp_path_factory.mktemp("base") / "grasp", "grasp")


def of(policy, bound=0.2):
    """Return a residual of a loaded policy, as training makes it."""
    values = {**policy.checkpoint.recipe, "bound": bound, "correction": (8,)}
    corrected = Residual(ResidualRecipe(**values), policy.checkpoint.visual)
    corrected.take_base(policy)
    return corrected.eval().requires_grad_(False)


def test_an_untrained_correction_changes_nothing_and_a_trained_one_at_most_the_bound(base):
    policy = load_policy(base)
    corrected = of(policy)
    poses = np.random.default_rng(0).normal(size=(30, policy.inputs.width)).astype(np.float32)
    acted = policy.act(None, poses)
    assert np.array_equal(corrected.act(None, poses), acted)
    last = corrected.correction[-1]
    torch.nn.init.normal_(last.bias, std=9.0)
    corrected.eval()
    moved = corrected.act(None, poses)
    assert 0.1 < np.abs(moved - acted).max() <= 0.2 + 1e-6


def test_without_a_correction_the_env_is_the_frozen_policys_own_episode():
    spec = open_policy("released:grasp")
    agent = spec.make_agent()
    env = CorrectionEnv(agent, of(agent.policy), spec.config)
    sight, _ = env.reset(seed=3)
    assert env.observation_space.contains(sight)
    start = int(np.random.default_rng(3).integers(names.VALIDATION_SEED))
    steps, ended = 0, False
    while not ended:
        sight, reward, terminated, truncated, info = env.step(STILL)
        steps, ended = steps + 1, terminated or truncated
        assert reward == (0.0 if info["is_success"] else -1.0)
    env.close()
    (episode,) = run_share(spec.make_agent, spec.config, [start], 1, report=lambda _: None)
    assert (info["is_success"], steps) == (episode.row.success, episode.row.steps)


def test_an_action_of_the_env_moves_the_frozen_action_within_the_bound(base):
    spec = open_policy(base)
    agent = spec.make_agent()
    env = CorrectionEnv(agent, of(agent.policy), spec.config)
    taken = []
    step = env._env.step
    env._env.step = lambda action: taken.append(action) or step(action)
    for action in (STILL, np.ones(7, np.float32), -np.ones(7, np.float32)):
        sight, _ = env.reset(seed=0)
        env.step(action)
    still, up, down = taken
    assert np.array_equal(still, sight[-7:])
    assert np.allclose(up, np.clip(still + 0.2, -1, 1), atol=1e-6)
    assert np.allclose(down, np.clip(still - 0.2, -1, 1), atol=1e-6)
    env.close()


def test_what_is_trained_is_a_checkpoint_that_is_evaluated_as_any(base, tmp_path):
    trained = train_residual(request_of(base), tmp_path / "residual")
    assert trained.run.name == "residual-td3-proprioception-bound=0.2"
    assert (trained.run.env_steps, trained.frames) == (24, 24)
    policy = load_policy(tmp_path / "residual")
    before = load_policy(base)
    weights = before.state_dict()
    assert all(torch.equal(policy.state_dict()[name], weights[name]) for name in weights)
    assert policy.correction[-1].weight.abs().sum() > 0
    poses = np.random.default_rng(0).normal(size=(9, policy.inputs.width)).astype(np.float32)
    assert np.abs(policy.act(None, poses) - before.act(None, poses)).max() <= 0.2 + 1e-6
    spec = open_policy(tmp_path / "residual")
    (episode,) = run_share(spec.make_agent, spec.config, [5], 1, report=lambda _: None)
    assert not episode.row.error
    with pytest.raises(OutputExists):
        train_residual(request_of(base, seed=1), tmp_path / "residual")


def test_control_steps_are_counted_where_an_action_is_held(tmp_path):
    held = checkpoint(tmp_path / "held", "grasp", env=TaskConfig("grasp", action_repeat=2))
    shown = []
    request = request_of(held)

    def show(done, total, unit=""):
        shown.append((done, total))

    trained = train_residual(request, tmp_path / "residual", progress=show)
    assert (trained.run.env_steps, trained.frames) == (24, 24)
    assert shown == [(0, 24), (12, 24), (24, 24)]
    curve = read_json(tmp_path / "residual" / "curve.json")
    assert [point["env_steps"] for point in curve] == [12, 24]
    assert [point["updates"] for point in curve] == [2, 8]  # one a decision, after four


def test_the_actor_waits_for_its_critics(base):
    training = residual._Training(request_of(base, settings={"actor_starts": 8}), open_policy(base))
    last = linear(training.model.actor.mu)[-1]
    training.model.learn(12)  # eight updates, after four actions
    assert not last.weight.any()
    training.model.learn(4, reset_num_timesteps=False)
    assert last.weight.any()
    training.close()


def test_a_correction_whose_actor_would_not_learn_is_refused(base):
    with pytest.raises(InputError, match="at most 20 updates, but the actor learns only after 20"):
        request_of(base, settings={"actor_starts": 20})
    with pytest.raises(InputError, match="at most 0 updates"):
        request_of(base, settings={"learning_starts": 30})
    with pytest.raises(InputError, match="at most 2000 updates"):
        ResidualRequest(base, env_steps=5000)


def test_a_correction_that_diverges_says_so_in_one_line(base, tmp_path):
    request = request_of(base, settings={"learning_rate": 1e12})
    with pytest.raises(InputError, match=r"correction diverged.*lower the learning rate"):
        train_residual(request, tmp_path / "out")


def test_the_actor_is_held_to_the_frozen_policy_as_its_loss_says(base):
    training = residual._Training(request_of(base, settings={"bc_weight": 0.25}), open_policy(base))
    model = training.model
    torch.nn.init.normal_(linear(model.actor.mu)[-1].weight)
    seen = torch.randn(16, training.policy.sight)
    moved = model.actor(seen)
    values = model.critic.q1_forward(seen, moved)
    parts = model.losses(SimpleNamespace(observations=seen))
    held = (moved**2).sum() / 16
    assert parts["correction"].item() == pytest.approx(held.item(), rel=1e-5) and held > 0.01
    wanted = -0.75 * values.mean() / values.abs().mean() + 0.25 * held
    assert parts["actor_loss"].item() == pytest.approx(wanted.item(), rel=1e-5)
    training.close()


def test_a_kill_changes_no_result_and_the_best_is_kept(base, tmp_path, monkeypatch):
    evaluate = residual._Training._evaluate

    def falling(training, minutes):
        point, weights = evaluate(training, minutes)
        return dataclasses.replace(point, successes=24 - point.env_steps), weights

    save = residual._Training._save

    def die(*arguments):
        save(*arguments)
        raise KeyboardInterrupt

    early = dataclasses.replace(request_of(base), env_steps=12)
    first = train_residual(early, tmp_path / "early")
    last = train_residual(request_of(base), tmp_path / "last")
    monkeypatch.setattr(residual._Training, "_evaluate", falling)
    whole = train_residual(request_of(base), tmp_path / "whole")
    monkeypatch.setattr(residual._Training, "_save", die)
    with pytest.raises(KeyboardInterrupt):
        train_residual(request_of(base), tmp_path / "killed")
    monkeypatch.setattr(residual._Training, "_save", save)
    resumed = train_residual(request_of(base), tmp_path / "killed")
    assert resumed.policy_sha256 == whole.policy_sha256 == first.policy_sha256
    assert last.policy_sha256 != whole.policy_sha256 and whole.frames == 12


def test_only_a_cloned_policy_of_one_subtask_is_corrected(base, tmp_path):
    train_residual(request_of(base), tmp_path / "residual")
    for other in (tmp_path / "residual", "expert"):
        with pytest.raises(InputError, match="can be corrected"):
            train_residual(request_of(str(other)), tmp_path / "again")
    progress = read_checkpoint(checkpoint(tmp_path / "fed" / "progress", "suture", "hlp"))
    recipe = BC.recipe(progress_input=True)  # as a recipe file says it, without a change
    fed = dataclasses.replace(
        read_checkpoint(base), recipe=to_mapping(recipe), progress_sha256=progress.policy_sha256
    )
    write_checkpoint(tmp_path / "fed", fed, BC.make(recipe, ()).state_dict())
    with pytest.raises(InputError, match="uses another policy's progress"):
        train_residual(request_of(str(tmp_path / "fed")), tmp_path / "again")
    averaging = BC.recipe(denoise=6)
    made = dataclasses.replace(read_checkpoint(base), recipe=to_mapping(averaging))
    write_checkpoint(tmp_path / "averaging", made, BC.make(averaging, ()).state_dict())
    with pytest.raises(InputError, match="acts on averaged images"):
        train_residual(request_of(str(tmp_path / "averaging")), tmp_path / "again")
    with pytest.raises(InputError, match="success_steps"):
        ResidualRequest(base, settings=residual_settings({"success_steps": 3}))
    with pytest.raises(InputError, match="stop_at"):
        ResidualRequest(base, settings=residual_settings({"stop_at": 0.9}))
    with pytest.raises(InputError, match="reads no stop_at"):
        ResidualRequest(base, settings=Settings(stop_at=0.9))
    with pytest.raises(InputError, match="bound"):
        ResidualRequest(base, bound=0.0)
