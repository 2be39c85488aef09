"""What of a policy's actions is executed at its pace (`core.config.Pace`).

    surgicai-vision evaluate POLICY --change pinch_speed=0.4

Simulated jaws that shut at full speed press deep into a needle that they meet at an edge of their
pads, and the needle springs away (docs/results/unmoved-trials.md). With `Pace.pinch_speed` the last
part of every closing is slower, from a commanded angle of `NEARLY_CLOSED` on. This reads the arm's
own jaw and set point, which a dVRK reports, too, and nothing else.
"""

from collections.abc import Sequence

from surgicai_vision.core import names
from surgicai_vision.core.config import Pace
from surgicai_vision.evaluation.agent import Actions, Robot

JAW = names.STATE_NAMES.index("jaw")
"""Where `Robot.agent_pos`, `Robot.setpoint` and an action have the jaw."""
NEARLY_CLOSED = 0.12
"""A jaw that is commanded to less than this is nearly closed [rad]: its pads touch a needle at 0.04
to 0.1, and a step at full speed is 0.05."""


def at_pace(actions: Actions, robots: Sequence[Robot], pace: Pace) -> Actions:
    """Return what of the actions (n, 7) is executed.

    Args:
        actions: a policy's answers, one for each robot.
        robots: the robots that they are for, before they act.
        pace: how fast the policy acts.
    """
    executed = actions * pace.executed
    if pace.pinch_speed < 1.0:
        for action, robot in zip(executed, robots, strict=True):
            if action[JAW] < 0.0 and _commanded_jaw(robot) < NEARLY_CLOSED:
                action[JAW] *= pace.pinch_speed
    return executed


def _commanded_jaw(robot: Robot) -> float:
    """Return the angle that the active arm's jaw is commanded to [rad]."""
    return float(robot.agent_pos()[JAW] + robot.setpoint()[JAW])
