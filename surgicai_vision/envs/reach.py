"""Reach: whether an arm's joints can follow the needle's path through the tissue.

A *way* is a list of T_world_tip (4, 4) of the arm that holds the needle by a grasp T_needle_tip.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import UnreachablePose
from surgicai_vision.envs import poses
from surgicai_vision.envs.geometry import EXTRA, INSERT_DEPTH, Stitch
from surgicai_vision.scene import kinematics
from surgicai_vision.scene.kinematics import Joints

Matrix = NDArray[np.float64]

PLACES = 9
"""Points along the circle at which the joints are computed."""
OUT = math.radians(12.0)
"""How far past the exit the pull-out turns the needle's base [rad]."""
ROOM = math.radians(5.0)
"""Margin that a way must keep to a rotary joint's limits [rad]: closing jaws may turn a needle
by 4° (`envs.handoff.STRAIGHT`)."""
TURNING = [index for index in range(len(kinematics.DVRK_JOINTS)) if index != kinematics.INSERTION]
"""Indices of the rotary joints."""


def insertion(stitch: Stitch, grasp: Matrix) -> list[Matrix]:
    """Return PSM2's way from the entry to the end of the insertion, for a grasp T_needle_tip."""
    last = stitch.angle_at_entry(stitch.insert_angle, INSERT_DEPTH + EXTRA)
    circle = [stitch.on_arc(at) @ grasp for at in np.linspace(stitch.tip_angle, last, PLACES)]
    return [stitch.place() @ grasp, *circle]


def extraction(stitch: Stitch, grasp: Matrix) -> list[Matrix]:
    """Return PSM1's way from the insertion's to the pull-out's end, for a grasp T_needle_tip."""
    first = stitch.angle_at_entry(stitch.insert_angle, INSERT_DEPTH + EXTRA)
    last = -2 * stitch.half - OUT
    circle = [stitch.on_arc(at) @ grasp for at in np.linspace(first, last, PLACES)]
    return [*circle, stitch.pulled() @ grasp]


def joints_along(arm: str, way: Sequence[Matrix], instrument: str) -> list[Joints]:
    """Return an arm's joints along a way, each solved from the previous ones.

    Raises:
        UnreachablePose: past a joint limit.
    """
    from_world = np.linalg.inv(kinematics.base_in_world(arm))
    joints: list[Joints] = []
    for tip in way:
        pose = poses.flat(from_world @ tip)
        joints.append(kinematics.inverse_flat(pose, instrument, joints[-1] if joints else None))
    return joints


def is_followed(arm: str, way: Sequence[Matrix], instrument: str) -> bool:
    """Return True if an arm's joints keep within their limits on a way, rotary ones by `ROOM`."""
    try:
        joints = joints_along(arm, way, instrument)
    except UnreachablePose:
        return False
    low, high = kinematics.limits(instrument)[TURNING].T
    turns = np.array(joints)[:, TURNING]
    return bool((turns > low + ROOM).all() and (turns < high - ROOM).all())
