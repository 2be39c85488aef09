"""Relative features: obs_type "goal" in a form suited to learning (obs_type "relative").

The goal dict mixes metres and radians, and in a grasp the length of its rotation vectors is near π,
where they flip sign between neighbouring steps. Here the error is relative and in the active arm's
base frame, like actions. The features are functions of the goal dict alone, so that hindsight
relabelling keeps working: relabel the goal, then compute them.

`relative_features(observation, achieved_goal, desired_goal, base)` → (24,) or (batch, 24) float32,
in the order of `names.RELATIVE_NAMES`:

* 0–2: the tip in the base [cm].
* 3–8: the x and the y axis of the tip's frame in the base. Sines and cosines of roll, pitch and yaw
  would jump at a pitch of 90°, which an arm can reach (89.3° in an insertion with one angle driven
  to its end); two columns of the rotation matrix do not (Zhou et al., On the continuity of rotation
  representations, CVPR 2019).
* 9: the jaw [rad].
* 10–12: the way from the achieved to the desired position in the base [cm].
* 13–15: the turn from the achieved to the desired rotation in the base: the rotation vector [rad],
  which fades to 0 between `FADE` and half a turn, where its sign is not defined.
* 16–18: tanh of the way / `FINE_DISTANCE`, 19–21: tanh of the turn / `FINE_TURN`: the resolution
  that tolerances of millimetres need.
* 22, 23: whether the success conditions other than the pose hold, and whether the goal requires
  them.

No element jumps between neighbouring poses (`tests/envs/test_relative.py`).
"""

import numpy as np
from numpy.typing import NDArray

FADE = np.deg2rad(150.0)
"""Where the rotation vector begins to fade [rad]; no subtask starts further from its goal."""
FINE_DISTANCE = 0.002
"""Distance whose fine feature is tanh 1 [m]: about the tolerance of a grasp."""
FINE_TURN = 0.2
"""Turn whose fine feature is tanh 1 [rad]: about the tolerances, 10° to 20°."""

Array = NDArray[np.float64]
Features = NDArray[np.float32]


def relative_features(
    observation: Features, achieved_goal: Features, desired_goal: Features, base: Array
) -> Features:
    """Return the features of observations and goals of obs_type "goal".

    Args:
        observation: (7,) or (batch, 7): x y z [m], roll pitch yaw [rad], jaw [rad] in the base.
        achieved_goal: (8,) or (batch, 8): x y z [m] in world, rotation vector, jaw, demands met.
        desired_goal: the goal, of the same shape.
        base: rotation matrix of the active arm's base in world, (3, 3).

    Returns:
        (24,) or (batch, 24) float32; see the module's docstring.
    """
    seen = np.asarray(observation, np.float64)
    achieved = np.asarray(achieved_goal, np.float64)
    desired = np.asarray(desired_goal, np.float64)
    way = (desired[..., :3] - achieved[..., :3]) @ base
    turn = _turn(achieved[..., 3:6], desired[..., 3:6]) @ base
    parts = (
        100.0 * seen[..., :3],
        _axes(seen[..., 3:6]),
        seen[..., 6:7],
        100.0 * way,
        turn,
        np.tanh(way / FINE_DISTANCE),
        np.tanh(turn / FINE_TURN),
        achieved[..., 7:8],
        desired[..., 7:8],
    )
    features: Features = np.concatenate(parts, axis=-1).astype(np.float32)
    return features


def _axes(angles: Array) -> Array:
    """Return the first two columns of Rz(yaw) Ry(pitch) Rx(roll), (…, 6), of (…, 3) [rad]."""
    sin = np.sin(angles)
    cos = np.cos(angles)
    sr, sp, sy = sin[..., 0], sin[..., 1], sin[..., 2]
    cr, cp, cy = cos[..., 0], cos[..., 1], cos[..., 2]
    columns = (cy * cp, sy * cp, -sp, cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr)
    return np.stack(columns, axis=-1)


def _turn(achieved: Array, desired: Array) -> Array:
    """Return the rotation vectors from one rotation to another, (…, 3), faded from `FADE` on.

    Args:
        achieved: rotation vectors (…, 3) [rad], of any length.
        desired: the same.
    """
    wa, va = _quaternion(achieved)
    wd, vd = _quaternion(desired)
    # desired · conjugate(achieved)
    w = wd * wa + np.sum(vd * va, axis=-1, keepdims=True)
    v = wa * vd - wd * va - np.cross(vd, va)
    v = np.where(w < 0.0, -v, v)
    half_sine = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(half_sine, np.abs(w))
    faded = np.minimum(angle, (np.pi - angle) * FADE / (np.pi - FADE))
    turn: Array = v * faded / np.maximum(half_sine, 1e-12)
    return turn


def _quaternion(vectors: Array) -> tuple[Array, Array]:
    """Return the scalar (…, 1) and vector part (…, 3) of rotation vectors (…, 3)."""
    half = 0.5 * np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.cos(half), 0.5 * np.sinc(half / np.pi) * vectors
