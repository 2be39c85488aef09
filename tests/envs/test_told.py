"""The whole procedure that advances only when told to: `TaskConfig.advance`."""

import math

import numpy as np
import pytest
from procedures import expert_procedure

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, UnknownName

TOLD = TaskConfig("suture", advance="told")
SEED = names.TEST_SEED


def test_told_when_the_success_would_have_it_go_on_the_procedure_is_the_same() -> None:
    played = expert_procedure(SEED)
    env = envs.make(TOLD)
    env.reset(seed=SEED)
    reached = []
    for action, phase, qpos in zip(played.actions, played.phases, played.qpos, strict=True):
        env.enter(phase)
        _, _, terminated, _, info = env.step(action)
        np.testing.assert_array_equal(env.data.qpos, qpos)
        reached.append(info["progress"])
        if len(reached) % 20 == 0:
            measured = env.measure()
            for key in ("is_success", "paper_success", "progress"):
                assert measured[key] == info[key]
    assert terminated and info["is_success"] and info["paper_success"]
    assert sorted(set(reached)) == [0, 1, 2, 3, 4, 5] and reached == sorted(reached)


def test_measuring_says_what_the_step_said() -> None:
    played = expert_procedure(SEED)
    env = envs.make(TaskConfig("suture"))
    env.reset(seed=SEED)
    for action in played.actions:
        phase = env.phase
        *_, info = env.step(action)
        measured = env.measure()
        if env.phase == phase:
            for key in ("subtask_success", "is_success", "paper_success", "progress"):
                assert measured[key] == info[key]
    assert info["is_success"] and info["progress"] == 5


def test_without_a_word_the_first_subtask_goes_on_for_ever() -> None:
    played = expert_procedure(SEED)
    env = envs.make(TOLD)
    env.reset(seed=SEED)
    for action in played.actions[: played.phases.index(1)]:
        *_, info = env.step(action)
    assert info["subtask_success"] and env.dwell == 0
    for _ in range(40):
        *_, info = env.step(np.zeros(7, np.float32))
    assert env.phase == 0 and info["progress"] == 1


def test_the_whole_is_solved_where_the_needle_is_out_whatever_subtask_is_on() -> None:
    played = expert_procedure(SEED)
    env = envs.make(TOLD)
    env.reset(seed=SEED)
    pulled = 0
    for action, phase in zip(played.actions, played.phases, strict=True):
        pulled += phase == 4
        # Once PSM2 has let go, the same arm moves on under another subtask's name.
        env.enter(3 if pulled > 45 else phase)
        _, _, terminated, _, info = env.step(action)
    assert (env.phase, info["progress"], info["is_success"], terminated) == (3, 5, True, True)


def test_any_grasp_that_an_episode_may_ask_for_will_do_and_looking_changes_nothing() -> None:
    played = expert_procedure(SEED)
    env = envs.make(TOLD)
    env.reset(seed=SEED)
    angle = env.simulation.task_state.grasp_angle
    drawn = [math.radians(degrees) for degrees in (5.0, 20.0)]
    other = max(drawn, key=lambda one: abs(one - angle))
    own, seen = [], []
    for action in played.actions[: played.phases.index(1)]:
        *_, info = env.step(action)
        own.append(info["subtask_success"])
        env.simulation.task_state.grasp_angle = other
        before = env.get_state()
        seen.append(env.judge(0).full)
        np.testing.assert_array_equal(env.get_state(), before)
        env.simulation.task_state.grasp_angle = angle
        assert not own[-1] or env.judge(0).full, "the episode's own goal will do too"
    assert any(own) and seen[-1], "held at one angle while the goal is at another one"
    env.simulation.task_state.grasp_angle = other
    assert not env.measure()["is_success"]
    assert [env.judge(phase).full for phase in range(1, 5)] == [False] * 4


def test_a_task_of_one_subtask_has_only_its_own() -> None:
    env = envs.make(TaskConfig("insert"))
    env.enter(2)
    with pytest.raises(InputError, match="has one subtask, 2; it cannot enter 3"):
        env.enter(3)
    with pytest.raises(UnknownName, match="advance"):
        TaskConfig("suture", advance="sometimes")
