"""Path through the holes: how far a carried needle has turned along it, or strays from it.

    turns = turns_along(stitch, needle_poses)
    strays = deviation_from_path(stitch, needle_poses) > CLEARANCE

`expert.on_path` gives the path itself.
"""

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.demos.expert import on_path, turn_about_wound
from surgicai_vision.envs.geometry import Stitch
from surgicai_vision.scene import needle

Array = NDArray[np.float64]

CLEARANCE = 0.0009
"""Clearance between the needle on the path and the openings' edges [m]; see `envs.geometry`."""
OUTSIDE = 0.0003
"""The needle enters after its tip was last further than this outside the entry [m]."""


def turns_along(stitch: Stitch, path: Array) -> Array:
    """Return the turns about the wound of needle poses (n, 4, 4), without jumps, (n,) [rad]."""
    start = stitch.place()
    wrapped = np.array([turn_about_wound(start, pose) for pose in path])
    turns: Array = np.unwrap(wrapped).astype(np.float64)
    return turns + (2 * np.pi if turns[-1] < 0.0 else 0.0)


def at_turns(stitch: Stitch, turns: Array) -> Array:
    """Return the needle poses (n, 4, 4) on the path through the holes at turns (n,) [rad]."""
    return np.array([on_path(stitch, max(float(turn), 0.0)) for turn in turns])


def project(stitch: Stitch, path: Array) -> Array:
    """Return needle poses (n, 4, 4) on the path through the holes, at the same turns."""
    return at_turns(stitch, turns_along(stitch, path))


def deviation_from_path(stitch: Stitch, path: Array) -> float:
    """Return the largest distance of a point of the needle from its place on the path [m]."""
    line = np.column_stack([needle.polyline(5, stitch.radius, stitch.tip_angle), np.ones(5)])
    apart = np.einsum("tij,pj->tpi", path - project(stitch, path), line)
    return float(np.linalg.norm(apart[..., :3], axis=-1).max())
