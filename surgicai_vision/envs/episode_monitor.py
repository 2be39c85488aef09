"""Episode monitor: what one episode does to needle and tissue, read after every control step.

An `EpisodeMonitor` only reads: an episode is the same with and without it.

* Where the needle's tip goes through the stitch's planes: `entry_error` and `exit_error`, the
  distance of that point from the hole's centre in the hole's plane [m]; NaN where the tip did not
  go through in this episode. The openings are squares of `holes.OPENING`, so an error is at most
  their half diagonal, 2.7 mm. A tip that goes back and through again counts anew.
* `wrong_hole`: the tip went through an opening of another stitch, or through this exit from
  outside, and has not left through the right exit since.
* `slip`, `turn`: the needle's largest shift [m] and turn [rad] in the active jaws since they took
  it.
* `tissue_force`: largest net force [N] of needle and instruments (not of the thread) on the
  phantom, as a force plate under it would show. Sampled when a control step ends, at 50 Hz: a
  shorter blow can be missed.
"""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.envs import randomisation
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.hole_crossing import JUMP, crossing
from surgicai_vision.envs.success import Info
from surgicai_vision.scene.holes import PAIRS, Point

STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class EpisodeMonitor:
    """What the present episode of `env` has done; see the module's docstring.

    Args:
        env: the env to read; `reset` follows each of its resets, `update` each of its steps.
    """

    def __init__(self, env: SuturingEnv):
        self._env = env
        self._plate = ForcePlate(env.model)
        self._layout = PAIRS[env.scene.config.layout]
        self._chosen = env.scene.config.hole_pair - 1
        self.clear()

    def clear(self) -> None:
        """Forget the last episode."""
        self.entry_error = self.exit_error = math.nan
        self.slip = self.turn = self.tissue_force = 0.0
        self.wrong_hole = False

    def reset(self) -> None:
        """Begin an episode; the env has just been reset."""
        self.clear()
        simulation = self._env.simulation
        self._pairs = [randomisation.shifted(pair, simulation.draws) for pair in self._layout]
        self._is_through_entry = simulation.task_state.holes_passed >= 1
        self._tip = simulation.needle_point(simulation.tip_angle)

    def update(self, info: Info) -> None:
        """Read the state that a step ended in; `info` is that step's."""
        simulation = self._env.simulation
        slip, turn = info["needle_slip"]
        self.slip = max(self.slip, float(slip))
        self.turn = max(self.turn, float(turn))
        self.tissue_force = max(self.tissue_force, self._plate.force(simulation.data))
        before = self._tip
        self._tip = simulation.needle_point(simulation.tip_angle)
        if math.dist(before, self._tip) <= JUMP:
            self._note_crossings(before, self._tip)

    def is_held(self) -> bool:
        """Return True if either arm holds the needle now."""
        return any(self._env.simulation.holds(arm) for arm in names.ARMS)

    def _note_crossings(self, before: Point, now: Point) -> None:
        """Note where the tip went through the opening of any hole."""
        pair = self._pairs[self._chosen]
        entering = crossing(before, now, pair.entry, inward=True)
        leaving = crossing(before, now, pair.exit, inward=False)
        if entering is not None:
            self.entry_error = math.hypot(*entering)
            self._is_through_entry = True
        elif leaving is not None and self._is_through_entry:
            self.exit_error = math.hypot(*leaving)
            self.wrong_hole = False
        elif crossing(before, now, pair.entry, inward=False):
            self._is_through_entry = False
        elif not self._is_through_entry and crossing(before, now, pair.exit, inward=True):
            self.wrong_hole = True
        for index, other in enumerate(self._pairs):
            if index != self._chosen:
                self.wrong_hole |= any(
                    crossing(before, now, hole, inward=True) for hole in (other.entry, other.exit)
                )


class ForcePlate:
    """A force plate under the phantom: the force of needle and instruments on it.

    Contact forces are not part of a state that ends with MuJoCo's position stage, and computing
    them in place would change the state's warm start. They are computed on data of the plate's own.

    Args:
        model: the env's model, its own copy where the env has one.
    """

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        self._scratch = mujoco.MjData(model)
        self._state = np.empty(mujoco.mj_stateSize(model, STATE))
        phantom = model.body("phantom").id
        needle_id = model.body("needle").id
        of_geom = model.geom_bodyid
        self._tissue = of_geom == phantom
        # The thread hangs on the needle and is not meant; every other moving body is part of an
        # instrument.
        thread = (model.body_rootid[of_geom] == needle_id) & (of_geom != needle_id)
        self._presses = (model.body_weldid[of_geom] != 0) & ~thread

    def force(self, data: mujoco.MjData) -> float:
        """Return the size of the net force on the tissue [N]."""
        if not self._touching(data).any():
            return 0.0
        mujoco.mj_getState(self._model, data, self._state, STATE)
        mujoco.mj_setState(self._model, self._scratch, self._state, STATE)
        mujoco.mj_forward(self._model, self._scratch)
        return float(np.linalg.norm(self.net(self._scratch)))

    def _touching(self, data: mujoco.MjData) -> NDArray[np.bool_]:
        """Return which contacts are of the tissue with the needle or an instrument, (contacts,)."""
        one = data.contact.geom[:, 0]
        other = data.contact.geom[:, 1]
        touching: NDArray[np.bool_] = (self._tissue[one] & self._presses[other]) | (
            self._tissue[other] & self._presses[one]
        )
        return touching

    def net(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """Return the net force in world (3,) [N] of data whose forces have been computed."""
        net = np.zeros(3)
        wrench = np.empty(6)
        for index in np.flatnonzero(self._touching(data)):
            contact = data.contact[int(index)]
            mujoco.mj_contactForce(self._model, data, int(index), wrench)
            # MuJoCo's force is that on the second geom.
            sign = 1.0 if self._tissue[contact.geom[1]] else -1.0
            net += sign * (contact.frame.reshape(3, 3).T @ wrench[:3])
        return net
