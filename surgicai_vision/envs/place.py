"""Place: PSM2 brings the needle's tip to the entry, perpendicular to the entry's plane."""

import math
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.names import PSM2
from surgicai_vision.envs import poses
from surgicai_vision.envs.geometry import Stitch, needle_frame_flat
from surgicai_vision.envs.grasp import lying_needle
from surgicai_vision.envs.reach import is_followed
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.starts import (
    GRASP_ANGLES,
    SAFE_ANGLES,
    draw_grasp_error,
    grasp_pose,
    hold_needle,
)
from surgicai_vision.envs.subtask import Demands, Subtask, Tolerance
from surgicai_vision.scene.kinematics import Pose

GRASP_SHIFT = 0.0015
"""How far PSM2's grasp may be off at the start of place and insert [m] (paper)."""
GRASP_TILT = math.radians(12.0)
"""How far that grasp may be tilted [rad] (paper)."""


def draw_psm2_grasp(
    rng: np.random.Generator, needle_pose: NDArray[np.float64], stitch: Stitch
) -> NDArray[np.float64]:
    """Draw T_world_tip (4, 4) of PSM2's imperfect grasp of a needle, within the angles that work.

    Args:
        rng: source of the draw.
        needle_pose: T_world_needle (4, 4).
        stitch: limits the angles by the room it leaves.
    """
    angle = rng.uniform(*GRASP_ANGLES) + stitch.ahead
    error = draw_grasp_error(rng, GRASP_SHIFT, GRASP_TILT)
    low, high = stitch.grasps(*SAFE_ANGLES)
    off = error.along / stitch.radius
    angle = min(max(angle, max(low, stitch.first_grasp) - off), high - off)
    return grasp_pose(PSM2, needle_pose, angle, error, stitch.radius)


class Place(Subtask):
    """Put the needle's tip into the entry: 5 mm, 10° of the needle's orientation (paper)."""

    name = "place"
    arm = PSM2
    phase = 1
    starts_held = True
    through = False
    tolerances = MappingProxyType(
        {"paper": Tolerance.of(5.0, 10.0), "released": Tolerance.of(5.0, 10.0)}
    )
    demands = MappingProxyType({"paper": Demands(), "released": Demands()})

    def start(self, simulation: Simulation, stitch: Stitch, rng: np.random.Generator) -> bool:
        """Hold the needle that still lies on the tissue."""
        needle_pose = lying_needle(simulation, stitch, rng)
        tip = draw_psm2_grasp(rng, needle_pose, stitch)
        goal = stitch.place() @ np.linalg.inv(needle_pose) @ tip
        if not is_followed(PSM2, [goal], simulation.scene.config.instrument):
            return False
        return hold_needle(simulation, PSM2, needle_pose, tip)

    def target(self, simulation: Simulation, stitch: Stitch) -> tuple[Pose, Pose]:
        """Return the needle's frame at its tip and that frame in the entry."""
        return poses.compose(
            simulation.needle(), needle_frame_flat(stitch.tip_angle, stitch.radius)
        ), stitch.place_tip
