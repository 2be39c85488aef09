"""Grasp level "attach": the needle sticks to closed jaws that touch it, and only then."""

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core.config import SceneConfig, TaskConfig
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs import poses
from surgicai_vision.scene import build_scene

ATTACH = SceneConfig(grasp="attach")
STAY, CLOSE = (np.array([0, 0, 0, 0, 0, 0, jaw], dtype=np.float32) for jaw in (0, -1))


def made(task="place"):
    """An env whose needle is attached."""
    return envs.make(TaskConfig(task=task, scene=ATTACH))


def in_jaws(env):
    """T_grasp_needle of PSM2, measured."""
    return poses.relative(env.simulation.grasp("psm2"), env.simulation.needle())


def test_the_default_level_has_no_weld():
    assert "psm2_attach" not in [
        build_scene().model.equality(index).name for index in range(build_scene().model.neq)
    ]


@pytest.mark.parametrize("seed", range(1, 6))
def test_the_needle_stays_without_friction(seed):
    env = made()
    env.reset(seed=seed)
    env.model.geom_friction[:] = 1e-6
    for _ in range(10):  # at first the squeeze turns the needle as far as the weld gives
        env.step(np.zeros(7, dtype=np.float32))
    before = in_jaws(env)
    for _ in range(50):
        env.step(np.array([0.5, 0.5, 0.5, 0.3, 0.3, 0.3, 0], dtype=np.float32))
    after = in_jaws(env)
    assert env.measure()["contact"]
    assert poses.distance(before, after) < 3e-4
    assert poses.angle(before, after) < np.radians(0.5)


def test_open_jaws_let_go():
    env = made()
    env.reset(seed=1)
    start = env.needle_pose()[2]
    for _ in range(12):
        env.step(np.array([0, 0, 0, 0, 0, 0, 1], dtype=np.float32))
    assert not env.measure()["contact"]
    assert env.needle_pose()[2] < start + 1e-3


def test_jaws_closed_on_nothing_attach_nothing():
    env = made("grasp")
    env.reset(seed=0)
    for _ in range(40):
        info = env.step(CLOSE)[-1]
        assert not info["contact"]
        assert not info["is_success"]


def test_a_restored_weld_holds_where_it_held():
    one, other = made("insert"), made("insert")
    one.reset(seed=3)
    other.reset(seed=8)
    for _ in range(5):
        one.step(STAY)
    other.set_state_vector(one.get_state())
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-1, 1, 7).astype(np.float32)
        np.testing.assert_array_equal(one.step(action)[0], other.step(action)[0])
    np.testing.assert_array_equal(one.get_state(), other.get_state())


def test_the_same_seed_gives_the_same_state_whatever_came_before():
    used, fresh = made(), made()
    used.reset(seed=5)
    used.step(STAY)
    used.reset(seed=2)
    fresh.reset(seed=2)
    np.testing.assert_array_equal(used.get_state(), fresh.get_state())


@pytest.mark.parametrize("task", ["grasp", "place", "insert", "handoff", "pullout"])
def test_the_expert_solves_it(task):
    env = made(task)
    expert = Expert(env)
    env.reset(seed=0)
    done = False
    while not done:
        _, _, terminated, truncated, info = env.step(expert.action())
        done = terminated or truncated
    assert info["is_success"]
