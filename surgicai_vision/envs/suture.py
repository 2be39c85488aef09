"""Suture: the whole procedure, all five subtasks in one episode.

The present subtask's success must hold for `DWELL` control steps before the next one begins: the
paper's tolerances are met before a subtask is finished (an insertion counts 5 mm before its goal),
and the next one needs it finished. When the pull-out begins PSM2 lets go by itself, as in the
released code. A high-level policy may choose another subtask by `begin`.
"""

from surgicai_vision.core.config import DWELL
from surgicai_vision.core.errors import InputError
from surgicai_vision.envs.base import Info, SuturingEnv
from surgicai_vision.envs.simulation import RELEASE_STEPS

PULLOUT_PHASE = 4


class Suture(SuturingEnv):
    """All five subtasks in a row; `is_success` is the whole procedure's."""

    def _progress(self, info: Info) -> bool:
        """Begin the next subtask, and say so, when the present one's success has held."""
        memory = self.simulation.memory
        info["subtask_success"] = info["is_success"]
        memory.dwell = memory.dwell + 1.0 if info["is_success"] else 0.0
        last = int(memory.phase) == len(self._subtasks) - 1
        if info["is_success"] and memory.phase == memory.done:
            memory.done += 1.0
        info["progress"] = int(memory.done)
        info["is_success"] = bool(last and info["is_success"])
        if last or memory.dwell < DWELL:
            return False
        self._enter(int(memory.phase) + 1)
        return True

    def _meets_demands(self) -> bool:
        """Say so of the last subtask alone: it is the one whose success is the whole's."""
        return (
            int(self.simulation.memory.phase) == len(self._subtasks) - 1
            and super()._meets_demands()
        )

    @property
    def dwell(self) -> int:
        """Control steps for which the present subtask's success has held."""
        return int(self.simulation.memory.dwell)

    def begin(self, phase: int) -> None:
        """Begin a subtask by choice, as a high-level policy does: its arm moves from now on.

        Args:
            phase: index in `names.SUBTASKS`; that of the present subtask changes nothing.
        """
        if not 0 <= phase < len(self._subtasks):
            raise InputError(
                f"There is no subtask {phase}; allowed: 0 to {len(self._subtasks) - 1}."
            )
        if phase != self.phase:
            self._enter(phase)

    def _enter(self, phase: int) -> None:
        """Make a subtask the present one; what lies behind is kept as it is."""
        memory = self.simulation.memory
        memory.phase = float(phase)
        memory.dwell = memory.held = 0.0
        if self.config.randomisation.latency:
            self.simulation.drop_waiting()
        memory.release = float(RELEASE_STEPS) if phase == PULLOUT_PHASE else 0.0
        self._remember_tool()
