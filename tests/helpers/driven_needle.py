"""A needle that no arm holds: an invisible hand drives it along a given path.

It tests tissue where no arm can bring the needle: through every pair of holes of every
layout, in both directions.
"""

import dataclasses
import math

import mujoco
import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig
from surgicai_vision.envs import poses
from surgicai_vision.envs.control import StepSize
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.scene.compose import build_scene, build_spec
from surgicai_vision.scene.rotations import matrix_to_quaternion

STILL = [0.0] * 7
STEP = StepSize.of("paper")
TURN = math.radians(2.0)
"""Turn of the needle per control step [rad]: 0.36 mm, about as fast as the expert."""
OUTSIDE = math.radians(20.0)
"""Angle before the skin at which the tip starts [rad]."""


def driven(scene: SceneConfig, draws: tuple[float, ...] | None = None) -> Simulation:
    """Return a simulation of soft tissue with the needle on a hand, randomised by `draws`."""
    spec = build_spec(scene)
    spec.worldbody.add_body(name="hand", mocap=True)
    weld = spec.add_equality(
        name="hand", type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY
    )
    weld.name1, weld.name2 = "needle", "hand"
    weld.data[:11] = [0.0] * 6 + [1.0] + [0.0] * 3 + [1.0]
    weld.solref, weld.solimp = [0.004, 1.0], [0.9999, 0.99999, 0.0001, 0.5, 2.0]
    whole = dataclasses.replace(build_scene(scene), model=spec.compile())
    simulation = Simulation(whole, own_model=True)
    if draws is not None:
        simulation.randomise(draws)
        simulation.reset()
    return simulation


def put(simulation: Simulation, pose: np.ndarray) -> None:
    """Put hand and needle at T_world_needle, (4, 4), outside the tissue or embedded in it."""
    simulation.pose_needle(poses.flat(pose))
    move(simulation, pose)
    simulation.refresh()


def carry(simulation: Simulation, pose: np.ndarray) -> None:
    """Move hand and needle to T_world_needle, (4, 4), at once; the tissue keeps its wounds."""
    free = simulation.scene.needle_qpos
    simulation.data.qpos[free] = [*pose[:3, 3], *matrix_to_quaternion(pose[:3, :3])]
    simulation.data.qvel[:] = 0.0
    move(simulation, pose)
    simulation.refresh()


def move(simulation: Simulation, pose: np.ndarray) -> None:
    """Move the hand to T_world_needle, (4, 4)."""
    hand = simulation.model.body("hand").mocapid[0]
    simulation.data.mocap_pos[hand] = pose[:3, 3]
    simulation.data.mocap_quat[hand] = matrix_to_quaternion(pose[:3, :3])


class Circle:
    """The needle's poses on the circle from `entry` to `leave`, two points in world, (3,) [m]."""

    def __init__(self, entry: np.ndarray, leave: np.ndarray, radius: float):
        chord = leave - entry
        half = float(np.linalg.norm(chord)) / 2
        across = np.cross([0.0, 0.0, 1.0], chord)
        self.axis = across / np.linalg.norm(across)
        up = np.cross(chord / (2 * half), self.axis)
        self.centre = (entry + leave) / 2 + up * math.sqrt(radius**2 - half**2)
        self.radial = (entry - self.centre) / radius
        self.between = 2 * math.asin(half / radius)

    def pose(self, angle_at_entry: float) -> np.ndarray:
        """Return T_world_needle with the needle's point at that angle [rad] at the entry."""
        tangent = np.cross(self.radial, self.axis)
        x = -math.cos(angle_at_entry) * self.radial + math.sin(angle_at_entry) * tangent
        pose = np.eye(4)
        pose[:3, :3] = np.stack([x, np.cross(self.axis, x), self.axis], axis=1)
        pose[:3, 3] = self.centre
        return pose


def drive(simulation: Simulation, circle: Circle, first: float, last: float, each=None) -> None:
    """Drive the needle from the angle `first` at the entry to `last` [rad].

    Args:
        simulation: from `driven`.
        circle: path of the needle.
        first: present angle.
        last: final angle.
        each: called after each control step.
    """
    steps = max(1, round(abs(last - first) / TURN))
    for angle in np.linspace(first, last, steps + 1)[1:]:
        move(simulation, circle.pose(float(angle)))
        assert simulation.advance(names.PSM1, STILL, STEP), "MuJoCo diverged"
        if each is not None:
            each()


def whole_way(simulation: Simulation, circle: Circle) -> tuple[float, float]:
    """Return the angles at the entry [rad] before and after the needle goes all the way through."""
    return simulation.tip_angle + OUTSIDE, -circle.between - OUTSIDE
