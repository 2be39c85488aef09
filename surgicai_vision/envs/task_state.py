"""Memory: what an episode must remember beyond the physics, so that one vector is its whole state.

Fields are plain floats; `pack` and `unpack` turn them into the start of MuJoCo's user data and
back.
"""

from dataclasses import dataclass, fields
from typing import ClassVar

from surgicai_vision.envs.poses import IDENTITY
from surgicai_vision.scene.kinematics import Pose


@dataclass
class Memory:
    """The running record of one episode.

    Attributes:
        phase: index of the present subtask in `names.SUBTASKS`, -1 in another task.
        steps: control steps taken.
        tip_path: length of the active tip's way so far [m].
        passed: hole planes passed by the tip in travel direction, 0..2; 3 when the base is out as
            well.
        grasp_angle: needle angle of this episode's grasp goal [rad].
        held: 1 when `hold` is set.
        dwell: control steps the present subtask's success has held (whole procedure).
        release: control steps PSM2 goes on letting go.
        diverged: 1 after a physics error.
        tip_x, tip_y, tip_z: needle tip at the last measurement, world [m].
        hold: T_grasp_needle when the active jaws first held the needle.
        goal: the subtask's fixed goal in world, where it has one.
        done: subtasks that succeeded in their order (whole procedure).
    """

    phase: float = 0.0
    steps: float = 0.0
    tip_path: float = 0.0
    passed: float = 0.0
    grasp_angle: float = 0.0
    held: float = 0.0
    dwell: float = 0.0
    release: float = 0.0
    diverged: float = 0.0
    tip_x: float = 0.0
    tip_y: float = 0.0
    tip_z: float = 0.0
    tool_x: float = 0.0
    tool_y: float = 0.0
    tool_z: float = 0.0
    hold: Pose = IDENTITY
    goal: Pose = IDENTITY
    done: float = 0.0

    SIZE: ClassVar[int] = 16 + 2 * 12
    """Numbers of a record; what else is in MuJoCo's user data follows it: see `simulation`."""

    def pack(self) -> list[float]:
        """Return all fields as `SIZE` floats."""
        values: list[float] = []
        for item in fields(self):
            value = getattr(self, item.name)
            values += value if isinstance(value, tuple) else [value]
        return values

    @classmethod
    def unpack(cls, values: list[float]) -> "Memory":
        """Return the record that `pack` wrote at the start of `values`."""
        record, start = cls(), 0
        for item in fields(cls):
            length = len(item.default) if isinstance(item.default, tuple) else 0
            setattr(
                record,
                item.name,
                tuple(values[start : start + length]) if length else values[start],
            )
            start += length or 1
        return record
