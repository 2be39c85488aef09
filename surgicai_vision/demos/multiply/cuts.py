"""Cuts: a demonstration read as poses, and cut into the pieces that are re-posed.

    source = read_source("demos/episode_000000.safetensors")
    source.segments["insert"]           # its pieces, in order; see `segments`

`CUTS` names the function that cuts each subtask's part. Pauses are left out where the tool moves
freely. A demonstrator that does not know the goal of a grasp
(`demonstrator.GOAL_FREE_DEMONSTRATORS`) makes attempts at given times: all of them are kept,
relative to the needle itself, with their times. Of any other demonstrator's attempts, only the last
is kept.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.files import sha256_file
from surgicai_vision.core.runs import runs_of
from surgicai_vision.demos.demonstrator import GOAL_FREE_DEMONSTRATORS
from surgicai_vision.demos.multiply.segments import (
    STILL,
    Frame,
    FreeSegment,
    Moment,
    Segment,
    Source,
    TissueSegment,
    at_end,
    at_entry,
    centre,
    grasp_of,
    grasped_point,
    lying_needle,
    moment_of,
    tip_of_needle,
    turn_knots,
)
from surgicai_vision.demos.stitch_path import (
    CLEARANCE,
    OUTSIDE,
    at_turns,
    deviation_from_path,
    turns_along,
)
from surgicai_vision.demos.store import Demo, read_demo
from surgicai_vision.envs import poses
from surgicai_vision.scene import needle

Array = NDArray[np.float64]

NAME = "multiply"
"""The demonstrator's name, as it is stored."""
NEAR = 0.015
"""Distance from a motion's goal at which the end that is copied begins [m]. It is more than the
expert's `HOVER` and less than the distance to anything else."""
NEAR_ENTRY = 0.004
"""The same before the entry, from a start that is at most 5.5 mm off [m]."""
LIFTED = 0.004
"""Height above its resting place from which a needle may travel [m] (the expert's `CLEAR`)."""
CLOSED = 0.1
"""A jaw commanded below this angle is closed [rad]: `control.SQUEEZE_BELOW`."""
OTHER_JAWS = 0.002
"""A grasp that ends further than this from the goal was made by jaws other than ours [m]; the
tolerances of grasp and handoff are 1 mm and 2 mm."""
JAW_STEP = 0.05
"""How far a jaw closes per step [rad], in every preset of `config.STEPS`."""


@dataclass(frozen=True)
class Track:
    """One subtask's part of a demonstration: n + 1 states, n steps.

    Attributes:
        moment: where the objects were in the first state.
        command: commanded T_world_tip of the active tool, (n + 1, 4, 4).
        jaw: its commanded jaw angle, (n + 1,) [rad].
        tip: its measured T_world_tip, (n + 1, 4, 4).
        needle: measured T_world_needle, (n + 1, 4, 4).
        step: control step of each state in its episode, (n + 1,).
    """

    moment: Moment
    command: Array
    jaw: Array
    tip: Array
    needle: Array
    step: NDArray[np.int64]

    @functools.cached_property
    def carried(self) -> Array:
        """Where the held needle would be if the tool were at its commanded pose, (n + 1, 4, 4)."""
        carried: Array = self.command @ np.linalg.inv(self.tip) @ self.needle
        return carried

    def at(self, index: int) -> Moment:
        """Return where the objects were in one state."""
        first = self.moment
        return Moment(
            first.arm, self.needle[index], self.tip[index], first.stitch, first.grasp_angle
        )


# -- reading a demonstration -----------------------------------------------------------------------


def read_source(path: str) -> Source:
    """Read a demonstration and cut it; once per process and content of the file.

    Raises:
        BadFile: the file is not a demonstration.
        InputError: it was multiplied itself, or was recorded in a scene that is compiled
            differently now.
    """
    return _read_source(path, sha256_file(Path(path)))


@functools.cache
def _read_source(path: str, sha256: str) -> Source:
    """Read and cut a demonstration whose file has this hash; see `read_source`."""
    demo = read_demo(Path(path))
    if demo.demonstrator == NAME:
        raise InputError(
            f"{path} is itself a multiplied demonstration; give the demonstrations that it "
            "was made from."
        )
    env = envs.make(demo.config)
    if env.scene.hash != demo.scene_hash:
        raise InputError(
            f"{path} was recorded in another scene (hash {demo.scene_hash[:12]}, now "
            f"{env.scene.hash[:12]}); record or import it again."
        )
    keeps_time = demo.demonstrator in GOAL_FREE_DEMONSTRATORS and demo.config.task == "grasp"
    segments: dict[str, tuple[Segment, ...]] = {}
    start: Moment | None = None
    for subtask, first, last in _runs(demo):
        track = _track(env, demo, subtask, first, last, keeps_time)
        start = start or track.moment
        segments[subtask] = CUTS[subtask](track, keeps_time)
    if start is None:
        raise InputError(
            f"{path} shows '{demo.config.task}', which has no pieces to re-pose; allowed: "
            f"{', '.join(names.TASKS)}."
        )
    return Source(sha256, keeps_time, start, MappingProxyType(segments))


def _runs(demo: Demo) -> list[tuple[str, int, int]]:
    """Return (subtask, first state, last state) of each run of control steps in one subtask."""
    return [
        (names.SUBTASKS[demo.phase[first]], first, last)
        for first, last in runs_of(demo.phase)
        if demo.phase[first] >= 0
    ]


def _track(
    env: envs.SuturingEnv, demo: Demo, subtask: str, first: int, last: int, keeps_time: bool
) -> Track:
    """Return the states `first` to `last` of a demonstration as poses."""
    arm = names.ACTIVE_ARM[subtask]
    simulation = env.simulation
    base = poses.square(simulation.bases[arm])
    commands = []
    jaws = []
    moments = []
    for state in demo.state[first : last + 1]:
        env.set_state_vector(state)
        command = simulation.commands[arm]
        commands.append(base @ poses.square(simulation.true_pose(arm, command)))
        jaws.append(command.jaw if command.jaw > STILL else 0.0)
        moments.append(moment_of(env, arm, subtask, keeps_time))
    return Track(
        moments[0],
        np.array(commands),
        np.array(jaws),
        np.array([moment.tip for moment in moments]),
        np.array([moment.needle for moment in moments]),
        np.arange(first, last + 1),
    )


# -- cutting it ------------------------------------------------------------------------------------


def _cut_grasp(track: Track, keeps_time: bool) -> tuple[Segment, ...]:
    """Cut the approach to a grasp: the last attempt, or all of them with their times."""
    closed = track.jaw < CLOSED
    opens = [_before_rise(track.jaw, at) for at in np.flatnonzero(closed[:-1] & ~closed[1:])]
    bounds = [0, *opens, len(closed) - 1]
    attempts = list(itertools.pairwise(bounds))
    segments: list[FreeSegment] = []
    for first, last in attempts if keeps_time else attempts[-1:]:
        begin = first if segments else _last_beyond(track.command, track.command[last], first, last)
        segments.append(_free(track, grasp_of, None, begin, last, keeps_time))
    return tuple(segments) if keeps_time else tuple(map(_with_our_jaws, segments))


def _before_rise(jaw: Array, index: int) -> int:
    """Return the first index from which a jaw (n,) [rad] only opens up to `index`."""
    while index and jaw[index - 1] < jaw[index]:
        index -= 1
    return index


def _with_our_jaws(grasp: FreeSegment) -> FreeSegment:
    """Return an approach to a grasp that ends where our jaws hold the needle, closed.

    SurgicAI's tip frame is `replay.LIFT` above the needle's plane at the goal, ours twice that.
    """
    miss = grasp.path[-1, :3, 3]
    path = grasp.path.copy()
    if float(np.linalg.norm(miss)) > OTHER_JAWS:
        path[:, :3, 3] -= miss
    closing = np.arange(grasp.jaw[-1], -JAW_STEP, -JAW_STEP)[1:]
    count = len(closing)
    return dataclasses.replace(
        grasp,
        path=np.concatenate([path, np.repeat(path[-1:], count, axis=0)]),
        jaw=np.concatenate([grasp.jaw, np.maximum(closing, 0.0)]),
        step=np.concatenate([grasp.step, grasp.step[-1] + 1 + np.arange(count)]),
    )


def _cut_place(track: Track, _: bool) -> tuple[Segment, ...]:
    """Cut the lift of the needle and the end of its path to the entry."""
    end = len(track.jaw) - 1
    height = track.carried[:, 2, 3] - track.carried[0, 2, 3]
    lifted = int(np.argmax(height > LIFTED)) if (height > LIFTED).any() else 0
    tips = track.carried @ tip_of_needle(track.moment)
    begin = _last_beyond(tips, at_entry(track.moment), lifted, end)
    lift = [_free(track, lying_needle, centre, 0, lifted)] if lifted else []
    return (*lift, _free(track, at_entry, tip_of_needle, begin, end))


def _cut_insert(track: Track, _: bool) -> tuple[Segment, ...]:
    """Cut the path into the entry and the path through the tissue."""
    end = len(track.jaw) - 1
    entry = track.moment.stitch.pair.entry
    tips = track.needle @ tip_of_needle(track.moment)
    depth = (tips[:, :3, 3] - np.asarray(entry.centre)) @ entry.rotation[:, 2]
    outside = np.flatnonzero(depth > OUTSIDE)
    entered = min(int(outside[-1]) + 1, end) if len(outside) else 0
    tissue = _tissue(track, entered, end)
    if not entered:
        return (tissue,)
    begin = _last_beyond(tips, at_entry(track.moment), 0, entered, NEAR_ENTRY)
    return (_free(track, at_entry, tip_of_needle, begin, entered), tissue)


def _cut_pullout(track: Track, _: bool) -> tuple[Segment, ...]:
    """Cut the path out of the tissue and the end of the path to the end point."""
    end = len(track.jaw) - 1
    stitch = track.moment.stitch
    line = np.column_stack([needle.polyline(13, stitch.radius, stitch.tip_angle), np.ones(13)])
    points = np.einsum("tij,pj->tpi", track.needle, line)[..., :3]
    leave = stitch.pair.exit
    beyond = ((points - np.asarray(leave.centre)) @ leave.rotation[:, 2]).min(axis=1) > 0.0
    left = int(np.argmax(beyond)) if beyond.any() else end
    ways = track.carried @ grasped_point(track.moment)
    begin = _last_beyond(ways, at_end(track.moment), left, end)
    return (_tissue(track, 0, left), _free(track, at_end, grasped_point, begin, end))


CUTS: Mapping[str, Callable[[Track, bool], tuple[Segment, ...]]] = MappingProxyType(
    {
        "grasp": _cut_grasp,
        "place": _cut_place,
        "insert": _cut_insert,
        "handoff": _cut_grasp,
        "pullout": _cut_pullout,
    }
)
"""Subtask → the function that cuts its part of a demonstration."""


def _last_beyond(path: Array, goal: Array, first: int, last: int, near: float = NEAR) -> int:
    """Return the index after the last one in [first, last] further than `near` [m] from a goal."""
    away = np.linalg.norm(path[first : last + 1, :3, 3] - goal[:3, 3], axis=1) > near
    beyond = np.flatnonzero(away)
    return min(first + int(beyond[-1]) + 1, last) if len(beyond) else first


def _free(
    track: Track, object_: Frame, body: Frame | None, first: int, last: int, pauses: bool = False
) -> FreeSegment:
    """Return the states `first` to `last` relative to an object, without pauses."""
    states = np.arange(first, last + 1)
    kept = states if pauses else np.compress(_moves(track, states), states)
    moment = track.at(first)
    path = track.command if body is None else track.carried @ body(moment)
    relative = np.linalg.inv(object_(moment)) @ path[kept]
    return FreeSegment(object_, body, relative, track.jaw[kept], track.step[kept], pauses)


def _moves(track: Track, kept: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which states' commands differ from the one before (the first always does), (n,)."""
    before = np.maximum(kept - 1, kept[0])
    change = np.abs(track.command[kept] - track.command[before]).max(axis=(1, 2))
    moves: NDArray[np.bool_] = change > STILL
    moves |= np.abs(track.jaw[kept] - track.jaw[before]) > STILL
    moves[0] = True
    return moves


def _tissue(track: Track, first: int, last: int) -> TissueSegment:
    """Return the states `first` to `last` relative to the path through the holes."""
    stitch = track.moment.stitch
    carried = track.carried[first : last + 1]
    turn = turns_along(stitch, carried)
    off = np.linalg.inv(at_turns(stitch, turn)) @ carried
    if deviation_from_path(stitch, track.needle[first : last + 1]) > CLEARANCE:
        off = np.broadcast_to(np.eye(4), carried.shape)
    return TissueSegment(
        np.maximum(turn, 0.0),
        off,
        turn_knots(stitch),
        track.jaw[first : last + 1],
        track.step[first : last + 1],
    )
