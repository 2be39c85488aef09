"""The time that a policy with a clock is told.

    surgicai-vision evaluate POLICY --change retry_after=8

It is the number of control steps since the subtask began, at the policy's pace (`Pace`). A policy
that has learned a search (`demos.search_expert`) opens its jaws and tries again at fixed times, and
waits for them with its jaws shut beside the needle. With `Pace.retry_after` it does not wait: once
the measured jaw has been shut for so many control steps and the episode goes on, the clock jumps to
the step at which the next attempt begins. After the last attempt it goes back to the second. The
clock reads the arm's own jaw and nothing else.
"""

from typing import final

from surgicai_vision.core.config import CLOCK_PERIOD, FULL_SPEED, SECOND_ATTEMPT_STEP, Pace
from surgicai_vision.core.tasks import SUBTASK_STEPS
from surgicai_vision.evaluation.agent import Robot
from surgicai_vision.evaluation.pace import JAW

SHUT = 0.06
"""A jaw angle below this is shut [rad]; it need not be 0, since jaws close on tissue, too."""
OPEN = 0.12
"""A jaw that was shut counts as open from here on [rad]; a search opens it to .22 rad."""


@final
class PolicyClock:
    """Tells one policy the time, in one episode.

    Args:
        pace: how fast it acts.
        action_repeat: control steps for which each of its actions is held.
    """

    def __init__(self, pace: Pace = FULL_SPEED, action_repeat: int = 1):
        self._rate = pace.clock * action_repeat
        self._wait = -(-pace.retry_after // action_repeat)  # actions, rounded up
        self._jumped = 0.0
        self._shut = 0

    def read(self, tick: int, robot: Robot) -> float:
        """Return the time [control steps]; called once for each action.

        Args:
            tick: actions since the subtask began that the observation shows.
            robot: whose jaw may stay shut.
        """
        time = tick * self._rate + self._jumped
        if self._wait and self._has_missed(float(robot.agent_pos()[JAW])):
            time = self._jump(time, next_attempt(time))
        if self._jumped and time >= SUBTASK_STEPS:
            time = self._jump(time, SECOND_ATTEMPT_STEP + time - SUBTASK_STEPS)
        return time

    def _has_missed(self, jaw: float) -> bool:
        """Return True once for each time that the jaws stay shut."""
        if jaw < SHUT:
            self._shut += 1
        elif jaw > OPEN:
            self._shut = 0
        return self._shut == self._wait and jaw < SHUT

    def _jump(self, time: float, to: float) -> float:
        """Let the clock go on from another time."""
        self._jumped += to - time
        return to


def next_attempt(time: float) -> float:
    """Return the step at which the attempt after the present one of a search begins."""
    if time < SECOND_ATTEMPT_STEP:
        return SECOND_ATTEMPT_STEP
    periods = (time - SECOND_ATTEMPT_STEP) // CLOCK_PERIOD + 1
    begins = SECOND_ATTEMPT_STEP + periods * CLOCK_PERIOD
    return begins if begins < SUBTASK_STEPS else SECOND_ATTEMPT_STEP
