"""Task state: what an episode must remember beyond the physics.

`pack` and `unpack` turn it into the start of MuJoCo's user data and back, so that one vector is the
whole state of an episode.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, cast

from surgicai_vision.envs.poses import IDENTITY
from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import Vector

ORIGIN: Vector = (0.0, 0.0, 0.0)


@dataclass
class TaskState:
    """The running record of one episode.

    Attributes:
        phase: index of the present subtask in `names.SUBTASKS`, -1 in another task.
        steps: control steps taken.
        tip_path: length of the active tip's path so far [m].
        holes_passed: hole planes that the needle's tip passed in travel direction, 0 to 2;
            `hole_crossing.OUT` when the base has left the exit as well.
        grasp_angle: needle angle of this episode's grasp goal [rad].
        is_held: the active jaws hold the needle; `hold` is how they first held it.
        dwell: control steps for which the present subtask's success has held (whole procedure).
        release_steps: control steps for which PSM2 will continue to let go.
        has_diverged: a physics error happened.
        needle_tip: the needle's tip after the last control step, in world [m].
        tool_tip: the active tool's tip after the last control step, in world [m].
        hold: T_grasp_needle when the active jaws first held the needle.
        done: subtasks that succeeded in their order (whole procedure).
    """

    phase: int = 0
    steps: int = 0
    tip_path: float = 0.0
    holes_passed: int = 0
    grasp_angle: float = 0.0
    is_held: bool = False
    dwell: int = 0
    release_steps: int = 0
    has_diverged: bool = False
    needle_tip: Vector = ORIGIN
    tool_tip: Vector = ORIGIN
    hold: Pose = IDENTITY
    done: int = 0

    SIZE: ClassVar[int] = 10 + 2 * len(ORIGIN) + len(IDENTITY)
    """Number of values in a packed state; `simulation` says what follows it in the user data."""

    def pack(self) -> list[float]:
        """Return the state as `SIZE` numbers."""
        return [
            *(self.phase, self.steps, self.tip_path, self.holes_passed, self.grasp_angle),
            *(self.is_held, self.dwell, self.release_steps, self.has_diverged, self.done),
            *self.needle_tip,
            *self.tool_tip,
            *self.hold,
        ]

    @classmethod
    def unpack(cls, values: Sequence[float]) -> "TaskState":
        """Return the state that `pack` wrote at the start of `values`."""
        phase, steps, tip_path, holes_passed, grasp_angle = values[:5]
        is_held, dwell, release_steps, has_diverged, done = values[5:10]
        return cls(
            phase=int(phase),
            steps=int(steps),
            tip_path=tip_path,
            holes_passed=int(holes_passed),
            grasp_angle=grasp_angle,
            is_held=bool(is_held),
            dwell=int(dwell),
            release_steps=int(release_steps),
            has_diverged=bool(has_diverged),
            needle_tip=cast(Vector, tuple(values[10:13])),
            tool_tip=cast(Vector, tuple(values[13:16])),
            hold=cast(Pose, tuple(values[16 : cls.SIZE])),
            done=int(done),
        )
