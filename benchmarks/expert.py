"""Measure the expert's successes over many starts, with the exact 95 % interval.

    python benchmarks/expert.py --task all --episodes 500
    python benchmarks/expert.py --task suture --episodes 200 --thread 10
    python benchmarks/expert.py --randomisation world --seed 500000
    python benchmarks/expert.py --randomisation pair=any,phantom_turn=10

`all` means the five subtasks. Episodes whose physics diverged count as failures and are also
reported separately. `--randomisation world` varies all geometry at once, each axis as far as the
geometry allows (`WORLD`).
"""

import argparse
from typing import Any, NamedTuple

from common import chunks, emit, median, spread

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import (
    WORLD,
    RandomisationConfig,
    SceneConfig,
    TaskConfig,
    from_mapping,
    read_changes,
    to_mapping,
)
from surgicai_vision.core.errors import SurgicaiError
from surgicai_vision.demos.expert import Expert
from surgicai_vision.evaluation.statistics import clopper_pearson


class Job(NamedTuple):
    """Some episodes of one task."""

    config: TaskConfig
    seeds: range


class Episode(NamedTuple):
    """How one episode ended."""

    seed: int
    success: bool
    physics_error: bool
    steps: int
    end: str


def play(job: Job) -> list[Episode]:
    """Play the job's episodes."""
    env = envs.make(job.config)
    return [_episode(env, seed) for seed in job.seeds]


def _episode(env: envs.SuturingEnv, seed: int) -> Episode:
    expert = Expert(env)
    info = {}
    steps = 0
    try:
        _, info = env.reset(seed=seed)
        for steps in range(1, env.config.max_steps + 1):  # noqa: B007
            _, _, terminated, truncated, info = env.step(expert.action())
            if terminated or truncated:
                break
    except SurgicaiError as error:  # no physical start, or an unreachable path
        return Episode(seed, False, False, steps, f"{type(error).__name__}: {error}")
    end = (
        f"{names.SUBTASKS[info['phase']]} {info['d_trans'] * 1e3:.1f} mm, {info['holes_passed']}"
        " holes"
    )
    return Episode(seed, info["is_success"], info["physics_error"], steps, end)


def table(config: TaskConfig, episodes: list[Episode]) -> dict[str, Any]:
    """Return one task's row."""
    successes = [episode for episode in episodes if episode.success]
    low, high = clopper_pearson(len(successes), len(episodes))
    return {
        "step": config.step,
        "tolerance": config.tolerance,
        "episodes": len(episodes),
        "successes": len(successes),
        "interval_95": [round(low, 4), round(high, 4)],
        "physics_errors": sum(episode.physics_error for episode in episodes),
        "steps_median": median([episode.steps for episode in successes]) if successes else None,
        "failed": [f"{episode.seed}: {episode.end}" for episode in episodes if not episode.success][
            :20
        ],
    }


def read_randomisation(text: str) -> RandomisationConfig:
    """Parse "", "world" or "axis=value,…"."""
    if text == "world":
        return WORLD
    changes = read_changes(text.split(",")) if text else {}
    return from_mapping(RandomisationConfig, changes, "--randomisation")


def main() -> None:
    """Play and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=("all", *names.TASKS), default="all")
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--seed", type=int, default=names.TEST_SEED)
    parser.add_argument("--thread", type=int, default=0)
    parser.add_argument("--layout", default="simple")
    parser.add_argument("--hole-pair", type=int, default=1)
    parser.add_argument("--grasp", default="friction")
    parser.add_argument("--tissue", default="channels", choices=names.TISSUES)
    parser.add_argument("--tissue-forces", default="phantom", choices=names.TISSUE_FORCES)
    parser.add_argument("--step", default="paper")
    parser.add_argument("--tolerance", default="paper")
    parser.add_argument("--randomisation", default="", help='what varies: "world" or axis=value,…')
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    scene = SceneConfig(
        layout=chosen.layout,
        hole_pair=chosen.hole_pair,
        thread=chosen.thread,
        grasp=chosen.grasp,
        tissue=chosen.tissue,
        tissue_forces=chosen.tissue_forces,
    )
    tasks = names.SUBTASKS if chosen.task == "all" else (chosen.task,)
    axes = read_randomisation(chosen.randomisation)
    configs = [
        TaskConfig(task, scene, chosen.step, chosen.tolerance, randomisation=axes) for task in tasks
    ]
    jobs = [
        Job(config, seeds) for config in configs for seeds in chunks(chosen.seed, chosen.episodes)
    ]
    done = list(zip(jobs, spread(play, jobs, chosen.workers), strict=True))
    rows = {
        config.task: table(
            config, [episode for job, part in done if job.config == config for episode in part]
        )
        for config in configs
    }
    row = {"seed": chosen.seed, "scene": to_mapping(scene), "tasks": rows}
    if axes.on:
        row["randomisation"] = {axis: to_mapping(axes)[axis] for axis in axes.on}
    emit("expert", row)


if __name__ == "__main__":
    main()
