"""Rotations: matrices, roll-pitch-yaw, rotation vectors, quaternions, and the angle between two.

Conventions: `R = Rz(yaw) Ry(pitch) Rx(roll)` (fixed axes, as in SurgicAI); quaternions are (w,
x, y, z), as in MuJoCo, with w >= 0. Each function has one implementation in plain floats (`…_flat`:
a matrix is a tuple of nine floats, row by row), because a control step that calls numpy on 3 × 3
arrays is several times slower; the numpy functions wrap it.
"""

from collections.abc import Sequence
from math import atan2, cos, nextafter, pi, sin, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

Flat9 = tuple[float, float, float, float, float, float, float, float, float]
"""A rotation matrix, row by row."""
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = NDArray[np.float64]

LARGEST_ROLL = nextafter(2.0 * pi, 0.0)
"""[rad]; its negative is the limit that keeps a roll above -2π."""
GIMBAL = 1e-9
"""Below this cosine of the pitch, roll and yaw turn about one axis and the yaw is set to 0."""


def rpy_to_matrix_flat(roll: float, pitch: float, yaw: float) -> Flat9:
    """Return Rz(yaw) Ry(pitch) Rx(roll) [rad]."""
    cr, sr, cp, sp, cy, sy = cos(roll), sin(roll), cos(pitch), sin(pitch), cos(yaw), sin(yaw)
    return (
        cy * cp,
        cy * sp * sr - sy * cr,
        cy * sp * cr + sy * sr,
        sy * cp,
        sy * sp * sr + cy * cr,
        sy * sp * cr - cy * sr,
        -sp,
        cp * sr,
        cp * cr,
    )


def matrix_to_rpy_flat(m: Sequence[float]) -> Vector:
    """Return (roll, pitch, yaw) [rad] of a rotation.

    Roll is in (-2π, 0] as in the released code, pitch in [-π/2, π/2], yaw in (-π, π].

    The tools point down in their base frames, at a roll of about ±π; the range (-2π, 0] puts the
    cut elsewhere.
    """
    r00, _, _, r10, r11, r12, r20, r21, r22 = m
    cos_pitch = sqrt(r00 * r00 + r10 * r10)
    if cos_pitch < GIMBAL:
        roll = atan2(-r12, r11)
        yaw = 0.0
    else:
        roll = atan2(r21, r22)
        yaw = atan2(r10, r00)
    if roll > 0.0:
        roll = max(roll - 2.0 * pi, -LARGEST_ROLL)
    return roll, atan2(-r20, cos_pitch), yaw


def rotvec_to_matrix_flat(x: float, y: float, z: float) -> Flat9:
    """Return the rotation about (x, y, z) by its length [rad] (Rodrigues)."""
    square = x * x + y * y + z * z
    if square < 1e-16:  # the series' next terms lie below double precision
        a, b, c = 1.0, 0.5, 1.0 - 0.5 * square
    else:
        angle = sqrt(square)
        c = cos(angle)
        a, b = sin(angle) / angle, (1.0 - c) / square
    ax, ay, az, bxy, bxz, byz = a * x, a * y, a * z, b * x * y, b * x * z, b * y * z
    return (
        c + b * x * x,
        bxy - az,
        bxz + ay,
        bxy + az,
        c + b * y * y,
        byz - ax,
        bxz - ay,
        byz + ax,
        c + b * z * z,
    )


def matrix_to_rotvec_flat(m: Sequence[float]) -> Vector:
    """Return the rotation vector [rad], at most π long; exact to rounding at 0 and at π too."""
    w, x, y, z = matrix_to_quaternion_flat(m)
    half_sine = sqrt(x * x + y * y + z * z)
    scale = 2.0 if half_sine < 1e-12 else 2.0 * atan2(half_sine, w) / half_sine
    return scale * x, scale * y, scale * z


def matrix_to_quaternion_flat(m: Sequence[float]) -> Quaternion:
    """Return the unit quaternion (w, x, y, z) with w >= 0.

    Shepperd's method: the largest component is computed first.
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = m
    trace = r00 + r11 + r22
    if trace >= r00 and trace >= r11 and trace >= r22:
        w, x, y, z = 1.0 + trace, r21 - r12, r02 - r20, r10 - r01
    elif r00 >= r11 and r00 >= r22:
        w, x, y, z = r21 - r12, 1.0 + r00 - r11 - r22, r10 + r01, r02 + r20
    elif r11 >= r22:
        w, x, y, z = r02 - r20, r10 + r01, 1.0 - r00 + r11 - r22, r21 + r12
    else:
        w, x, y, z = r10 - r01, r02 + r20, r21 + r12, 1.0 - r00 - r11 + r22
    scale = 1.0 / sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        scale = -scale
    return w * scale, x * scale, y * scale, z * scale


def quaternion_to_matrix_flat(w: float, x: float, y: float, z: float) -> Flat9:
    """Return the matrix of a quaternion of any length but 0."""
    s = 2.0 / (w * w + x * x + y * y + z * z)
    xs, ys, zs = x * s, y * s, z * s
    return (
        1.0 - y * ys - z * zs,
        x * ys - w * zs,
        x * zs + w * ys,
        x * ys + w * zs,
        1.0 - x * xs - z * zs,
        y * zs - w * xs,
        x * zs - w * ys,
        y * zs + w * xs,
        1.0 - x * xs - y * ys,
    )


def multiply_flat(a: Sequence[float], b: Sequence[float]) -> Flat9:
    """Return the product of two matrices."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = a
    b0, b1, b2, b3, b4, b5, b6, b7, b8 = b
    return (
        a0 * b0 + a1 * b3 + a2 * b6,
        a0 * b1 + a1 * b4 + a2 * b7,
        a0 * b2 + a1 * b5 + a2 * b8,
        a3 * b0 + a4 * b3 + a5 * b6,
        a3 * b1 + a4 * b4 + a5 * b7,
        a3 * b2 + a4 * b5 + a5 * b8,
        a6 * b0 + a7 * b3 + a8 * b6,
        a6 * b1 + a7 * b4 + a8 * b7,
        a6 * b2 + a7 * b5 + a8 * b8,
    )


def transpose_flat(a: Flat9) -> Flat9:
    """Return the transposed matrix; for a rotation this is its inverse."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = a
    return a0, a3, a6, a1, a4, a7, a2, a5, a8


def geodesic_angle_flat(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the angle of the rotation from `a` to `b` [rad], in [0, π]."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = a
    b0, b1, b2, b3, b4, b5, b6, b7, b8 = b
    trace = a0 * b0 + a1 * b1 + a2 * b2 + a3 * b3 + a4 * b4 + a5 * b5 + a6 * b6 + a7 * b7 + a8 * b8
    # The skew part of a bᵀ is the sine; with both, the angle is exact near 0 and π, where an arc
    # cosine is not.
    x = a6 * b3 + a7 * b4 + a8 * b5 - a3 * b6 - a4 * b7 - a5 * b8
    y = a0 * b6 + a1 * b7 + a2 * b8 - a6 * b0 - a7 * b1 - a8 * b2
    z = a3 * b0 + a4 * b1 + a5 * b2 - a0 * b3 - a1 * b4 - a2 * b5
    return atan2(sqrt(x * x + y * y + z * z), trace - 1.0)


def rpy_to_matrix(roll: float, pitch: float, yaw: float) -> Matrix:
    """Return Rz(yaw) Ry(pitch) Rx(roll), (3, 3), from angles [rad]."""
    return np.array(rpy_to_matrix_flat(roll, pitch, yaw)).reshape(3, 3)


def matrix_to_rpy(matrix: ArrayLike) -> Matrix:
    """Return (roll, pitch, yaw) [rad] of a (3, 3) rotation, roll in (-2π, 0]."""
    return np.array(matrix_to_rpy_flat(flatten(matrix)))


def rotvec_to_matrix(rotvec: ArrayLike) -> Matrix:
    """Return the (3, 3) rotation of a rotation vector (3,) [rad]: the exponential."""
    x, y, z = np.asarray(rotvec, dtype=np.float64).tolist()
    return np.array(rotvec_to_matrix_flat(x, y, z)).reshape(3, 3)


def matrix_to_rotvec(matrix: ArrayLike) -> Matrix:
    """Return the rotation vector (3,) [rad] of a rotation (3, 3): its logarithm, at most π long."""
    return np.array(matrix_to_rotvec_flat(flatten(matrix)))


def matrix_to_quaternion(matrix: ArrayLike) -> Matrix:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a (3, 3) rotation."""
    return np.array(matrix_to_quaternion_flat(flatten(matrix)))


def quaternion_to_matrix(quaternion: ArrayLike) -> Matrix:
    """Return the (3, 3) rotation of a quaternion (w, x, y, z) of any length but 0."""
    w, x, y, z = np.asarray(quaternion, dtype=np.float64).tolist()
    return np.array(quaternion_to_matrix_flat(w, x, y, z)).reshape(3, 3)


def geodesic_angle(a: ArrayLike, b: ArrayLike) -> float:
    """Return the angle [rad] in [0, π] between two (3, 3) rotations."""
    return geodesic_angle_flat(flatten(a), flatten(b))


def flatten(matrix: ArrayLike) -> list[float]:
    """Return a (3, 3) matrix as nine floats, row by row."""
    values: list[float] = np.asarray(matrix, dtype=np.float64).ravel().tolist()
    return values
