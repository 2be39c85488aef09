"""Imitator: does a subtask as its demonstrations did, from a new start, in the env's own actions.

    imitator = Imitator(env, ["demos/episode_000000.safetensors"])
    env.reset(seed=7)
    imitator.reset()
    env.step(imitator.action())

A lesson's primitives (`lesson`) run from the needle's measured start to the goal. Each step the
needle's next pose becomes the tool's through the rigid grasp, measured anew each time, and the
tool's becomes an action like the expert's. The primitive's clock waits while the command is more
than one action behind it (phase stopping of Ijspeert et al., all or nothing), so the path is kept
whatever the step size. Demonstrations end as soon as they are within the tolerance; when the last
primitive has run out, its goal moves on to the subtask's own.

Where the needle is taken the tool runs relative to the grasp goal on the needle where it lies, jaws
as open as the demonstration's before it closed, and closes when it is there.
"""

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import InputError
from surgicai_vision.core.names import SUTURE
from surgicai_vision.demos.dmp.fit import CARRIED, Lesson, Piece, as_pose, learn_lesson
from surgicai_vision.demos.dmp.primitive import Course
from surgicai_vision.demos.expert import ALIGNED, ALIGNED_ANGLE, Sight, Wish, moves, toward
from surgicai_vision.demos.store import read_demo
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.geometry import grasp_in_needle
from surgicai_vision.scene.rotations import geodesic_angle, matrix_to_quaternion

Matrix = NDArray[np.float64]


class Imitator:
    """The imitator of an env; see the module's docstring. It begins an episode at its first action.

    Args:
        env: the env.
        demos: files of demonstrations of its subtask; they may come from another scene or step
            size.
        scaled: see `movement`.

    Raises:
        BadFile: a file that is no demonstration.
        InputError: no file, one of another task, or the whole procedure.
    """

    def __init__(self, env: SuturingEnv, demos: Sequence[str | Path], scaled: bool = False):
        if env.task == SUTURE:
            raise InputError(
                "Movement primitives are learned for a subtask; the whole procedure has none."
            )
        self.env = env
        self.lesson = _lesson(env.task, tuple(map(str, demos)), scaled)
        self._course: Course | None = None
        self._piece = 0
        self._closing = self._waits = False
        self._told = np.eye(4)

    def reset(self) -> None:
        """Begin a new episode at the env's present state."""
        self._begin(0, self._start(Sight(self.env)))
        self._closing = self._waits = False

    def action(self) -> NDArray[np.float32]:
        """Return the next action, (7,) float32 in [-1, 1]."""
        if self._course is None:
            self.reset()
        sight = Sight(self.env)
        refused = self._waits and np.array_equal(sight.command, self._told)
        self._waits = self._waits and not refused
        wish = self._carry(sight) if self.env.task in CARRIED else self._take(sight)
        self._waits, self._told = bool(np.abs(moves(sight, wish.tip)).max() > 1.0), sight.command
        return toward(sight, wish)

    # -- the course --------------------------------------------------------------------------------

    def _begin(self, index: int, pose: Matrix) -> None:
        """Start a part of the lesson at a pose in its coordinates."""
        part = self.lesson.parts[index]
        self._piece = index
        self._course = part.primitive.start(*_split(pose), *_split(part.goal))

    def _next(self) -> Matrix:
        """Move the course on by a control step, unless the tool is behind; return its pose in its
        coordinates.
        """
        course = self._course
        assert course is not None
        if not self._waits:
            course.advance(self.env.dt)
        pose = as_pose(course.position, course.rotation)
        if course.done and self._piece + 1 < len(self.lesson.parts):
            before, after = self._pieces[self._piece], self._pieces[self._piece + 1]
            stitch = self.env.stitch
            needle_pose = before.goal(stitch) @ pose @ np.linalg.inv(before.frame())
            self._begin(
                self._piece + 1, np.linalg.inv(after.goal(stitch)) @ needle_pose @ after.frame()
            )
        elif course.done:
            course.aim(*_split(np.eye(4)))
        return pose

    @property
    def _pieces(self) -> tuple[Piece, ...]:
        return CARRIED[self.env.task]

    def _start(self, sight: Sight) -> Matrix:
        """Return where the episode starts, in the first part's coordinates."""
        if self.env.task not in CARRIED:
            return np.linalg.inv(self._grasp(sight)) @ sight.tip
        piece = self._pieces[0]
        return np.linalg.inv(piece.goal(sight.stitch)) @ sight.needle @ piece.frame()

    # -- wishes ------------------------------------------------------------------------------------

    def _carry(self, sight: Sight) -> Wish:
        piece = self._pieces[self._piece]
        wanted = piece.goal(sight.stitch) @ self._next() @ np.linalg.inv(piece.frame())
        return Wish(sight.carrying(wanted), 0.0)

    def _take(self, sight: Sight) -> Wish:
        goal = self._grasp(sight)
        if self._closing:
            return Wish(sight.command if sight.holds else goal, 0.0)
        wanted = goal @ self._next()
        off = float(np.linalg.norm(sight.tip[:3, 3] - goal[:3, 3]))
        there = off < ALIGNED and geodesic_angle(sight.tip[:3, :3], goal[:3, :3]) < ALIGNED_ANGLE
        self._closing = self._course is not None and self._course.done and there
        return Wish(wanted, self.lesson.opening)

    def _grasp(self, sight: Sight) -> Matrix:
        """Return T_world_tip of the grasp: at the angle the episode drew, or else at the
        demonstrated one.
        """
        angle = sight.memory.grasp_angle or self.lesson.angle
        return sight.needle @ grasp_in_needle(sight.arm, angle)


def _split(pose: Matrix) -> tuple[Matrix, Matrix]:
    """Return a pose (4, 4) as position (3,) and quaternion (4,)."""
    return pose[:3, 3], matrix_to_quaternion(pose[:3, :3])


@functools.lru_cache(maxsize=8)
def _lesson(task: str, demos: tuple[str, ...], scaled: bool) -> Lesson:
    """Learn once per process."""
    return learn_lesson(task, [read_demo(Path(path)) for path in demos], scaled)
