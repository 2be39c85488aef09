"""Subtask: one step of the procedure, or a task of another distribution.

Each subtask has its own file; this is what they share.

A subtask defines which arm moves, how an episode starts, which measured pose must meet which goal,
and what else success requires. It keeps no state: everything an episode remembers is in the
simulation's `TaskState`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from surgicai_vision.core.tasks import SUBTASK_STEPS
from surgicai_vision.envs.geometry import Stitch
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.scene.kinematics import Pose

NO_PHASE = -1
"""The phase of a task that is not a subtask of the procedure."""


class Tolerance(NamedTuple):
    """Largest errors accepted: distance [m] and geodesic angle [rad]."""

    distance: float
    angle: float

    @classmethod
    def of(cls, millimetres: float, degrees: float) -> "Tolerance":
        """Return a tolerance from mm and degrees."""
        return cls(millimetres / 1e3, math.radians(degrees))

    def scaled(self, share: float) -> "Tolerance":
        """Return this share of the tolerance."""
        return Tolerance(share * self.distance, share * self.angle)


@dataclass(frozen=True)
class Demands:
    """What success requires besides the pose.

    Attributes:
        contact: both jaw pads of the active arm must touch the needle.
        holes: 2 if the needle must be in both holes, passed in travel direction; 0 if this does not
            matter.
        out: the needle must be completely out of the tissue, after having passed both holes.
    """

    contact: bool = False
    holes: int = 0
    out: bool = False


class Subtask(ABC):
    """One subtask of the procedure, or a separate task."""

    name: ClassVar[str]
    arm: ClassVar[str]
    """The arm that moves, one of `names.ARMS`."""
    text: ClassVar[str] = ""
    """The task as a sentence, LeRobot's `task`; built-in ones are in `names.TASK_TEXTS`."""
    phase: ClassVar[int] = NO_PHASE
    """Index in `names.SUBTASKS` of a subtask of the procedure."""
    expert: ClassVar[str] = ""
    """"module:function" of the expert's rule (`demos.expert`); built-in rules are found there."""
    max_steps: ClassVar[int] = SUBTASK_STEPS
    """Default limit of an episode [control steps]."""
    tolerances: ClassVar[Mapping[str, Tolerance]]
    """Preset ("paper", "released") → tolerance."""
    demands: ClassVar[Mapping[str, Demands]]
    """Preset → what else success requires."""

    starts_held: ClassVar[bool] = False
    """The active jaws hold the needle at the start."""
    passed_at_start: ClassVar[int] = 0
    """Holes that the needle has passed at the start (`TaskState.holes_passed`)."""
    through: ClassVar[bool] = True
    """The needle is driven through the tissue, or already was."""

    @abstractmethod
    def start(self, simulation: Simulation, stitch: Stitch, rng: np.random.Generator) -> bool:
        """Put the simulation into a random start state.

        Return False if the draw is not physical: the caller draws again.
        """

    @abstractmethod
    def target(self, simulation: Simulation, stitch: Stitch) -> tuple[Pose, Pose]:
        """Return the measured pose that success is judged by and its goal, both in world."""

    def targets(self, simulation: Simulation, stitch: Stitch) -> tuple[tuple[Pose, Pose], ...]:
        """Return all targets that suffice for what follows, that of the episode first.

        There is more than one if each episode draws its goal from a range.
        """
        return (self.target(simulation, stitch),)
