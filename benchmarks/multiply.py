"""Measure how often demonstrations re-posed to other starts succeed.

    python benchmarks/multiply.py  # ten of the expert's, every subtask
    python benchmarks/multiply.py --task insert --npz surgicai_insert_v2.npz  # ten of SurgicAI's
    python benchmarks/multiply.py --task grasp --demos outputs/demos/search

Every start counts; none is redrawn. Prints one JSON object: per task and method of choosing the
source, the successes, the starts, the share with its 95 % Clopper-Pearson interval, and the median
steps of successes.
"""

import argparse
import json
import statistics
import tempfile
from pathlib import Path
from typing import Any

from dmp import demonstrate

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import WORLD, RandomisationConfig, TaskConfig
from surgicai_vision.demos.demonstrator import SOURCES
from surgicai_vision.demos.imports.surgicai import import_demos
from surgicai_vision.demos.multiply.cuts import NAME
from surgicai_vision.demos.multiply.multiplier import Multiplier
from surgicai_vision.demos.rollout import Disturbance, rollout
from surgicai_vision.demos.store import list_demos
from surgicai_vision.evaluation.statistics import clopper_pearson


def measure(
    config: TaskConfig, demos: list[Path], episodes: int, seed: int, source: str, noise: float
) -> dict[str, Any]:
    """Re-pose `demos` to `episodes` starts and return the successes."""
    env = envs.make(config)
    steps = []
    for number in range(seed, seed + episodes):
        multiplier = Multiplier(env, demos, source)
        result = rollout(env, multiplier, number, NAME, Disturbance(noise))
        if result.success:
            steps.append(len(result.demo))
    return {
        "successes": len(steps),
        "starts": episodes,
        "share": len(steps) / episodes,
        "interval": clopper_pearson(len(steps), episodes),
        "median_steps": statistics.median(steps) if steps else None,
    }


def main() -> None:
    """Take demonstrations, re-pose them, count and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=names.TASKS, help="task; all subtasks by default")
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--seed", type=int, default=10_000)
    parser.add_argument("--demos-used", type=int, default=10)
    parser.add_argument(
        "--source", choices=SOURCES, help="how to choose the source; both ways by default"
    )
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--world", action="store_true", help="use starts in the varied world")
    parser.add_argument("--npz", type=Path, help="a recording of SurgicAI (needs --task)")
    parser.add_argument("--demos", type=Path, help="a folder of demonstrations (needs --task)")
    arguments = parser.parse_args()
    if (arguments.npz or arguments.demos) and not arguments.task:
        parser.error("--npz and --demos need --task")
    tasks: dict[str, Any] = {}
    world = WORLD if arguments.world else RandomisationConfig()
    for task in [arguments.task] if arguments.task else names.SUBTASKS:
        with tempfile.TemporaryDirectory() as folder:
            if arguments.npz:
                demos = list(import_demos(arguments.npz, task=task, out=Path(folder) / "d").paths)
            elif arguments.demos:
                demos = list_demos(arguments.demos)
            else:
                demos = demonstrate(task, arguments.demos_used, Path(folder))
            used = demos[: arguments.demos_used]
            config = TaskConfig(task, randomisation=world)
            tasks[task] = {
                source: measure(
                    config, used, arguments.episodes, arguments.seed, source, arguments.noise
                )
                for source in ([arguments.source] if arguments.source else SOURCES)
            }
    print(
        json.dumps(
            {
                "demos_used": arguments.demos_used,
                "noise": arguments.noise,
                "world": arguments.world,
                **tasks,
            }
        )
    )


if __name__ == "__main__":
    main()
