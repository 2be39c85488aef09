"""What the libraries lack, checked against the papers' formulas."""

import pickle

import numpy as np
import pytest
import torch
from d3rlpy.algos import AWAC, AWACConfig
from d3rlpy.dataset import MDPDataset
from d3rlpy.torch_utility import TorchMiniBatch
from stable_baselines3 import SAC, TD3

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.store import list_demos
from surgicai_vision.rl import extractor as extractors
from surgicai_vision.rl import train as training
from surgicai_vision.rl.awac import PlainAWAC
from surgicai_vision.rl.buffers import DEMAND, HindsightBuffer, MixedBuffer, demonstrations_of
from surgicai_vision.rl.export import fill
from surgicai_vision.rl.extractor import FeatureMemo, RelativeExtractor
from surgicai_vision.rl.nair import DemonstrationTD3, cloning_loss
from surgicai_vision.rl.rlpd import LayerNormPolicy
from surgicai_vision.rl.settings import Request
from surgicai_vision.rl.transitions import of_demos
from surgicai_vision.rl.vec_env import SuturingVecEnv

SMALL = {"net_arch": [16, 16]}


@pytest.fixture(scope="module")
def goal_demos(demos):
    return {task: of_demos(list_demos(folder), obs_type="goal") for task, folder in demos.items()}


# -- Nair et al. 2018 ------------------------------------------------------------------------------


def test_the_cloning_loss_is_the_papers_sum_over_what_passes_the_filter():
    generator = torch.Generator().manual_seed(0)
    chosen, demonstrated = torch.rand((2, 5, 7), generator=generator) * 2 - 1
    values = torch.tensor([[-3.0], [-1.0], [-2.0], [-5.0], [-4.0]])
    known = torch.tensor([[-2.0], [-2.0], [-2.0], [-1.0], [-9.0]])
    expected = 0.0
    for index in range(5):
        if known[index] > values[index]:  # rows 0 and 3
            expected += float(((chosen[index] - demonstrated[index]) ** 2).sum())
    loss, passed = cloning_loss(chosen, demonstrated, values, known)
    assert loss.item() * 5 == pytest.approx(expected) and passed.item() == pytest.approx(2 / 5)
    every, passed = cloning_loss(chosen, demonstrated, values, known, q_filter=False)
    assert passed == 1 and every.item() * 5 == pytest.approx(
        float(((chosen - demonstrated) ** 2).sum())
    )


def _td3(**options):
    env = envs.make(TaskConfig("grasp"), "relative")
    return DemonstrationTD3(
        "MlpPolicy",
        env,
        seed=0,
        policy_kwargs=SMALL,
        replay_buffer_class=MixedBuffer,
        buffer_size=100,
        device="cpu",
        **options,
    )


@pytest.mark.parametrize("normalise", [False, True])
def test_the_actor_climbs_the_papers_gradient(normalise):
    """It is λ1 ∇J - λ2 ∇L_BC, with each term differentiated automatically on its own."""
    model = _td3(bc_weight=0.3, normalise_q=normalise)
    generator = torch.Generator().manual_seed(1)
    seen = torch.randn((10, 24), generator=generator)
    actions = torch.rand((10, 7), generator=generator) * 2 - 1
    parameters = list(model.actor.parameters())
    parts = model.actor_losses(seen, actions, 4)
    gradient = torch.autograd.grad(parts["actor_loss"], parameters)

    chosen = model.actor(seen)
    values = model.critic.q1_forward(seen, chosen)
    known = model.critic.q1_forward(seen[6:], actions[6:])
    passes = (known > values[6:]).float().detach()
    cloning = ((chosen[6:] - actions[6:]) ** 2 * passes).sum() / 4
    scale = 1 / values.abs().mean().detach() if normalise else 1.0
    objective = torch.autograd.grad(values.mean() * scale, parameters, retain_graph=True)
    cloned = torch.autograd.grad(cloning, parameters)
    for found, ours, theirs in zip(gradient, objective, cloned, strict=True):
        assert torch.allclose(found, -(0.7 * ours - 0.3 * theirs), atol=1e-6)


def test_without_clipping_and_cloning_its_updates_are_those_of_td3(demos):
    """With λ2 → 0 and no demonstrations it is the library's own TD3, step by step."""
    rng = np.random.default_rng(0)
    options = {"seed": 0, "buffer_size": 64, "device": "cpu", "policy_kwargs": SMALL}
    env = envs.make(TaskConfig("grasp"), "relative")
    models = [
        TD3("MlpPolicy", env, **options),
        _td3(bc_weight=0.0, normalise_q=False, clip_q=False),
    ]
    rows = rng.normal(size=(2, 64, 1, 24)).astype(np.float32)
    actions = rng.uniform(-1, 1, (64, 1, 7)).astype(np.float32)
    weights = []
    for model in models:
        model.set_logger(_silent())
        for index in range(64):
            reward, done = np.array([-1.0]), np.array([index % 9 == 0])
            model.replay_buffer.add(
                rows[0, index], rows[1, index], actions[index], reward, done, [{}]
            )
        if isinstance(model, DemonstrationTD3):
            model.replay_buffer.rows = lambda batch_size: 0
            model.actor_losses = lambda seen, acts, _, m=model: {
                "actor_loss": -m.critic.q1_forward(seen, m.actor(seen)).mean()
            }
        torch.manual_seed(3)
        np.random.seed(3)  # noqa: NPY002
        model.train(6, 32)
        weights.append(torch.cat([p.flatten() for p in model.policy.parameters()]))
    assert torch.allclose(*weights, atol=1e-7)


def test_clipped_targets_are_returns_that_the_reward_allows():
    model = _td3(gamma=0.9)
    seen = torch.randn((50, 24)) * 30
    batch = type("Batch", (), {})()
    batch.observations = batch.next_observations = seen
    batch.actions, batch.dones = torch.zeros((50, 7)), torch.zeros((50, 1))
    batch.rewards = -torch.ones((50, 1)) * torch.linspace(0, 40, 50)[:, None]
    targets = model._targets(batch)
    assert targets.min() >= -10.00001 and targets.max() <= 0
    model.clip_q = False
    assert model._targets(batch).min() < -11


def _silent():
    from stable_baselines3.common.logger import Logger

    return Logger(None, [])


# -- buffers ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("task", "keeps"), [("grasp", False), ("insert", False), ("insert", True)])
def test_a_relabelled_success_ends_the_episode(goal_demos, task, keeps):
    env = SuturingVecEnv(task, obs_type="goal")
    np.random.seed(0)  # noqa: NPY002
    demos = goal_demos[task]
    space = env.observation_space
    buffer = HindsightBuffer(len(demos), space, env.action_space, env, keeps, device="cpu")
    fill(buffer, demos)
    batch = buffer.sample(400)
    achieved = batch.next_observations["achieved_goal"].numpy()
    desired = batch.observations["desired_goal"].numpy()
    goal_env = envs.make(TaskConfig(task), "goal")
    assert np.array_equal(batch.rewards.numpy()[:, 0], goal_env.compute_reward(achieved, desired))
    assert np.array_equal(batch.dones.numpy()[:, 0] > 0, batch.rewards.numpy()[:, 0] == 0)
    reached = (batch.rewards == 0).float().mean().item()
    asked = desired[:, DEMAND]
    if keeps:
        assert (asked == 1).all()
        # No goal is reached without the holes, however near the pose is.
        assert (achieved[batch.rewards.numpy()[:, 0] == 0][:, DEMAND] == 1).all()
    else:
        assert (asked == 0).mean() > 0.3 and reached > 0.03
    env.close()


def test_a_share_of_every_batch_is_demonstrations(goal_demos):
    env = SuturingVecEnv("grasp", obs_type="goal")
    source = demonstrations_of(goal_demos["grasp"])
    own = HindsightBuffer(50, env.observation_space, env.action_space, env, device="cpu")
    zeros = {key: space.sample()[None] * 0 for key, space in env.observation_space.items()}
    for index in range(10):
        done = np.array([index == 9])
        own.add(zeros, zeros, np.zeros((1, 7)), np.array([-1.0]), done, [{}])
    own.mix(source, 0.3)
    batch = own.sample(100)
    is_own = (batch.observations["observation"] == 0).all(dim=1)
    assert own.rows(100) == 30 and is_own.tolist() == [True] * 70 + [False] * 30
    shown = set(map(tuple, goal_demos["grasp"].action.tolist()))
    assert all(tuple(row) in shown for row in batch.actions[70:].tolist())
    # Demonstrations keep the goals they reached.
    assert (batch.observations["desired_goal"][70:, DEMAND] == 1).all()
    env.close()


def test_a_constant_input_is_divided_by_one(goal_demos):
    request = Request("td3-her-bc", TaskConfig("grasp"), env_steps=300, demonstrations=1)
    mean, std = training._statistics(request, goal_demos["grasp"])
    asked = names.RELATIVE_NAMES.index("demanded")
    assert (mean[asked], std[asked]) == (1.0, 1.0) and (std >= training.SMALLEST_STD).all()


# -- networks --------------------------------------------------------------------------------------


def test_the_extractor_gives_what_the_env_shows(goal_demos, demos):
    space = envs.make(TaskConfig("insert"), "goal").observation_space
    extractor = RelativeExtractor(space, "insert")
    goals = goal_demos["insert"]
    features = extractor({key: torch.from_numpy(part) for key, part in goals.observation.items()})
    shown = of_demos(list_demos(demos["insert"]), obs_type="relative").vector
    assert np.array_equal(features.numpy(), shown)
    scaled = RelativeExtractor(space, "insert", mean=[1.0] * 24, std=[2.0] * 24)
    again = scaled({key: torch.from_numpy(part) for key, part in goals.observation.items()})
    assert np.allclose(again.numpy(), (shown - 1) / 2)


def test_extractors_that_share_a_memo_compute_the_features_of_a_batch_once(goal_demos, monkeypatch):
    calls = []
    original = extractors.relative_features

    def counted(*arrays):
        calls.append(len(arrays[0]))
        return original(*arrays)

    space = envs.make(TaskConfig("grasp"), "goal").observation_space
    parts = goal_demos["grasp"].observation
    batches = [
        {key: torch.from_numpy(part[start : start + 5].copy()) for key, part in parts.items()}
        for start in (0, 5, 10)
    ]
    alone = RelativeExtractor(space, "grasp")
    expected = [alone(batch) for batch in batches]
    monkeypatch.setattr(extractors, "relative_features", counted)
    memo = FeatureMemo()
    several = [RelativeExtractor(space, "grasp", memo=memo) for _ in range(3)]
    for extractor in several:
        for batch, features in zip(batches[:2], expected, strict=False):
            assert torch.equal(extractor(batch), features)
    assert calls == [5, 5]
    # A third batch evicts the first; another dict with equal numbers is another batch.
    assert torch.equal(several[0](batches[2]), expected[2])
    assert torch.equal(several[1](batches[0]), expected[0]) and calls == [5] * 4
    assert pickle.loads(pickle.dumps(memo)).find(tuple(batches[0].values())) is None


def test_the_critics_of_rlpd_have_layer_norm_and_its_actor_has_none():
    env = envs.make(TaskConfig("grasp"), "relative")
    model = SAC(
        LayerNormPolicy, env, policy_kwargs=SMALL | {"n_critics": 3}, buffer_size=10, device="cpu"
    )
    for critic in (model.critic, model.critic_target):
        kinds = [[type(layer).__name__ for layer in network] for network in critic.q_networks]
        assert kinds == [["Linear", "LayerNorm", "ReLU"] * 2 + ["Linear"]] * 3
        held = {id(parameter) for parameter in critic.parameters()}
        used = {id(p) for network in critic.q_networks for p in network.parameters()}
        assert used == held
    trained = {id(p) for group in model.critic.optimizer.param_groups for p in group["params"]}
    assert trained == {id(parameter) for parameter in model.critic.parameters()}
    assert not any(isinstance(layer, torch.nn.LayerNorm) for layer in model.actor.modules())
    same = zip(model.critic.parameters(), model.critic_target.parameters(), strict=True)
    assert all(torch.equal(one, other) for one, other in same)
    # LayerNorm bounds the values of actions far from all data, as the paper intends.
    seen = torch.zeros((1, 24))
    values = [model.critic.q1_forward(seen, torch.full((1, 7), s)).item() for s in (1e3, 1e6)]
    assert values[0] == pytest.approx(values[1], rel=1e-2)


def test_the_target_of_awac_holds_no_entropy():
    rng = np.random.default_rng(0)
    rows = {
        "observations": rng.normal(size=(20, 24)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (20, 7)).astype(np.float32),
        "rewards": -np.ones(20, np.float32),
        "terminals": (np.arange(20) == 19).astype(np.float32),
    }
    batch = TorchMiniBatch.from_batch(
        MDPDataset(**rows).sample_transition_batch(8), 0.99, False, "cpu"
    )
    targets = {}
    for kind in (AWAC, PlainAWAC):
        algo = kind(AWACConfig(), device=False, enable_ddp=False)
        algo.create_impl((24,), 7)
        for parameter in algo.impl.modules.targ_q_funcs.parameters():
            parameter.data.zero_()
        targets[kind] = algo.impl.compute_target(batch)
    assert torch.equal(targets[PlainAWAC], torch.zeros(8, 1)), "critics that value nothing"
    assert (targets[AWAC].abs() > 1e-3).all(), "the library is mended; leave `PlainAWAC` out"
