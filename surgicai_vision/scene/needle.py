"""Needle: a rigid arc of capsules, one free body whose origin is the centre of the arc.

Needle frame (as in SurgicAI's released code): the point at angle θ [rad] is p(θ) = (-R cos θ, R
sin θ, 0); 0 is the base, where the thread is tied, `TIP_ANGLE` the tip; +z is the normal of the
needle's plane.

Sources: radius 10.18 mm and the 0°–120° arc from SurgicAI's scene; the diameter of 0.9 mm is
between that of the new surgical robotics challenge (0.98 × 0.86 mm) and SurgicAI's (0.725 mm), and
both taper towards the tip. Contact numbers were measured by `benchmarks/grip.py`.
"""

import itertools
import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

RADIUS = 0.01018
"""Radius of the arc [m]."""
TIP_ANGLE = math.radians(120.0)
BODY_RADIUS = 0.00045
"""Half of the needle's thickness [m]."""
TIP_RADIUS = 0.000155
"""Half of the thickness at the tip [m]."""
SEGMENTS = 16
MASS = 0.0002
"""[kg]; a steel needle of this size."""
ARMATURE = 1e-8
"""Added to the needle's inertia [kg·m²] and, without effect, to its mass [kg]. A needle that tissue
loads while a strong grip squeezes it out would otherwise spin up: without the armature, 2 to 3 of
60 to 120 random episodes in soft tissue ended in a physics error; with it, none of 150."""
DRAG = 2e-7
"""Drag of the free needle [N·s/m and N·m·s/rad]. It slows a fall by 0.1 % per second, and it
removes the energy that the explicit integrator would otherwise feed into a fast spin: without it
one random episode in seventy diverged. Damping is explicit (`compose`), so it must stay below
2 I / dt. About the needle's chord, where its inertia is least, I is 4.7e-10 kg m² and the limit is
4.7e-7."""
HOME = np.array([-0.02079, 0.05620, 0.07171])
"""Origin of the needle frame at the centre of the start distribution, where the needle lies flat
[m, world]."""

CONTACT = {
    "condim": 4,
    "friction": [1.0, 0.01, 0.0001],
    "solref": [0.004, 1.0],
    "solimp": [0.99, 0.999, 0.0001, 0.5, 2.0],
}
"""Stiff contact with strong torsional friction, for the serrated jaws of a needle driver: it lets
two flat pads hold a round needle. With the default torsional friction of 0.005 m the grip crept
0.7° in ten seconds, 2.2° at most; with 0.01 m, 0.4° and 1.2°."""


@dataclass(frozen=True)
class NeedleShape:
    """The shape of a needle; the scene's own by default.

    Attributes:
        radius: of the arc [m].
        tip_angle: of the tip [rad]: how much of a circle the needle covers.
        body_radius: half of its thickness [m].
    """

    radius: float = RADIUS
    tip_angle: float = TIP_ANGLE
    body_radius: float = BODY_RADIUS

    @property
    def mass(self) -> float:
        """Return its mass [kg], in proportion to its length, not to its thickness.

        The stiffness of MuJoCo's contacts grows with the mass. With half of it, the pads of
        a grip of 10 N pressed 0.3 mm into a needle of 0.2 mm and shot it away.
        """
        return MASS * (self.radius / RADIUS) * (self.tip_angle / TIP_ANGLE)

    def thickness(self, angle: float) -> float:
        """Return half of the thickness [m] at `angle` [rad]; the last quarter tapers."""
        share = max(0.0, (angle / self.tip_angle - 0.75) / 0.25)
        end = TIP_RADIUS * (self.body_radius / BODY_RADIUS)
        return self.body_radius + share * (end - self.body_radius)


OWN_SHAPE = NeedleShape()
"""The shape of the scene's own needle."""


def point(angle: float, radius: float = RADIUS) -> NDArray[np.float64]:
    """Return the point (3,) [m] at `angle` [rad] on an arc of `radius` [m] in its frame."""
    return np.array([-radius * math.cos(angle), radius * math.sin(angle), 0.0])


def tangent(angle: float) -> NDArray[np.float64]:
    """Return the unit tangent towards the tip at `angle` [rad] in the needle frame, shape (3,)."""
    return np.array([math.sin(angle), math.cos(angle), 0.0])


def radial(angle: float) -> NDArray[np.float64]:
    """Return the unit vector (3,) from the centre to the arc at `angle` [rad]."""
    return np.array([-math.cos(angle), math.sin(angle), 0.0])


def polyline(
    points: int = 61, radius: float = RADIUS, tip_angle: float = TIP_ANGLE
) -> NDArray[np.float64]:
    """Return points along the needle from base to tip in its frame, shape (points, 3) [m]."""
    angles = np.linspace(0.0, tip_angle, points)
    return np.stack(
        [-radius * np.cos(angles), radius * np.sin(angles), np.zeros_like(angles)], axis=1
    )


def thickness(angle: float) -> float:
    """Return half of the scene needle's thickness [m] at `angle` [rad]; the last quarter tapers."""
    return OWN_SHAPE.thickness(angle)


def add_needle(
    spec: mujoco.MjSpec, collision: dict[str, int], shape: NeedleShape = OWN_SHAPE
) -> mujoco.MjsBody:
    """Add the needle's free body to `spec` at `HOME` and return it.

    Args:
        spec: the scene.
        collision: `contype` and `conaffinity` of the needle.
        shape: of the needle.
    """
    body = spec.worldbody.add_body(name="needle", pos=HOME.tolist())
    body.add_joint(name="needle", type=mujoco.mjtJoint.mjJNT_FREE, damping=DRAG, armature=ARMATURE)
    radius = shape.radius
    edges = np.linspace(0.0, shape.tip_angle, SEGMENTS + 1)
    for index, (start, end) in enumerate(itertools.pairwise(edges)):
        body.add_geom(
            name=f"needle_{index}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[*point(start, radius), *point(end, radius)],
            size=[shape.thickness((start + end) / 2), 0, 0],
            mass=shape.mass / SEGMENTS,
            material="needle",
            **CONTACT,
            **collision,
        )
    for name, angle in (("needle_base", 0.0), ("needle_tip", shape.tip_angle)):
        body.add_site(name=name, pos=point(angle, radius).tolist(), size=[0.0003] * 3, group=4)
    return body
