"""Upsets: one thing that goes wrong, drawn from the seed; and going back to any subtask."""

import math
from collections import Counter

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs import poses
from surgicai_vision.envs.suture import Suture
from surgicai_vision.envs.upset import (
    KINDS,
    OPENING_STEPS,
    PUSH,
    TASK_KINDS,
    WAITS,
    Upset,
    UpsetPlan,
    plan_upset,
)


def test_plans_are_drawn_from_the_seed_and_every_kind_occurs():
    plans = [plan_upset(seed, names.SUTURE) for seed in range(200)]
    assert plans == [plan_upset(seed, names.SUTURE) for seed in range(200)]
    counts = Counter(plan.kind for plan in plans if plan)
    assert set(counts) == set(KINDS) and min(counts.values()) > 30
    for plan in plans:
        assert plan is not None
        low, high = WAITS[plan.kind]
        assert low <= plan.wait <= high
    some = [plan_upset(seed, names.SUTURE, 0.5) for seed in range(200)]
    assert 70 < sum(plan is not None for plan in some) < 130
    # What happens in an episode does not depend on how many others are upset.
    assert all(plan is None or plan == plans[seed] for seed, plan in enumerate(some))
    assert {plan_upset(0, task) is not None for task in TASK_KINDS} == {True}
    with pytest.raises(InputError, match="'tie-knot' has no upsets"):
        plan_upset(0, "tie-knot")


@pytest.mark.parametrize("heading", [0.0, 1.0, 3.0, 5.0])
def test_a_push_moves_the_lying_needle_once(heading):
    env = envs.make(TaskConfig("grasp"))
    env.reset(seed=3)
    shape = env.get_state().shape
    before = np.array(poses.position(env.simulation.needle()))
    upset = Upset(env, UpsetPlan("push", 2, heading))
    expert = Expert(env)
    pushed = []
    for _ in range(8):
        pushed.append(upset.before_step())
        action = expert.action()
        assert upset.altered(action) is action
        env.step(action)
    assert pushed == [False, False, True, *[False] * 5]
    assert (upset.kind, upset.step) == ("push", 2)
    moved = np.array(poses.position(env.simulation.needle())) - before
    assert math.hypot(*moved[:2]) == pytest.approx(PUSH, abs=2e-4)
    assert abs(moved[2]) < 1e-4
    assert env.get_state().shape == shape


def test_jaws_open_while_they_hold_and_the_needle_drops():
    env = envs.make(TaskConfig("place"))
    env.reset(seed=3)
    expert = Expert(env)
    upset = Upset(env, UpsetPlan("drop", 10, 0.0))
    altered = []
    for _ in range(30):
        assert not upset.before_step()
        action = expert.action()
        executed = upset.altered(action)
        altered.append(executed is not action)
        if altered[-1]:
            assert executed.tolist() == [0.0] * 6 + [1.0]
        env.step(executed)
    assert altered == [10 <= step < 10 + OPENING_STEPS for step in range(30)]
    assert upset.step == 10 and not env.simulation.holds(names.PSM2)


@pytest.mark.parametrize(("held", "opened"), [(1, 6), (2, 6), (5, 10)])
def test_an_upset_counts_control_steps_however_long_an_action_is_held(held, opened):
    env = envs.make(TaskConfig("place", action_repeat=held))
    env.reset(seed=3)
    expert = Expert(env)
    upset = Upset(env, UpsetPlan("drop", 10, 0.0))
    steps = 0
    for _ in range(30 // held):
        upset.before_step()
        action = expert.action()
        executed = upset.altered(action)
        steps += held if executed is not action else 0
        env.step(executed)
    assert (upset.step, steps) == (10, opened)


def test_nothing_happens_without_a_plan():
    env = envs.make(TaskConfig("grasp"))
    env.reset(seed=3)
    upset = Upset(env, None)
    assert not upset.before_step() and upset.kind == "" and upset.step == -1


@pytest.fixture(scope="module")
def moments() -> list[np.ndarray]:
    """Return states from a whole procedure, including PSM2's release."""
    env = envs.make(TaskConfig(names.SUTURE))
    env.reset(seed=2)
    expert = Expert(env)
    states = []
    phase = -1
    ended = False
    while not ended:
        _, _, terminated, truncated, _ = env.step(expert.action())
        ended = terminated or truncated
        steps = env.simulation.task_state.steps
        if env.phase != phase or steps % 40 == 0:
            states.append(env.get_state())
        phase = env.phase
    return states


def test_grasping_can_be_entered_at_any_moment(moments):
    """PSM2 moves, PSM1 keeps its command, no release is pending, progress is kept."""
    env = envs.make(TaskConfig(names.SUTURE))
    assert isinstance(env, Suture)
    env.reset(seed=2)
    action = np.array([0.5, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0], np.float32)
    phases = set()
    for state in moments[:-1]:
        env.set_state_vector(state)
        phases.add(env.phase)
        done = env.simulation.task_state.done
        env.enter(0)
        psm1 = env.simulation.commands[names.PSM1]
        psm2 = env.simulation.commands[names.PSM2]
        assert env.subtask.arm == names.PSM2
        assert env.simulation.task_state.release_steps == 0
        _, _, terminated, truncated, info = env.step(action)
        assert not (terminated or truncated or info["physics_error"])
        assert info["phase"] == 0 and info["progress"] >= done
        assert env.simulation.commands[names.PSM1] == psm1
        moved = np.subtract(env.simulation.commands[names.PSM2].pose[:3], psm2.pose[:3])
        assert np.linalg.norm(moved) == pytest.approx(0.5e-3 * math.sqrt(0.5), abs=1e-4)
        assert env.simulation.commands[names.PSM2].jaw == psm2.jaw
    assert phases == {0, 1, 2, 3, 4}


def test_actions_that_wait_are_dropped_where_another_subtask_is_entered():
    config = TaskConfig(names.SUTURE, randomisation=RandomisationConfig(latency=3))
    env = envs.make(config)
    assert isinstance(env, Suture)
    env.reset(seed=2)
    env.enter(3)
    for _ in range(5):
        env.step(np.ones(7, np.float32))
    env.enter(0)
    commands = dict(env.simulation.commands)
    for _ in range(3):
        env.step(np.full(7, 0.5, np.float32))
        assert env.simulation.commands[names.PSM1] == commands[names.PSM1]
        assert env.simulation.commands[names.PSM2] == commands[names.PSM2]
    env.step(np.full(7, 0.5, np.float32))
    assert env.simulation.commands[names.PSM1] == commands[names.PSM1]
    assert env.simulation.commands[names.PSM2] != commands[names.PSM2]
