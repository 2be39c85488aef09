"""Vector envs (sync, async, our workers) give what single envs give, infos included."""

import os
import signal

import gymnasium
import numpy as np
import pytest

import surgicai_vision.envs
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, SurgicaiError
from surgicai_vision.core.tasks import env_id
from surgicai_vision.envs.vector_env import make_vector

SEEDS, STEPS = (3, 4), 8
MODES = ("sync", "async", "workers")


def actions():
    """The same actions in every test, (steps, envs, 7)."""
    return np.random.default_rng(0).uniform(-1, 1, (STEPS, len(SEEDS), 7)).astype(np.float32)


def alone(name, index, **arguments):
    """One env's observations, rewards and infos."""
    env = gymnasium.make(name, **arguments)
    observation, info = env.reset(seed=SEEDS[index])
    rows = [(observation, 0.0, info)]
    for action in actions()[:, index]:
        observation, reward, _, _, info = env.step(action)
        rows.append((observation, reward, info))
    env.close()
    return rows


def make_vec(task, mode, count=2, **arguments):
    """A vector env; "workers" are our own."""
    how = {"workers": count} if mode == "workers" else {"vectorization_mode": mode}
    return gymnasium.make_vec(env_id(task), num_envs=count, **how, **arguments)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("task", "arguments"),
    [
        ("insert", {}),
        ("suture", {"randomisation": {"friction": 0.2, "kinematic_error": 0.5, "latency": 1}}),
    ],
)
def test_a_vector_env_gives_the_trajectories_of_single_envs(mode, task, arguments):
    vector = make_vec(task, mode, **arguments)
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
            rows, alone(env_id(task), index, **arguments), strict=True
        ):
            np.testing.assert_array_equal(seen[index], expected)
            assert rewards[index] == pytest.approx(reward)
            assert single.keys() <= infos.keys()
            for key in set(single) - {"randomisation"}:
                np.testing.assert_array_equal(infos[key][index], single[key])
            for axis, value in single.get("randomisation", {}).items():
                np.testing.assert_array_equal(infos["randomisation"][axis][index], value)


@pytest.mark.parametrize("mode", MODES)
def test_images_of_workers_are_those_of_single_envs(mode):
    arguments = {"obs_type": "pixels_agent_pos", "cameras": ("front",), "image_size": 48}
    vector = make_vec("place", mode, **arguments)
    try:
        vector.reset(seed=list(SEEDS))
        observation = vector.step(actions()[0])[0]
        expected = [alone(env_id("place"), index, **arguments)[1][0] for index in range(2)]
        for index in range(2):
            np.testing.assert_array_equal(
                observation["agent_pos"][index], expected[index]["agent_pos"]
            )
            np.testing.assert_array_equal(observation["front"][index], expected[index]["front"])
    finally:
        vector.close()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("held", [1, 2])
def test_lerobot_finds_its_attributes(mode, held):
    vector = make_vec("grasp", mode, max_episode_steps=120, action_repeat=held)
    try:
        assert vector.call("_max_episode_steps") == (120, 120)
        assert vector.call("task") == ("grasp", "grasp")
        assert vector.call("task_description") == (names.TASK_TEXTS["grasp"],) * 2
        assert vector.metadata["render_fps"] == 50 // held
    finally:
        vector.close()


def test_importing_registers_every_id():
    assert set(map(env_id, names.TASKS)) <= set(gymnasium.registry)
    assert set(surgicai_vision.envs.SUBTASKS) == set(names.SUBTASKS)


@pytest.mark.parametrize("autoreset", ["NextStep", "SameStep"])
def test_shares_of_envs_are_one_sync_vector(autoreset):
    """Three envs on two workers give the same as in this process, across episode ends too."""
    arguments = {
        "max_episode_steps": 3,
        "autoreset_mode": autoreset,
        "randomisation": {"friction": 0.2},
    }
    ours, plain = (
        gymnasium.make_vec(env_id("place"), 3, workers=workers, **arguments) for workers in (2, 0)
    )
    try:
        pairs = [(ours.reset(seed=5), plain.reset(seed=5))]
        for batch in np.random.default_rng(1).uniform(-1, 1, (8, 3, 7)).astype(np.float32):
            pairs.append((ours.step(batch), plain.step(batch)))
        mask = np.array([True, False, False])
        pairs.append(
            (
                ours.reset(options={"reset_mask": mask}, seed=9),
                plain.reset(options={"reset_mask": mask}, seed=9),
            )
        )
        for one, other in pairs:
            assert_same(one, other)
        assert ours.metadata["autoreset_mode"] == plain.metadata["autoreset_mode"]
        ours.set_attr("mark", [1, 2, 3])
        assert ours.get_attr("mark") == (1, 2, 3)
    finally:
        ours.close()
        plain.close()


def assert_same(one, other):
    """Assert that nested tuples, dicts and arrays are equal."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, tuple):
        for left, right in zip(one, other, strict=True):
            assert_same(left, right)
    elif isinstance(one, np.ndarray) and one.dtype == object:
        assert_same(tuple(one), tuple(other))
    else:
        np.testing.assert_array_equal(one, other)


def test_a_workers_error_and_its_death_are_told():
    """The error is that of a single env, a killed worker is named, and the env is closed."""
    vector = make_vec("place", "workers")
    vector.reset(seed=0)
    with pytest.raises(InputError, match="7 finite numbers"):
        vector.step(np.full((2, 7), np.nan, np.float32))
    with pytest.raises(InputError, match="closed"):
        vector.step(np.zeros((2, 7), np.float32))
    vector = make_vec("place", "workers", randomisation={"light": 0.2})
    with pytest.raises(InputError, match="Did you mean 'light'"):
        vector.reset(options={"randomisation": {"lihgt": [0.1]}})
    vector = make_vec("place", "workers")
    os.kill(vector._workers[1].pid, signal.SIGKILL)
    vector._workers[1].join()
    with pytest.raises(SurgicaiError, match="died"):
        vector.reset(seed=0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"workers": -1},
        {"num_envs": 0},
        {"workers": 2, "obs_type": "image"},
        {"autoreset_mode": "same_step"},
    ],
)
def test_wrong_arguments_are_refused(wrong):
    with pytest.raises(InputError):
        make_vector(**{"task": "place", "num_envs": 2, "workers": 1} | wrong)


def test_a_wrong_mask_is_refused_and_the_workers_go_on():
    vector = make_vec("place", "workers", 3)
    try:
        first = vector.reset(seed=0)[0]
        wrongs = ([True, False], [True] * 4, [False] * 3, [1, 0, 0])
        for wrong in wrongs:
            with pytest.raises(InputError, match=r"bool of shape \(3,\) with at least one"):
                vector.reset(options={"reset_mask": np.array(wrong)})
        mask = np.array([False, True, False])
        again = vector.reset(seed=7, options={"reset_mask": mask})[0]
        np.testing.assert_array_equal((first != again).any(axis=1), mask)
    finally:
        vector.close()
