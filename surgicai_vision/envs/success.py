"""Success: whether a task is solved, judged from the measured state, never from the command.

* `paper_success`: the paper's own success: position and angle within the tolerance, and the
  subtask's other demands met (contact, both holes passed, needle out).
* `is_success`: the same in channels. Soft tissue does not guide the needle, so more is required:
  the tissue has not torn, and, from the insertion on, the latest bite goes in and comes out within
  `ON_MARK` of its marks.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.envs import hole_crossing, poses
from surgicai_vision.envs.geometry import Stitch
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.subtask import Subtask
from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import geodesic_angle_flat, multiply_flat

ON_MARK = 0.002
"""How far from its mark a bite in soft tissue may go in and come out [m]: about half of a channel's
opening."""
Info = dict[str, Any]


class Verdict(NamedTuple):
    """Whether a subtask is solved: by the paper, and with what soft tissue requires in addition."""

    paper: bool
    full: bool


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
    near = _is_near(subtask, preset, distance, turn) and not state.has_diverged
    as_in_paper = near and _meets_demands(simulation, subtask, stitch, preset, contact)
    return {
        "is_success": as_in_paper and _is_well_stitched(simulation, subtask, stitch),
        "paper_success": as_in_paper,
        "d_trans": distance,
        "d_angle": turn,
        "contact": contact,
        "phase": state.phase,
        "holes_passed": min(state.holes_passed, 2),
        "needle_slip": _slip(simulation, subtask.arm, contact),
        "physics_error": state.has_diverged,
        "tip_path": state.tip_path,
    }


def judge(simulation: Simulation, subtask: Subtask, stitch: Stitch, preset: str) -> Verdict:
    """Return whether a subtask is solved now, by any of its `targets`, whichever one is active.

    Nothing is stored, so calling it has no side effects.
    """
    if simulation.task_state.has_diverged:
        return Verdict(paper=False, full=False)
    near = any(
        _is_near(subtask, preset, poses.distance(*target), poses.angle(*target))
        for target in subtask.targets(simulation, stitch)
    )
    contact = simulation.holds(subtask.arm)
    as_in_paper = near and _meets_demands(simulation, subtask, stitch, preset, contact)
    return Verdict(as_in_paper, as_in_paper and _is_well_stitched(simulation, subtask, stitch))


def _is_near(subtask: Subtask, preset: str, distance: float, turn: float) -> bool:
    """Return True if a distance [m] and an angle [rad] are within the tolerance."""
    tolerance = subtask.tolerances[preset]
    return distance <= tolerance.distance and turn <= tolerance.angle


def meets_demands(simulation: Simulation, subtask: Subtask, stitch: Stitch, preset: str) -> bool:
    """Return True if the other conditions of success hold: contact, holes, needle out, marks.

    The pose is not checked. After a physics error none of them holds.
    """
    contact = simulation.holds(subtask.arm)
    return (
        not simulation.task_state.has_diverged
        and _meets_demands(simulation, subtask, stitch, preset, contact)
        and _is_well_stitched(simulation, subtask, stitch)
    )


def _meets_demands(
    simulation: Simulation, subtask: Subtask, stitch: Stitch, preset: str, contact: bool
) -> bool:
    """Return True if the paper's conditions other than the pose hold."""
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


def _is_well_stitched(simulation: Simulation, subtask: Subtask, stitch: Stitch) -> bool:
    """Return True in channels, and in soft tissue that is intact and pierced at its marks."""
    tissue = simulation.tissue
    if tissue is None:
        return True
    if tissue.tears:
        return False
    if not subtask.through:
        return True
    bites = tissue.bites
    if not bites or bites[-1].exit is None:
        return False
    pair = stitch.pair
    return (
        math.dist(bites[-1].entry, pair.entry.centre) <= ON_MARK
        and math.dist(bites[-1].exit, pair.exit.centre) <= ON_MARK
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
    # The point that was grasped lies at `inverse_origin(hold)` in the needle's frame; a rotation
    # does not change the length of its displacement.
    shift = poses.gap(lying, poses.inverse_origin(state.hold), grasp)
    held = multiply_flat(poses.rotation(grasp), poses.rotation(state.hold))
    return np.array((shift, geodesic_angle_flat(poses.rotation(lying), held)))
