"""Poses in plain floats: parts, composition and inversion of the poses of `scene.kinematics`.

A pose is twelve floats: the position, then the rotation row by row. Most other modules of the envs
use these functions and do not depend on that order.
"""

from math import sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import (
    Flat9,
    Vector,
    geodesic_angle_flat,
    multiply_flat,
    transpose_flat,
)

IDENTITY: Pose = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def flat(matrix: ArrayLike) -> Pose:
    """Return a (4, 4) transform as twelve floats."""
    array = np.asarray(matrix, dtype=np.float64)
    return (*array[:3, 3].tolist(), *array[:3, :3].ravel().tolist())


def square(pose: Pose) -> NDArray[np.float64]:
    """Return twelve floats as a (4, 4) transform."""
    matrix = np.eye(4)
    matrix[:3, 3] = pose[:3]
    matrix[:3, :3] = np.reshape(pose[3:], (3, 3))
    return matrix


def position(pose: Pose) -> Vector:
    """Return the origin of a pose [m]."""
    return pose[:3]


def rotation(pose: Pose) -> Flat9:
    """Return the rotation matrix of a pose, row by row."""
    return pose[3:]


def z_axis(pose: Pose) -> Vector:
    """Return the z axis of a pose, the last column of its rotation."""
    return pose[5], pose[8], pose[11]


def shifted_along_z(pose: Pose, distance: float) -> Pose:
    """Return a pose shifted by `distance` [m] along its own z axis."""
    x, y, z, r0, r1, r2, r3, r4, r5, r6, r7, r8 = pose
    return (
        x + distance * r2,
        y + distance * r5,
        z + distance * r8,
        r0,
        r1,
        r2,
        r3,
        r4,
        r5,
        r6,
        r7,
        r8,
    )


def transform(a: Pose, point: Vector) -> Vector:
    """Return a point of the frame of `a` in the parent's frame [m]."""
    x, y, z = point
    return (
        a[0] + a[3] * x + a[4] * y + a[5] * z,
        a[1] + a[6] * x + a[7] * y + a[8] * z,
        a[2] + a[9] * x + a[10] * y + a[11] * z,
    )


def compose(a: Pose, b: Pose) -> Pose:
    """Return the product a · b."""
    return (*transform(a, b[:3]), *multiply_flat(a[3:], b[3:]))


def invert(a: Pose) -> Pose:
    """Return the inverse of a rigid transform."""
    return (*inverse_origin(a), *transpose_flat(a[3:]))


def relative(a: Pose, b: Pose) -> Pose:
    """Return `b` in the frame of `a`: the product invert(a) · b."""
    x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    _, _, _, r0, r1, r2, r3, r4, r5, r6, r7, r8 = a
    return (
        r0 * x + r3 * y + r6 * z,
        r1 * x + r4 * y + r7 * z,
        r2 * x + r5 * y + r8 * z,
        *multiply_flat(transpose_flat(a[3:]), b[3:]),
    )


def inverse_origin(a: Pose) -> Vector:
    """Return where the parent's origin lies in the frame of `a` [m]."""
    x, y, z, r0, r1, r2, r3, r4, r5, r6, r7, r8 = a
    return -(r0 * x + r3 * y + r6 * z), -(r1 * x + r4 * y + r7 * z), -(r2 * x + r5 * y + r8 * z)


def gap(a: Pose, point: Vector, b: Pose) -> float:
    """Return the distance from a point in the frame of `a` to the origin of `b` [m]."""
    x, y, z = transform(a, point)
    u, v, w = x - b[0], y - b[1], z - b[2]
    return sqrt(u * u + v * v + w * w)


def distance(a: Pose, b: Pose) -> float:
    """Return the distance between two origins [m]."""
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return sqrt(x * x + y * y + z * z)


def angle(a: Pose, b: Pose) -> float:
    """Return the geodesic angle between two rotations [rad]."""
    return geodesic_angle_flat(a[3:], b[3:])
