"""Success: the judge of a task. Everything it says is from the measured state, never from the
command.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.envs import hole_crossing, poses
from surgicai_vision.envs.geometry import Stitch
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.subtask import Subtask
from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import geodesic_angle_flat, multiply_flat

Info = dict[str, Any]
Target = tuple[Pose, Pose]
"""The measured frame that success is judged by, and where it should be, both in world."""


def measure(
    simulation: Simulation, subtask: Subtask, stitch: Stitch, preset: str, target: Target
) -> Info:
    """Return the info dict of the present state under the tolerances of `preset`."""
    memory = simulation.memory
    achieved, desired = target
    contact = simulation.holds(subtask.arm)
    distance, turn = poses.distance(achieved, desired), poses.angle(achieved, desired)
    diverged = memory.diverged > 0.0
    tolerance = subtask.tolerances[preset]
    near = distance <= tolerance.distance and turn <= tolerance.angle and not diverged
    return {
        "is_success": near and _meets_demands(simulation, subtask, stitch, preset, contact),
        "d_trans": distance,
        "d_angle": turn,
        "contact": contact,
        "phase": int(memory.phase),
        "holes_passed": min(int(memory.passed), 2),
        "needle_slip": _slip(simulation, subtask.arm, contact),
        "physics_error": diverged,
        "tip_path": memory.tip_path,
    }


def meets_demands(simulation: Simulation, subtask: Subtask, stitch: Stitch, preset: str) -> bool:
    """Say whether what success needs besides the pose holds now: contact, holes passed, needle out,
    no divergence.
    """
    contact = simulation.holds(subtask.arm)
    return simulation.memory.diverged == 0.0 and _meets_demands(
        simulation, subtask, stitch, preset, contact
    )


def _meets_demands(
    simulation: Simulation, subtask: Subtask, stitch: Stitch, preset: str, contact: bool
) -> bool:
    """Say whether what success needs besides the pose holds."""
    demands, passed = subtask.demands[preset], simulation.memory.passed
    if demands.contact and not contact:
        return False
    if demands.holes and not (
        passed >= demands.holes and hole_crossing.in_both(simulation, stitch.pair)
    ):
        return False
    return not demands.out or (
        passed == hole_crossing.OUT and hole_crossing.is_out(simulation, stitch.pair)
    )


def _slip(simulation: Simulation, arm: str, contact: bool) -> NDArray[np.float64]:
    """Return how far the needle moved in the active jaws since they first held it, (2,) [m,
    rad].
    """
    memory = simulation.memory
    if not contact:
        memory.held = 0.0
        return np.zeros(2)
    grasp, lying = simulation.grasp(arm), simulation.needle()
    if memory.held == 0.0:
        memory.held, memory.hold = 1.0, poses.relative(grasp, lying)
        return np.zeros(2)
    # The point then grasped is where the needle has `inverse_origin(hold)`; rotations leave its
    # way's length alone.
    way = poses.gap(lying, poses.inverse_origin(memory.hold), grasp)
    return np.array(
        (way, geodesic_angle_flat(lying[3:], multiply_flat(grasp[3:], memory.hold[3:])))
    )
