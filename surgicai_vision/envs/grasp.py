"""Grasp (SurgicAI: Approach): PSM2 takes the needle that lies at a random pose on the tissue."""

import functools
import math
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.names import PSM2
from surgicai_vision.envs import poses
from surgicai_vision.envs.geometry import Stitch, grasp_in_needle
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.starts import GRASP_ANGLES
from surgicai_vision.envs.subtask import Demands, Subtask, Tolerance
from surgicai_vision.scene import needle
from surgicai_vision.scene.arm import GRASP_DEPTH
from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import rpy_to_matrix

SPREAD_X = 0.003
SPREAD_Y = 0.020
"""Half widths of the needle's start about its home [m] (released code, Approach)."""
SPREAD_TURN = math.radians(30.0)
"""Half width of its rotation [rad]."""
REACH = needle.RADIUS * math.cos(math.pi - needle.TIP_ANGLE - SPREAD_TURN)
"""How far the scene's own needle may reach from its centre towards the ridge [m], whose foot is
then 1 mm away: its tip lies at 180° - 120° from the phantom's x axis, or nearer to it by as much as
the needle may be turned. A needle that would reach further lies that much further away; the
largest, a half circle, is then still 1.2 mm from the pad's edge."""


def lying_needle(
    simulation: Simulation, stitch: Stitch, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Draw T_world_needle (4, 4) of a needle that lies on the tissue, wherever the tissue is.

    At PSM2's grasp point it is oriented as a 120° needle would be: from the other end of a half
    circle the wrist could not turn it upright.
    """
    shape = simulation.shape
    pose = np.eye(4)
    yaw = stitch.ahead + rng.uniform(-SPREAD_TURN, SPREAD_TURN)
    pose[:3, :3] = rpy_to_matrix(0.0, 0.0, yaw)
    pose[:3, 3] = needle.HOME + np.array(
        [rng.uniform(-SPREAD_X, SPREAD_X), rng.uniform(-SPREAD_Y, SPREAD_Y), 0.0]
    )
    tip = math.pi - shape.tip_angle + stitch.ahead - SPREAD_TURN
    pose[0, 3] -= max(0.0, shape.radius * math.cos(max(0.0, tip)) - REACH)
    pose[2, 3] += shape.body_radius - needle.BODY_RADIUS
    bed: NDArray[np.float64] = simulation.placement.T_world_bed
    return bed @ pose


class Grasp(Subtask):
    """Close PSM2's jaws on the needle at the grasp angle: 1 mm, 10°, both pads touch (paper)."""

    name = "grasp"
    arm = PSM2
    phase = 0
    through = False
    tolerances = MappingProxyType(
        {"paper": Tolerance.of(1.0, 10.0), "released": Tolerance.of(3.0, 10.0)}
    )
    demands = MappingProxyType({"paper": Demands(contact=True), "released": Demands()})

    def start(self, simulation: Simulation, stitch: Stitch, rng: np.random.Generator) -> bool:
        """Put the needle on the tissue, with both arms at home."""
        simulation.pose_needle(poses.flat(lying_needle(simulation, stitch, rng)))
        simulation.task_state.grasp_angle = rng.uniform(*stitch.grasps(*GRASP_ANGLES))
        simulation.settle(20)
        return True

    def target(self, simulation: Simulation, stitch: Stitch) -> tuple[Pose, Pose]:
        """Return the jaws' grasp frame and the grasp frame on the needle."""
        return simulation.grasp(PSM2), grasp_goal(
            simulation, PSM2, simulation.task_state.grasp_angle
        )

    def targets(self, simulation: Simulation, stitch: Stitch) -> tuple[tuple[Pose, Pose], ...]:
        """Return the episode's target, and the nearest one that an episode could draw."""
        drawn = self.target(simulation, stitch)
        x, y, _ = poses.position(poses.relative(simulation.needle(), drawn[0]))
        low, high = stitch.grasps(*GRASP_ANGLES)
        angle = min(max(math.atan2(y, -x), low), high)
        return drawn, (drawn[0], grasp_goal(simulation, PSM2, angle))


def grasp_goal(simulation: Simulation, arm: str, angle: float) -> Pose:
    """Return the jaws' grasp frame that holds the needle's point at `angle` [rad], in world."""
    return poses.compose(simulation.needle(), _grasp_frame(arm, angle, simulation.radius))


@functools.lru_cache(maxsize=64)
def _grasp_frame(arm: str, angle: float, radius: float) -> Pose:
    """Return T_needle_grasp: `grasp_in_needle` with the jaws' grasp point as its origin."""
    shift = np.eye(4)
    shift[2, 3] = GRASP_DEPTH
    return poses.flat(grasp_in_needle(arm, angle, radius=radius) @ shift)
