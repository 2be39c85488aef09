"""Try to break the physics with random actions, over all subtasks.

    python benchmarks/random_actions.py --episodes 10000
    python benchmarks/random_actions.py --episodes 1000 --hold 25 --thread 10
    python benchmarks/random_actions.py --tissue soft --mid-insertion 0.5 --out /tmp/random.jsonl

Each episode takes up to 200 steps of uniform random actions, each held for `--hold` steps (long
holds drive the tools to the limits of their reach and into everything). Counts the episodes that
ended as `physics_error`, the episodes in which MuJoCo warned of divergence but no error was
reported, and the observations that are not finite.

`--mid-insertion SHARE` of the episodes begin with the needle in the tissue, in equal parts at
starts of `handoff`, at starts of `pullout`, and half-way through `insert`: the expert drives until
the tip is through the entry, and up to `DEEPER` steps more. The others are shared among all five
subtasks. With `--out`, an interrupted run continues where it stopped.
"""

import argparse
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from common import chunks, emit, spread_resumable

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig, TaskConfig, to_mapping
from surgicai_vision.core.errors import SurgicaiError
from surgicai_vision.core.files import code_version
from surgicai_vision.demos.expert import Expert

STEPS = 200
DEEPER = 40
"""Most steps that the expert continues once the tip is in the tissue: half of an insertion."""
INSIDE = ("insert", "handoff", "pullout")
"""Subtasks of the episodes that begin in the tissue."""
DIVERGED = tuple(
    int(kind)
    for kind in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
)

KEYS = (
    "episodes",
    "mid_insertion",
    "steps",
    "physics_errors",
    "physics_errors_mid_insertion",
    "divergence_unreported",
    "observations_not_finite",
    "errors_as_success",
    "successes",
    "no_start",
)


class Job(NamedTuple):
    """Some episodes of one task, from its starts or from within the tissue, under one code."""

    config: TaskConfig
    seeds: range
    hold: int
    inside: bool
    code: str


def play(job: Job) -> dict[str, Any]:
    """Play the job's episodes and count; the seeds that diverged are listed."""
    env = envs.make(job.config)
    counts = Counter[str]()
    diverged = []
    for seed in job.seeds:
        found = _episode(env, seed, job)
        counts.update(found)
        if found["physics_errors"]:
            diverged.append(seed)
    return {"counts": counts, "diverged": diverged}


def _episode(env: envs.SuturingEnv, seed: int, job: Job) -> Counter[str]:
    rng = np.random.default_rng(seed)
    counts = Counter(episodes=1, mid_insertion=int(job.inside))
    try:
        env.reset(seed=seed)
        if job.inside and env.task == "insert":
            _drive_in(env, int(rng.integers(DEEPER + 1)))
    except SurgicaiError:
        counts["no_start"] += 1
        return counts
    action = np.zeros(7, np.float32)
    info: dict[str, Any] = {}
    for step in range(STEPS):
        if step % job.hold == 0:
            action = rng.uniform(-1, 1, 7).astype(np.float32)
        observation, reward, terminated, _, info = env.step(action)
        counts["steps"] += 1
        counts["observations_not_finite"] += int(
            not (np.isfinite(observation).all() and np.isfinite(reward))
        )
        if terminated:
            counts["physics_errors"] += int(info["physics_error"])
            counts["physics_errors_mid_insertion"] += int(info["physics_error"] and job.inside)
            counts["errors_as_success"] += int(info["physics_error"] and info["is_success"])
            counts["successes"] += int(info["is_success"])
            break
    warned = any(env.data.warning[kind].number for kind in DIVERGED)
    counts["divergence_unreported"] += int(warned and not info["physics_error"])
    return counts


def _drive_in(env: envs.SuturingEnv, deeper: int) -> None:
    """Let the expert drive the needle through the entry and `deeper` steps further."""
    expert = Expert(env)
    left = env.config.max_steps
    while left:
        left -= 1
        ended = env.step(expert.action())[2]
        if ended:
            return
        if env.simulation.task_state.holes_passed:
            left = min(left, deeper)


def jobs_of(chosen: argparse.Namespace) -> list[Job]:
    """Return a command line's jobs: episodes from starts, then those from within the tissue."""
    scene = SceneConfig(thread=chosen.thread, tissue=chosen.tissue)
    inside = round(chosen.episodes * chosen.mid_insertion)
    jobs = []
    for tasks, episodes, half_way in (
        (names.SUBTASKS, chosen.episodes - inside, False),
        (INSIDE, inside, True),
    ):
        for task in tasks if episodes else ():
            config = TaskConfig(task, scene, max_steps=STEPS)
            jobs += [
                Job(config, seeds, chosen.hold, half_way, code_version())
                for seeds in chunks(chosen.seed, -(-episodes // len(tasks)))
            ]
    return jobs


def main() -> None:
    """Play and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--episodes", type=int, default=10_000, help="episodes in all, shared among the subtasks"
    )
    parser.add_argument("--seed", type=int, default=names.TEST_SEED)
    parser.add_argument("--thread", type=int, default=0)
    parser.add_argument("--tissue", default=SceneConfig().tissue)
    parser.add_argument(
        "--mid-insertion", type=float, default=0.0, help="share of episodes begun in the tissue"
    )
    parser.add_argument("--hold", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, help="file of finished jobs to continue from")
    chosen = parser.parse_args()
    if not 0.0 <= chosen.mid_insertion <= 1.0:
        parser.error(f"--mid-insertion is {chosen.mid_insertion}; allowed: 0 to 1.")
    jobs = jobs_of(chosen)
    rows = {task: Counter[str]() for task in names.SUBTASKS}
    diverged = []
    for job, part in zip(
        jobs, spread_resumable(play, jobs, chosen.workers, chosen.out), strict=True
    ):
        rows[job.config.task].update(part["counts"])
        diverged += [[job.config.task, seed, job.inside] for seed in part["diverged"]]
    tasks = {task: {key: count[key] for key in KEYS} for task, count in rows.items()}
    total = {key: sum(row[key] for row in tasks.values()) for key in KEYS}
    emit(
        "random_actions",
        {
            "seed": chosen.seed,
            "scene": to_mapping(jobs[0].config.scene),
            "hold": chosen.hold,
            **total,
            "diverged": diverged,
            "tasks": tasks,
        },
    )


if __name__ == "__main__":
    main()
