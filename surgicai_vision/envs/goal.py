"""Goal envs: obs_type "goal", for hindsight experience replay (HER).

They follow gymnasium-robotics' `GoalEnv`: the reward, the termination and the truncation of a step
are functions of the achieved goal, the desired goal and the info, so that a replay buffer can
compute them for another desired goal. All three take single goals (8,) or batches (batch, 8).
"""

from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.envs import observation
from surgicai_vision.envs.base import Observation, SuturingEnv, staged_reward
from surgicai_vision.envs.success import Info, Target
from surgicai_vision.envs.suture import Suture

Goals = NDArray[np.float32]
Infos = Info | Sequence[Info] | NDArray[np.object_]
"""The info of one step, or one for each row of a batch."""


class GoalSuturingEnv(SuturingEnv):
    """A task that shows its goal; see the module's docstring."""

    def compute_reward(
        self, achieved_goal: Goals, desired_goal: Goals, info: Infos | None = None
    ) -> NDArray[np.float64]:
        """Return the rewards of goals; for the observed goals it is the reward of the step.

        A relabelled goal requires what held when it was achieved: an insertion that missed the
        holes is not an example of passing them, but it is one of reaching that pose.
        """
        if self.config.reward == "sparse":
            return np.where(self._reached(achieved_goal, desired_goal), 0.0, -1.0)
        distance, turn = observation.goal_errors(achieved_goal, desired_goal)
        if self.config.reward == "staged":
            is_met = _meets(achieved_goal, desired_goal)
            is_reached = self._reached(achieved_goal, desired_goal)
            return staged_reward(distance, turn, is_met, is_reached)
        return -(distance + turn / 10.0)

    def compute_terminated(
        self, achieved_goal: Goals, desired_goal: Goals, info: Infos | None = None
    ) -> NDArray[np.bool_]:
        """Return whether episodes end with these goals: reached, or a physics error in `info`."""
        return self._reached(achieved_goal, desired_goal) | _physics_errors(info)

    def compute_truncated(
        self, achieved_goal: Goals, desired_goal: Goals, info: Infos | None = None
    ) -> NDArray[np.bool_]:
        """Return whether the present episode has reached its time limit, whatever the goals."""
        is_over = self._truncates and self.simulation.task_state.steps >= self.config.max_steps
        return np.full(np.shape(achieved_goal)[:-1], is_over)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, Info]:
        """Take one step; a non-sparse reward is computed from the observed, rounded goals."""
        seen, reward, terminated, truncated, info = super().step(action)
        if self.config.reward != "sparse":
            assert isinstance(seen, dict)
            achieved = cast(Goals, seen["achieved_goal"])
            desired = cast(Goals, seen["desired_goal"])
            reward = float(self.compute_reward(achieved, desired, info))
        return seen, reward, terminated, truncated, info

    def _reached(self, achieved_goal: Goals, desired_goal: Goals) -> NDArray[np.bool_]:
        """Return whether goals are within the tolerance and their other conditions hold."""
        distance, turn = observation.goal_errors(achieved_goal, desired_goal)
        tolerance = self.tolerance()
        is_near = (distance <= tolerance.distance) & (turn <= tolerance.angle)
        return is_near & _meets(achieved_goal, desired_goal)

    def _observe(self, target: Target) -> Observation:
        achieved, desired = target
        jaw = self.simulation.jaw(self.subtask.arm)
        return {
            "observation": self.agent_pos(),
            "achieved_goal": observation.goal_vector(achieved, jaw, self._meets_demands()),
            "desired_goal": observation.goal_vector(desired, 0.0, True),
        }


class GoalSuture(GoalSuturingEnv, Suture):
    """The whole procedure; the goal is that of the present subtask."""


def _meets(achieved_goal: Goals, desired_goal: Goals) -> NDArray[np.bool_]:
    """Return whether the conditions of goals other than the pose hold, () or (batch,)."""
    met: NDArray[np.bool_] = np.asarray(achieved_goal)[..., 7] >= np.asarray(desired_goal)[..., 7]
    return met


def _physics_errors(info: Infos | None) -> NDArray[np.bool_]:
    """Return whether infos report a physics error, () or (batch,)."""
    if info is None:
        return np.array(False)
    if isinstance(info, dict):
        return np.array(bool(info.get("physics_error")))
    return np.array([bool(row.get("physics_error")) for row in info])
