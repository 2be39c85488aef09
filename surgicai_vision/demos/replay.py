"""Replay recorded arm motions in our scene: kinematics, no physics.

    demo, clipped = Replay(config).demo(episode)

A recording of SurgicAI holds the commanded tip pose of one arm and nothing of the needle. In every state the
arm stands at the recorded pose, the other one at its start or, in handoff, holding the needle, and the needle
lies where the task's definition puts it:

* handoff: still; its 105° point is where the goal grasps it.
* grasp: still; its 17.5° point is where the goal grasps it. (The angle was drawn from 5°–20° and not recorded;
  the shipped set has the needle's tip on the entry, which gives 15°–20°.)
* place, insert: rigid in the jaws as it is when they stand at the goal, that is with the tip on the entry and
  perpendicular to it, or with the 100° point 2 mm beyond the exit.
* pullout: rigid in PSM1's jaws, grasped as the handoff's goal grasps it.

Sources: needle points, insertion depth and lift from SurgicAI's released code (the project's facts); the
relations between needle and goal were fitted to needle poses that were derived independently for handoff, place
and insert, and the tests compare with those.

The first transition of a pullout episode is dropped: a jump from the start pose, a fault of the recorder.
"""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from surgicai_vision import names
from surgicai_vision.config import STEPS, TaskConfig
from surgicai_vision.demos.store import Demo
from surgicai_vision.errors import UnreachablePose
from surgicai_vision.files import code_version
from surgicai_vision.scene import kinematics, needle
from surgicai_vision.scene.holes import PAIRS
from surgicai_vision.scene.rotations import matrix_to_rotvec, rpy_to_matrix

LIFT = 0.005
"""Height of the tip frame over the needle's plane at the released code's grasp goals [m]."""
GRASP_ANGLE, HANDOFF_ANGLE, INSERT_ANGLE = (float(angle) for angle in np.radians([17.5, 105.0, 100.0]))
INSERT_DEPTH = 0.002
"""Distance of the needle's 100° point beyond the exit at the goal of insert [m]."""
HOLD_ANGLES = np.radians([15.0, 20.0, 25.0, 30.0, 10.0, 35.0, 40.0, 5.0])
"""Points of the needle at which PSM2 may hold it during the handoff, tried in this order: SurgicAI draws its
grasps from 10°–50° after the approach's 5°–20°."""
RADIAL_SLACK, DEPTHS = 0.004, (0.004, 0.014)
"""A held needle's arc lies within this of the jaws' axis, and its plane within these distances of the tip frame
[m]; place and insert recordings have 1.5 mm and 8–10 mm."""


@dataclass(frozen=True)
class Episode:
    """One recorded episode of T steps.

    Attributes:
        pose: commanded tip pose and jaw, x y z [m] roll pitch yaw jaw [rad], (T + 1, 7).
        goal: the same of the goal, (7,).
        action: as recorded, (T, 7).
        reward: as recorded, (T,).
        success: after the step, as recorded, (T,) bool.
    """

    pose: np.ndarray
    goal: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    success: np.ndarray


def trimmed(episode: Episode, task: str) -> Episode:
    """Return the episode without the jump that opens every pullout recording."""
    if task != "pullout":
        return episode
    return Episode(episode.pose[1:], episode.goal, episode.action[1:], episode.reward[1:], episode.success[1:])


def pose_matrix(seven: np.ndarray) -> np.ndarray:
    """Return T_base_tip (4, 4) of x y z [m] roll pitch yaw [rad] (the jaw is ignored)."""
    pose = np.eye(4)
    pose[:3, :3] = rpy_to_matrix(*seven[3:6])
    pose[:3, 3] = seven[:3]
    return pose


def needle_path(episode: Episode, task: str) -> np.ndarray:
    """Return T_world_needle (T + 1, 4, 4) of a recorded episode; see the module's docstring for the rules."""
    base = kinematics.base_in_world(names.ACTIVE_ARM[task])
    goal = base @ pose_matrix(episode.goal)
    tips = base @ np.stack([pose_matrix(row) for row in episode.pose])
    if task in ("grasp", "handoff"):
        return np.broadcast_to(goal @ np.linalg.inv(_grasp(task)), tips.shape)
    if task == "pullout":
        return tips @ np.linalg.inv(_grasp("handoff"))
    return tips @ np.linalg.inv(goal) @ _needle_at_goal(task)


def _grasp(task: str) -> np.ndarray:
    """Return T_needle_tip (4, 4) at the goal of grasp or handoff.

    The jaws come down the normal of the needle's plane; PSM1 closes along -radial, PSM2 along +radial.
    """
    angle, sign = (GRASP_ANGLE, 1.0) if task == "grasp" else (HANDOFF_ANGLE, -1.0)
    pose = np.eye(4)
    y, z = sign * needle.radial(angle), np.array([0.0, 0.0, -1.0])
    pose[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    pose[:3, 3] = needle.point(angle) - LIFT * z
    return pose


def _needle_at_goal(task: str) -> np.ndarray:
    """Return T_world_needle (4, 4) when place or insert is done, at the first pair of holes of layout "simple"."""
    pair = PAIRS["simple"][0]
    # Columns: radial, tangent and normal of the needle's point, in the hole's frame.
    if task == "place":
        hole, angle = pair.entry.pose, needle.TIP_ANGLE
        target = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    else:
        hole, angle = pair.exit.pose, INSERT_ANGLE
        target = np.array([[-1.0, 0, 0, INSERT_DEPTH], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    point = np.eye(4)
    point[:3, 0], point[:3, 1], point[:3, 3] = -needle.radial(angle), needle.tangent(angle), needle.point(angle)
    return hole @ target @ np.linalg.inv(point)


def grip_error(episode: Episode, task: str) -> float:
    """Return how far the needle would lie outside the jaws that hold it [m]; 0 where it is inside or not held."""
    if task not in ("place", "insert"):
        return 0.0
    base = kinematics.base_in_world(names.ACTIVE_ARM[task])
    x, y, z = (np.linalg.inv(needle_path(episode, task)[0]) @ base @ pose_matrix(episode.pose[0]))[:3, 3]
    radial = abs(np.hypot(x, y) - needle.RADIUS) - RADIAL_SLACK
    return float(max(radial, DEPTHS[0] - z, z - DEPTHS[1], 0.0))


def actions(episode: Episode, step: str) -> tuple[np.ndarray, int]:
    """Return the motion as actions of our envs, (T, 7) float32, and how many had to be clipped to [-1, 1]."""
    metres, degrees, jaw = STEPS[step]
    rotations = np.stack([pose_matrix(row)[:3, :3] for row in episode.pose])
    turns = [matrix_to_rotvec(after @ before.T) for before, after in itertools.pairwise(rotations)]
    moves = np.diff(episode.pose, axis=0)
    values = np.column_stack([moves[:, :3] / metres, np.stack(turns) / np.radians(degrees), moves[:, 6] / jaw])
    inside = np.clip(values, -1.0, 1.0)
    return inside.astype(np.float32), int((np.abs(values - inside) > 1e-4).any(axis=1).sum())


class Replay:
    """Replays episodes of one task."""

    def __init__(self, config: TaskConfig):
        import surgicai_vision.envs as envs

        self.config = config
        self._env: Any = envs.make(config)

    def demo(self, episode: Episode) -> tuple[Demo, int]:
        """Return the episode as a demonstration, and how many actions were clipped.

        Raises:
            UnreachablePose: a pose outside the arms' joint limits.
        """
        from surgicai_vision.envs.posing import pose_scene

        task, env = self.config.task, self._env
        arm = names.ACTIVE_ARM[task]
        needles = needle_path(episode, task)
        env.reset(seed=0)
        others = {"psm2": self._hold(needles[0])} if task == "handoff" else {}
        states, contact = [], []
        for seven, needle_pose in zip(episode.pose, needles, strict=True):
            pose_scene(env, **{arm: (pose_matrix(seven), float(seven[6])), **others}, T_world_needle=needle_pose)
            states.append(env.get_state())
            contact.append(bool(env.measure()["contact"]))
        action, clipped = actions(episode, self.config.step)
        demo = Demo(
            config=self.config,
            seed=-1,
            source="surgicai",
            scene_hash=env.scene.hash,
            code_version=code_version(),
            state=np.stack(states),
            action=action,
            phase=np.full(len(action), names.SUBTASKS.index(task), np.int8),
            reward=episode.reward.astype(np.float32),
            success=episode.success,
            contact=np.array(contact[1:]),
        )
        return demo, clipped

    def _hold(self, needle_pose: np.ndarray) -> tuple[np.ndarray, float]:
        """Return PSM2's pose (T_base_tip, jaw) that holds the needle near its base."""
        from surgicai_vision.envs.geometry import grasp_in_needle
        from surgicai_vision.envs.starts import CLOSED_JAW

        base = np.linalg.inv(kinematics.base_in_world(names.PSM2))
        for angle in HOLD_ANGLES:
            tip = base @ needle_pose @ grasp_in_needle(names.PSM2, float(angle))
            try:
                kinematics.inverse(tip, self.config.scene.instrument)
            except UnreachablePose:
                continue
            return tip, CLOSED_JAW
        raise UnreachablePose("PSM2 cannot reach the needle to hold it during the handoff.")
