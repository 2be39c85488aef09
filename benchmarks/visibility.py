"""Count the needle's pixels at the end of successful expert episodes, per view.

    python benchmarks/visibility.py --episodes 100

Per task and view: the share of successful episodes at whose end the needle covers at least 25
pixels of 224 × 224 in the segmentation image (with the exact 95 % interval), and the minimum, the
5 % quantile and the median of the number of pixels. Starts that the expert fails are left out.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
from common import chunks, emit, spread

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig, TaskConfig
from surgicai_vision.core.errors import SurgicaiError
from surgicai_vision.demos.expert import Expert
from surgicai_vision.evaluation.statistics import clopper_pearson

TASKS = ("grasp", "place", "insert", "handoff")
SIZE = 224
PIXELS = 25
GOAL = 0.95
"""Image side, fewest needle pixels in it, and share of the starts that must show that many."""


class Job(NamedTuple):
    """Some episodes of one task, seen by some views."""

    config: TaskConfig
    seeds: range
    views: tuple[str, ...]


def count(job: Job) -> list[list[int] | None]:
    """Return the needle's pixels per view at each episode's end, None if it failed."""
    env = envs.make(job.config)
    counts = [_pixels(env, seed, job.views) for seed in job.seeds]
    env.close()
    return counts


def _pixels(env: envs.SuturingEnv, seed: int, views: tuple[str, ...]) -> list[int] | None:
    expert = Expert(env)
    needle = names.PARTS.index("needle")
    try:
        env.reset(seed=seed)
        for _ in range(env.config.max_steps):
            _, _, terminated, truncated, info = env.step(expert.action())
            if terminated or truncated:
                break
    except SurgicaiError:  # no physical start, or an unreachable path
        return None
    if not info["is_success"]:
        return None
    size = (SIZE, SIZE)
    return [int((env.image(view, size, names.SEGMENTATION) == needle).sum()) for view in views]


def table(pixels: list[int]) -> dict[str, Any]:
    """Return one view's row."""
    seen = sum(value >= PIXELS for value in pixels)
    low, high = clopper_pearson(seen, len(pixels))
    return {
        "share": round(seen / len(pixels), 4),
        "interval_95": [round(low, 4), round(high, 4)],
        "enough": seen / len(pixels) >= GOAL,
        "pixels": {
            "min": min(pixels),
            "p5": int(np.quantile(pixels, 0.05)),
            "median": int(np.median(pixels)),
        },
    }


def main() -> None:
    """Play, count the pixels, and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=TASKS, nargs="+", default=TASKS)
    parser.add_argument("--view", choices=names.CAMERAS, nargs="+", default=("front", "back"))
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=names.TEST_SEED)
    parser.add_argument("--thread", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    scene = SceneConfig(thread=chosen.thread)
    views = tuple(chosen.view)
    seeds = chunks(chosen.seed, chosen.episodes)
    jobs = [Job(TaskConfig(task, scene), part, views) for task in chosen.task for part in seeds]
    done = list(zip(jobs, spread(count, jobs, chosen.workers), strict=True))
    rows: dict[str, Any] = {}
    for task in chosen.task:
        ends = [end for job, part in done if job.config.task == task for end in part]
        shown = [end for end in ends if end is not None]
        rows[task] = {"episodes": len(ends), "successes": len(shown)}
        rows[task] |= {
            view: table([end[index] for end in shown]) for index, view in enumerate(views) if shown
        }
    emit(
        "visibility",
        {"seed": chosen.seed, "size": SIZE, "at_least": PIXELS, "tasks": rows},
        render=True,
    )


if __name__ == "__main__":
    main()
