"""Searching: grasps without reading the goal; the clock that lets a policy learn them."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from fake_dataset import FakeDataset

from policies.base import Recipe
from policies.bc import BC
from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import (
    CLOCK_PERIOD,
    CLOCK_SIZE,
    FULL_SPEED,
    SECOND_ATTEMPT_STEP,
    SUBTASK_STEPS,
    Pace,
    RandomisationConfig,
    TaskConfig,
    clock,
)
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos.disturbance import UNDISTURBED, Disturbance
from surgicai_vision.demos.rollout import rollout
from surgicai_vision.demos.search_expert import SearchExpert
from surgicai_vision.envs.geometry import Stitch
from surgicai_vision.envs.starts import GRASP_ANGLES
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.scene.holes import PAIRS, HolePair
from surgicai_vision.training.policies import check_retries, load_policy
from surgicai_vision.training.train import train


def grasp(env: envs.SuturingEnv, seed: int, goal: float | None = None) -> tuple[bool, np.ndarray]:
    env.reset(seed=seed)
    if goal is not None:
        env.simulation.task_state.grasp_angle = math.radians(goal)
    actor, actions, ended, info = SearchExpert(env), [], False, {}
    while not ended:
        actions.append(actor.action())
        _, _, terminated, truncated, info = env.step(actions[-1])
        ended = terminated or truncated
    return info["is_success"], np.stack(actions)


def test_it_meets_every_goal_and_reads_none() -> None:
    env = envs.make(TaskConfig("grasp"))
    for seed, goals in ((500_000, (5.0, 9.0, 13.0)), (500_001, (12.0, 16.0, 20.0))):
        tried = [grasp(env, seed, goal) for goal in goals]
        assert all(success for success, _ in tried)
        shortest = min(len(actions) for _, actions in tried)
        for _, actions in tried[1:]:
            np.testing.assert_array_equal(actions[:shortest], tried[0][1][:shortest])
    second, third = SECOND_ATTEMPT_STEP, SECOND_ATTEMPT_STEP + CLOCK_PERIOD
    steps = [len(grasp(env, 500_000, goal)[1]) for goal in (12.5, 5.0, 20.0)]
    assert steps[0] < second < steps[1] < third < steps[2] < SUBTASK_STEPS


def test_its_attempts_go_where_the_goals_on_a_half_circle_lie() -> None:
    half_circles = RandomisationConfig(needle_arc="1/2", needle_size=0.2)
    env = envs.make(TaskConfig("grasp", randomisation=half_circles))
    assert all(grasp(env, seed)[0] for seed in range(500_000, 500_004))


@pytest.mark.parametrize("pair", [pair for pairs in PAIRS.values() for pair in pairs])
def test_its_attempts_on_our_own_needle_are_the_angles_named(pair: HolePair) -> None:
    assert Stitch.of(pair).grasps(*GRASP_ANGLES)[0] == GRASP_ANGLES[0]


def test_its_demonstrations_show_every_attempt() -> None:
    """They go on after the success, so that a learner sees what follows a failed attempt."""
    env = envs.make(TaskConfig("grasp"))
    result = rollout(env, SearchExpert(env), 500_000, "search")
    assert result.success and len(result.demo) == env.config.max_steps and result.demo.success.any()
    closing = result.demo.action[:, 6] < -0.5
    opening = result.demo.action[:, 6] > 0.5
    edges = range(SECOND_ATTEMPT_STEP, env.config.max_steps + 1, CLOCK_PERIOD)
    assert len(edges) == len(SearchExpert.ATTEMPTS)
    for start, stop in pairwise(edges):
        assert opening[start:stop].any() and closing[start:stop].any()
        assert opening[start:stop].argmax() < closing[start:stop].argmax()
    other = envs.make(TaskConfig("pullout"))
    assert len(rollout(other, SearchExpert(other), 500_000, "search").demo) < other.config.max_steps


def test_its_attempts_are_counted_from_where_the_recording_begins() -> None:
    """Regression: the steps of an unrecorded perturbation counted, but not for a policy's clock."""
    env = envs.make(TaskConfig("grasp"))
    opens = []
    for disturbance in (UNDISTURBED, Disturbance(perturb_start_fraction=1.0)):
        demo = rollout(env, SearchExpert(env), 500_000, "search", disturbance).demo
        env.set_state_vector(demo.state[0])
        state = env.simulation.task_state
        assert (state.steps, state.tip_path) == (0, 0.0)
        opens.append(np.flatnonzero(np.diff(demo.action[60:, 6] > 0.5).astype(int) > 0).tolist())
    assert opens[0] == opens[1] and len(opens[0]) >= 3


def test_the_clock_tells_steps_apart_and_comes_round() -> None:
    told = clock(np.arange(SUBTASK_STEPS))
    assert told.shape == (SUBTASK_STEPS, CLOCK_SIZE) and told.dtype == np.float32
    np.testing.assert_allclose(told[CLOCK_PERIOD:, 1:], told[:-CLOCK_PERIOD, 1:], atol=1e-5)
    assert np.abs(np.diff(told[:, 1:], axis=0)).sum(1).min() > 0.2


class Stepped(FakeDataset):
    """A dataset whose action depends on time alone."""

    def columns(self) -> dict[str, np.ndarray]:
        columns = super().columns()
        step = np.tile(np.arange(self.steps), self.episodes)
        clock = np.where(step >= self.steps // 2, 0.5, -0.5).astype(np.float32)
        return {
            **columns,
            "timestamp": step / names.FPS,
            names.ACTION: np.repeat(clock[:, None], 7, axis=1),
        }


class Still:
    """An env whose proprioception never changes."""

    def agent_pos(self) -> np.ndarray:
        return np.zeros(7, np.float32)


def test_a_policy_with_a_clock_acts_by_it(tmp_path: Path) -> None:
    recipe = Recipe(hidden=(32,), epochs=60, batch_size=32, learning_rate=1e-2, clock=True)
    train(Stepped(), [], BC, recipe, out=tmp_path / "clocked")
    policy = load_policy(tmp_path / "clocked")
    agent = PolicyAgent("clocked", policy, None, (), 224, policy.inputs.vector)
    agent.reset(0, Still(), 0)
    early = [agent.act([0], [Still()], [None])[0, 0] for _ in range(40)]
    assert np.mean(early[:18]) < -0.3 and np.mean(early[22:]) > 0.3
    agent.restart(0)
    assert agent.act([0], [Still()], [None])[0, 0] == early[0]
    held = PolicyAgent("held", policy, None, (), 224, policy.inputs.vector, action_repeat=2)
    held.reset(0, Still(), 0)
    assert [held.act([0], [Still()], [None])[0, 0] for _ in range(20)] == early[::2]
    slow = PolicyAgent("slow", policy, None, (), 224, policy.inputs.vector, pace=Pace(speed=0.5))
    slow.reset(0, Still(), 0)
    halves = [slow.act([0], [Still()], [None])[0, 0] for _ in range(40)][::2]
    np.testing.assert_array_equal(halves, np.float32(0.5) * np.array(early[:20]))


def test_the_jaw_and_the_clock_are_slowed_on_their_own(tmp_path: Path) -> None:
    recipe = Recipe(hidden=(32,), epochs=60, batch_size=32, learning_rate=1e-2, clock=True)
    train(Stepped(), [], BC, recipe, out=tmp_path / "clocked")
    policy = load_policy(tmp_path / "clocked", {"jaw_speed": 0.25, "clock_speed": 0.5})
    assert policy.pace == Pace(jaw_speed=0.25, clock_speed=0.5)

    def acted(pace: Pace) -> np.ndarray:
        agent = PolicyAgent("a", policy, None, (), 224, policy.inputs.vector, pace=pace)
        agent.reset(0, Still(), 0)
        return np.array([agent.act([0], [Still()], [None])[0] for _ in range(40)])

    for speed in (1.0, 0.5):
        whole, slow = acted(Pace(speed)), acted(Pace(speed, jaw_speed=0.25))
        np.testing.assert_array_equal(slow[:, :6], whole[:, :6])
        np.testing.assert_array_equal(slow[:, 6], np.float32(0.25) * whole[:, 6])
        assert np.abs(slow[:, 6]).min() > 0
        late = acted(Pace(speed, clock_speed=0.5))
        np.testing.assert_array_equal(late[::2], whole[:20])


def test_a_policy_whose_jaws_stay_shut_acts_as_in_the_next_attempt(tmp_path: Path) -> None:
    recipe = Recipe(hidden=(32,), epochs=2, batch_size=32, clock=True)
    train(Stepped(), [], BC, recipe, out=tmp_path / "clocked")
    policy = load_policy(tmp_path / "clocked", {"retry_after": 8})

    def acted(pace: Pace) -> np.ndarray:
        agent = PolicyAgent("a", policy, None, (), 224, policy.inputs.vector, pace=pace)
        agent.reset(0, Still(), 0)
        return np.array([agent.act([0], [Still()], [None])[0] for _ in range(120)])

    assert Still().agent_pos()[6] == 0, "its jaws are shut"
    waiting, again = acted(FULL_SPEED), acted(policy.pace)
    np.testing.assert_array_equal(again[:7], waiting[:7])
    np.testing.assert_array_equal(again[7:27], waiting[SECOND_ATTEMPT_STEP:])


def test_a_clock_goes_with_proprioception() -> None:
    with pytest.raises(InputError, match="clock needs proprioception"):
        replace(Recipe(), clock=True, proprioception=False)


def test_a_clock_whose_hand_stands_still_in_all_frames_is_refused() -> None:
    for stride in (25, 50):
        with pytest.raises(InputError, match="would have the same value in all training frames"):
            Recipe(clock=True, frame_stride=stride)
    assert Recipe(clock=True, frame_stride=10).frame_stride == 10


def test_only_a_policy_that_has_learned_a_search_tries_again() -> None:
    recipe = replace(Recipe(), clock=True, retry_after=8)
    for task, demonstrator in (("grasp", "search"), ("grasp", None)):
        check_retries(recipe, task, demonstrator)
    for task, demonstrator in (("grasp", "expert"), ("place", "expert"), ("place", None)):
        check_retries(replace(recipe, retry_after=0), task, demonstrator)
        with pytest.raises(InputError, match="no further attempts to go on to"):
            check_retries(recipe, task, demonstrator)
