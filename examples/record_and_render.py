"""Record demonstrations once, render them twice, and look at what a dataset holds.

python examples/record_and_render.py --task insert --episodes 5
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import check_dataset, open_dataset, render_demos
from surgicai_vision.demos.record import record
from surgicai_vision.demos.rollout import Disturbance


def main() -> None:
    """Do all of it in one folder; steps that are already done are skipped."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="insert")
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--size", type=int, default=224, help="side of an image [px]")
    parser.add_argument("--workers", type=int, help="processes; default: one per core")
    arguments = parser.parse_args()
    out = Path("outputs/record_and_render")
    context = RunContext(arguments.workers)  # the result does not depend on their number

    # A demonstration consists of states and actions, without images. Noise makes it show how to
    # recover (DART): the executed actions are disturbed, the recorded labels are the expert's own.
    demos = out / "demos"
    record(
        TaskConfig(arguments.task),
        episodes=arguments.episodes,
        out=demos,
        disturbance=Disturbance(noise=0.3),
        context=context,
    )

    # The same demonstrations, rendered twice: two views with depth, and every fifth frame of a
    # crop that follows the arm. Both are LeRobot v3 datasets.
    both, few = out / "two_views", out / "every_fifth"
    shared = {"size": arguments.size, "context": context}
    render_demos(demos, both, views=("front", "back"), depth=True, **shared)
    render_demos(demos, few, views=("back_psm2",), frame_stride=5, **shared)

    for folder in (both, few):
        assert check_dataset(folder).ok  # reads every frame and compares its hash
        dataset = open_dataset(folder)
        print(f"{folder}: {len(dataset.bounds())} episodes, {dataset.length} frames")
        print("  columns:", *dataset.columns())
        first, end = dataset.bounds()[0]
        shown = dataset.frames(dataset.views[0], first, end)[:: max(1, (end - first) // 6)]
        Image.fromarray(np.concatenate(list(shown), axis=1)).save(folder.with_suffix(".png"))
        print(f"  a film strip of the first episode: {folder.with_suffix('.png')}")


if __name__ == "__main__":  # spawned workers import this file
    main()
