"""Subtask: what one step of the procedure is. One file a subtask; this is what they share.

A subtask says which arm moves, how an episode starts, which measured pose must meet which goal, and
what else success needs. It keeps no state: everything an episode remembers is in the simulation's
`Memory`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.envs.geometry import Stitch
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.scene.kinematics import Pose


class Tolerance(NamedTuple):
    """How near is near enough: distance [m] and geodesic angle [rad]."""

    distance: float
    angle: float

    @classmethod
    def of(cls, millimetres: float, degrees: float) -> "Tolerance":
        """Return a tolerance from mm and degrees."""
        return cls(millimetres / 1e3, math.radians(degrees))


@dataclass(frozen=True)
class Demands:
    """What success needs besides the pose.

    Attributes:
        contact: both jaw pads of the active arm touch the needle.
        holes: 2 where the needle must be in both holes, passed in travel direction; 0 where it does
            not matter.
        out: the needle must be wholly out of the tissue, after having passed both holes.
    """

    contact: bool = False
    holes: int = 0
    out: bool = False


class Subtask(ABC):
    """One subtask of the procedure."""

    name: ClassVar[str]
    tolerances: ClassVar[Mapping[str, Tolerance]]
    """Preset ("paper", "released") → tolerance."""
    demands: ClassVar[Mapping[str, Demands]]
    """Preset → what else success needs."""

    def __init__(self) -> None:
        self.arm = names.ACTIVE_ARM[self.name]
        """The arm that moves."""
        self.phase = names.SUBTASKS.index(self.name)
        """The subtask's index in the procedure."""

    through: ClassVar[bool] = True
    """The needle is driven through the tissue, or already was."""

    @abstractmethod
    def start(self, simulation: Simulation, stitch: Stitch, rng: np.random.Generator) -> bool:
        """Put the simulation into a random start state; False where the draw is not physical (draw
        again).
        """

    @abstractmethod
    def target(self, simulation: Simulation, stitch: Stitch) -> tuple[Pose, Pose]:
        """Return the measured pose that matters and its goal, both in world."""
