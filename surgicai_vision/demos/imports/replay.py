"""Replay: recorded arm motions posed in our scene, without physics.

    demo, clipped = Replay(config).demo(episode)

A recording of SurgicAI holds the commanded tip pose of one arm and nothing about the needle. In
every state that arm is at the recorded pose, the other one is at its start or, in handoff, holds
the needle, and the needle is where the task's definition puts it:

* handoff: still; its 105° point is where the goal grasps it.
* grasp: still; its 17.5° point is where the goal grasps it. (The angle was drawn from 5°–20° and
  not recorded; the shipped set has the needle's tip on the entry, which gives 15°–20°.)
* place, insert: fixed in the jaws as it must be when they are at the goal: with the tip on the
  entry and perpendicular to it (place), or with the 100° point 2 mm beyond the exit (insert).
* pullout: fixed in PSM1's jaws, grasped as by the handoff's goal.

Sources: needle points, insertion depth and lift are from SurgicAI's released code (the project's
facts). The relations between needle and goal were fitted to needle poses that were derived
independently for handoff, place and insert; the tests compare against those.

The first transition of a pullout episode is dropped: it is a jump from the start pose, a fault of
the recorder.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import STEPS, TaskConfig
from surgicai_vision.core.errors import UnreachablePose
from surgicai_vision.core.files import code_version
from surgicai_vision.demos.store import Demo
from surgicai_vision.envs.geometry import grasp_in_needle
from surgicai_vision.envs.starts import CLOSED_JAW
from surgicai_vision.envs.teleport import pose_scene
from surgicai_vision.scene import kinematics, needle
from surgicai_vision.scene.holes import PAIRS
from surgicai_vision.scene.rotations import matrix_to_rotvec, rpy_to_matrix

LIFT = 0.005
"""Height of the tip frame above the needle's plane at the released code's grasp goals [m]."""
GRASP_ANGLE, HANDOFF_ANGLE, INSERT_ANGLE = (
    float(angle) for angle in np.radians([17.5, 105.0, 100.0])
)
INSERT_DEPTH = 0.002
"""Distance of the needle's 100° point beyond the exit at the goal of insert [m]."""
MOST_CLIPPED = 0.01
"""Largest share of a recording's steps that may exceed a step preset for the preset to be used."""
HOLD_ANGLES = np.radians([15.0, 20.0, 25.0, 30.0, 10.0, 35.0, 40.0, 5.0])
"""Points of the needle at which PSM2 may hold it during the handoff, tried in this order: SurgicAI
draws its grasps from 10°–50° after the approach's 5°–20°."""
RADIAL_SLACK = 0.004
DEPTHS = (0.004, 0.014)
"""A held needle's arc lies within this of the jaws' axis, and its plane within these distances of
the tip frame [m]; place and insert recordings have 1.5 mm and 8–10 mm."""


@dataclass(frozen=True)
class Episode:
    """One recorded episode of T steps.

    Attributes:
        pose: commanded tip pose and jaw, x y z [m] roll pitch yaw jaw [rad], (T + 1, 7).
        goal: the same for the goal, (7,).
        action: as recorded, (T, 7).
        reward: as recorded, (T,).
        success: after the step, as recorded, (T,) bool.
    """

    pose: NDArray[np.float64]
    goal: NDArray[np.float64]
    action: NDArray[np.float64]
    reward: NDArray[np.float64]
    success: NDArray[np.bool_]

    @property
    def motion(self) -> "Motion":
        """Return the poses as matrices, and the jaw."""
        return np.stack([pose_matrix(row) for row in self.pose]), self.pose[:, 6]


Motion = tuple[NDArray[np.float64], NDArray[np.float64]]
"""T_base_tip (T + 1, 4, 4) of an arm and its jaw (T + 1,) [rad]."""


def trimmed(episode: Episode, task: str) -> Episode:
    """Return the episode without the jump at the start of every pullout recording."""
    if task != "pullout":
        return episode
    return Episode(
        episode.pose[1:], episode.goal, episode.action[1:], episode.reward[1:], episode.success[1:]
    )


def pose_matrix(seven: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return T_base_tip (4, 4) from x y z [m] roll pitch yaw [rad] (the jaw is ignored)."""
    pose = np.eye(4)
    pose[:3, :3] = rpy_to_matrix(*seven[3:6])
    pose[:3, 3] = seven[:3]
    return pose


def needle_path(episode: Episode, task: str) -> NDArray[np.float64]:
    """Return T_world_needle (T + 1, 4, 4) of an episode, by the rules in the module's docstring."""
    base = kinematics.base_in_world(names.ACTIVE_ARM[task])
    goal = base @ pose_matrix(episode.goal)
    tips = base @ episode.motion[0]
    if task in ("grasp", "handoff"):
        return np.broadcast_to(goal @ np.linalg.inv(_grasp(task)), tips.shape)
    if task == "pullout":
        return tips @ np.linalg.inv(_grasp("handoff"))
    return tips @ np.linalg.inv(goal) @ _needle_at_goal(task)


def _grasp(task: str) -> NDArray[np.float64]:
    """Return T_needle_tip (4, 4) at the goal of grasp or handoff.

    The jaws come down along the normal of the needle's plane; PSM1 closes along -radial, PSM2 along
    +radial.
    """
    is_grasp = task == "grasp"
    angle = GRASP_ANGLE if is_grasp else HANDOFF_ANGLE
    sign = 1.0 if is_grasp else -1.0
    pose = np.eye(4)
    y = sign * needle.radial(angle)
    z = np.array([0.0, 0.0, -1.0])
    pose[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    pose[:3, 3] = needle.point(angle) - LIFT * z
    return pose


def _needle_at_goal(task: str) -> NDArray[np.float64]:
    """Return T_world_needle (4, 4) at the goal of place or insert, at hole pair 1 of `simple`."""
    pair = PAIRS["simple"][0]
    # Columns: radial, tangent and normal of the needle's point, in the hole's frame.
    if task == "place":
        hole = pair.entry.pose
        angle = needle.TIP_ANGLE
        target = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    else:
        hole = pair.exit.pose
        angle = INSERT_ANGLE
        target = np.array([[-1.0, 0, 0, INSERT_DEPTH], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    point = np.eye(4)
    point[:3, 0] = -needle.radial(angle)
    point[:3, 1] = needle.tangent(angle)
    point[:3, 3] = needle.point(angle)
    needle_pose: NDArray[np.float64] = hole @ target @ np.linalg.inv(point)
    return needle_pose


def grip_error(episode: Episode, task: str) -> float:
    """Return how far outside the jaws that should hold it the needle would be [m], at least 0."""
    if task not in ("place", "insert"):
        return 0.0
    base = kinematics.base_in_world(names.ACTIVE_ARM[task])
    tip = base @ pose_matrix(episode.pose[0])
    x, y, z = (np.linalg.inv(needle_path(episode, task)[0]) @ tip)[:3, 3]
    radial = abs(np.hypot(x, y) - needle.RADIUS) - RADIAL_SLACK
    return float(max(radial, DEPTHS[0] - z, z - DEPTHS[1], 0.0))


def motion_actions(motion: Motion, step: str) -> tuple[NDArray[np.float32], int]:
    """Return a motion as actions of our envs, (T, 7) float32, and how many had to be clipped.

    Args:
        motion: one arm's motion.
        step: a key of `STEPS`.
    """
    tip, jaw = motion
    metres, degrees, opening = STEPS[step]
    turns = [
        matrix_to_rotvec(after[:3, :3] @ before[:3, :3].T)
        for before, after in itertools.pairwise(tip)
    ]
    shifts = np.diff(tip[:, :3, 3], axis=0)
    values = np.column_stack(
        [shifts / metres, np.stack(turns) / np.radians(degrees), np.diff(jaw) / opening]
    )
    inside = np.clip(values, -1.0, 1.0)
    return inside.astype(np.float32), int((np.abs(values - inside) > 1e-4).any(axis=1).sum())


def fitting_step(motions: Sequence[Motion], smallest: str = next(iter(STEPS))) -> str:
    """Return the smallest step preset that nearly all steps fit into, or else the best one.

    Args:
        motions: one arm's motions in several episodes.
        smallest: the smallest preset that is tried.
    """
    steps = sum(len(jaw) - 1 for _, jaw in motions)
    sizes = list(STEPS)[list(STEPS).index(smallest) :]
    clipped = {size: sum(motion_actions(motion, size)[1] for motion in motions) for size in sizes}
    for size in sizes:
        if clipped[size] <= MOST_CLIPPED * steps:
            return size
    return min(sizes, key=lambda size: clipped[size])


@dataclass(frozen=True)
class Track:
    """Where everything is in each of T + 1 states.

    Attributes:
        arms: arm → its motion; other arms are at their start.
        needle: T_world_needle (T + 1, 4, 4).
        grasp_angle: the needle's grasped point [rad], where the task has one.
        passed: `TaskState.holes_passed` in each state, (T + 1,), or None for its value at the
            task's start.
    """

    arms: Mapping[str, Motion]
    needle: NDArray[np.float64]
    grasp_angle: float
    passed: NDArray[np.float64] | None = None


class Replay:
    """Replays episodes of one task."""

    def __init__(self, config: TaskConfig):
        self.config = config
        self._env = envs.make(config)

    def demo(self, episode: Episode) -> tuple[Demo, int]:
        """Return the episode as a demonstration, and how many actions were clipped.

        Raises:
            UnreachablePose: a pose outside the arms' joint limits.
        """
        task = self.config.task
        track = Track(
            {names.ACTIVE_ARM[task]: episode.motion},
            needle_path(episode, task),
            GRASP_ANGLE if task == "grasp" else 0.0,
        )
        states, infos = self.play(track)
        action, clipped = motion_actions(episode.motion, self.config.step)
        demo = self.as_demo(
            "surgicai",
            states,
            action=action,
            reward=episode.reward.astype(np.float32),
            success=episode.success,
            contact=np.array([info["contact"] for info in infos[1:]]),
        )
        return demo, clipped

    def play(self, track: Track) -> tuple[NDArray[np.float64], list[dict[str, Any]]]:
        """Pose the scene state by state; return the states (T + 1, n) and each one's info.

        Raises:
            UnreachablePose: a pose outside the arms' joint limits.
        """
        env = self._env
        env.reset(seed=0)
        arms = dict(track.arms)
        if self.config.task == "handoff" and names.PSM2 not in arms:
            tip, jaw = self._hold(track.needle[0])
            arms[names.PSM2] = (
                np.broadcast_to(tip, track.needle.shape),
                np.full(len(track.needle), jaw),
            )
        states = []
        infos = []
        for index, needle_pose in enumerate(track.needle):
            poses = {arm: (tip[index], float(jaw[index])) for arm, (tip, jaw) in arms.items()}
            pose_scene(env, **poses, T_world_needle=needle_pose)
            state = env.simulation.task_state
            state.grasp_angle = track.grasp_angle or state.grasp_angle
            if track.passed is not None:
                state.holes_passed = int(track.passed[index])
            infos.append(env.measure())
            states.append(env.get_state())
        return np.stack(states), infos

    def reward(self, success: bool, info: Mapping[str, Any]) -> float:
        """Return the env's reward for a state, given whether it counts as a success."""
        return self._env.reward({**info, "is_success": success})

    def as_demo(
        self,
        demonstrator: str,
        states: NDArray[np.float64],
        *,
        action: NDArray[np.float32],
        reward: NDArray[np.float32],
        success: NDArray[np.bool_],
        contact: NDArray[np.bool_],
    ) -> Demo:
        """Return states and what was done and measured in them as a demonstration."""
        return Demo(
            config=self.config,
            seed=-1,
            demonstrator=demonstrator,
            scene_hash=self._env.scene.hash,
            code_version=code_version(),
            state=states,
            phase=np.full(len(states) - 1, names.SUBTASKS.index(self.config.task), np.int8),
            action=action,
            reward=reward,
            success=success,
            contact=contact,
        )

    def _hold(self, needle_pose: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """Return PSM2's pose (T_base_tip, jaw) that holds the needle near its base."""
        base = np.linalg.inv(kinematics.base_in_world(names.PSM2))
        for angle in HOLD_ANGLES:
            tip = base @ needle_pose @ grasp_in_needle(names.PSM2, float(angle))
            try:
                kinematics.inverse(tip, self.config.scene.instrument)
            except UnreachablePose:
                continue
            return tip, CLOSED_JAW
        raise UnreachablePose("PSM2 cannot reach the needle to hold it during the handoff.")
