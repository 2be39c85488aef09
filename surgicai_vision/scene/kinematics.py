"""Kinematics of the da Vinci patient-side manipulator (PSM): joints ⇄ pose of the tool tip.

The pose is in the arm's base frame.

`Instrument.dh` is the modified DH table that the surgical robotics challenge publishes. The base
origin is the remote centre of motion: the shaft passes through it, so both directions have closed
forms. Multiplied out, with L = L_tool - L_rcc and s, c for sine and cosine:

    shaft  z3 = (s1 c2, -s2, -c1 c2),  x3 = (-s1 s2, -c2, c1 s2),  y3 = (-c1, 0, -s1)
    wrist  w  = (q3 + L) z3                       where the pitch axis meets the shaft
    pitch axis  e = s4 x3 - c4 y3
    pitch link  u = s5 (c4 x3 + s4 y3) + c5 z3
    tip    p  = w + L_p2y u                       on the yaw axis
    columns of R: x = -c5 (c4 x3 + s4 y3) + s5 z3,  y = c6 e - s6 u,  z = c6 u + s6 e

`…_flat` functions work on plain floats for the control step: a pose is a tuple of twelve floats,
the position and then the rotation row by row.
"""

import functools
import math
from dataclasses import dataclass
from math import atan2, cos, pi, radians, sin, sqrt
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgicai_vision.core.errors import InputError, UnreachablePose, check_name
from surgicai_vision.core.names import PSM1, PSM2
from surgicai_vision.scene.rotations import rpy_to_matrix

Joints = tuple[float, float, float, float, float, float]
"""outer_yaw, outer_pitch [rad], outer_insertion [m], outer_roll, outer_wrist_pitch, outer_wrist_yaw
[rad].
"""
Pose = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""Position [m], then the rotation matrix row by row."""

DVRK_JOINTS = (
    "outer_yaw",
    "outer_pitch",
    "outer_insertion",
    "outer_roll",
    "outer_wrist_pitch",
    "outer_wrist_yaw",
)
"""The dVRK's names; a joint in the model is called f"{arm}_{name}"."""
INSERTION = DVRK_JOINTS.index("outer_insertion")

TOLERANCE = 1e-9
"""How far past a joint limit a solution may lie [rad or m]: rounding, not motion."""


class Row(NamedTuple):
    """One row: RotX(alpha) TransX(a) RotZ(q + offset) TransZ(d) [rad, m].

    If `prismatic`, q is added to d.
    """

    alpha: float
    a: float
    d: float
    offset: float
    prismatic: bool = False


@dataclass(frozen=True)
class Instrument:
    """Lengths [m] and joint limits of a PSM with one instrument.

    Attributes:
        name: Intuitive's number for the instrument.
        rcc: L_rcc, from the remote centre to the tool carriage at zero insertion.
        tool: L_tool, from the carriage to the wrist's pitch axis.
        limits: lower and upper limit of the six joints in the order of `DVRK_JOINTS` [rad, m].
        jaw: lower and upper limit of a finger's angle [rad].
        pitch_to_yaw: L_p2y, from the wrist's pitch axis to its yaw axis, where the tip frame lies.
    """

    name: str
    rcc: float
    tool: float
    limits: tuple[tuple[float, float], ...]
    jaw: tuple[float, float]
    pitch_to_yaw: float = 0.009

    @functools.cached_property
    def bounds(self) -> tuple[float, ...]:
        """Return the lower and upper limit of each joint, `TOLERANCE` wider, in one tuple."""
        return tuple(
            edge for low, high in self.limits for edge in (low - TOLERANCE, high + TOLERANCE)
        )

    @property
    def dh(self) -> tuple[Row, ...]:
        """Return the DH table: six joints and the fixed tip."""
        right = pi / 2
        first = Row(right, 0.0, 0.0, right)
        second = Row(-right, 0.0, 0.0, -right)
        insertion = Row(right, 0.0, -self.rcc, 0.0, prismatic=True)
        roll = Row(0.0, 0.0, self.tool, 0.0)
        wrist_yaw = Row(-right, self.pitch_to_yaw, 0.0, -right)
        tip = Row(-right, 0.0, 0.0, right)
        return first, second, insertion, roll, second, wrist_yaw, tip


def _limits(*degrees: float) -> tuple[tuple[float, float], ...]:
    """Return symmetric limits of the five revolute joints and 0..0.24 m of insertion."""
    turning = [(-radians(angle), radians(angle)) for angle in degrees]
    return (*turning[:INSERTION], (0.0, 0.24), *turning[INSERTION:])


INSTRUMENTS = MappingProxyType(
    {
        "400006": Instrument(
            "400006", 0.4389, 0.416, _limits(92.0, 60.0, 175.0, 90.0, 85.0), (0.0, 1.57)
        ),
        "420006": Instrument(
            "420006",
            0.4318,
            0.4826,
            _limits(91.0, 53.0, 175.0, 80.0, 80.0),
            (radians(-20.0), radians(80.0)),
        ),
    }
)
"""Large needle drivers of the surgical robotics challenge; SurgicAI uses 400006."""
DEFAULT = "400006"

BASES = MappingProxyType(
    {
        PSM1: ((0.1, 0.13461, 0.13499), (0.6981, -0.5236, -3.1416)),
        PSM2: ((-0.1, 0.13461, 0.13499), (0.6981, 0.5236, -3.1416)),
    }
)
"""Arm → position [m] and roll, pitch, yaw [rad] of its base in world (SurgicAI's scene)."""


class Start(NamedTuple):
    """The tip at the start of an episode, in the arm's own base [m, rad]."""

    x: float
    y: float
    z: float
    roll: float
    pitch: float
    yaw: float
    jaw: float


STARTS = MappingProxyType(
    {
        PSM1: Start(0.04629208, 0.00752399, -0.08173992, -3.598019, -0.05762508, 1.2738742, 0.8),
        PSM2: Start(-0.03721037, 0.01213105, -0.08036895, -2.7039163, 0.07693613, 2.0361109, 0.8),
    }
)
"""Arm → its start (released code)."""


def limits(instrument: str = DEFAULT) -> NDArray[np.float64]:
    """Return the lower and upper limit of each joint, (6, 2) [rad, m]."""
    return np.array(INSTRUMENTS[check_name("instrument", instrument, INSTRUMENTS)].limits)


def base_in_world(arm: str) -> NDArray[np.float64]:
    """Return T_world_base (4, 4) of "psm1" or "psm2"."""
    position, rpy = BASES[check_name("arm", arm, BASES)]
    return _matrix(position, rpy_to_matrix(*rpy))


def start_in_base(arm: str) -> NDArray[np.float64]:
    """Return T_base_tip (4, 4) at the start of an episode."""
    start = STARTS[check_name("arm", arm, STARTS)]
    rotation = rpy_to_matrix(start.roll, start.pitch, start.yaw)
    return _matrix((start.x, start.y, start.z), rotation)


def forward(q6: ArrayLike, instrument: str = DEFAULT) -> NDArray[np.float64]:
    """Return T_base_tip (4, 4) of the joints (6,) [rad, m]; limits are not checked.

    Raises:
        InputError: not six finite numbers.
    """
    check_name("instrument", instrument, INSTRUMENTS)
    pose = forward_flat(_six("q6", q6), instrument)
    return _matrix(pose[:3], np.array(pose[3:]).reshape(3, 3))


def inverse(
    T_base_tip: ArrayLike, instrument: str = DEFAULT, near: ArrayLike | None = None
) -> NDArray[np.float64]:
    """Return the joints (6,) [rad, m] that put the tip at `T_base_tip` (4, 4).

    Args:
        near: joints (6,) the arm comes from. The roll is then unwrapped towards them: a pose that
            can only be reached by turning the roll back through its whole range is refused. Without
            `near`, any solution will do.

    Raises:
        UnreachablePose: outside a joint limit; the message names joint, value and limit.
        InputError: not a (4, 4) matrix of finite numbers, or `near` not six of them.
    """
    check_name("instrument", instrument, INSTRUMENTS)
    matrix = np.asarray(T_base_tip, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"T_base_tip must be a finite 4 × 4 matrix; its shape is {matrix.shape}.")
    pose = (*matrix[:3, 3].tolist(), *matrix[:3, :3].ravel().tolist())
    joints = None if near is None else _six("near", near)
    return np.array(inverse_flat(pose, instrument, joints))


def _six(name: str, values: ArrayLike) -> Joints:
    """Return an argument as the joints of one arm, or refuse it."""
    joints = np.asarray(values, dtype=np.float64)
    if joints.shape != (len(DVRK_JOINTS),) or not np.isfinite(joints).all():
        raise InputError(f"{name} must be six finite numbers; its shape is {joints.shape}.")
    a, b, c, d, e, f = joints.tolist()
    return a, b, c, d, e, f


def forward_flat(q: Joints, instrument: str = DEFAULT) -> Pose:
    """Return the tip's pose in the base as twelve floats."""
    q1, q2, q3, q4, q5, q6 = q
    length = INSTRUMENTS[instrument]
    s1, c1, s2, c2, s4, c4 = sin(q1), cos(q1), sin(q2), cos(q2), sin(q4), cos(q4)
    s5, c5, s6, c6 = sin(q5), cos(q5), sin(q6), cos(q6)
    zx, zy, zz = s1 * c2, -s2, -c1 * c2
    xx, xy, xz = -s1 * s2, -c2, c1 * s2
    ex, ey, ez = s4 * xx + c4 * c1, s4 * xy, s4 * xz + c4 * s1
    fx, fy, fz = c4 * xx - s4 * c1, c4 * xy, c4 * xz - s4 * s1
    ux, uy, uz = s5 * fx + c5 * zx, s5 * fy + c5 * zy, s5 * fz + c5 * zz
    depth = q3 + length.tool - length.rcc
    p2y = length.pitch_to_yaw
    return (
        depth * zx + p2y * ux,
        depth * zy + p2y * uy,
        depth * zz + p2y * uz,
        s5 * zx - c5 * fx,
        c6 * ex - s6 * ux,
        c6 * ux + s6 * ex,
        s5 * zy - c5 * fy,
        c6 * ey - s6 * uy,
        c6 * uy + s6 * ey,
        s5 * zz - c5 * fz,
        c6 * ez - s6 * uz,
        c6 * uz + s6 * ez,
    )


def inverse_flat(pose: Pose, instrument: str = DEFAULT, near: Joints | None = None) -> Joints:
    """Return the joints of a tip pose given as twelve floats; see `inverse`."""
    px, py, pz, ax, yx, bx, ay, yy, by, az, yz, bz = pose
    length = INSTRUMENTS[instrument]
    # The pitch axis e is normal to the plane of the shaft and the yaw axis a, which contains the
    # base origin and the tip.
    ex, ey, ez = py * az - pz * ay, pz * ax - px * az, px * ay - py * ax
    norm = sqrt(ex * ex + ey * ey + ez * ez)
    if norm < 1e-12:  # the yaw axis passes through the remote centre: any wrist yaw will do
        ex = yx
        ey = yy
        ez = yz
        norm = 1.0
    ex, ey, ez = ex / norm, ey / norm, ez / norm
    ux, uy, uz = ay * ez - az * ey, az * ex - ax * ez, ax * ey - ay * ex
    c6 = bx * ux + by * uy + bz * uz
    if c6 < 0.0:  # e and -e give wrist yaws half a turn apart; only one is within ±90°
        ex, ey, ez, ux, uy, uz, c6 = -ex, -ey, -ez, -ux, -uy, -uz, -c6
    q6 = atan2(bx * ex + by * ey + bz * ez, c6)
    p2y = length.pitch_to_yaw
    wx, wy, wz = px - p2y * ux, py - p2y * uy, pz - p2y * uz
    depth = sqrt(wx * wx + wy * wy + wz * wz)
    offset = length.rcc - length.tool
    geometry = (ux, uy, uz, ex, ey, ez, ax, ay, az)
    if depth < 1e-12:  # the wrist is at the remote centre: any shaft will do, take the pitch link
        return _checked((*_shaft(ux, uy, uz, offset, geometry, near), q6), length)
    joints = (*_shaft(wx / depth, wy / depth, wz / depth, depth + offset, geometry, near), q6)
    # The wrist may be behind the remote centre: instrument 400006 inserted by less than 23 mm.
    if depth <= 2.0 * offset:
        behind = (
            *_shaft(-wx / depth, -wy / depth, -wz / depth, offset - depth, geometry, near),
            q6,
        )
        return _checked(_better(joints, behind, length, near), length)
    return _checked(joints, length)


def _shaft(
    zx: float, zy: float, zz: float, q3: float, geometry: tuple[float, ...], near: Joints | None
) -> tuple[float, float, float, float, float]:
    """Return the first five joints for a shaft along z = (zx, zy, zz) and insertion `q3`."""
    ux, uy, uz, ex, ey, ez, ax, ay, az = geometry  # pitch link, pitch axis, yaw axis
    c2 = sqrt(zx * zx + zz * zz)
    s1, c1 = (zx / c2, -zz / c2) if c2 > 0.0 else (0.0, 1.0)
    # s4 = e · x3 and c4 = -e · y3, s5 = a · z3 and c5 = u · z3.
    q4 = atan2(s1 * zy * ex - c2 * ey - c1 * zy * ez, c1 * ex + s1 * ez)
    if near is not None:
        q4 += 2.0 * pi * round((near[3] - q4) / (2.0 * pi))
    return (
        atan2(s1, c1),
        atan2(-zy, c2),
        q3,
        q4,
        atan2(ax * zx + ay * zy + az * zz, ux * zx + uy * zy + uz * zz),
    )


def _better(first: Joints, second: Joints, instrument: Instrument, near: Joints | None) -> Joints:
    """Return the solution within limits; of two, the one nearer to `near`, or else to zero."""
    within = [joints for joints in (first, second) if _violation(joints, instrument) < 0]
    return min(within or (first, second), key=lambda joints: math.dist(joints, near or (0.0,) * 6))


def _violation(joints: Joints, instrument: Instrument) -> int:
    """Return the index of the first joint outside its limits, -1 for none."""
    a, b, c, d, e, f = joints
    a0, a1, b0, b1, c0, c1, d0, d1, e0, e1, f0, f1 = instrument.bounds
    if (
        a0 <= a <= a1
        and b0 <= b <= b1
        and c0 <= c <= c1
        and d0 <= d <= d1
        and e0 <= e <= e1
        and f0 <= f <= f1
    ):
        return -1
    return next(
        index
        for index, (value, (low, high)) in enumerate(zip(joints, instrument.limits, strict=True))
        if not low - TOLERANCE <= value <= high + TOLERANCE
    )


def _checked(joints: Joints, instrument: Instrument) -> Joints:
    """Return `joints`, or raise `UnreachablePose` for the first one outside its limits."""
    index = _violation(joints, instrument)
    if index < 0:
        return joints
    (low, high) = instrument.limits[index]
    value = joints[index]
    scale, unit = (1000.0, "mm") if index == INSERTION else (180.0 / pi, "°")
    raise UnreachablePose(
        f"Pose out of reach: {DVRK_JOINTS[index]} would be {value * scale:.2f} {unit}; "
        f"instrument {instrument.name} allows {low * scale:.2f} to {high * scale:.2f} {unit}."
    )


def _matrix(position: ArrayLike, rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (4, 4) transform of a position (3,) and a rotation (3, 3)."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = position
    return transform
