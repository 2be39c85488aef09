"""Upset: one thing that goes wrong in an episode, once.

    upset = Upset(env, plan_upset(seed, task))   # after env.reset(seed=seed)
    upset.before_step()                          # may push the needle; if True, observe again
    action = upset.altered(action)               # may open the jaws
    env.step(action)

What can go wrong (`KINDS`):

* `push`: the needle, lying free before its grasp, moves by `PUSH` in a random direction and stays
  on the phantom;
* `drop`: PSM2's jaws open while they hold the needle, before its tip is in the tissue;
* `insertion`: PSM2's jaws open while the needle's tip is in the tissue;
* `handoff`: PSM1's jaws open as they close on the needle or just after they grasped it.

It happens `wait` control steps after it first can. `wait` is drawn from `WAITS`, so that the moment
is within the phase. An upset is not part of the env: opening jaws alter the executed actions, a
push sets the needle's pose by `Simulation.pose_needle`. So the scene, the state vector and
undisturbed episodes are the same as without it. What happens depends only on the episode's seed and
the env's state.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.envs import hole_crossing, poses
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.grasp import REACH, SPREAD_X
from surgicai_vision.scene import needle
from surgicai_vision.scene.phantom import ORIGIN, SIZE

JAW = names.ACTION_NAMES.index("jaw")
"""Index of the jaws in an action."""
UPSET_STREAM = 0x0B5E7
"""Separates an upset's random numbers from the start's and the noise's for the same seed."""
PUSH = 0.005
"""How far the needle is pushed [m] (issue 17)."""
DIRECTIONS = 16
"""Directions tried for a push that leaves the needle on the phantom, free of the arms."""
EDGE = 0.002
"""How far a pushed needle stays from the pad's edges [m]."""
NEAR = 0.006
"""Jaws that come this near to the needle [m] trigger a push that is still waiting."""
OPENING_STEPS = 6
"""Control steps for which jaws open: 0.3 rad at the paper's step size."""
CLOSING_JAW = 0.12
"""Jaws commanded below this angle [rad] are closing, or closed: the expert approaches with 0.18."""
CLOSING_RANGE = 0.004
"""Distance of PSM1's jaws from the point they are to grasp, below which they grasp it [m]."""

KINDS = ("push", "drop", "insertion", "handoff")
WAITS: Mapping[str, tuple[int, int]] = MappingProxyType(
    {"push": (0, 60), "drop": (0, 75), "insertion": (0, 45), "handoff": (0, 12)}
)
"""Kind → fewest and most control steps from when it can happen to when it does. The expert takes
54 to 95 steps to its grasp, 65 to 70 from there to the entry, and 45 to 50 through the tissue.
"""
TASK_KINDS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "grasp": ("push",),
        "place": ("drop",),
        "insert": ("insertion",),
        "handoff": ("handoff",),
        "pullout": ("handoff",),
        names.SUTURE: KINDS,
    }
)
"""Task → what can go wrong in it."""


@dataclass(frozen=True)
class UpsetPlan:
    """What is to go wrong.

    Attributes:
        kind: one of `KINDS`.
        wait: control steps from when it can happen to when it does.
        heading: direction of a push on the phantom [rad].
    """

    kind: str
    wait: int
    heading: float


def check_upset_task(task: str) -> None:
    """Raise `InputError` unless something can go wrong in a task."""
    if task not in TASK_KINDS:
        raise InputError(
            f"Task '{task}' has no upsets; tasks with upsets: {', '.join(TASK_KINDS)}."
        )


def plan_upset(seed: int, task: str, fraction: float = 1.0) -> UpsetPlan | None:
    """Draw the upset of one episode; None if it has none.

    Args:
        seed: of the episode's start.
        task: a key of `TASK_KINDS`.
        fraction: share of episodes that have one.

    Raises:
        InputError: a task in which nothing can go wrong.
    """
    check_upset_task(task)
    rng = np.random.default_rng([seed, UPSET_STREAM])
    if rng.random() >= fraction:
        return None
    kinds = TASK_KINDS[task]
    kind = kinds[int(rng.integers(len(kinds)))]
    # An episode of this subtask alone ends at its success, so the jaws open as they first close.
    wait = 0 if task == "handoff" else int(rng.integers(*WAITS[kind], endpoint=True))
    return UpsetPlan(kind, wait, float(rng.uniform(0.0, 2 * math.pi)))


@final
class Upset:
    """The upset of one episode; see the module's docstring.

    Args:
        env: the env, at its start state.
        plan: what is to happen; None lets nothing happen.

    Attributes:
        step: control steps taken when it happened, or -1.
    """

    def __init__(self, env: SuturingEnv, plan: UpsetPlan | None):
        self.step = -1
        self._env = env
        self._plan = plan
        self._waited = 0
        self._opening = 0

    @property
    def kind(self) -> str:
        """What happened, one of `KINDS`, or "" where nothing has."""
        return self._plan.kind if self._plan is not None and self.step >= 0 else ""

    def before_step(self) -> bool:
        """Let the upset happen if it is due; return True if the needle was pushed.

        Call this before every step of the env, and before the state is observed. A push that finds
        no room is tried again at the next step.
        """
        plan = self._plan
        if plan is None or self.step >= 0:
            return False
        is_possible, is_late = _POSSIBLE[plan.kind](self._env)
        if not is_possible:
            return False
        waited = self._waited
        self._waited += self._env.config.action_repeat
        if waited < plan.wait and not is_late:
            return False
        is_push = plan.kind == "push"
        if is_push and not _push(self._env, plan.heading):
            return False
        self._opening = 0 if is_push else OPENING_STEPS
        self.step = self._env.simulation.task_state.steps
        return is_push

    def altered(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what is executed instead of `action`, (7,): opening jaws, or `action` itself."""
        if not self._opening:
            return action
        self._opening = max(0, self._opening - self._env.config.action_repeat)
        opened = np.zeros_like(action)
        opened[JAW] = 1.0
        return opened


def _can_push(env: SuturingEnv) -> tuple[bool, bool]:
    """Return whether a needle lies free before its grasp, and whether jaws are about to take it."""
    arm = env.subtask.arm
    simulation = env.simulation
    if env.subtask.name != "grasp" or any(simulation.touching(arm)):
        return False, False
    goal = simulation.needle_point(simulation.task_state.grasp_angle)
    return True, math.dist(goal, poses.position(simulation.grasp(arm))) < NEAR


def _can_drop(env: SuturingEnv) -> tuple[bool, bool]:
    """Return whether PSM2 carries the needle before its tip is in the tissue."""
    simulation = env.simulation
    is_outside = simulation.task_state.holes_passed == 0
    is_carried = env.subtask.name in ("place", "insert") and simulation.holds(names.PSM2)
    return is_carried and is_outside, False


def _can_open_inserting(env: SuturingEnv) -> tuple[bool, bool]:
    """Return whether PSM2 holds the needle whose tip is in the tissue."""
    simulation = env.simulation
    is_inside = simulation.task_state.holes_passed in (1, 2)
    return is_inside and env.subtask.name == "insert" and simulation.holds(names.PSM2), False


def _can_open_handing(env: SuturingEnv) -> tuple[bool, bool]:
    """Return whether PSM1's jaws close on the needle, or hold it, in the tissue."""
    simulation = env.simulation
    if env.subtask.arm != names.PSM1 or simulation.task_state.holes_passed not in (1, 2):
        return False, False
    is_closing = simulation.commands[names.PSM1].jaw < CLOSING_JAW
    point = simulation.needle_point(env.stitch.handoff_angle)
    off = math.dist(point, poses.position(simulation.grasp(names.PSM1)))
    return is_closing and off < CLOSING_RANGE, False


_POSSIBLE = MappingProxyType(
    {
        "push": _can_push,
        "drop": _can_drop,
        "insertion": _can_open_inserting,
        "handoff": _can_open_handing,
    }
)
"""Kind → whether it can happen now, and whether it must because soon it no longer can."""


def _push(env: SuturingEnv, heading: float) -> bool:
    """Push the needle by `PUSH`; return False if no direction leaves it free on the phantom.

    Args:
        env: the env, whose needle lies free.
        heading: the first direction tried [rad]; others follow at equal angles.
    """
    simulation = env.simulation
    before = simulation.needle()
    x, y, z = poses.position(before)
    for turn in range(DIRECTIONS):
        angle = heading + 2 * math.pi * turn / DIRECTIONS
        shift_x = PUSH * math.cos(angle)
        shift_y = PUSH * math.sin(angle)
        simulation.pose_needle((x + shift_x, y + shift_y, z, *poses.rotation(before)))
        simulation.refresh()
        if _lies_free(env):
            hole_crossing.remember_tip(simulation, simulation.task_state)
            return True
    simulation.pose_needle(before)
    simulation.refresh()
    return False


def _lies_free(env: SuturingEnv) -> bool:
    """Return True if the needle lies on the bed of the phantom and touches no arm."""
    simulation = env.simulation
    if any(any(simulation.touching(arm)) for arm in names.ARMS):
        return False
    line = needle.polyline(13, simulation.radius, simulation.tip_angle)
    pose = np.linalg.inv(simulation.placement.T_world_bed) @ poses.square(simulation.needle())
    x, y = (pose[:3, :3] @ line.T + pose[:3, 3:4])[:2] - np.array(ORIGIN)[:, None]
    half_x, half_y = SIZE[0] / 2 - EDGE, SIZE[1] / 2 - EDGE
    foot = needle.HOME[0] + SPREAD_X + REACH - ORIGIN[0]
    return bool((x > -half_x).all() and (x < foot).all() and (np.abs(y) < half_y).all())
