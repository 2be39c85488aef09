"""The time a policy is told, and its jump to the next attempt of a search."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from policies.base import Recipe
from surgicai_vision.core.config import SECOND_ATTEMPT_STEP, SUBTASK_STEPS, Pace
from surgicai_vision.core.errors import InputError
from surgicai_vision.evaluation.policy_clock import OPEN, SHUT, PolicyClock, next_attempt

JAW_OPEN, JAW_SHUT = 2 * OPEN, SHUT / 2


@dataclass
class Jaw:
    """A robot that reports its jaw and nothing else."""

    angle: float = JAW_OPEN

    def agent_pos(self) -> NDArray[np.float32]:
        return np.array([0, 0, 0, 0, 0, 0, self.angle], np.float32)

    def both_arms(self) -> NDArray[np.float32]:
        raise AssertionError("a clock reads the active arm only")

    def setpoint(self) -> NDArray[np.float32]:
        raise AssertionError("a clock reads the measured pose only")

    def enter(self, phase: int) -> None:
        raise AssertionError("a clock moves nothing")


def told(pace: Pace, jaws: list[float], action_repeat: int = 1) -> list[float]:
    clock = PolicyClock(pace, action_repeat)
    return [clock.read(tick, Jaw(jaw)) for tick, jaw in enumerate(jaws)]


@given(
    pace=st.builds(
        Pace, speed=st.floats(0.1, 1.0), clock_speed=st.floats(0.1, 1.0), jaw_speed=st.just(1.0)
    ),
    action_repeat=st.integers(1, 5),
    jaws=st.lists(st.floats(0, 1), max_size=60),
)
def test_without_retries_it_is_the_steps_at_the_policys_pace(
    pace: Pace, action_repeat: int, jaws: list[float]
) -> None:
    expected = np.arange(len(jaws)) * action_repeat * pace.speed * pace.clock_speed
    np.testing.assert_allclose(told(pace, jaws, action_repeat), expected, rtol=1e-12)


@given(
    jaws=st.lists(st.floats(0, 0.5), min_size=1, max_size=300),
    wait=st.integers(1, 30),
    action_repeat=st.integers(1, 3),
)
def test_it_jumps_to_attempts_only_and_stays_within_the_subtask(
    jaws: list[float], wait: int, action_repeat: int
) -> None:
    times = told(Pace(retry_after=wait), jaws, action_repeat)
    before, has_jumped = float(-action_repeat), False
    for time in times:
        went_on = before + action_repeat
        has_jumped |= time != went_on
        assert time < SUBTASK_STEPS or not has_jumped
        around = SECOND_ATTEMPT_STEP + went_on - SUBTASK_STEPS
        assert time in (went_on, next_attempt(went_on), around)
        before = time


def test_a_jaw_that_stays_shut_brings_the_next_attempt_once() -> None:
    shut = [JAW_OPEN] * 60 + [JAW_SHUT] * 30
    times = told(Pace(retry_after=8), shut)
    assert times[:67] == list(range(67))
    assert times[67:] == list(range(SECOND_ATTEMPT_STEP, SECOND_ATTEMPT_STEP + 23))
    again = told(Pace(retry_after=8), [*shut[:68], *[JAW_OPEN] * 10, *[JAW_SHUT] * 8])
    assert again[-1] == SECOND_ATTEMPT_STEP + 25
    between = told(Pace(retry_after=8), [*shut[:68], *[(SHUT + OPEN) / 2, JAW_SHUT] * 10])
    assert between[-1] == SECOND_ATTEMPT_STEP + 20  # it has not been open


def test_it_jumps_in_control_steps_whatever_an_action_lasts() -> None:
    for repeat in (1, 2, 4):
        times = told(Pace(retry_after=8), [JAW_SHUT] * 20, repeat)
        assert times[8 // repeat - 1] == SECOND_ATTEMPT_STEP
        assert times[8 // repeat - 2] < 8


def test_the_attempts_come_round() -> None:
    attempt = [JAW_OPEN, *[JAW_SHUT] * 3]
    times = told(Pace(retry_after=3), attempt * 6)
    jumps = [times[at] for at in range(3, 24, 4)]
    assert jumps == [100, 125, 150, 175, 100, 125]


def test_a_policy_without_a_clock_cannot_go_on_to_the_next_attempt() -> None:
    with pytest.raises(InputError, match="no clock that could go on"):
        Recipe(retry_after=8)
    with pytest.raises(InputError, match="retry_after is -1"):
        Recipe(clock=True, retry_after=-1)
    assert Recipe(clock=True, retry_after=8).pace == Pace(retry_after=8)
