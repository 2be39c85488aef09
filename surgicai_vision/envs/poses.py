"""Poses in plain floats: composition and inversion of the twelve-float poses of
`scene.kinematics`.
"""

from math import sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import geodesic_angle_flat, multiply_flat

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


def compose(a: Pose, b: Pose) -> Pose:
    """Return the product a · b."""
    x, y, z = b[0], b[1], b[2]
    return (
        a[0] + a[3] * x + a[4] * y + a[5] * z,
        a[1] + a[6] * x + a[7] * y + a[8] * z,
        a[2] + a[9] * x + a[10] * y + a[11] * z,
        *multiply_flat(a[3:], b[3:]),
    )


def invert(a: Pose) -> Pose:
    """Return the inverse of a rigid transform."""
    x, y, z, r0, r1, r2, r3, r4, r5, r6, r7, r8 = a
    return (
        -(r0 * x + r3 * y + r6 * z), -(r1 * x + r4 * y + r7 * z), -(r2 * x + r5 * y + r8 * z),
        r0, r3, r6, r1, r4, r7, r2, r5, r8,
    )  # fmt: skip


def relative(a: Pose, b: Pose) -> Pose:
    """Return `b` in the frame of `a`: the product invert(a) · b."""
    x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    _, _, _, r0, r1, r2, r3, r4, r5, r6, r7, r8 = a
    return (
        r0 * x + r3 * y + r6 * z,
        r1 * x + r4 * y + r7 * z,
        r2 * x + r5 * y + r8 * z,
        *multiply_flat((r0, r3, r6, r1, r4, r7, r2, r5, r8), b[3:]),
    )


def inverse_origin(a: Pose) -> tuple[float, float, float]:
    """Return where the parent's origin lies in the frame of `a`."""
    x, y, z, r0, r1, r2, r3, r4, r5, r6, r7, r8 = a
    return -(r0 * x + r3 * y + r6 * z), -(r1 * x + r4 * y + r7 * z), -(r2 * x + r5 * y + r8 * z)


def gap(a: Pose, point: tuple[float, float, float], b: Pose) -> float:
    """Return how far `a` puts a point of its frame from the origin of `b` [m]."""
    x, y, z = point
    u = a[0] + a[3] * x + a[4] * y + a[5] * z - b[0]
    v = a[1] + a[6] * x + a[7] * y + a[8] * z - b[1]
    w = a[2] + a[9] * x + a[10] * y + a[11] * z - b[2]
    return sqrt(u * u + v * v + w * w)


def distance(a: Pose, b: Pose) -> float:
    """Return the distance between two origins [m]."""
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return sqrt(x * x + y * y + z * z)


def angle(a: Pose, b: Pose) -> float:
    """Return the geodesic angle between two rotations [rad]."""
    return geodesic_angle_flat(a[3:], b[3:])
