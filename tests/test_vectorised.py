"""Vectorised: make_vec, sync and async, gives what single envs give, infos included; LeRobot's names are reachable."""

import gymnasium
import numpy as np
import pytest

import surgicai_vision.envs
from surgicai_vision import names

SEEDS, STEPS = (3, 4), 8


def actions():
    """The same actions in every test, (steps, envs, 7)."""
    return np.random.default_rng(0).uniform(-1, 1, (STEPS, len(SEEDS), 7)).astype(np.float32)


def alone(env_id, index, **arguments):
    """One env's observations, rewards and infos."""
    env = gymnasium.make(env_id, **arguments)
    observation, info = env.reset(seed=SEEDS[index])
    rows = [(observation, 0.0, info)]
    for action in actions()[:, index]:
        observation, reward, _, _, info = env.step(action)
        rows.append((observation, reward, info))
    env.close()
    return rows


@pytest.mark.parametrize("mode", ["sync", "async"])
@pytest.mark.parametrize(
    ("task", "arguments"),
    [("insert", {}), ("suture", {"randomisation": {"friction": 0.2, "kinematic_error": 0.5, "latency": 1}})],
)
def test_a_vector_env_gives_the_trajectories_of_single_envs(mode, task, arguments):
    env_id = names.ENV_IDS[task]
    vector = gymnasium.make_vec(env_id, num_envs=len(SEEDS), vectorization_mode=mode, **arguments)
    try:
        observation, info = vector.reset(seed=list(SEEDS))
        rows = [(observation.copy(), np.zeros(len(SEEDS)), info)]
        for batch in actions():
            observation, reward, _, _, info = vector.step(batch)
            rows.append((observation.copy(), reward, info))
    finally:
        vector.close()
    for index in range(len(SEEDS)):
        for (seen, rewards, infos), (expected, reward, single) in zip(
            rows, alone(env_id, index, **arguments), strict=True
        ):
            np.testing.assert_array_equal(seen[index], expected)
            assert rewards[index] == pytest.approx(reward)
            assert single.keys() <= infos.keys()
            for key in set(single) - {"randomisation"}:
                np.testing.assert_array_equal(infos[key][index], single[key])
            for axis, value in single.get("randomisation", {}).items():
                np.testing.assert_array_equal(infos["randomisation"][axis][index], value)


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_pictures_of_workers_are_those_of_single_envs(mode):
    arguments = {"obs_type": "pixels_agent_pos", "cameras": ("front",), "image_size": 48}
    vector = gymnasium.make_vec(names.ENV_IDS["place"], num_envs=2, vectorization_mode=mode, **arguments)
    try:
        vector.reset(seed=list(SEEDS))
        observation = vector.step(actions()[0])[0]
        expected = [alone(names.ENV_IDS["place"], index, **arguments)[1][0] for index in range(2)]
        for index in range(2):
            np.testing.assert_array_equal(observation["agent_pos"][index], expected[index]["agent_pos"])
            np.testing.assert_array_equal(observation["pixels"]["front"][index], expected[index]["pixels"]["front"])
    finally:
        vector.close()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_lerobot_finds_its_attributes(mode):
    vector = gymnasium.make_vec(names.ENV_IDS["grasp"], num_envs=2, vectorization_mode=mode, max_steps=120)
    try:
        assert vector.call("_max_episode_steps") == (120, 120)
        assert vector.call("task") == ("grasp", "grasp")
        assert vector.call("task_description") == (names.TASK_TEXTS["grasp"],) * 2
        assert vector.metadata["render_fps"] == 50
    finally:
        vector.close()


def test_importing_registers_every_id():
    assert set(names.ENV_IDS.values()) <= set(gymnasium.registry)
    assert set(surgicai_vision.envs.SUBTASKS) == set(names.SUBTASKS)
