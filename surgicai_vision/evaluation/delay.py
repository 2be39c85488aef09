"""How late an arm's actions take effect, measured while it acts.

    meter = DelayMeter(translation=0.5e-3, longest=7)
    meter.see(robot.agent_pos())          # before each action
    meter.delay                           # [actions], 0 until the arm has moved
    meter.send(action)

The way that the sent actions command is compared with the way that the arm reports, each counted
from the first observation on. The delay is the one by which the commanded way has to be moved back
to fit best (least squares of the tip's position). Nobody has to tell the delay: it is found within
the first six control steps of a motion (tests/evaluation/test_delay.py), and a constant error of
the reported joints does not matter, because only changes are compared. A servo's own lag, a third
of a control step in this scene, counts as none.
"""

from typing import final

import numpy as np
from numpy.typing import NDArray


@final
class DelayMeter:
    """Measures the delay between the actions that are sent and the motion that is reported.

    Args:
        translation: the way that an action of 1 commands [m].
        longest: the longest delay that is considered [actions], at least 0.
    """

    def __init__(self, translation: float, longest: int):
        self._translation = translation
        self._start: NDArray[np.float64] | None = None
        # Where the commands of the last actions lead to, the newest first; one row per delay.
        self._commanded = np.zeros((longest + 1, 3))
        self._errors = np.zeros(longest + 1)

    def see(self, agent_pos: NDArray[np.float32]) -> None:
        """Compare the arm's reported tip pose (7,) [m, rad] with each delay's commands."""
        tip = np.asarray(agent_pos[:3], np.float64)
        if self._start is None:
            self._start = tip
        moved = tip - self._start
        self._errors += ((moved - self._commanded) ** 2).sum(axis=1)

    def send(self, action: NDArray[np.float32]) -> None:
        """Count an executed action (7,) in [-1, 1]."""
        newest = self._commanded[0] + self._translation * np.clip(action[:3], -1.0, 1.0)
        self._commanded = np.concatenate([newest[None], self._commanded[:-1]])

    @property
    def delay(self) -> int:
        """The delay that fits best [actions]; 0 as long as nothing has been sent."""
        return int(np.argmin(self._errors))
