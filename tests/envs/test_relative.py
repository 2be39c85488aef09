"""obs_type "relative", and the options that reinforcement learning needs."""

import numpy as np
import pytest
from episodes import make
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs.base import staged_reward
from surgicai_vision.envs.observation import goal_vector
from surgicai_vision.envs.poses import square
from surgicai_vision.envs.relative import FADE, relative_features

SIZE = len(names.RELATIVE_NAMES)
MET = names.RELATIVE_NAMES.index("met")
HELD = ("place", "insert", "pullout")


def base_of(env):
    return square(env.simulation.bases[env.subtask.arm])[:3, :3]


# -- what it holds ---------------------------------------------------------------------------------


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_relative_is_a_function_of_the_goal_dict(task):
    env, goal = make(task, obs_type="relative"), make(task, obs_type="goal")
    pairs = [(env.reset(seed=1)[0], goal.reset(seed=1)[0])]
    expert = Expert(env)
    for _ in range(30):
        action = expert.action()
        pairs.append((env.step(action)[0], goal.step(action)[0]))
    base = base_of(goal)
    parts = ("observation", "achieved_goal", "desired_goal")
    batch = [np.stack([seen[part] for _, seen in pairs]) for part in parts]
    relative = np.stack([seen for seen, _ in pairs])
    assert relative.dtype == np.float32 and relative.shape == (len(pairs), SIZE)
    assert np.array_equal(relative_features(*batch, base), relative)
    single = relative_features(*(part[3] for part in batch), base)
    assert np.array_equal(single, relative[3])


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_its_error_is_that_of_the_measure_and_points_the_way_actions_go(task):
    env = make(task, obs_type="relative")
    seen, info = env.reset(seed=2)
    assert np.linalg.norm(seen[10:13]) == pytest.approx(100 * info["d_trans"], rel=1e-5)
    assert np.linalg.norm(seen[13:16]) == pytest.approx(info["d_angle"], rel=1e-4)
    assert np.allclose(seen[:3], 100 * env.agent_pos()[:3], atol=1e-4)
    tip = Rotation.from_euler("xyz", env.agent_pos()[3:6]).as_matrix()
    assert np.allclose(seen[3:9], tip[:, :2].T.ravel(), atol=1e-5)
    if task in ("grasp", "handoff"):
        way = seen[10:13] / max(np.abs(seen[10:13]))
        for _ in range(6):
            after, *_ = env.step(np.array([*way, 0, 0, 0, 0], np.float32))
        assert np.linalg.norm(after[10:13]) < np.linalg.norm(seen[10:13]) - 0.1


def test_within_the_whole_procedure_it_is_that_of_the_present_subtask():
    env = make("suture", obs_type="relative")
    seen, _ = env.reset(seed=0)
    assert np.array_equal(seen, make("suture").relative_state()) is False
    env.enter(3)
    assert np.array_equal(env.observe(), env.relative_state())
    assert env.relative_state()[0] != seen[0]


def test_within_the_whole_procedure_it_tells_what_the_present_subtask_asks_for():
    env = make("suture", obs_type="relative")
    env.reset(seed=0)
    expert, told = Expert(env), set()
    while env.phase == 0:
        seen, *_, info = env.step(expert.action())
        if env.phase == 0:
            assert bool(seen[MET]) == info["contact"]
            told.add(info["contact"])
    assert told == {False, True}


# -- no jumps --------------------------------------------------------------------------------------

angles = st.floats(-np.pi, np.pi)
directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)
TURN = 0.02
"""Angle between neighbouring poses [rad] in the law below."""


@settings(max_examples=300, deadline=None)
@given(directions, st.floats(0, np.pi), directions, directions, angles, angles, angles)
def test_no_element_jumps_between_neighbouring_poses(axis, size, step, way, roll, pitch, yaw):
    """Also where the error passes half a turn and where the pitch passes 90°."""
    desired = Rotation.random(random_state=3)
    turn = Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * size)
    small = Rotation.from_rotvec(np.array(step) / np.linalg.norm(step) * TURN)
    tip = Rotation.from_euler("xyz", (roll, pitch, yaw))
    rows = []
    for moved in (Rotation.identity(), small):
        achieved = [*np.array(way) * 0.01, *(moved * turn * desired).as_rotvec(), 0.3, 0.0]
        seen = [0.01, 0.02, -0.1, *(moved * tip).as_euler("xyz"), 0.3]
        goal = [0, 0, 0, *desired.as_rotvec(), 0.0, 1.0]
        rows.append(
            relative_features(np.array(seen), np.array(achieved), np.array(goal), np.eye(3))
        )
    slope = FADE / (np.pi - FADE)  # of the fading rotation vector
    jump = np.abs(rows[1] - rows[0])
    assert jump[3:9].max() < 1.1 * TURN
    assert jump[13:16].max() < 1.1 * TURN * max(slope, np.pi / np.sin(FADE / 2))
    assert jump[19:22].max() < 1.1 * TURN * slope / 0.2


def test_the_turn_is_the_rotation_vector_until_it_fades():
    goal = np.zeros(8)
    for degrees, expected in ((40, 40), (149, 149), (165, 75), (180, 0)):
        achieved = np.array([0, 0, 0, 0, 0, -np.radians(degrees), 0, 0])
        seen = relative_features(np.zeros(7), achieved, goal, np.eye(3))
        assert np.allclose(seen[13:16], (0, 0, np.radians(expected)), atol=1e-6)


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_no_element_jumps_along_episodes(task):
    """Driven by the expert, and with one angle turned to its end, past half a turn of error."""
    env = make(task, obs_type="relative")
    largest = np.zeros(SIZE)
    for index in range(4):
        before, _ = env.reset(seed=index)
        expert = Expert(env)
        action = np.zeros(7, np.float32)
        for _ in range(150):
            if index:
                action[2 + index] = 1.0
            else:
                action = expert.action()
            seen, _, terminated, truncated, _ = env.step(action)
            largest = np.maximum(largest, np.abs(seen - before))
            before = seen
            if terminated or truncated:
                break
    assert largest[:3].max() < 0.2  # [cm]; a step is 0.05
    assert largest[3:9].max() < 0.2
    assert largest[10:13].max() < 0.6
    assert largest[13:16].max() < 1.0  # 2° per step, five times that where it fades
    assert np.degrees(env.reset(seed=0)[1]["d_angle"]) < 150


# -- options ---------------------------------------------------------------------------------------


def test_options_are_off_by_default_and_named_in_the_configuration():
    config = TaskConfig()
    assert (config.action_repeat, config.hold_jaw, config.end_on_drop) == (1, False, False)
    assert make("place").config == TaskConfig("place")
    changed = make("place", action_repeat=2, hold_jaw=True, end_on_drop=True, reward="staged")
    assert changed.config == TaskConfig(
        "place", reward="staged", action_repeat=2, hold_jaw=True, end_on_drop=True
    )
    with pytest.raises(InputError, match="action_repeat is 0; allowed: 1 to 10"):
        TaskConfig(action_repeat=0)


@pytest.mark.parametrize("obs_type", ["relative", "goal"])
def test_a_repeated_action_is_the_action_given_again(obs_type):
    once, twice = (
        make("insert", obs_type=obs_type),
        make("insert", obs_type=obs_type, action_repeat=2),
    )
    once.reset(seed=4)
    twice.reset(seed=4)
    for action in np.random.default_rng(0).uniform(-1, 1, (5, 7)).astype(np.float32):
        once.step(action)
        expected = once.step(action)
        result = twice.step(action)
        assert np.array_equal(once.get_state(), twice.get_state())
        assert result[1:4] == expected[1:4]
    assert twice.simulation.task_state.steps == 10


def test_a_repeated_action_ends_with_the_episode():
    env = make("grasp", action_repeat=2, max_steps=5)
    env.reset(seed=0)
    ends = [env.step(np.zeros(7, np.float32))[3] for _ in range(3)]
    assert ends == [False, False, True] and env.simulation.task_state.steps == 5


@pytest.mark.parametrize("task", HELD)
def test_a_held_jaw_keeps_the_needle_while_it_is_drawn_back(task):
    moves = np.random.default_rng(1).uniform(-1, 1, (120, 7)).astype(np.float32)
    moves[:, 2] = 0.8  # draws the arm back
    moves[:, 6] = 1.0  # opens the jaw
    free, held = (make(task, hold_jaw=flag, end_on_drop=True) for flag in (False, True))
    kept, jaws = [], []
    for env in (free, held):
        env.reset(seed=0)
        ended = False
        for move in moves:
            *_, terminated, ended, info = env.step(move)
            assert not terminated
            if ended:
                break
        kept.append(not info["dropped"])
        jaws.append(env.agent_pos()[6])
    assert kept == [False, True]
    assert jaws[0] > jaws[1] + 0.3


def test_a_jaw_that_has_to_grasp_stays_free():
    env = make("grasp", hold_jaw=True, end_on_drop=True)
    env.reset(seed=0)
    before = env.agent_pos()[6]
    for _ in range(8):
        *_, ended, info = env.step(np.array([0, 0, 0, 0, 0, 0, -1], np.float32))
        assert not ended and not info["dropped"]
    assert env.agent_pos()[6] < before - 0.2


# -- the staged reward -----------------------------------------------------------------------------


def test_the_staged_reward_pays_for_what_the_dense_one_does_not():
    near = {"distance": 0.0004, "turn": 0.02}
    hovering = staged_reward(**near, is_met=False, is_success=False)
    assert staged_reward(**near, is_met=True, is_success=True) == 0
    assert staged_reward(**near, is_met=True, is_success=False) > hovering + 0.3
    far = staged_reward(0.2, 3.0, False, False)
    assert -1 <= far < -0.99 < hovering


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_staged_rewards_are_in_range_and_computable_from_goals(task):
    env, goal = make(task, reward="staged"), make(task, obs_type="goal", reward="staged")
    env.reset(seed=0)
    goal.reset(seed=0)
    expert, rewards = Expert(env), []
    for _ in range(200):
        action = expert.action()
        _, reward, ended, _, info = env.step(action)
        seen, other, *_ = goal.step(action)
        assert other == pytest.approx(reward, abs=1e-4)
        assert other == goal.compute_reward(seen["achieved_goal"], seen["desired_goal"], info)
        rewards.append(reward)
        if ended:
            break
    assert ended and rewards[-1] == 0 and max(rewards[:-1]) < 0 and min(rewards) >= -1
    batch = np.stack([seen["achieved_goal"]] * 3), np.stack([seen["desired_goal"]] * 3)
    assert goal.compute_reward(*batch).shape == (3,)
    assert goal_vector(env._target()[0], 0.0, True).shape == (8,)
