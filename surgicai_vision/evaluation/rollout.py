"""Evaluation: an agent × a task × start seeds → one row an episode.

Episodes run in lock step in `batch` slots, so that an encoder sees many frames at once; a slot
whose episode ends takes the next seed. Seeds are shared out over spawned processes. The result
depends on neither: every episode has its own state and random numbers, and encoders and policies
give a row the same answer in any batch.

An episode ends at success, at the task's step limit, or at an error (diverged physics, a start that
cannot be made, an action that is not finite). An error is a failure, counted in `errors` as well.
"""

import functools
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import processes
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, PhysicsError, SurgicaiError
from surgicai_vision.core.progress import Progress
from surgicai_vision.evaluation.agent import Agent, Env, MakeAgent, Observation
from surgicai_vision.evaluation.metrics import EpisodeMetrics, failure_kind

BATCH = 8
"""Slots of a process: what an encoder computes at once (`encoders.base`)."""

FILM_FRAMES = 10
"""States kept of each episode, evenly spaced from the first to the last."""


@dataclass(frozen=True)
class Film:
    """States of one episode: `steps` (k,) and `states` (k, n) for the env's `set_state_vector`."""

    steps: NDArray[np.int64]
    states: NDArray[np.float64]


@dataclass(frozen=True)
class Episode:
    """A row and the film of its episode."""

    row: EpisodeMetrics
    film: Film


def env_of(agent: Agent, config: TaskConfig) -> Env:
    """Make an env that shows what the agent sees."""
    from surgicai_vision import envs

    cameras = tuple(agent.cameras)
    return envs.make(
        config,
        obs_type="pixels_agent_pos" if cameras else "state",
        cameras=cameras,
        image_size=agent.image_size,
        depth=agent.depth,
    )


def evaluate(
    make_agent: MakeAgent,
    task_config: TaskConfig,
    seeds: Sequence[int],
    batch: int = BATCH,
    workers: int | None = None,
    progress: Progress | None = None,
) -> list[Episode]:
    """Run one episode for each seed and return them in the order of `seeds`.

    Args:
        make_agent: makes the agent, once in each process.
        task_config: the task.
        seeds: start states, each once.
        batch: slots of a process, at least 1.
        workers: processes; None takes one for each core and for each 4 seeds.
        progress: called as progress(steps done, steps at most).

    Raises:
        InputError: no seeds, repeated seeds, or numbers below 1.
    """
    if not seeds or len(set(seeds)) != len(seeds):
        raise InputError(
            f"{len(seeds)} start seeds, {len(set(seeds))} of them different; give each once."
        )
    if batch < 1 or (workers is not None and workers < 1):
        raise InputError(f"batch is {batch} and workers {workers}; both must be at least 1.")
    count = workers or min(len(os.sched_getaffinity(0)), -(-len(seeds) // 4))
    shares = [list(seeds[index::count]) for index in range(min(count, len(seeds)))]
    total = len(seeds) * task_config.max_steps
    jobs = [functools.partial(run_share, make_agent, task_config, share, batch) for share in shares]
    if len(jobs) == 1:
        results = [jobs[0](report=lambda done: progress(done, total) if progress else None)]
    else:
        results = _in_processes(jobs, progress, total)
        if progress:
            progress(total, total)
    by_seed = {episode.row.seed: episode for share in results for episode in share}
    return [by_seed[seed] for seed in seeds]


def run_share(
    make_agent: MakeAgent,
    task_config: TaskConfig,
    seeds: Sequence[int],
    batch: int,
    report: Callable[[int], None],
) -> list[Episode]:
    """Run the episodes of one process.

    `report` is told the steps done; a finished episode counts as all of its own.
    """
    agent = make_agent()
    slots = [_Slot(index, agent, task_config) for index in range(min(batch, len(seeds)))]
    waiting, finished = list(seeds)[::-1], []
    for slot in slots:
        slot.begin(waiting.pop())
    while running := [slot for slot in slots if slot.seed is not None]:
        live = [slot for slot in running if not slot.ended]
        if live:
            actions = agent.act(
                [slot.index for slot in live],
                [slot.env for slot in live],
                [slot.observation for slot in live],
            )
            for slot, action in zip(live, actions, strict=True):
                slot.step(action)
        for slot in running:
            if slot.ended:
                finished.append(slot.take())
                if waiting:
                    slot.begin(waiting.pop())
        report(
            len(finished) * task_config.max_steps
            + sum(slot.steps for slot in slots if slot.seed is not None)
        )
    for slot in slots:
        slot.env.close()
    return finished


@final
@dataclass
class _Slot:
    """One env and the episode that runs in it."""

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

    def __post_init__(self) -> None:
        from surgicai_vision.envs.episode_monitor import EpisodeMonitor

        self.env = env_of(self.agent, self.task_config)
        self.monitor = EpisodeMonitor(self.env)

    def begin(self, seed: int) -> None:
        """Start the episode of `seed`."""
        self.seed, self.steps, self.states = seed, 0, []
        self.ended = self.diverged = self.touched = False
        self.error = ""
        self.monitor.clear()
        try:
            self.observation, self.info = self.env.reset(seed=seed)
            self.touched = bool(self.info.get("contact"))
            self.monitor.reset()
            self.agent.reset(self.index, self.env, seed)
        except PhysicsError as error:
            self.info, self.ended, self.error = {}, True, str(error)
        self._keep()

    def step(self, action: NDArray[np.float32]) -> None:
        """Take one step."""
        if not np.isfinite(action).all():
            self.ended, self.error = True, "the policy's action is not finite"
            return
        try:
            self.observation, _, terminated, truncated, self.info = self.env.step(action)
        except PhysicsError as error:
            terminated, truncated, self.error, self.diverged = True, False, str(error), True
        else:
            self.monitor.update(self.info)
        if self.info.get("physics_error"):
            self.error, self.diverged = self.error or "the physics diverged", True
        self.steps += 1
        self.touched = self.touched or bool(self.info.get("contact"))
        self.ended = bool(
            terminated or truncated or self.error or self.steps >= self.task_config.max_steps
        )
        if not self.error:
            self._keep()

    def take(self) -> Episode:
        """Return the ended episode and free the slot."""
        assert self.seed is not None
        contact = bool(self.info.get("contact", False))
        success = bool(self.info.get("is_success", False)) and not self.error
        monitor = self.monitor
        bite = monitor.bite
        held = not self.error and monitor.is_held()
        failure = failure_kind(self.error, self.diverged, self.touched, bite.wrong_hole, held)
        row = EpisodeMetrics(
            task=self.task_config.task,
            policy=self.agent.name,
            seed=self.seed,
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
        )
        self.seed = None
        return Episode(row, self._film())

    def _keep(self) -> None:
        if not self.error:
            self.states.append(np.asarray(self.env.get_state(), dtype=np.float64))

    def _film(self) -> Film:
        if not self.states:
            return Film(np.zeros(0, np.int64), np.zeros((0, 0)))
        steps = np.unique(
            np.linspace(0, len(self.states) - 1, FILM_FRAMES).round().astype(np.int64)
        )
        return Film(steps, np.stack([self.states[step] for step in steps]))


def _in_processes(
    shares: Sequence[Callable[..., list[Episode]]], progress: Progress | None, total: int
) -> list[list[Episode]]:
    """Run shares in processes of their own."""
    try:
        return processes.run_all(
            shares,
            "the evaluation",
            lambda done: progress(sum(done), total) if progress else None,
            {"LP_NUM_THREADS": "0"},  # the agents keep torch to one thread
        )
    except processes.Died:
        raise SurgicaiError(
            "A process of the evaluation was killed (out of memory?); "
            "run it again with --workers 1."
        ) from None
