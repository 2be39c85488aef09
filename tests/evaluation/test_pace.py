"""Pace: what of an action is executed."""

import numpy as np
import pytest

from surgicai_vision.core.config import FULL_SPEED, Pace
from surgicai_vision.envs import make_task
from surgicai_vision.evaluation.pace import JAW, NEARLY_CLOSED, at_pace


class Jawed:
    """A robot whose jaw is measured at one angle and commanded to another [rad]."""

    def __init__(self, measured: float, commanded: float):
        self._measured = measured
        self._commanded = commanded

    def agent_pos(self) -> np.ndarray:
        return np.array([0, 0, 0, 0, 0, 0, self._measured], np.float32)

    def setpoint(self) -> np.ndarray:
        return np.array([0, 0, 0, 0, 0, 0, self._commanded - self._measured], np.float32)


def test_only_what_shuts_nearly_closed_jaws_is_slower() -> None:
    robots = [Jawed(0.3, 0.11), Jawed(0.05, 0.13), Jawed(0.1, 0.05), Jawed(0.0, 0.0)]
    actions = np.full((4, 7), -0.5, np.float32)
    actions[2, JAW] = 0.5
    executed = at_pace(actions, robots, Pace(pinch_speed=0.4))  # type: ignore[arg-type]
    np.testing.assert_array_equal(executed[:, :JAW], actions[:, :JAW])
    np.testing.assert_allclose(executed[:, JAW], [-0.2, -0.5, 0.5, -0.2], rtol=1e-6)
    assert (actions[[0, 1, 3], JAW] == -0.5).all(), "the policy's own answers were changed"


def test_it_is_a_share_of_what_other_paces_leave() -> None:
    robots = [Jawed(0.0, 0.05)]
    actions = np.full((1, 7), -1.0, np.float32)
    pace = Pace(speed=0.5, jaw_speed=0.5, pinch_speed=0.4)
    executed = at_pace(actions, robots, pace)  # type: ignore[arg-type]
    np.testing.assert_allclose(executed[0], [-0.5] * 6 + [-0.1], rtol=1e-6)
    whole = at_pace(actions, robots, FULL_SPEED)  # type: ignore[arg-type]
    np.testing.assert_array_equal(whole, actions)


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_jaws_shut_after_as_many_steps_more(share: float) -> None:
    env = make_task("grasp")
    env.reset(seed=0)
    closing = np.array([[0, 0, 0, 0, 0, 0, -1.0]], np.float32)
    commanded = []
    for _ in range(30):
        commanded.append(float(env.agent_pos()[JAW] + env.setpoint()[JAW]))
        env.step(at_pace(closing, [env], Pace(pinch_speed=share))[0])
    closed = next(step for step, angle in enumerate(commanded) if angle < 1e-6)
    last = [angle for angle in commanded if angle >= NEARLY_CLOSED][-1] - 0.05
    first = next(step for step, angle in enumerate(commanded) if angle < NEARLY_CLOSED)
    assert commanded[first] == pytest.approx(last, abs=1e-5)
    assert closed - first == int(np.ceil(round(last / (0.05 * share), 4)))
