"""Pullout: PSM1 pulls the needle wholly out of the tissue, to a fixed end point."""

import math
from types import MappingProxyType

import numpy as np

from surgicai_vision.core.errors import UnreachablePose
from surgicai_vision.core.names import PSM1, PSM2
from surgicai_vision.envs import poses
from surgicai_vision.envs.geometry import Stitch, needle_frame_flat
from surgicai_vision.envs.handoff import STRAIGHT, inserted_needle
from surgicai_vision.envs.place import draw_psm2_grasp
from surgicai_vision.envs.reach import extraction, is_followed
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.starts import draw_grasp_error, grasp_pose, hold_needle, stands_free
from surgicai_vision.envs.subtask import Demands, Subtask, Tolerance
from surgicai_vision.scene.kinematics import Pose

GRASP_SHIFT = 0.0015
"""How far PSM1's grasp may be off at the start [m] (paper)."""
GRASP_TILT = math.radians(20.0)
"""How far that grasp may be tilted [rad] (paper)."""
RETREAT = 0.025
"""How far PSM2 is drawn back along its axis after letting go [m]."""
RELEASED_JAW = 0.5
"""How far its jaw is then open [rad]."""


class Pullout(Subtask):
    """Bring the needle's 105° point to the end point: 5 mm, 20°, wholly out (paper)."""

    name = "pullout"
    arm = PSM1
    phase = 4
    starts_held = True
    passed_at_start = 2
    tolerances = MappingProxyType(
        {"paper": Tolerance.of(5.0, 20.0), "released": Tolerance.of(5.0, 5.0)}
    )
    demands = MappingProxyType({"paper": Demands(out=True), "released": Demands()})

    def start(self, simulation: Simulation, stitch: Stitch, rng: np.random.Generator) -> bool:
        """Hold the inserted needle with PSM1, with PSM2 drawn back and its jaws open."""
        needle_pose = inserted_needle(stitch, rng)
        simulation.task_state.holes_passed = self.passed_at_start
        away = draw_psm2_grasp(rng, needle_pose, stitch)
        away[:3, 3] -= RETREAT * away[:3, 2]
        try:
            simulation.pose_arm(PSM2, simulation.to_base(PSM2, poses.flat(away)), RELEASED_JAW)
        except UnreachablePose:
            return False
        error = draw_grasp_error(rng, GRASP_SHIFT, GRASP_TILT)
        grasp = grasp_pose(PSM1, needle_pose, stitch.handoff_angle, error, stitch.radius)
        way = extraction(stitch, np.linalg.inv(needle_pose) @ grasp)
        if not is_followed(PSM1, way, simulation.scene.config.instrument):
            return False
        held = hold_needle(simulation, PSM1, needle_pose, grasp, STRAIGHT)
        free = held and stands_free(simulation, PSM2)
        return free and not simulation.touches_phantom(needle=False)

    def target(self, simulation: Simulation, stitch: Stitch) -> tuple[Pose, Pose]:
        """Return the needle's frame at the handoff's angle and the goal of that frame."""
        return poses.compose(
            simulation.needle(), needle_frame_flat(stitch.handoff_angle, stitch.radius)
        ), stitch.pullout_point
