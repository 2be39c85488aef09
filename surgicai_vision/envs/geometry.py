"""Geometry of the stitch: grasp frames on the needle, the path through the holes, and the goals.

A grasp: the jaws approach along the normal of the needle's plane from its +z side and close in the
radial direction. The same kind of grasp picks the needle up from the tissue, drives it through the
holes and pulls it out. In the tool's frame (z along the jaws, y across them, x along their hinge),
with θ the grasped point's angle: y = ± radial(θ), z = -normal, tip frame at `GRASP_DEPTH` above the
plane. PSM2 uses +radial, PSM1 -radial: with these signs no joint limit is met on the whole path
(SurgicAI's demonstrations use the same).

On a needle of another arc the goals keep their shares, 5/6 and 7/8 of it (100° and 105° of 120°),
so that the same share of it is out of the exit. PSM2 grasps it as far before the insertion's goal
as the 120° needle, up to 95°, because this distance decides the pose of its wrist. (From the base
of a half circle the roll would have to go 125° past its limit.)

The path: the holes of layout `simple` lie 7.8 mm apart on flanks tilted 46.1°, their axes 43.9°
below the horizontal. A circle of the needle's radius R through both centres has its centre √(R² -
(gap/2)²) = 9.4 mm above their midpoint. In the holes it runs at asin(gap / 2R) = 22.6° to the
horizontal, 21° off their axes. No rigid arc of this radius is perpendicular at both holes, so the
needle starts perpendicular at the entry (place), turns those 21° about its tip while the tip
enters, then follows the circle. In the 3.8 mm openings the needle's surface keeps at least 0.7 mm
of clearance all the way (0.71 to 0.82 mm by pair; `tests/scene/test_scene.py` measures it).

Room for PSM2's jaws: at the end of the insertion the needle's point at
`angle_at_entry(INSERT_ANGLE, INSERT_DEPTH)` = 100° - 11.3° - 2 asin(gap / 2R) is in the entry, and
the jaws, `PAD_WIDTH` wide, must still be outside. With the extra drive `EXTRA` that makes room for
PSM1, this leaves grasps up to 27° in `simple` and up to 8° to 15° in `3dmed_straight` (gaps 9.8 to
10.9 mm), where PSM2 grasps nearer the base. The gaps of `3dmed` (12.2 to 14.1 mm, 74° to 88° of the
needle's 120°) leave no room: a third of this needle cannot protrude from the exit while PSM2 holds
its base. Those holes are meant for their challenge's needle of 133°. In `3dmed` grasp and place are
possible; the later subtasks are refused.
"""

import dataclasses
import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import InputError
from surgicai_vision.core.names import PSM1, PSM2
from surgicai_vision.envs import poses
from surgicai_vision.scene import needle
from surgicai_vision.scene.arm import GRASP_DEPTH, PAD_WIDTH
from surgicai_vision.scene.holes import Hole, HolePair
from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import rotvec_to_matrix, rpy_to_matrix

Matrix = NDArray[np.float64]

GRASP_SIGNS = {PSM1: -1.0, PSM2: 1.0}
INSERT_ANGLE = math.radians(100.0)
"""The point of a 120° needle that the insertion brings beyond the exit (released code)."""
COME_ROUND = math.radians(10.0)
"""Turn that must remain before a long needle's tip would reach the exit's plane."""
INSERT_DEPTH = 0.002
"""How far beyond the exit the insertion brings that point [m]."""
EXTRA = 0.0014
"""How far the expert drives on past that goal, to make room for PSM1's jaws [m]."""
FIRST_GRASP = math.radians(6.5)
"""Smallest angle on the scene's own needle at which a grasp, off by its error, has the needle
between the pads; on another needle, the angle of an equally long arc."""
HANDOFF_ANGLE = math.radians(105.0)
"""The point of a 120° needle that PSM1 grasps (released code)."""
PULLOUT_SHIFT = np.array([0.030, 0.0, 0.030])
"""End of the pull-out relative to the exit [m], in world for a phantom that is not turned (released
code)."""
PULLOUT_TURN = math.radians(-50.0)
"""Rotation of the handoff grasp about the wound at that end (released code)."""


def cross(a: Matrix, b: Matrix) -> Matrix:
    """Return the cross product of two vectors (3,): numpy's takes twenty times as long."""
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def grasp_in_needle(
    arm: str, angle: float, depth: float = GRASP_DEPTH, radius: float = needle.RADIUS
) -> Matrix:
    """Return T_needle_tip (4, 4): the tool's pose that grasps the needle's point at `angle` [rad].

    Args:
        arm: "psm1" or "psm2".
        angle: angle of the grasped point.
        depth: distance of the tip frame from the needle's plane [m].
        radius: of the needle's arc [m].
    """
    y = GRASP_SIGNS[arm] * needle.radial(angle)
    z = np.array([0.0, 0.0, -1.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([cross(y, z), y, z], axis=1)
    pose[:3, 3] = needle.point(angle, radius) - depth * z
    return pose


def needle_frame(angle: float, radius: float = needle.RADIUS) -> Matrix:
    """Return T_needle_point (4, 4): the needle's frame shifted to its point at `angle`."""
    pose = np.eye(4)
    pose[:3, 3] = needle.point(angle, radius)
    return pose


@functools.lru_cache(maxsize=256)
def needle_frame_flat(angle: float, radius: float) -> Pose:
    """Return `needle_frame` as twelve floats."""
    return poses.flat(needle_frame(angle, radius))


def _moved(hole: Hole, shift: Matrix) -> Hole:
    """Return a hole moved by `shift` (3,) [m]."""
    x, y, z = (np.asarray(hole.centre) + shift).tolist()
    return dataclasses.replace(hole, centre=(x, y, z))


@dataclass(frozen=True)
class Stitch:
    """The path of the needle through one pair of holes, all poses T_world_needle (4, 4).

    Attributes:
        pair: entry and exit.
        centre: centre of the circle through both holes [m, world].
        half: half of the circle's angle between the holes [rad].
        radius: of the circle and of the needle's arc [m].
        tip_angle: of the needle's tip [rad].
    """

    pair: HolePair
    centre: Matrix
    half: float
    radius: float = needle.RADIUS
    tip_angle: float = needle.TIP_ANGLE

    @classmethod
    def of(
        cls,
        pair: HolePair,
        radius: float = needle.RADIUS,
        tip_angle: float = needle.TIP_ANGLE,
    ) -> "Stitch":
        """Return the stitch through `pair` by a needle whose arc has `radius` [m].

        Raises:
            InputError: the holes are further apart than the needle is wide.
        """
        entry = np.asarray(pair.entry.centre)
        leave = np.asarray(pair.exit.centre)
        chord = leave - entry
        half = float(np.linalg.norm(chord)) / 2
        if half >= radius:
            raise InputError(
                f"The holes are {2e3 * half:.1f} mm apart; a needle of {1e3 * radius:.1f} mm "
                "radius cannot reach both."
            )
        up = cross(chord / (2 * half), pair.entry.rotation[:, 1])
        centre = (entry + leave) / 2 + up * math.sqrt(radius**2 - half**2)
        return cls(pair, centre, math.asin(half / radius), radius, tip_angle)

    def beside(self, along: float, across: float) -> "Stitch":
        """Return the path moved along the wound and across it, in the entry's plane [m]."""
        if not (along or across):
            return self
        axes = self.pair.entry.rotation
        shift = along * axes[:, 1] + across * axes[:, 0]
        pair = HolePair(_moved(self.pair.entry, shift), _moved(self.pair.exit, shift))
        return dataclasses.replace(self, pair=pair, centre=self.centre + shift)

    @functools.cached_property
    def wound(self) -> Matrix:
        """Return the wound's direction in world (3,): the normal of the needle's plane."""
        along: Matrix = self.pair.entry.rotation[:, 1]
        return along

    @functools.cached_property
    def insert_angle(self) -> float:
        """Return the needle's point that the insertion brings beyond the exit [rad]."""
        return INSERT_ANGLE * (self.tip_angle / needle.TIP_ANGLE)

    @functools.cached_property
    def handoff_angle(self) -> float:
        """Return the needle's point that PSM1 grasps [rad]."""
        return HANDOFF_ANGLE * (self.tip_angle / needle.TIP_ANGLE)

    def on_arc(self, angle_at_entry: float) -> Matrix:
        """Return the needle's pose on the circle with `angle_at_entry` [rad] in the entry."""
        radial = (np.asarray(self.pair.entry.centre) - self.centre) / self.radius
        return _needle_pose(angle_at_entry, radial, self.centre, self.wound)

    def angle_at_entry(self, angle: float, beyond: float) -> float:
        """Return the needle angle in the entry when `angle` is `beyond` [m] past the exit."""
        return angle - beyond / self.radius - 2 * self.half

    def place(self) -> Matrix:
        """Return the needle's pose with its tip in the entry, perpendicular to its plane."""
        entry = self.pair.entry
        inward = -entry.rotation[:, 2]
        radial = cross(self.wound, inward)
        pose = _needle_pose(self.tip_angle, radial, np.zeros(3), self.wound)
        pose[:3, 3] = np.asarray(entry.centre) - pose[:3, :3] @ needle.point(
            self.tip_angle, self.radius
        )
        return pose

    def inserted(self, extra: float = 0.0) -> Matrix:
        """Return the goal of the insertion, driven `extra` further [m]."""
        return self.on_arc(self.angle_at_entry(self.insert_angle, INSERT_DEPTH + extra))

    def pulled(self) -> Matrix:
        """Return the goal of the pull-out.

        The handoff point is at the end point, and the inserted needle is turned by `PULLOUT_TURN`.
        """
        pose = np.eye(4)
        pose[:3, :3] = rotvec_to_matrix(PULLOUT_TURN * self.wound) @ self.inserted()[:3, :3]
        pose[:3, 3] = (
            np.asarray(self.pair.exit.centre)
            + rpy_to_matrix(0.0, 0.0, self.pair.exit.turn) @ PULLOUT_SHIFT
            - pose[:3, :3] @ needle.point(self.handoff_angle, self.radius)
        )
        return pose

    @functools.cached_property
    def last_grasp(self) -> float:
        """Return the largest needle angle [rad] at which PSM2's jaws stay outside the entry."""
        beyond = INSERT_DEPTH + EXTRA
        return self.angle_at_entry(self.insert_angle, beyond) - PAD_WIDTH / 2 / self.radius

    @property
    def ahead(self) -> float:
        """Return by how much PSM2's grasp angle exceeds that on a 120° needle [rad]."""
        return self.insert_angle - INSERT_ANGLE

    @property
    def first_grasp(self) -> float:
        """Return the smallest needle angle [rad] at which PSM2 may aim its grasp."""
        return FIRST_GRASP * (needle.RADIUS / self.radius)

    @property
    def possible(self) -> bool:
        """Return True if the holes leave room for PSM2's jaws.

        If they do not, only grasp and place are possible.
        """
        return self.last_grasp >= self.first_grasp

    @property
    def comes_out(self) -> bool:
        """Return True if the base comes out before the tip has come round to the exit's plane.

        A point at α from the circle's bottom is R (cos(half + tilt) - cos(α + tilt)) above that
        plane; the tip is then at half + tip_angle.
        """
        return self.tip_angle + COME_ROUND < 2 * (math.pi - self.half - abs(self.pair.exit.tilt))

    def grasps(self, low: float, high: float) -> tuple[float, float]:
        """Return the range of grasp angles [rad] on this needle for one on a 120° needle.

        It lies as far before the insertion's goal, or nearer to the base if the stitch leaves no
        room for all of it.
        """
        if not self.possible:
            return low + self.ahead, high + self.ahead
        last = min(high + self.ahead, self.last_grasp)
        return min(low + self.ahead, max(low, last - (high - low))), last

    @functools.cached_property
    def place_tip(self) -> Pose:
        """Return the goal of `place` for the needle's frame at its tip."""
        return poses.flat(self.place() @ needle_frame(self.tip_angle, self.radius))

    @functools.cached_property
    def insert_point(self) -> Pose:
        """Return the goal of `insert` for the needle's frame at `insert_angle`."""
        return poses.flat(self.inserted() @ needle_frame(self.insert_angle, self.radius))

    @functools.cached_property
    def pullout_point(self) -> Pose:
        """Return the goal of `pullout` for the needle's frame at `handoff_angle`."""
        return poses.flat(self.pulled() @ needle_frame(self.handoff_angle, self.radius))


def _needle_pose(angle: float, radial: Matrix, centre: Matrix, wound: Matrix) -> Matrix:
    """Return the needle's pose with its plane's normal along `wound` and `radial` at `angle`."""
    tangent = cross(radial, wound)
    x = -math.cos(angle) * radial + math.sin(angle) * tangent
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, cross(wound, x), wound], axis=1)
    pose[:3, 3] = centre
    return pose
