"""Recovery expert: the expert of the whole procedure that notices a loss and goes back.

After every upset (`envs.upset`) it continues from where the needle then is:

| what went wrong | noticed by | goes back to |
|---|---|---|
| the needle slid or was pushed before its grasp | not needed: the grasp's rule follows it | – |
| PSM2 no longer holds it, placing or inserting | `LOST` control steps without both pads | grasp |
| PSM1 missed it, PSM2 or the tissue still holds it | not needed: the rule tries again | – |
| PSM1 no longer holds it, pulling, base in the tissue | `LOST` control steps | handoff |

It ends a grasp itself once the jaws have held the needle for `DWELL` control steps. Then it places
the needle, or continues inserting if the tip is already in the tissue. A grasp therefore needs no
goal: it is always in the middle of the range from which goals are drawn, since no image shows the
goal. A recording's phase decreases where the expert goes back.

With `late` it notices a loss that many control steps later, and until then acts as if the needle
were in its jaws. A high-level policy that learns from such a recording sees what an arm looks like
that has lost the needle and carries on (`training.visits` says from when on going back is due). A
low-level policy should not learn from it.

It gives up (`gives_up`) where no rule leads on: PSM2 cannot reach a needle that has come to rest
(on its face, on edge, behind the ridge), or a grasp takes `PATIENCE` steps. Everything else is
`Expert`'s, whose labels in an undisturbed procedure differ only in the grasp's goal.
"""

import math
from collections import deque
from typing import final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import DWELL
from surgicai_vision.demos.demonstrator import Demonstrator
from surgicai_vision.demos.disturbance import check_returning
from surgicai_vision.demos.expert import (
    HOVER,
    OPEN_ABOVE,
    OPEN_HANDOFF,
    Expert,
    Matrix,
    ToolTarget,
    WorldState,
    action_towards,
    angle_between,
    approach_and_grasp,
    on_path,
    turn_about_wound,
)
from surgicai_vision.envs import hole_crossing, poses
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.geometry import grasp_in_needle
from surgicai_vision.envs.reach import insertion, is_followed
from surgicai_vision.envs.starts import GRASP_ANGLES
from surgicai_vision.envs.suture import Suture
from surgicai_vision.scene.arm import GRASP_DEPTH
from surgicai_vision.scene.rotations import rotvec_to_matrix

GRASP, PLACE, INSERT, HANDOFF, PULLOUT = range(len(names.SUBTASKS))

LOST = 3
"""Control steps without both pads on the needle after which it is lost; contact flickers."""
STANDING = 0.0025
"""Jaws count as resting on the phantom if they are closer to their grasp than this [m], …"""
STILL = 0.0003
"""… and their distance from it has changed by less than this [m] …"""
STALLED = 12
"""… in this many control steps."""
ON_PATH = 0.002
"""A needle in the tissue that is off its path by less than this [m] …"""
ON_PATH_ANGLE = math.radians(15.0)
"""… and this [rad] is driven further, otherwise it is drawn out."""
FLAT = math.cos(math.radians(10.0))
"""Cosine of the lean up to which a needle counts as lying flat."""
UPRIGHT_SHARES = (1.0, 0.5, 0.0)
"""How far a tool is turned from the needle's normal towards the vertical, tried in this order."""
BESIDE = np.array([-5.0, 0.0, 5.0, 10.0])
"""Angles relative to the middle that are tried [deg]."""
MOVED = 0.002
"""The grasp is chosen anew for a needle that has moved further than this [m] …"""
MOVED_ANGLE = math.radians(8.0)
"""… or turned further than this [rad]."""
PATIENCE = 250
"""Control steps after which a grasp is given up; the expert takes 54 to 95."""


@final
class RecoveryExpert(Demonstrator):
    """The expert that goes back after the needle was lost; see the module's docstring.

    Args:
        env: an env of the whole procedure.

    Raises:
        InputError: an env of a single subtask, which has nothing to go back to, or one that does
            not advance to the next subtask at a success.
    """

    def __init__(self, env: SuturingEnv):
        check_returning("recover", env.config)
        if not isinstance(env, Suture):
            raise TypeError(f"the env of task '{env.task}' is no Suture")
        self._env = env
        self._expert = Expert(env)
        self._phase = -1
        # Of the present visit: its control steps, and those since the needle was taken or lost.
        self._steps = 0
        self._held = 0
        self._lost = 0
        # Of its grasp: the jaws' last distances from it [m], whether they close, its pose in the
        # needle (T_needle_tip), and the needle's pose when it was chosen (T_world_needle).
        self._distances: deque[float] = deque(maxlen=STALLED)
        self._closes = False
        self._hold: Matrix | None = None
        self._chosen_at = np.eye(4)

    @property
    def gives_up(self) -> str:
        """Return why no rule leads any further, or ""."""
        if self._steps > PATIENCE:
            return f"no progress beyond {names.SUBTASKS[self._env.phase]} in {PATIENCE} steps"
        if self._env.phase == PULLOUT and self._env.simulation.task_state.holes_passed < 2:
            return "the needle slid back out of the exit in the pull-out"
        return ""

    def action(self) -> NDArray[np.float32]:
        """Go back or on if that is due; return the next action, (7,) in [-1, 1]."""
        self._watch()
        phase = self._due()
        if phase != self._env.phase:
            self._env.enter(phase)
            self._begin()
        if phase != GRASP:
            return self._expert.label()
        world = WorldState(self._env)
        return action_towards(world, self._grasp(world))

    def _watch(self) -> None:
        """Count the steps of the present visit, and how long the needle has been held or not."""
        if self._env.phase != self._phase:
            self._begin()
        self._steps += 1
        if self._env.simulation.holds(self._env.subtask.arm):
            self._held += 1
            self._lost = 0
        else:
            self._held = 0
            self._lost += 1

    def _begin(self) -> None:
        """Begin a visit of the present phase."""
        self._phase = self._env.phase
        self._steps = 0
        self._held = 0
        self._lost = 0
        self._distances.clear()
        self._closes = False
        self._hold = None

    def _due(self) -> int:
        """Return the phase that is due."""
        phase = self._env.phase
        passed = self._env.simulation.task_state.holes_passed
        is_inside = 0 < passed < hole_crossing.OUT
        if phase == GRASP and self._held >= DWELL:
            return INSERT if is_inside and self._is_on_path() else PLACE
        is_lost = self._lost >= LOST + self.late
        if phase in (PLACE, INSERT) and is_lost:
            return GRASP
        if phase == HANDOFF and passed < 2 and not self._env.simulation.holds(names.PSM2):
            return GRASP
        if phase == PULLOUT and is_lost and passed == 2:
            return HANDOFF
        return phase

    def _is_on_path(self) -> bool:
        """Return True if the needle is close enough to the stitch's path to be driven further."""
        stitch = self._env.stitch
        now = poses.square(self._env.simulation.needle())
        turned = turn_about_wound(stitch.place(), now)
        path = on_path(stitch, max(turned, 0.0))
        near = float(np.linalg.norm(now[:3, 3] - path[:3, 3])) < ON_PATH
        return near and angle_between(now, path) < ON_PATH_ANGLE

    def _grasp(self, world: WorldState) -> ToolTarget:
        """Grasp the needle in the middle of the range of goals.

        Jaws that come no closer, because they rest on the phantom, close where they are.
        """
        if self._hold is None or _has_moved(self._chosen_at, world.needle):
            self._hold = choose_grasp(world)
            self._chosen_at = world.needle.copy()
            self._closes = False
        goal = world.needle @ self._hold
        distance = float(np.linalg.norm(world.tip[:3, 3] - goal[:3, 3]))
        self._distances.append(distance)
        change = max(self._distances) - min(self._distances)
        stands = len(self._distances) == STALLED and change < STILL
        self._closes = distance < STANDING and (self._closes or stands)
        if self._closes:
            return ToolTarget(world.command, 0.0)
        is_flat = float(world.needle[2, 2]) > FLAT
        return approach_and_grasp(world, goal, HOVER, OPEN_ABOVE if is_flat else OPEN_HANDOFF)


def choose_grasp(world: WorldState) -> Matrix:
    """Return T_needle_tip (4, 4) of a grasp that leads to the stitch from where the needle lies.

    If the needle lies flat, that is the expert's own. A needle that leans is grasped by a tool
    closer to the vertical, turned about the grasped point, so that its fingers clear the phantom.
    The first such grasp that can be followed all the way is taken, or else the expert's own.
    """
    stitch = world.stitch
    middle = sum(stitch.grasps(*GRASP_ANGLES)) / 2
    own = grasp_in_needle(world.arm, middle, radius=stitch.radius)
    if float(world.needle[2, 2]) > FLAT:
        return own
    for share in UPRIGHT_SHARES:
        for angle in middle + np.radians(BESIDE):
            grasp = turned_upright(world.needle, world.arm, float(angle), stitch.radius, share)
            tip = world.needle @ grasp
            way = [_above(tip), tip, *insertion(stitch, grasp)]
            if is_followed(world.arm, way, world.instrument):
                return grasp
    return own


def turned_upright(
    needle_pose: Matrix, arm: str, angle: float, radius: float, share: float
) -> Matrix:
    """Return T_needle_tip (4, 4) of a grasp whose tool is turned towards the vertical.

    Args:
        needle_pose: T_world_needle (4, 4).
        arm: the grasping arm.
        angle: angle of the grasped point [rad].
        radius: radius of the needle's arc [m].
        share: 0 for a tool along the needle's normal, 1 for one that points down.
    """
    grasp = grasp_in_needle(arm, angle, radius=radius)
    axis = needle_pose[:3, :3] @ grasp[:3, 2]
    down = np.array([0.0, 0.0, -1.0])
    across = np.cross(axis, down)
    size = float(np.linalg.norm(across))
    if size < 1e-9:  # it already points down, or up
        return grasp
    lean = math.atan2(size, float(axis @ down))
    turn_in_world = rotvec_to_matrix(share * lean * across / size)
    turn = needle_pose[:3, :3].T @ turn_in_world @ needle_pose[:3, :3]
    point = grasp[:3, 3] + GRASP_DEPTH * grasp[:3, 2]
    turned = np.eye(4)
    turned[:3, :3] = turn @ grasp[:3, :3]
    turned[:3, 3] = point - GRASP_DEPTH * turned[:3, 2]
    return turned


def _above(tip: Matrix) -> Matrix:
    """Return where the tool lines up before a grasp, T_world_tip (4, 4)."""
    above = tip.copy()
    above[:3, 3] -= HOVER * tip[:3, 2]
    return above


def _has_moved(then: Matrix, now: Matrix) -> bool:
    """Return True if the needle's pose, T_world_needle, has moved or turned too far."""
    moved = float(np.linalg.norm(then[:3, 3] - now[:3, 3]))
    return moved > MOVED or angle_between(then, now) > MOVED_ANGLE
