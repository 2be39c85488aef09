"""Measure how often movement primitives learned from demonstrations succeed from other starts.

    python benchmarks/dmp.py  # learned from our expert, every subtask
    python benchmarks/dmp.py --task insert --npz surgicai_insert_v2.npz  # from SurgicAI's

Every start counts; none is redrawn. Prints one JSON object: per task the successes, the starts,
the share with its 95 % Clopper-Pearson interval, the median steps, and what was learned from
(`projected`: demonstrations that were projected onto the path through the holes; see
`surgicai_vision/demos/dmp/fit.py`).
"""

import argparse
import json
import statistics
import tempfile
from pathlib import Path
from typing import Any

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.dmp.controller import DmpController
from surgicai_vision.demos.expert import Expert
from surgicai_vision.demos.imports.surgicai import import_demos
from surgicai_vision.demos.rollout import rollout
from surgicai_vision.demos.store import write_demo
from surgicai_vision.evaluation.statistics import clopper_pearson

DEMO_SEED = 0
"""Seed of the expert's first demonstration; the starts begin at `--seed`."""


def demonstrate(task: str, count: int, folder: Path) -> list[Path]:
    """Record the expert's first `count` successes."""
    env = envs.make(TaskConfig(task))
    paths: list[Path] = []
    seed = DEMO_SEED
    while len(paths) < count:
        result = rollout(env, Expert(env), seed)
        if result.success:
            paths.append(write_demo(folder, len(paths), result.demo))
        seed += 1
    return paths


def measure(task: str, demos: list[Path], episodes: int, seed: int, scaled: bool) -> dict[str, Any]:
    """Execute the primitives learned from `demos` from `episodes` starts."""
    env = envs.make(TaskConfig(task))
    controller = DmpController(env, demos, scaled)
    successes = 0
    steps = []
    for number in range(seed, seed + episodes):
        result = rollout(env, DmpController(env, demos, scaled), number, "dmp")
        successes += result.success
        steps.append(len(result.demo))
    return {
        "successes": successes,
        "starts": episodes,
        "share": successes / episodes,
        "interval": clopper_pearson(successes, episodes),
        "median_steps": statistics.median(steps),
        "projected": controller.fit.projected,
    }


def main() -> None:
    """Learn, execute, count and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", help="one subtask; all subtasks by default")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=10_000)
    parser.add_argument("--demos-used", type=int, default=1)
    parser.add_argument(
        "--scaled", action="store_true", help="scale the primitive's shape with g - y0 on each axis"
    )
    parser.add_argument(
        "--npz",
        "--pickle",
        dest="recording",
        type=Path,
        help="learn from a recording of SurgicAI (needs --task)",
    )
    arguments = parser.parse_args()
    if arguments.recording and not arguments.task:
        parser.error("--npz and --pickle need --task: a recording does not say what it shows")
    tasks = {}
    for task in [arguments.task] if arguments.task else names.SUBTASKS:
        with tempfile.TemporaryDirectory() as folder:
            if arguments.recording:
                demos = list(
                    import_demos(arguments.recording, task=task, out=Path(folder) / "demos").paths
                )
            else:
                demos = demonstrate(task, arguments.demos_used, Path(folder))
            used = demos[: arguments.demos_used]
            tasks[task] = measure(task, used, arguments.episodes, arguments.seed, arguments.scaled)
    source = arguments.recording.name if arguments.recording else "expert"
    print(
        json.dumps(
            {
                "taught_by": source,
                "demos_used": arguments.demos_used,
                "scaled": arguments.scaled,
                **tasks,
            }
        )
    )


if __name__ == "__main__":
    main()
