"""Multiplier: one of a few demonstrations, re-posed to the present start and executed in the env.

    multiplier = Multiplier(env, ["demos/episode_000000.safetensors"], "nearest")
    env.reset(seed=7)
    env.step(multiplier.action())

An episode takes one demonstration, at random or the one with the most similar start, and executes
its pieces (`segments`) one after another. The tool, or the needle in it, goes straight from where
it is to a piece's first pose and then along the piece, re-posed to where its object is now. Every
step is one action of the env, at most one step size long. The path waits for the tool: its
parameter advances by one sample per step, or by less where an action is too small to follow, so
that a tool pushed away by noise comes back to the path. In the whole procedure, each subtask begins
when the env says so.

The method is MimicGen's (Mandlekar et al., CoRL 2023); `segments` says what differs.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.demos.demonstrator import NEAREST, RANDOM, SOURCES, Demonstrator
from surgicai_vision.demos.expert import ToolTarget, WorldState, action_towards, command_error
from surgicai_vision.demos.multiply.cuts import read_source
from surgicai_vision.demos.multiply.segments import (
    STILL,
    Moment,
    Segment,
    Source,
    grasp_of,
    moment_of,
)
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.control import StepSize
from surgicai_vision.scene.rotations import matrix_to_rotvec, rotvec_to_matrix

Array = NDArray[np.float64]


class Multiplier(Demonstrator):
    """Re-poses demonstrations in an env; an episode starts at its first action.

    Args:
        env: the env.
        demos: files of demonstrations of its task; they may come from another step size.
        source: one of `SOURCES`.

    Raises:
        BadFile: a file that is not a demonstration.
        InputError: no file, one of another task, one that was multiplied, or a task that has no
            pieces.
    """

    def __init__(self, env: SuturingEnv, demos: Sequence[str | Path], source: str = NEAREST):
        check_name("source", source, SOURCES)
        self.env = env
        self._choice = source
        self._sources = [read_source(str(path)) for path in demos]
        if not self._sources:
            raise InputError("There is no demonstration to re-pose; give at least one.")
        wanted = names.SUBTASKS if env.task == names.SUTURE else (env.task,)
        for path, one in zip(demos, self._sources, strict=True):
            if tuple(one.segments) != wanted:
                raise InputError(
                    f"{path} shows {', '.join(one.segments)}; to multiply '{env.task}' it must "
                    f"show {', '.join(wanted)}."
                )
        self._source: Source | None = None
        self._subtask = ""
        self._walk: _Walk | None = None
        self._left: list[Segment] = []

    @property
    def persists(self) -> bool:
        """Return True if the demonstration continues after its success."""
        return self._chosen().keeps_time

    @property
    def source(self) -> str:
        """Return the sha256 of the file of the episode's demonstration."""
        return self._chosen().digest

    def action(self) -> NDArray[np.float32]:
        """Return the next action, (7,) in [-1, 1]."""
        source = self._chosen()
        subtask = self.env.subtask.name
        if subtask != self._subtask:
            self._subtask = subtask
            self._left = list(source.segments[subtask])
            self._walk = None
        world = WorldState(self.env)
        if self._walk is None or (self._walk.done and self._left):
            self._walk = _Walk(self._left.pop(0), world, self._moment(source), source.keeps_time)
        return action_towards(world, self._walk.next(world))

    def _moment(self, source: Source) -> Moment:
        """Return where the objects are now."""
        env = self.env
        return moment_of(env, env.subtask.arm, env.subtask.name, source.keeps_time)

    def _chosen(self) -> Source:
        """Return the episode's demonstration, chosen when it is first requested."""
        if self._source is None:
            if self._choice == RANDOM:
                rng = self.env.np_random.spawn(1)[0]
                self._source = self._sources[int(rng.integers(len(self._sources)))]
            else:
                step = StepSize.of(self.env.config.step)
                away = [_away(one.start, self._moment(one), step) for one in self._sources]
                self._source = self._sources[int(np.argmin(away))]
        return self._source


class _Walk:
    """The walk along one re-posed piece, preceded by the straight path to it."""

    def __init__(self, segment: Segment, world: WorldState, moment: Moment, keeps_time: bool):
        self._segment = segment
        self._frame = None if segment.body is None else segment.body(moment)
        self._keeps_time = keeps_time
        path = segment.reposed(moment)
        way = np.abs(command_error(world, self._tool(world, path[0]))).max()
        now = world.command if self._frame is None else world.commanded_needle @ self._frame
        before = math.ceil(float(way) - STILL)
        line = [_between(now, path[0], index / before) for index in range(before)]
        self._path = np.array([*line, *path])
        self._jaw = np.concatenate([np.full(before, segment.jaw[0]), segment.jaw])
        self._step = np.concatenate([np.full(before, -1), segment.step])
        self._at = 0.0
        self._last = np.eye(4)

    @property
    def done(self) -> bool:
        """Return True once the last pose was the target."""
        return self._at >= len(self._path) - 1

    def next(self, world: WorldState) -> ToolTarget:
        """Advance as far as one action can follow and return where the tool should be."""
        if self._keeps_time and self._is_still():
            self._wait(world.task_state.steps)
        else:
            ahead = min(math.floor(self._at) + 1.0, len(self._path) - 1.0)
            way = self._way(world, ahead)
            refused = np.array_equal(world.command, self._last)
            share = 1.0 if refused or way <= 1.0 else 1.0 / way
            self._at += share * (ahead - self._at)
            if share == 1.0 and not self._segment.keeps_pauses:
                self._at = self._hurried(world)
        self._last = world.command
        return ToolTarget(self._tool(world, self._pose(self._at)), self._jaw_at(self._at))

    def _hurried(self, world: WorldState) -> float:
        """Return the furthest sample that one action reaches, which speeds up slow motions."""
        at = self._at
        while at + 1.0 <= len(self._path) - 1.0 and self._way(world, at + 1.0) <= 1.0:
            at += 1.0
        return at

    def _wait(self, step: int) -> None:
        """Lengthen or shorten a pause so that what follows happens at the demonstrated time."""
        index = int(self._at)
        while index + 1 < len(self._path) and self._is_pause(index) and self._step[index] <= step:
            index += 1
        self._at = float(index)

    def _is_still(self) -> bool:
        """Return True in a pause."""
        return self._at.is_integer() and self._is_pause(int(self._at))

    def _is_pause(self, index: int) -> bool:
        """Return True if the next sample is the same."""
        if index + 1 >= len(self._path) or self._step[index] < 0:
            return False
        return (
            float(np.abs(self._path[index + 1] - self._path[index]).max()) < STILL
            and abs(self._jaw[index + 1] - self._jaw[index]) < STILL
        )

    def _way(self, world: WorldState, at: float) -> float:
        """Return how many actions away a point of the path is."""
        move = np.abs(command_error(world, self._tool(world, self._pose(at)))).max()
        if self._frame is not None:
            return float(move)
        return max(float(move), abs(self._jaw_at(at) - world.command_jaw) / world.step.jaw)

    def _tool(self, world: WorldState, body: Array) -> Array:
        """Return the T_world_tip that brings the moving body to T_world_body."""
        if self._frame is None:
            return body
        return world.tip_for_needle(body @ np.linalg.inv(self._frame))

    def _pose(self, at: float) -> Array:
        """Return T_world_body at a point of the path."""
        index = min(int(at), len(self._path) - 1)
        share = at - index
        if share == 0.0:
            pose: Array = self._path[index]
            return pose
        return _between(self._path[index], self._path[index + 1], share)

    def _jaw_at(self, at: float) -> float:
        """Return the jaw angle at a point of the path [rad]; closed where the needle is held."""
        if self._frame is not None:
            return 0.0
        return float(np.interp(at, np.arange(len(self._jaw)), self._jaw))


def _between(first: Array, last: Array, share: float) -> Array:
    """Return the pose (4, 4) at a share of the straight path from one pose to another."""
    pose = np.eye(4)
    turn = matrix_to_rotvec(last[:3, :3] @ first[:3, :3].T)
    pose[:3, :3] = rotvec_to_matrix(share * turn) @ first[:3, :3]
    pose[:3, 3] = (1.0 - share) * first[:3, 3] + share * last[:3, 3]
    return pose


def _away(one: Moment, other: Moment, step: StepSize) -> float:
    """Return how much two starts differ from the tool's viewpoint, in step sizes.

    The comparison is between the poses of the needle's grasp and of the entry in the tool's frame.
    """
    total = 0.0
    for first, second in zip(_seen(one), _seen(other), strict=True):
        shift = np.linalg.norm(first[:3, 3] - second[:3, 3]) / step.translation
        turn = np.linalg.norm(matrix_to_rotvec(first[:3, :3] @ second[:3, :3].T)) / step.rotation
        total += float(shift + turn)
    return total


def _seen(moment: Moment) -> tuple[Array, Array]:
    """Return T_tip_grasp of the grasp on the needle and T_tip_entry (4, 4)."""
    from_world = np.linalg.inv(moment.tip)
    return from_world @ grasp_of(moment), from_world @ moment.stitch.place()
