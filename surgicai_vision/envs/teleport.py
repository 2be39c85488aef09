"""Teleport: put an env into a given state, to replay motions that were recorded elsewhere.

A replay is kinematic: tools and needle are placed where the recording had them, at rest, and
commands match. Images, observations and measurements are those of that state; nothing is claimed
about the forces between.
"""

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.envs import hole_crossing, poses
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.starts import CLOSED_JAW, grasp_pose
from surgicai_vision.scene.kinematics import STARTS, start_in_base

Matrix = NDArray[np.float64]
ArmPose = tuple[Matrix, float]
"""T_base_tip (4, 4) and jaw angle [rad]."""


def pose_scene(
    env: SuturingEnv,
    psm1: ArmPose | None = None,
    psm2: ArmPose | None = None,
    T_world_needle: Matrix | None = None,
) -> None:
    """Set a kinematic state: arms, needle, no velocity, commands to match.

    Args:
        env: the env; its task state (progress) stays as it is.
        psm1: T_base_tip (4, 4) and jaw [rad] of PSM1; None leaves it where it is.
        psm2: the same for PSM2.
        T_world_needle: pose of the needle in world (4, 4); None leaves it where it is.

    Raises:
        UnreachablePose: a tip pose outside the joint limits.
    """
    simulation = env.simulation
    for arm, wanted in ((names.PSM1, psm1), (names.PSM2, psm2)):
        if wanted is not None:
            pose, jaw = wanted
            simulation.pose_arm(
                arm, poses.flat(pose), float(np.clip(jaw, 0.0, 1.0)), max(jaw, CLOSED_JAW)
            )
    if T_world_needle is not None:
        simulation.pose_needle(poses.flat(T_world_needle))
    simulation.data.qvel[:] = 0.0
    simulation.refresh()
    hole_crossing.remember_tip(simulation, simulation.task_state)


def home(arm: str) -> ArmPose:
    """Return an arm's pose at the start of an episode."""
    return start_in_base(arm), STARTS[arm].jaw


def holding(env: SuturingEnv, arm: str, T_world_needle: Matrix, angle: float) -> ArmPose:
    """Return the pose of an arm that holds the needle's point at `angle` [rad] with closed jaws."""
    tip = grasp_pose(arm, T_world_needle, angle)
    return poses.square(env.simulation.to_base(arm, poses.flat(tip))), 0.0
