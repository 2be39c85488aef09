"""Insert: PSM2 drives the needle through both holes until a third of it is out of the exit."""

import math
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.names import PSM2
from surgicai_vision.envs import poses
from surgicai_vision.envs.geometry import Stitch, needle_frame_flat
from surgicai_vision.envs.place import draw_psm2_grasp
from surgicai_vision.envs.reach import insertion, is_followed
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.starts import about_point, draw_rotation, hold_needle
from surgicai_vision.envs.subtask import Demands, Subtask, Tolerance
from surgicai_vision.scene import needle
from surgicai_vision.scene.kinematics import Pose

START_SHIFT = 0.0055
"""How far the tip may be off the entry at the start [m] (paper)."""
START_TURN = math.radians(12.0)
"""How far the needle may be turned at the start [rad] (paper)."""


class Insert(Subtask):
    """Bring the needle's 100° point 2 mm beyond the exit: 5 mm, 10°, through both holes (paper)."""

    name = "insert"
    arm = PSM2
    phase = 2
    starts_held = True
    tolerances = MappingProxyType(
        {"paper": Tolerance.of(5.0, 10.0), "released": Tolerance.of(1.0, 5.0)}
    )
    demands = MappingProxyType({"paper": Demands(holes=2), "released": Demands()})

    def start(self, simulation: Simulation, stitch: Stitch, rng: np.random.Generator) -> bool:
        """Hold the needle with its tip near the entry, outside the tissue."""
        nominal = stitch.place()
        point = nominal[:3, :3] @ needle.point(stitch.tip_angle, stitch.radius) + nominal[:3, 3]
        shift = draw_in_ball(rng, START_SHIFT)
        outward = stitch.pair.entry.rotation[:, 2]
        if shift @ outward < -0.0005:
            shift = shift - 2 * (shift @ outward) * outward
        needle_pose = about_point(nominal, point, draw_rotation(rng, START_TURN), shift)
        tip = draw_psm2_grasp(rng, needle_pose, stitch)
        way = insertion(stitch, np.linalg.inv(needle_pose) @ tip)
        if not is_followed(PSM2, way, simulation.scene.config.instrument):
            return False
        held = hold_needle(simulation, PSM2, needle_pose, tip)
        return held and not simulation.touches_phantom(needle=True)

    def target(self, simulation: Simulation, stitch: Stitch) -> tuple[Pose, Pose]:
        """Return the needle's frame at the goal's angle and the goal of that frame."""
        return poses.compose(
            simulation.needle(), needle_frame_flat(stitch.insert_angle, stitch.radius)
        ), stitch.insert_point


def draw_in_ball(rng: np.random.Generator, radius: float) -> NDArray[np.float64]:
    """Draw a point (3,) in a ball [m]."""
    direction = rng.normal(size=3)
    point: NDArray[np.float64] = (
        direction / np.linalg.norm(direction) * radius * rng.uniform() ** (1 / 3)
    )
    return point
