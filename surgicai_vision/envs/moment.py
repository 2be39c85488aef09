"""Moment: what videos and pages show about one control step."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from surgicai_vision.envs.success import Info

if TYPE_CHECKING:
    from surgicai_vision.envs.base import SuturingEnv
    from surgicai_vision.envs.episode_monitor import EpisodeMonitor


@dataclass(frozen=True)
class Moment:
    """What is measured when a control step has ended.

    Attributes:
        step: control steps taken so far; 0 at the start.
        subtask: the present subtask.
        arm: its active arm.
        distance: from the goal [m].
        angle: from the goal [rad].
        contact: both pads of the active jaws touch the needle.
        force: net force of needle and instruments on the tissue [N] (`EpisodeMonitor.force`).
        stages: subtasks of the whole procedure that have succeeded so far, in their order.
        success: the task has succeeded.
    """

    step: int
    subtask: str
    arm: str
    distance: float
    angle: float
    contact: bool
    force: float
    stages: int
    success: bool


def present_moment(env: "SuturingEnv", info: Info, monitor: "EpisodeMonitor", step: int) -> Moment:
    """Return what is measured now.

    Args:
        env: the env.
        info: info of its last reset or step.
        monitor: a monitor that has seen both.
        step: control steps taken so far.
    """
    subtask = env.subtask
    return Moment(
        step=step,
        subtask=subtask.name,
        arm=subtask.arm,
        distance=float(info["d_trans"]),
        angle=float(info["d_angle"]),
        contact=bool(info["contact"]),
        force=monitor.force,
        stages=int(info.get("progress", 0)),
        success=bool(info["is_success"]),
    )
