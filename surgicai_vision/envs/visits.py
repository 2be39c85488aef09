"""Visits: when each subtask of a whole procedure was begun, met and left.

A `VisitWatch` only reads, and never informs whoever acts: it measures whether ends were correct. A
*visit* is a run of control steps with one active subtask. It is left when another subtask becomes
active, which is decided by whoever acts, or by the env (`TaskConfig.advance`). A visit left for a
later subtask was *ended*: too late by its `delay`, or falsely, before its success was measured. A
visit left for an earlier one was broken off, which is not an end.

The success of a visit is the paper's own, by any target that suffices for what follows
(`envs.success.judge`): for a grasp, at any angle in the range that goals are drawn from.
"""

from dataclasses import dataclass

from surgicai_vision.core import names
from surgicai_vision.envs.success import Info
from surgicai_vision.envs.suture import Suture

LAST = -1
"""`following` of the visit with which an episode ended."""


@dataclass(frozen=True)
class Visit:
    """One visit to a subtask; times are control steps since the episode's start.

    Attributes:
        subtask: index in `names.SUBTASKS`.
        began: when it began.
        left: when it was left, or the episode ended.
        following: the subtask that became active next; `LAST` if the episode ended.
        met: when the subtask's success was first measured in this visit; None if it was not.
        was_met: whether it had been met in an earlier visit and no needle was dropped since.
    """

    subtask: int
    began: int
    left: int
    following: int
    met: int | None
    was_met: bool

    @property
    def is_end(self) -> bool:
        """Return True if a later subtask followed."""
        return self.following > self.subtask

    @property
    def is_false_end(self) -> bool:
        """Return True if it was ended without its success."""
        return self.is_end and self.met is None and not self.was_met

    @property
    def delay(self) -> float | None:
        """Return how long after its success it was ended [s]; None without success or end."""
        if self.met is None or not self.is_end:
            return None
        return (self.left - self.met) / names.FPS


class VisitWatch:
    """The visits of the present episode of `env`; see the module's docstring.

    Args:
        env: the env to read; call `begin` after each of its resets, `update` after each step.
    """

    def __init__(self, env: Suture):
        self._env = env
        self.begin()

    def begin(self) -> None:
        """Begin an episode; the env has just been reset."""
        self._left: list[Visit] = []
        self._fulfilled: set[int] = set()
        self._subtask = self._env.phase
        self._began = 0
        self._steps = 0
        self._met: int | None = None

    def update(self, info: Info) -> None:
        """Read the state that a step ended in; `info` is that step's."""
        # The subtask in which the step was taken: the env may have advanced at its end.
        if info["phase"] != self._subtask:
            self._left.append(self._visit(info["phase"]))
            self._enter(info["phase"])
        self._steps = self._env.simulation.task_state.steps
        if self._met is None and self._env.judge(self._subtask).paper:
            self._met = self._steps

    def visits(self) -> tuple[Visit, ...]:
        """Return the episode's visits so far, the present one last."""
        return (*self._left, self._visit(LAST))

    def _visit(self, following: int) -> Visit:
        """Return the present visit as one that is left for another subtask."""
        was_met = self._subtask in self._fulfilled
        return Visit(self._subtask, self._began, self._steps, following, self._met, was_met)

    def _enter(self, subtask: int) -> None:
        """Begin a visit; the needle is where the last one left it."""
        if self._met is not None:
            self._fulfilled.add(self._subtask)
        simulation = self._env.simulation
        if not any(simulation.holds(arm) for arm in names.ARMS):
            self._fulfilled.clear()
        self._subtask = subtask
        self._began = self._steps
        self._met = None
