"""Tool: the visible shape of an instrument's shaft, wrist and fingers over its physics.

One mesh per link, because every geom costs a little of each physics step, whether or not it
collides. Dimensions are those of an 8 mm needle driver, drawn slim at the wrist so that it hides
little of the needle.
"""

import math

import mujoco
import numpy as np

from surgicai_vision.scene.arm import PAD_END, PAD_OFFSET, PAD_THICKNESS, PAD_WIDTH, SHAFT_LENGTH
from surgicai_vision.scene.visual.shapes import Mesh, bar, block, loft, rod, show

Cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
ALONG_Y = [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]
HALF_TURN = [0.0, 0.0, 0.0, 1.0]
"""Quaternions (wxyz): a cylinder laid along y, a half turn about z."""


def add_tool_meshes(spec: mujoco.MjSpec, length: float) -> None:
    """Add the meshes "fork", "wrist" and "finger".

    `length` is that of the link between the wrist's axes [m].
    """
    _fork().add_to(spec, "fork")
    _wrist(length).add_to(spec, "wrist")
    _finger().add_to(spec, "finger")


def dress_shaft(link: mujoco.MjsBody, arm: str) -> None:
    """Draw the shaft, a coloured band on it, and the fork.

    z runs along the shaft, y is the pitch axis.
    """
    show(link, Cylinder, "shaft", fromto=[0, 0, -SHAFT_LENGTH, 0, 0, -0.0105], size=[0.0040, 0, 0])
    show(link, Cylinder, f"band_{arm}", fromto=[0, 0, -0.0150, 0, 0, -0.0130], size=[0.0041, 0, 0])
    show(link, mujoco.mjtGeom.mjGEOM_MESH, "steel", meshname="fork")
    show(link, Cylinder, "jaw", quat=ALONG_Y, size=[0.0009, 0.0027, 0])


def dress_wrist(link: mujoco.MjsBody, length: float) -> None:
    """Draw the link between the wrist's axes.

    x runs along it, z is the pitch axis, y the yaw axis.
    """
    show(link, mujoco.mjtGeom.mjGEOM_MESH, "steel", meshname="wrist")
    show(link, Cylinder, "jaw", pos=[length, 0, 0], quat=ALONG_Y, size=[0.0008, 0.0025, 0])


def dress_finger(finger: mujoco.MjsBody, sign: float) -> None:
    """Draw the back of a finger that opens towards +y (sign = 1) or -y.

    Its physical pad is visible as it is.
    """
    turn = {} if sign > 0 else {"quat": HALF_TURN}
    show(finger, mujoco.mjtGeom.mjGEOM_MESH, "steel", meshname="finger", **turn)


def _fork() -> Mesh:
    """Return the cone at the shaft's end and the two prongs that hold the pitch axis."""
    angles = np.arange(12) * (math.pi / 6)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(12)], axis=1)
    ends = ((-0.0107, 0.0039), (-0.0075, 0.0036), (-0.0045, 0.0026))
    mesh = loft([radius * circle + [0.0, 0.0, z] for z, radius in ends])
    for side in (-0.0021, 0.0021):
        mesh.join(block((0.0, side, -0.0025), (0.0018, 0.0004, 0.0025)))
        mesh.join(rod((0.0, side - 0.0004, 0.0), (0.0, side + 0.0004, 0.0), 0.0018))
    return mesh


def _wrist(length: float) -> Mesh:
    """Return the hub on the pitch axis, the body, and the two prongs that hold the yaw axis."""
    mesh = rod((0.0, 0.0, -0.0016), (0.0, 0.0, 0.0016), 0.0018)
    middle = (length - 0.0018) / 2
    mesh.join(block((middle, 0.0, 0.0), (middle, 0.0017, 0.0015)))
    for side in (-0.0019, 0.0019):
        mesh.join(block((length - 0.0016, side, 0.0), (0.0018, 0.0003, 0.0014)))
        mesh.join(rod((length, side - 0.0003, 0.0), (length, side + 0.0003, 0.0), 0.0015))
    return mesh


def _finger() -> Mesh:
    """Return a finger's back, tapered from hinge to pad, and its hub on half of the hinge."""
    middle = PAD_OFFSET + PAD_THICKNESS / 2
    half = PAD_WIDTH / 2
    mesh = bar(
        [
            (0.0, -0.0005, 0.0014, 0.5 * half),
            (0.0030, 0.0004, 0.0021, 0.75 * half),
            (0.0055, middle, 0.0021, 0.85 * half),
            (PAD_END - 0.0008, middle, 0.0016, 0.7 * half),
            (PAD_END, middle, 0.0013, 0.6 * half),
        ]
    )
    mesh.join(rod((0.0001, 0.0, 0.0), (0.0013, 0.0, 0.0), 0.0014))
    return mesh
