"""Measure how often a grasp can succeed without knowing which point of the needle is requested.

    python benchmarks/grasp_ceiling.py --episodes 200

`once`: the expert grasps the needle in the middle of the range of goals, knowing everything else.
`search`: it tries again elsewhere (`surgicai_vision.demos.search_expert`). Both bound what a policy
that sees only images can achieve.
"""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

from common import chunks, emit, median, spread

from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.search_expert import SearchExpert
from surgicai_vision.evaluation.statistics import clopper_pearson


class Once(SearchExpert):
    """Grasps the needle once, in the middle of the range."""

    ATTEMPTS = (12.5,)


WAYS: dict[str, Callable[[Any], SearchExpert]] = {"once": Once, "search": SearchExpert}


def play(seeds: range, way: str) -> list[tuple[bool, int]]:
    """Play the seeds; return success and steps of each."""
    env = envs.make(TaskConfig("grasp"))
    rows = []
    for seed in seeds:
        env.reset(seed=seed)
        actor = WAYS[way](env)
        ended = False
        steps = 0
        info = {"is_success": False}
        while not ended:
            _, _, terminated, truncated, info = env.step(actor.action())
            ended = terminated or truncated
            steps = steps + 1
        rows.append((bool(info["is_success"]), steps))
    return rows


def main() -> None:
    """Measure both ways and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=900_000)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    table = {}
    for way in WAYS:
        played = spread(partial(play, way=way), chunks(given.seed, given.episodes), given.workers)
        rows = [row for part in played for row in part]
        wins = [steps for success, steps in rows if success]
        low, high = clopper_pearson(len(wins), len(rows))
        table[way] = {
            "k": len(wins),
            "n": len(rows),
            "low": low,
            "high": high,
            "steps": median(wins),
            "max": max(wins),
        }
    emit("grasp_ceiling", {"task": "grasp", **table})


if __name__ == "__main__":
    main()
