"""Slot: one env and the episode of an agent that runs in it.

`evaluation.rollout` runs several at once; `evaluation.watch` runs one for a person to watch. Both
take the same steps, so what a person watches is what an evaluation measures.

    slot = Slot(0, agent, config)
    slot.begin(seed)
    while not slot.ended:
        slot.step(agent.act([0], [slot.env], [slot.observation])[0])
    slot.states, slot.moments   # the whole episode so far, from the start on
    episode = slot.take()
"""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, PhysicsError
from surgicai_vision.envs.episode_monitor import EpisodeMonitor
from surgicai_vision.envs.moment import Moment, present_moment
from surgicai_vision.envs.suture import Suture
from surgicai_vision.envs.upset import Upset, plan_upset
from surgicai_vision.envs.visits import Visit, VisitWatch
from surgicai_vision.evaluation.agent import Agent, Env, Observation
from surgicai_vision.evaluation.metrics import EpisodeMetrics, failure_kind

FILM_FRAMES = 10
"""States kept of each episode, evenly spaced from the first to the last."""


@dataclass(frozen=True)
class Film:
    """States of one episode.

    Attributes:
        steps: control steps taken before each state, (k,).
        states: for the env's `set_state_vector`, (k, n).
    """

    steps: NDArray[np.int64]
    states: NDArray[np.float64]


@dataclass(frozen=True)
class Episode:
    """A row, the film of its episode, and the visits of a whole procedure."""

    row: EpisodeMetrics
    film: Film
    visits: tuple[Visit, ...] = ()


def env_of(agent: Agent, config: TaskConfig) -> Env:
    """Make an env that shows what the agent sees, and renders an image only when it is accessed."""
    return env_showing(
        config,
        agent.cameras,
        agent.image_size,
        aspect=agent.aspect,
        depth=agent.depth,
        action_mode=agent.action_mode,
    )


def env_showing(
    config: TaskConfig,
    cameras: Sequence[str],
    image_size: int,
    *,
    aspect: float = 1.0,
    depth: bool = False,
    action_mode: str = names.INCREMENTS,
) -> Env:
    """Make an env that shows these cameras, each image rendered only when it is accessed."""
    env = envs.make(
        config,
        obs_type="pixels_agent_pos" if cameras else "state",
        cameras=cameras,
        image_size=(image_size, round(image_size * aspect)),
        depth=depth,
        action_mode=action_mode,
    )
    if cameras:
        env.defer_images()
    return env


@final
@dataclass
class Slot:
    """One env and the episode that runs in it; see the module's docstring.

    Args:
        index: the slot's number, by which the agent tells its episodes apart.
        agent: what acts.
        task_config: the task.
        upset: let one thing go wrong in every episode (`envs.upset`).
    """

    index: int
    agent: Agent
    task_config: TaskConfig
    seed: int | None = None
    steps: int = 0
    ended: bool = False
    error: str = ""
    diverged: bool = False
    touched: bool = False
    observation: Observation = field(default_factory=lambda: np.zeros(0, np.float32))
    info: dict[str, Any] = field(default_factory=dict)
    states: list[NDArray[np.float64]] = field(default_factory=list)
    moments: list[Moment] = field(default_factory=list)
    upset: bool = False

    def __post_init__(self) -> None:
        if self.upset and self.agent.action_mode != names.INCREMENTS:
            raise InputError(
                f"{self.agent.name} gives set-points of both arms, which an upset cannot alter; "
                "leave --upset out."
            )
        self.env = env_of(self.agent, self.task_config)
        self._mishap = Upset(self.env, None)
        self._has_begun = False
        self.monitor = EpisodeMonitor(self.env)
        self.watch = VisitWatch(self.env) if isinstance(self.env, Suture) else None

    def begin(self, seed: int) -> None:
        """Start the episode of `seed`."""
        self.seed = seed
        self.steps = 0
        self.states = []
        self.moments = []
        self.ended = self.diverged = self.touched = False
        self.error = ""
        self._mishap = Upset(self.env, None)
        self._has_begun = False
        try:
            self.observation, self.info = self.env.reset(seed=seed)
            self.touched = bool(self.info.get("contact"))
            self.monitor.reset()
            if self.watch:
                self.watch.begin()
            self.agent.reset(self.index, self.env, seed)
        except PhysicsError as error:
            self.info, self.ended, self.error = {}, True, str(error)
            self.monitor.clear()
        else:
            self._has_begun = True
            plan = plan_upset(seed, self.task_config.task) if self.upset else None
            self._mishap = Upset(self.env, plan)
            self._let_happen()
        self._keep()

    def step(self, action: NDArray[np.float32]) -> None:
        """Take one step."""
        if not np.isfinite(action).all():
            self.ended, self.error = True, "the policy's action is not finite"
            return
        try:
            step = self.env.step(self._mishap.altered(action))
            self.observation, _, terminated, truncated, self.info = step
        except PhysicsError as error:
            terminated, truncated, self.error, self.diverged = True, False, str(error), True
        else:
            self.monitor.update(self.info)
            if self.watch:
                self.watch.update(self.info)
        if self.info.get("physics_error"):
            self.error, self.diverged = self.error or "the physics diverged", True
        # A step in which the physics diverged counts too, though the env does not count it.
        self.steps = max(self.steps + 1, self.env.simulation.task_state.steps)
        self.touched = self.touched or bool(self.info.get("contact"))
        self.ended = bool(
            terminated or truncated or self.error or self.steps >= self.task_config.max_steps
        )
        if not self.ended:
            self._let_happen()
        if not self.error:
            self._keep()

    def _let_happen(self) -> None:
        """Let an upset that is due happen, and observe again if it pushed the needle."""
        if self._mishap.before_step():
            self.observation = self.env.observe()

    def take(self) -> Episode:
        """Return the ended episode and free the slot."""
        assert self.seed is not None
        contact = bool(self.info.get("contact", False))
        success = bool(self.info.get("is_success", False)) and not self.error
        monitor = self.monitor
        bite = monitor.bite
        held = not self.error and monitor.is_held()
        # If the start could not be made, the watch still holds the episode before.
        watch = self.watch if self._has_begun else None
        visits = watch.visits() if watch else ()
        delays = [visit.delay for visit in visits if visit.delay is not None]
        failure = failure_kind(self.error, self.diverged, self.touched, bite.wrong_hole, held)
        row = EpisodeMetrics(
            task=self.task_config.task,
            policy=self.agent.name,
            seed=int(self.seed),
            success=success,
            steps=self.steps,
            trajectory_length_mm=1e3 * float(self.info.get("tip_path", 0.0)),
            d_trans_mm=1e3 * float(self.info.get("d_trans", np.nan)),
            d_angle_deg=float(np.degrees(self.info.get("d_angle", np.nan))),
            contact=contact,
            error=self.error,
            grasp=self.task_config.scene.grasp,
            failure="" if success else failure,
            stages=int(self.info.get("progress", success)),
            entry_mm=1e3 * bite.entry_error,
            exit_mm=1e3 * bite.exit_error,
            bite_depth_mm=1e3 * bite.depth,
            bite_length_mm=1e3 * bite.length,
            entry_deg=math.degrees(bite.entry_angle),
            exit_deg=math.degrees(bite.exit_angle),
            slip_mm=1e3 * monitor.slip,
            slip_deg=math.degrees(monitor.turn),
            tissue_force_n=monitor.tissue_force,
            tissue_impulse_ns=monitor.tissue_impulse,
            tears=monitor.tears,
            thread_mm=1e3 * monitor.thread_drawn,
            paper_success=monitor.paper_success and not self.error,
            upset=self._mishap.kind,
            upset_step=self._mishap.step,
            recovered=success and bool(self._mishap.kind),
            false_ends=float(sum(visit.is_false_end for visit in visits)) if watch else math.nan,
            end_delay_s=statistics.median(delays) if delays else math.nan,
        )
        self.seed = None
        return Episode(row, self._film(), visits)

    def _keep(self) -> None:
        if self.error:
            return
        self.states.append(np.asarray(self.env.get_state(), dtype=np.float64))
        moment = present_moment(self.env, self.info, self.monitor, self.steps)
        self.moments.append(moment)

    def _film(self) -> Film:
        if not self.states:
            return Film(np.zeros(0, np.int64), np.zeros((0, 0)))
        kept = np.unique(np.linspace(0, len(self.states) - 1, FILM_FRAMES).round().astype(np.int64))
        steps = np.array([self.moments[index].step for index in kept], np.int64)
        return Film(steps, np.stack([self.states[index] for index in kept]))
