"""Attach: the grasping rule of the released code, for comparison (grasp level "attach").

When an arm's commanded jaw is closed and a pad touches the needle, a weld holds the needle where it
is in the jaws, until the jaw opens. Only scenes of this level have the welds; the default level,
friction, has none.
"""

import mujoco

from surgicai_vision.core import names
from surgicai_vision.envs import poses
from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import matrix_to_quaternion_flat

CLOSED = 0.1
"""Commanded jaw angle [rad] below which a touched needle is attached."""
SIZE = 7 * len(names.ARMS)
"""Number of values that both welds' poses take in the whole state."""


class Welds:
    """The welds between both arms and the needle.

    The model must be the env's own: poses are written into it.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        self._model = model
        self._data = data
        self._ids = {arm: model.equality(f"{arm}_attach").id for arm in names.ARMS}

    def active(self, arm: str) -> bool:
        """Return True if the needle is attached to an arm."""
        return bool(self._data.eq_active[self._ids[arm]])

    def update(self, arm: str, *, closed: bool, touching: bool, tip: Pose, needle: Pose) -> bool:
        """Attach or release the needle; return whether anything changed.

        Args:
            arm: the arm.
            closed: whether its jaw is commanded closed.
            touching: whether a pad touches the needle.
            tip: T_world_tip.
            needle: T_world_needle.
        """
        active = self.active(arm)
        if active == (closed and (active or touching)):
            return False
        self._data.eq_active[self._ids[arm]] = not active
        if not active:
            held = poses.relative(tip, needle)
            self._model.eq_data[self._ids[arm], 3:10] = [
                *poses.position(held),
                *matrix_to_quaternion_flat(poses.rotation(held)),
            ]
        return True

    def pack(self) -> list[float]:
        """Return both welds' poses, `SIZE` numbers."""
        return [
            value
            for index in self._ids.values()
            for value in self._model.eq_data[index, 3:10].tolist()
        ]

    def unpack(self, values: list[float]) -> None:
        """Restore what `pack` returned; which welds are active is part of MuJoCo's state."""
        for position, index in enumerate(self._ids.values()):
            self._model.eq_data[index, 3:10] = values[7 * position : 7 * position + 7]
