"""Try to break the physics with random actions, over all subtasks.

    python benchmarks/random_actions.py --episodes 10000
    python benchmarks/random_actions.py --episodes 1000 --hold 25 --thread 10

Each episode takes up to 200 steps of uniform random actions, each kept for `--hold` steps (long
holds drive the tools to the ends of their reach and into everything). Counted are episodes that
ended as `physics_error`, episodes in which MuJoCo warned of divergence and no error was reported,
and observations that are not finite.
"""

import argparse
from collections import Counter
from typing import NamedTuple

import mujoco
import numpy as np
from common import chunks, emit, spread

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig, TaskConfig

STEPS = 200
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
    "steps",
    "physics_errors",
    "divergence_unreported",
    "observations_not_finite",
    "errors_as_success",
    "successes",
)


class Job(NamedTuple):
    """Some episodes of one task."""

    config: TaskConfig
    seeds: range
    hold: int


def play(job: Job) -> Counter[str]:
    """Play the job's episodes and count."""
    env = envs.make(job.config)
    counts = Counter[str]()
    for seed in job.seeds:
        counts.update(_episode(env, seed, job.hold))
    return counts


def _episode(env: envs.SuturingEnv, seed: int, hold: int) -> Counter[str]:
    rng = np.random.default_rng(seed)
    counts = Counter(episodes=1)
    env.reset(seed=seed)
    action = np.zeros(7, np.float32)
    for step in range(STEPS):
        if step % hold == 0:
            action = rng.uniform(-1, 1, 7).astype(np.float32)
        observation, reward, terminated, _, info = env.step(action)
        counts["steps"] += 1
        counts["observations_not_finite"] += int(
            not (np.isfinite(observation).all() and np.isfinite(reward))
        )
        if terminated:
            counts["physics_errors"] += int(info["physics_error"])
            counts["errors_as_success"] += int(info["physics_error"] and info["is_success"])
            counts["successes"] += int(info["is_success"])
            break
    warned = any(env.data.warning[kind].number for kind in DIVERGED)
    counts["divergence_unreported"] += int(warned and not info["physics_error"])
    return counts


def main() -> None:
    """Play and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--episodes", type=int, default=10_000, help="in all, shared among the subtasks"
    )
    parser.add_argument("--seed", type=int, default=names.TEST_SEED)
    parser.add_argument("--thread", type=int, default=0)
    parser.add_argument("--hold", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    share = -(-chosen.episodes // len(names.SUBTASKS))
    configs = [
        TaskConfig(task, SceneConfig(thread=chosen.thread), max_steps=STEPS)
        for task in names.SUBTASKS
    ]
    jobs = [
        Job(config, seeds, chosen.hold)
        for config in configs
        for seeds in chunks(chosen.seed, share)
    ]
    counts = {task: Counter[str]() for task in names.SUBTASKS}
    for job, part in zip(jobs, spread(play, jobs, chosen.workers), strict=True):
        counts[job.config.task].update(part)
    rows = {task: {key: count[key] for key in KEYS} for task, count in counts.items()}
    total = {key: sum(row[key] for row in rows.values()) for key in KEYS}
    emit(
        "random_actions",
        {"seed": chosen.seed, "thread": chosen.thread, "hold": chosen.hold, **total, "tasks": rows},
    )


if __name__ == "__main__":
    main()
