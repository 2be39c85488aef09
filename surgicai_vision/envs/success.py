"""Success: whether a task is solved, judged from the measured state, never from the command."""

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
    state = simulation.task_state
    achieved, desired = target
    contact = simulation.holds(subtask.arm)
    distance = poses.distance(achieved, desired)
    turn = poses.angle(achieved, desired)
    tolerance = subtask.tolerances[preset]
    near = distance <= tolerance.distance and turn <= tolerance.angle and not state.has_diverged
    solved = near and _meets_demands(simulation, subtask, stitch, preset, contact)
    return {
        "is_success": solved,
        "paper_success": solved,
        "d_trans": distance,
        "d_angle": turn,
        "contact": contact,
        "phase": state.phase,
        "holes_passed": min(state.holes_passed, 2),
        "needle_slip": _slip(simulation, subtask.arm, contact),
        "physics_error": state.has_diverged,
        "tip_path": state.tip_path,
    }


def meets_demands(simulation: Simulation, subtask: Subtask, stitch: Stitch, preset: str) -> bool:
    """Return True if what success needs besides the pose holds: contact, holes, needle out.

    After a physics error nothing holds.
    """
    contact = simulation.holds(subtask.arm)
    return not simulation.task_state.has_diverged and _meets_demands(
        simulation, subtask, stitch, preset, contact
    )


def _meets_demands(
    simulation: Simulation, subtask: Subtask, stitch: Stitch, preset: str, contact: bool
) -> bool:
    """Return True if what success needs besides the pose holds."""
    demands = subtask.demands[preset]
    passed = simulation.task_state.holes_passed
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
    """Return how far the needle moved in the active jaws since they held it, (2,) [m, rad]."""
    state = simulation.task_state
    if not contact:
        state.is_held = False
        return np.zeros(2)
    grasp = simulation.grasp(arm)
    lying = simulation.needle()
    if not state.is_held:
        state.is_held = True
        state.hold = poses.relative(grasp, lying)
        return np.zeros(2)
    # The point then grasped lies at `inverse_origin(hold)` in the needle's frame; a rotation does
    # not change the length of its way.
    shift = poses.gap(lying, poses.inverse_origin(state.hold), grasp)
    held = multiply_flat(poses.rotation(grasp), poses.rotation(state.hold))
    return np.array((shift, geodesic_angle_flat(poses.rotation(lying), held)))
