"""Suture: the whole procedure, all five subtasks in one episode.

The present subtask's success must hold for `DWELL` control steps before the next one begins: the paper's
tolerances are met before a subtask is finished (an insertion counts 5 mm before its goal), and the next one needs
it finished. When the pull-out begins PSM2 lets go by itself, as in the released code.
"""

from surgicai_vision.envs.base import Info, SuturingEnv
from surgicai_vision.envs.simulation import RELEASE_STEPS

DWELL = 15
"""Control steps a success must hold before the next subtask begins."""
PULLOUT_PHASE = 4


class Suture(SuturingEnv):
    """All five subtasks in a row; `is_success` is the whole procedure's."""

    def _progress(self, info: Info) -> bool:
        """Begin the next subtask, and say so, when the present one's success has held."""
        memory = self.simulation.memory
        info["subtask_success"] = info["is_success"]
        memory.dwell = memory.dwell + 1.0 if info["is_success"] else 0.0
        last = int(memory.phase) == len(self._subtasks) - 1
        info["progress"] = int(memory.phase) + int(last and info["is_success"])
        info["is_success"] = bool(last and info["is_success"])
        if last or memory.dwell < DWELL:
            return False
        memory.phase += 1.0
        memory.dwell = memory.held = 0.0
        if self.config.randomisation.latency:
            self.simulation.drop_waiting()
        if int(memory.phase) == PULLOUT_PHASE:
            memory.release = float(RELEASE_STEPS)
        self._remember_tool()
        return True
