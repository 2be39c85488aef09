"""Our envs as Stable-Baselines3's vector env."""

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.tasks import env_id
from surgicai_vision.envs import make
from surgicai_vision.rl.vec_env import SuturingVecEnv

LIMIT = 6


def moves(count):
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, (2 * LIMIT + 2, count, 7)).astype(np.float32)


def play(envs, actions):
    """Return observations, rewards, dones and infos of a reset and some steps."""
    envs.seed(5)
    rows = [(envs.reset(), None, None, None)]
    for action in actions:
        rows.append(envs.step(action))
    envs.close()
    return rows


def same(one, other):
    if isinstance(one, dict):
        return all(np.array_equal(one[key], other[key]) for key in one)
    return np.array_equal(one, other)


@pytest.mark.parametrize(("obs_type", "workers"), [("goal", 0), ("relative", 0), ("goal", 2)])
def test_it_is_stable_baselines_own_vector_env_of_single_envs(obs_type, workers):
    actions = moves(3)
    own = play(SuturingVecEnv("grasp", 3, workers, obs_type=obs_type, max_steps=LIMIT), actions)
    theirs = play(
        make_vec_env(
            env_id("grasp"), 3, env_kwargs={"obs_type": obs_type, "max_episode_steps": LIMIT}
        ),
        actions,
    )
    for (seen, rewards, dones, infos), (seen_, rewards_, dones_, infos_) in zip(
        own, theirs, strict=True
    ):
        assert same(seen, seen_)
        if infos is None:
            continue
        assert np.array_equal(rewards, rewards_) and np.array_equal(dones, dones_)
        for info, info_ in zip(infos, infos_, strict=True):
            assert info["TimeLimit.truncated"] == info_["TimeLimit.truncated"]
            assert info["d_trans"] == info_["d_trans"]
            assert ("episode" in info) == ("episode" in info_) == ("terminal_observation" in info)
            if "episode" in info:
                assert same(info["terminal_observation"], info_["terminal_observation"])
                assert info["episode"]["l"] == info_["episode"]["l"] == LIMIT
                assert info["episode"]["r"] == info_["episode"]["r"]
    assert sum(bool(row[2] is not None and row[2].all()) for row in own) == 2


@pytest.mark.parametrize("workers", [0, 1])
def test_a_restored_state_has_the_same_future_over_a_reset(workers):
    actions = moves(2)
    first = SuturingVecEnv("insert", 2, obs_type="relative", max_steps=LIMIT)
    first.seed(1)
    first.reset()
    for action in actions[:3]:
        first.step(action)
    state = first.get_state()
    second = SuturingVecEnv("insert", 2, workers, obs_type="relative", max_steps=LIMIT)
    second.set_state(*state)
    for action in actions[3:]:
        one, other = first.step(action), second.step(action)
        assert same(one[0], other[0]) and np.array_equal(one[1], other[1])
        assert [info.get("episode", {}).get("r") for info in one[3]] == [
            info.get("episode", {}).get("r") for info in other[3]
        ]
    first.close()
    second.close()


@pytest.mark.parametrize("workers", [0, 2])
def test_options_hold_for_one_reset_of_all_envs(workers):
    config = TaskConfig("insert", randomisation=RandomisationConfig(phantom_shift=3.0))
    options = {"randomisation": {"phantom_shift": [0.002, -0.001]}}
    envs = SuturingVecEnv.of(config, "state", 2, workers)
    envs.seed(0)
    drawn = envs.reset()
    envs.seed(0)
    envs.set_options(options)
    given = envs.reset()
    single = make(config, "state")
    wanted = [single.reset(seed=seed, options=options)[0] for seed in (0, 1)]
    assert same(given, np.stack(wanted)) and not same(given, drawn)
    envs.seed(0)
    assert same(envs.reset(), drawn)
    envs.close()
    single.close()


def test_options_that_differ_between_envs_are_refused():
    envs = SuturingVecEnv("grasp", 2, obs_type="relative")
    envs.set_options([{"randomisation": {}}, {"own": 1}])
    with pytest.raises(InputError, match="one table for all"):
        envs.reset()
    envs.close()


def test_rewards_of_goals_are_computed_in_this_process():
    config = TaskConfig("place", max_steps=LIMIT, action_repeat=2, hold_jaw=True)
    envs = SuturingVecEnv.of(config, "goal", 2, workers=1)
    seen = envs.reset()
    goals = seen["desired_goal"]
    (rewards,) = envs.env_method("compute_reward", goals, goals, [{}, {}], indices=[0])
    assert rewards.tolist() == [0.0, 0.0]
    assert envs.get_attr("config") == [config, config]
    assert envs.env_method("agent_pos", indices=[1])[0].shape == (7,)
    envs.close()
