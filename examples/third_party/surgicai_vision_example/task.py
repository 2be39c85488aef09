"""`touch_point`: touch a marked point with the needle's tip; and the expert that does it.

The point lies along the wound from the stitch's entry: in the default scene it is the next entry
hole, which every camera sees. When an episode starts, PSM2 holds the needle, which lies on the
tissue. Success: the tip is within 2 mm of the point, in any orientation, and the jaws hold the
needle.
"""

import math
from types import MappingProxyType

import numpy as np

from surgicai_vision.core.names import PSM2
from surgicai_vision.demos.expert import ToolTarget, WorldState
from surgicai_vision.envs import poses
from surgicai_vision.envs.geometry import Stitch, needle_frame_flat
from surgicai_vision.envs.grasp import lying_needle
from surgicai_vision.envs.place import draw_psm2_grasp
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.starts import hold_needle
from surgicai_vision.envs.subtask import Demands, Subtask, Tolerance
from surgicai_vision.scene import needle
from surgicai_vision.scene.holes import SURFACE
from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import geodesic_angle

NEXT = np.array([0.0, -0.0235, 0.0])
"""From the stitch's entry to the marked point [m, world]: the second hole pair of `simple`."""
CLEAR = 0.004
"""Height of the needle's lowest point over the tissue at which it may turn [m]."""
HOVER = 0.006
"""How far before the point the tip lines up [m]."""


def point(stitch: Stitch) -> np.ndarray:
    """Return the marked point in world (3,) [m]."""
    return np.asarray(stitch.pair.entry.centre) + NEXT


class TouchPoint(Subtask):
    """Touch the marked point: 2 mm, in any orientation, the needle in the jaws."""

    name = "touch_point"
    arm = PSM2
    text = "Touch the next entry hole with the needle's tip."
    expert = "surgicai_vision_example.task:touch"
    max_steps = 150
    through = False
    tolerances = MappingProxyType({"paper": Tolerance.of(2.0, 180.0)})
    demands = MappingProxyType({"paper": Demands(contact=True)})

    def start(self, simulation: Simulation, stitch: Stitch, rng: np.random.Generator) -> bool:
        """Hold the needle that still lies on the tissue."""
        needle_pose = lying_needle(simulation, stitch, rng)
        tip = draw_psm2_grasp(rng, needle_pose, stitch)
        return hold_needle(simulation, PSM2, needle_pose, tip)

    def target(self, simulation: Simulation, stitch: Stitch) -> tuple[Pose, Pose]:
        """Return the needle's frame at its tip, and that frame moved to the point."""
        tip_frame = needle_frame_flat(needle.TIP_ANGLE, stitch.radius)
        tip = poses.compose(simulation.needle(), tip_frame)
        x, y, z = point(stitch).tolist()
        return tip, (x, y, z, *tip[3:])


def touch(world: WorldState) -> ToolTarget:
    """Lift the needle, turn it upright before the point, bring its tip there: the expert's rule."""
    goal = world.stitch.place()
    goal[:3, 3] += NEXT
    line = world.needle[:3, :3] @ needle.polyline(13, world.stitch.radius).T
    line += world.needle[:3, 3:4]
    turn = geodesic_angle(world.needle[:3, :3], goal[:3, :3])
    if line[2].min() < SURFACE + CLEAR and turn > math.radians(20.0):
        lifted = world.command.copy()
        lifted[2, 3] += 0.01
        return ToolTarget(lifted, 0.0)
    outward = world.stitch.pair.entry.rotation[:, 2]
    offset = line[:, -1] - point(world.stitch)
    beside = np.linalg.norm(offset - (offset @ outward) * outward)
    if beside > 0.0015 or turn > math.radians(7.0):
        goal[:3, 3] += HOVER * outward
    return ToolTarget(world.tip_for_needle(goal), 0.0)
