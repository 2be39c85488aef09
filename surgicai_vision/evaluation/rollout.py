"""Evaluation: an agent × a task × start seeds → one row per episode.

Episodes run in lock step in `batch` slots, so that an encoder sees many frames at once; a slot
whose episode ends takes the next seed. Seeds are distributed over spawned processes. The result
depends on neither: every episode has its own state and random numbers, and encoders and policies
give a row the same answer in any batch.

An episode ends at success, at the task's step limit, or at an error (diverged physics, a start that
cannot be made, an action that is not finite). An error is a failure, counted in `errors` as well.
"""

import functools
import os
from collections.abc import Callable, Sequence

from surgicai_vision.core import processes
from surgicai_vision.core.config import LARGEST_INTEGER, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.progress import Progress
from surgicai_vision.envs.upset import check_upset_task
from surgicai_vision.evaluation.agent import MakeAgent
from surgicai_vision.evaluation.films import Filming
from surgicai_vision.evaluation.finished import FinishedEpisodes
from surgicai_vision.evaluation.slot import Episode, Slot

BATCH = 8
"""Slots per process, whose images an encoder computes at once (`encoders.base`)."""


def check_seeds(seeds: Sequence[int]) -> None:
    """Refuse start seeds from which no rows can be made, before any work.

    Raises:
        InputError: no seeds, repeated seeds, or one that is too large or negative.
    """
    # A range is ordered, and may be far too long to iterate over.
    ends = (seeds[0], seeds[-1]) if isinstance(seeds, range) and seeds else seeds
    if any(not 0 <= seed <= LARGEST_INTEGER for seed in ends):
        raise InputError(
            f"Start seeds range from {min(ends)} to {max(ends)}; allowed: 0 to {LARGEST_INTEGER}. "
            "Give another --seed, or fewer episodes."
        )
    if not seeds or len(set(seeds)) != len(seeds):
        raise InputError(
            f"{len(seeds)} start seeds, {len(set(seeds))} of them different; give each once."
        )


def evaluate(
    make_agent: MakeAgent,
    task_config: TaskConfig,
    seeds: Sequence[int],
    batch: int = BATCH,
    workers: int | None = None,
    progress: Progress | None = None,
    filming: Filming | None = None,
    upset: bool = False,
    finished: FinishedEpisodes | None = None,
) -> list[Episode]:
    """Run one episode for each seed and return them in the order of `seeds`.

    Args:
        make_agent: makes the agent, once in each process.
        task_config: the task.
        seeds: start states, each once.
        batch: slots per process, at least 1.
        workers: processes; None takes one per 4 seeds, but no more than there are cores.
        progress: called as progress(steps done, most steps there can be).
        filming: which episodes become videos, written by the process that ran them; None films
            nothing.
        upset: let one thing go wrong in every episode (`envs.upset`), drawn from its seed.
        finished: keeps each episode as it ends, and has those that need not run again; None keeps
            none.

    Raises:
        InputError: seeds that `check_seeds` refuses, numbers below 1, or upsets in a task that has
            none.
    """
    if upset:
        check_upset_task(task_config.task)
    check_seeds(seeds)
    if batch < 1 or (workers is not None and workers < 1):
        raise InputError(f"batch is {batch} and workers {workers}; both must be at least 1.")
    kept = finished.read(seeds) if finished else {}
    left = [seed for seed in seeds if seed not in kept]
    count = workers or min(len(os.sched_getaffinity(0)), -(-len(left) // 4))
    shares = [left[index::count] for index in range(min(count, len(left)))]
    total = len(seeds) * task_config.max_steps
    if filming is not None:
        filming = filming.begun(seeds, kept)

    def report(done: int) -> None:
        if progress:
            progress(len(kept) * task_config.max_steps + done, total)

    jobs = [
        functools.partial(
            run_share,
            make_agent,
            task_config,
            share,
            batch,
            filming=filming,
            upset=upset,
            finished=finished,
        )
        for share in shares
    ]
    results = [job(report=report) for job in jobs] if len(jobs) < 2 else _in_processes(jobs, report)
    report(len(left) * task_config.max_steps)
    by_seed = kept | {episode.row.seed: episode for share in results for episode in share}
    episodes = [by_seed[seed] for seed in seeds]
    if filming is not None:
        filming.finish(episodes)
    return episodes


def run_share(
    make_agent: MakeAgent,
    task_config: TaskConfig,
    seeds: Sequence[int],
    batch: int,
    report: Callable[[int], None],
    filming: Filming | None = None,
    upset: bool = False,
    finished: FinishedEpisodes | None = None,
) -> list[Episode]:
    """Run the episodes of one process.

    `report` is called with the steps done; a finished episode counts as its full step limit.
    """
    agent = make_agent()
    slots = [
        Slot(index, agent, task_config, upset=upset) for index in range(min(batch, len(seeds)))
    ]
    waiting, ended = list(seeds)[::-1], []
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
                ended.append(slot.take())
                if filming is not None:
                    filming.film(task_config, ended[-1].row, slot.states, slot.moments)
                if finished is not None:
                    finished.keep(ended[-1])
                if waiting:
                    slot.begin(waiting.pop())
        report(
            len(ended) * task_config.max_steps
            + sum(slot.steps for slot in slots if slot.seed is not None)
        )
    for slot in slots:
        slot.env.close()
    return ended


def _in_processes(
    shares: Sequence[Callable[..., list[Episode]]], report: Callable[[int], None]
) -> list[list[Episode]]:
    """Run each share in its own process."""
    return processes.run_all(
        shares,
        "the evaluation",
        lambda done: report(sum(done)),
        {"LP_NUM_THREADS": "0"},  # the agents keep torch to one thread
    )
