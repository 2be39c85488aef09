"""Controller: executes fitted movement primitives of a subtask in the env's own actions.

    controller = DmpController(env, ["demos/episode_000000.safetensors"])
    env.reset(seed=7)
    controller.reset()
    env.step(controller.action())

The primitives (`fit`) run from the needle's measured start to the goal. At each step, the rigid
grasp, measured anew each time, converts the needle's next pose to the tool's, which becomes an
action as in the expert. The primitive's clock stops while the command is more than one action
behind it (phase stopping of Ijspeert et al., all or nothing), so the path is kept whatever the step
size. Demonstrations end as soon as they are within the tolerance; when the last primitive has run
out, its goal becomes the subtask's own.

Where the needle is grasped, the tool moves relative to the grasp goal on the resting needle. Its
jaws are as open as in the demonstration before closing, and close when the tool has arrived.
"""

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import InputError
from surgicai_vision.core.files import sha256_file
from surgicai_vision.core.names import SUTURE
from surgicai_vision.demos.demonstrator import Demonstrator
from surgicai_vision.demos.dmp.fit import CARRY_PHASES, CarryPhase, SubtaskFit, as_pose, fit_subtask
from surgicai_vision.demos.dmp.primitive import Execution
from surgicai_vision.demos.expert import (
    ALIGNED,
    ALIGNED_ANGLE,
    ToolTarget,
    WorldState,
    action_towards,
    command_error,
)
from surgicai_vision.demos.store import read_demo
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.geometry import grasp_in_needle
from surgicai_vision.scene import needle
from surgicai_vision.scene.rotations import geodesic_angle, matrix_to_quaternion

Matrix = NDArray[np.float64]


class DmpController(Demonstrator):
    """Executes movement primitives in an env; an episode starts at its first action.

    Args:
        env: the env.
        demos: files of demonstrations of its subtask; they may come from another scene or step
            size.
        scaled: see `primitive`.

    Attributes:
        fit: what was learned from the demonstrations.

    Raises:
        BadFile: a file that is not a demonstration.
        InputError: no file, one of another task, or the whole procedure.
    """

    def __init__(self, env: SuturingEnv, demos: Sequence[str | Path], scaled: bool = False):
        if env.task == SUTURE:
            raise InputError(
                "Movement primitives are learned for a subtask; the whole procedure has none."
            )
        self.env = env
        files = tuple((str(path), sha256_file(Path(path))) for path in demos)
        self.fit = _fit_files(env.task, files, scaled)
        self._execution: Execution | None = None
        self._index = 0
        self._closing = False
        self._behind = False
        self._last_command = np.eye(4)

    def reset(self) -> None:
        """Start a new episode at the env's present state."""
        self._start_phase(0, self._start_pose(WorldState(self.env)))
        self._closing = False
        self._behind = False

    def action(self) -> NDArray[np.float32]:
        """Return the next action, (7,) in [-1, 1]."""
        if self._execution is None:
            self.reset()
        world = WorldState(self.env)
        if np.array_equal(world.command, self._last_command):
            self._behind = False  # the env refused the last action: waiting would not help
        target = self._carry(world) if self._phases else self._grasp(world)
        self._behind = bool(np.abs(command_error(world, target.tip)).max() > 1.0)
        self._last_command = world.command
        return action_towards(world, target)

    # -- the execution -----------------------------------------------------------------------------

    def _start_phase(self, index: int, pose: Matrix) -> None:
        """Start a phase of the fit at a pose in its coordinates."""
        phase = self.fit.phases[index]
        self._index = index
        self._execution = phase.primitive.start(*_split(pose), *_split(phase.goal))

    def _next_pose(self) -> Matrix:
        """Advance by a control step, unless the tool is behind, and return the phase's pose."""
        execution = self._execution
        assert execution is not None
        if not self._behind:
            execution.advance(self.env.dt)
        pose = as_pose(execution.position, execution.rotation)
        if execution.done and self._index + 1 < len(self.fit.phases):
            before = self._phases[self._index]
            after = self._phases[self._index + 1]
            stitch = self.env.stitch
            needle_pose = before.goal(stitch) @ pose @ np.linalg.inv(before.frame(stitch))
            start = np.linalg.inv(after.goal(stitch)) @ needle_pose @ after.frame(stitch)
            self._start_phase(self._index + 1, start)
        elif execution.done:
            execution.set_goal(*_split(np.eye(4)))
        return pose

    @property
    def _phases(self) -> tuple[CarryPhase, ...]:
        """Return the phases in which the needle is carried; none where it is grasped."""
        return CARRY_PHASES.get(self.env.task, ())

    def _start_pose(self, world: WorldState) -> Matrix:
        """Return where the episode starts, in the first phase's coordinates."""
        if not self._phases:
            return np.linalg.inv(self._grasp_pose(world)) @ world.tip
        phase = self._phases[0]
        return np.linalg.inv(phase.goal(world.stitch)) @ world.needle @ phase.frame(world.stitch)

    # -- tool targets ------------------------------------------------------------------------------

    def _carry(self, world: WorldState) -> ToolTarget:
        phase = self._phases[self._index]
        frame = phase.frame(world.stitch)
        needle_pose = phase.goal(world.stitch) @ self._next_pose() @ np.linalg.inv(frame)
        return ToolTarget(world.tip_for_needle(needle_pose), 0.0)

    def _grasp(self, world: WorldState) -> ToolTarget:
        goal = self._grasp_pose(world)
        if self._closing:
            return ToolTarget(world.command if world.holds else goal, 0.0)
        tip = goal @ self._next_pose()
        distance = float(np.linalg.norm(world.tip[:3, 3] - goal[:3, 3]))
        angle = geodesic_angle(world.tip[:3, :3], goal[:3, :3])
        arrived = distance < ALIGNED and angle < ALIGNED_ANGLE
        self._closing = self._execution is not None and self._execution.done and arrived
        return ToolTarget(tip, self.fit.jaw_opening)

    def _grasp_pose(self, world: WorldState) -> Matrix:
        """Return T_world_tip of the grasp, at the episode's angle or else the demonstrated one."""
        share = world.stitch.tip_angle / needle.TIP_ANGLE
        angle = world.task_state.grasp_angle or self.fit.grasp_angle * share
        return world.needle @ grasp_in_needle(world.arm, angle, radius=world.stitch.radius)


def _split(pose: Matrix) -> tuple[Matrix, Matrix]:
    """Return a pose (4, 4) as position (3,) and quaternion (4,)."""
    return pose[:3, 3], matrix_to_quaternion(pose[:3, :3])


@functools.lru_cache(maxsize=8)
def _fit_files(task: str, files: tuple[tuple[str, str], ...], scaled: bool) -> SubtaskFit:
    """Fit the primitives to files, (path, sha256) each; once per process and content."""
    return fit_subtask(task, [read_demo(Path(path)) for path, _ in files], scaled)
