"""Force plate: the net force of needle and instruments on the phantom, as a plate would show it.

Contact forces are not part of a state that ends with MuJoCo's position stage, and computing them in
place would change the state's warm start. They are therefore computed on the plate's own data. In
soft tissue the holds on the needle are included (`envs.tissue`); the thread's pull on the tissue is
not.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.envs.tissue import OUTSIDE, Tissue

STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class ForcePlate:
    """A force plate under the phantom; see the module's docstring.

    Args:
        model: the env's model, its own copy if the env has one.
        tissue: the simulation's soft tissue, if it has any.
    """

    def __init__(self, model: mujoco.MjModel, tissue: Tissue | None = None):
        self._model = model
        self._soft = tissue
        self._scratch = mujoco.MjData(model)
        self._state = np.empty(mujoco.mj_stateSize(model, STATE))
        phantom = model.body("phantom").id
        needle = model.body("needle").id
        of_geom = model.geom_bodyid
        self._tissue = of_geom == phantom
        # Every moving body but needle and thread is part of an instrument.
        thread = (model.body_rootid[of_geom] == needle) & (of_geom != needle)
        self._presses = (model.body_weldid[of_geom] != 0) & ~thread

    def force(self, data: mujoco.MjData) -> float:
        """Return the magnitude of the net force on the tissue [N]."""
        holds = self._soft is not None and self._soft.stage != OUTSIDE
        if not holds and not self._touching(data).any():
            return 0.0
        mujoco.mj_getState(self._model, data, self._state, STATE)
        mujoco.mj_setState(self._model, self._scratch, self._state, STATE)
        mujoco.mj_forward(self._model, self._scratch)
        return float(np.linalg.norm(self.net(self._scratch)))

    def net(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """Return the net force in world (3,) [N] from data whose forces have been computed."""
        net = np.zeros(3) if self._soft is None else -self._soft.hold_force(data)
        wrench = np.empty(6)
        for index in np.flatnonzero(self._touching(data)):
            contact = data.contact[int(index)]
            mujoco.mj_contactForce(self._model, data, int(index), wrench)
            # MuJoCo's force is that on the second geom.
            sign = 1.0 if self._tissue[contact.geom[1]] else -1.0
            net += sign * (contact.frame.reshape(3, 3).T @ wrench[:3])
        return net

    def _touching(self, data: mujoco.MjData) -> NDArray[np.bool_]:
        """Return which contacts are between tissue and needle or an instrument, (contacts,)."""
        one = data.contact.geom[:, 0]
        other = data.contact.geom[:, 1]
        touching: NDArray[np.bool_] = (self._tissue[one] & self._presses[other]) | (
            self._tissue[other] & self._presses[one]
        )
        return touching
