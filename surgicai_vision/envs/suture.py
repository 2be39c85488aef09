"""Suture: the whole procedure, all five subtasks in one episode.

The present subtask's success must hold for `DWELL` control steps before the next one begins: the
paper's tolerances are met before a subtask is finished (an insertion succeeds 5 mm before its
goal), but the next one needs it finished. When the pull-out begins, PSM2 lets go automatically, as
in the released code. A high-level policy may choose another subtask with `enter`.

With `TaskConfig.advance` "told" only `enter` switches to a subtask: measurements move no arm and
release nothing. Progress is still measured, whichever subtask is active. A subtask counts if it is
solved after all those before it (any grasp within the range that goals are drawn from will do). An
insertion and a pull-out also count by themselves, since a needle in both holes must have been
brought there. The whole procedure is solved when the pull-out is.

In soft tissue the paper's own success suffices to begin the next subtask: a bite off the marks is
still pulled out. `subtask_success`, `progress` and `is_success` require the marks as well
(`envs.success`).
"""

from surgicai_vision.core.config import DWELL
from surgicai_vision.core.errors import InputError
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.simulation import RELEASE_STEPS
from surgicai_vision.envs.success import Info, Verdict, judge

INSERT_PHASE = 2
PULLOUT_PHASE = 4


class Suture(SuturingEnv):
    """All five subtasks in a row; `is_success` is the whole procedure's."""

    def measure(self) -> Info:
        """Return the info dict of the present, measured state."""
        return self._of_procedure(super().measure())

    def _of_procedure(self, info: Info) -> Info:
        """Return the present subtask's measurement as the whole procedure's; store nothing."""
        info["subtask_success"] = info["is_success"]
        state = self.simulation.task_state
        if self.config.advance == "told":
            whole = self.judge(PULLOUT_PHASE)
            info["progress"] = self._solved(whole)
            info["is_success"] = whole.full
            info["paper_success"] = whole.paper
            return info
        is_next = info["is_success"] and state.phase == state.done
        info["progress"] = state.done + 1 if is_next else state.done
        info["is_success"] = self._is_last and info["is_success"]
        info["paper_success"] = self._is_last and info["paper_success"]
        return info

    def _solved(self, whole: Verdict) -> int:
        """Return how many subtasks are solved by now, whichever one is active.

        Args:
            whole: whether the pull-out, and with it the whole procedure, is solved.
        """
        done = self.simulation.task_state.done
        if whole.full:
            return len(self._subtasks)
        if done <= INSERT_PHASE and self.judge(INSERT_PHASE).full:
            return INSERT_PHASE + 1
        if done < PULLOUT_PHASE and self.judge(done).full:
            return done + 1
        return done

    def _progress(self, info: Info) -> bool:
        """Advance to the next subtask once the present one's success has held; return if it did."""
        state = self.simulation.task_state
        is_told = self.config.advance == "told"
        dwell = 0 if is_told else self._count_dwell(info["paper_success"])
        state.done = self._of_procedure(info)["progress"]
        if is_told or self._is_last or dwell < DWELL:
            return False
        self._make_present(state.phase + 1)
        return True

    def judge(self, phase: int) -> Verdict:
        """Return whether a subtask is solved now, whichever one is active (`envs.success.judge`).

        Args:
            phase: index in `names.SUBTASKS`.
        """
        subtask = self._subtasks[phase]
        return judge(self.simulation, subtask, self.stitch, self.config.tolerance)

    def _meets_demands(self) -> bool:
        """Return True only in the last subtask, whose success is that of the whole procedure."""
        return self._is_last and super()._meets_demands()

    @property
    def _is_last(self) -> bool:
        return self.phase == len(self._subtasks) - 1

    @property
    def dwell(self) -> int:
        """Return for how many control steps the present subtask's success has held."""
        return self.simulation.task_state.dwell

    def enter(self, phase: int) -> None:
        """Make a subtask the present one, as a high-level policy does: its arm moves from now on.

        Args:
            phase: index in `names.SUBTASKS`; the present subtask's index changes nothing.
        """
        if not 0 <= phase < len(self._subtasks):
            raise InputError(
                f"There is no subtask {phase}; allowed: 0 to {len(self._subtasks) - 1}."
            )
        if phase != self.phase:
            self._make_present(phase)

    def _make_present(self, phase: int) -> None:
        """Make a subtask the present one; the progress so far is kept."""
        state = self.simulation.task_state
        state.phase = phase
        state.dwell = 0
        state.is_held = False
        if self.config.randomisation.latency:
            self.simulation.drop_waiting()
        state.release_steps = RELEASE_STEPS if phase == PULLOUT_PHASE else 0
        self._remember_tool()
