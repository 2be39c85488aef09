"""Layouts: what can be done where, and the expert's seeded noise."""

import math

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core.config import SceneConfig, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs.geometry import FIRST_GRASP, Stitch
from surgicai_vision.scene.holes import PAIRS

PLACES = [(layout, pair) for layout in PAIRS for pair in (1, 2, 3, 4)]


def solved(task, scene, seed=0, **noise):
    """Play one episode by the expert."""
    env = envs.make(TaskConfig(task=task, scene=scene))
    expert = Expert(env, **noise)
    env.reset(seed=seed)
    done = False
    while not done:
        _, _, terminated, truncated, info = env.step(expert.action())
        done = terminated or truncated
    return info["is_success"], env.get_state()


@pytest.mark.parametrize(("layout", "pair"), PLACES)
def test_a_stitch_is_possible_where_psm2_has_room(layout, pair):
    stitch = Stitch.of(PAIRS[layout][pair - 1])
    assert stitch.possible == (layout != "3dmed")
    low, high = stitch.grasps(FIRST_GRASP, math.radians(27.0))
    assert low < high


@pytest.mark.parametrize("task", ["insert", "handoff", "pullout", "suture"])
def test_3dmed_refuses_what_needs_the_stitch(task):
    with pytest.raises(InputError, match="grasp, place"):
        envs.make(TaskConfig(task=task, scene=SceneConfig(layout="3dmed")))


@pytest.mark.parametrize("task", ["grasp", "place"])
def test_3dmed_allows_what_does_not(task):
    assert solved(task, SceneConfig(layout="3dmed", hole_pair=2))[0]


@pytest.mark.parametrize("task", ["insert", "handoff", "pullout"])
def test_the_straight_wound_can_be_stitched(task):
    assert solved(task, SceneConfig(layout="3dmed_straight", hole_pair=3))[0]


def test_the_expert_recovers_from_seeded_noise():
    first, again, other = (
        solved("place", SceneConfig(), noise=0.4, rng=np.random.default_rng(seed))
        for seed in (1, 1, 2)
    )
    assert first[0]
    assert other[0]
    np.testing.assert_array_equal(first[1], again[1])
    assert not np.array_equal(first[1], other[1])


@pytest.mark.parametrize("noise", [{"noise": -0.1}, {"noise": 0.2}])
def test_noise_needs_a_generator_and_a_size(noise):
    with pytest.raises(InputError, match="noise"):
        Expert(envs.make(), **noise)
