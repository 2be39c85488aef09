"""Handoff (SurgicAI: Regrasp): PSM1 takes the needle while PSM2 holds it in the tissue."""

import math
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.names import PSM1, PSM2
from surgicai_vision.envs.geometry import Stitch
from surgicai_vision.envs.grasp import grasp_goal
from surgicai_vision.envs.insert import draw_in_ball
from surgicai_vision.envs.place import draw_psm2_grasp
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.starts import about_point, draw_rotation, hold_needle
from surgicai_vision.envs.subtask import Demands, Subtask, Tolerance
from surgicai_vision.scene.kinematics import Pose

DRIVEN = (0.0, 0.002)
"""How far the insertion went past its goal [m]: room for PSM1's jaws next to the exit."""
OFF_PATH = 0.0003
"""Scatter of the inserted needle about the circle [m], within the clearance of the openings."""
OFF_TURN = math.radians(2.0)
"""Scatter of its rotation [rad]."""

STRAIGHT = math.radians(4.0)
"""How far the closing jaws may have turned the needle [rad]."""


def inserted_needle(stitch: Stitch, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw T_world_needle (4, 4) of a needle through both holes."""
    pose = stitch.inserted(rng.uniform(*DRIVEN))
    return about_point(pose, pose[:3, 3], draw_rotation(rng, OFF_TURN), draw_in_ball(rng, OFF_PATH))


class Handoff(Subtask):
    """Close PSM1's jaws on the needle's 105° point: 2 mm and 15°, both pads in contact (paper)."""

    name = "handoff"
    arm = PSM1
    phase = 3
    passed_at_start = 2
    tolerances = MappingProxyType(
        {"paper": Tolerance.of(2.0, 15.0), "released": Tolerance.of(2.0, 40.0)}
    )
    demands = MappingProxyType({"paper": Demands(contact=True), "released": Demands()})

    def start(self, simulation: Simulation, stitch: Stitch, rng: np.random.Generator) -> bool:
        """Hold the inserted needle with PSM2, with PSM1 at home."""
        needle_pose = inserted_needle(stitch, rng)
        simulation.task_state.holes_passed = self.passed_at_start
        held = hold_needle(
            simulation, PSM2, needle_pose, draw_psm2_grasp(rng, needle_pose, stitch), STRAIGHT
        )
        return held and not simulation.touches_phantom(needle=False)

    def target(self, simulation: Simulation, stitch: Stitch) -> tuple[Pose, Pose]:
        """Return the jaws' grasp frame and the grasp frame on the needle."""
        return simulation.grasp(PSM1), grasp_goal(simulation, PSM1, stitch.handoff_angle)
