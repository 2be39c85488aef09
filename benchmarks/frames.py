"""Render many frames and compare each with a live image of its state.

No frame may be dropped, black or misaligned.

    python benchmarks/frames.py --frames 10000 --workers 2 --json

Demonstrations of every subtask are recorded until there are that many frames (a step seen by one
view is a frame), and rendered by `render-demos`, two views with depth. Then a separate environment
in this process replays each demonstration's executed actions from its seed. What it sees live at
each step is compared bit by bit with the dataset's frame of that step, colours and depth. A frame
is

* dropped if the dataset has none for a step,
* black if no pixel is above 8 of 255, or all are equal,
* misaligned if it is not the live image of its step; `shifted` says how many equal the step before
  or after.

Prints one JSON object last; exits with 1 unless all are 0.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

VIEWS = ("front", "back")


def compare(demos: Path, dataset_folder: Path, size: int, episode_stride: int) -> dict:
    """Count what is wrong with a dataset's frames.

    One in `episode_stride` episodes is replayed live.
    """
    from surgicai_vision import envs
    from surgicai_vision.dataset import open_dataset
    from surgicai_vision.demos.store import list_demos, read_demo

    dataset = open_dataset(dataset_folder)
    bounds = dataset.bounds()
    found = {"dropped": 0, "black": 0, "misaligned": 0, "shifted": 0, "compared": 0}
    env = None
    for number, path in enumerate(list_demos(demos)):
        demo = read_demo(path)
        start, stop = bounds[number] if number < len(bounds) else (0, 0)
        found["dropped"] += len(VIEWS) * abs(len(demo) - (stop - start))
        stored = {
            view: (dataset.frames(view, start, stop), dataset.depth(view, start, stop))
            for view in VIEWS
        }
        for colours, _ in stored.values():
            flat = colours.reshape(len(colours), -1)
            found["black"] += int(((flat.max(1) <= 8) | (flat.max(1) == flat.min(1))).sum())
        if number % episode_stride:
            continue
        env = env or envs.make(
            demo.config, obs_type="pixels", cameras=VIEWS, image_size=size, depth=True
        )
        seen, _ = env.reset(seed=demo.seed)
        assert np.array_equal(env.get_state(), demo.state[0]), "the start is not the one recorded"
        for step in range(min(len(demo), stop - start)):
            for view, (colours, depth) in stored.items():
                live = seen[view]
                good = np.array_equal(live, colours[step]) and np.array_equal(
                    seen[f"{view}_depth"], depth[step]
                )
                found["compared"] += 1
                if not good:
                    near = colours[max(0, step - 1) : step + 2]
                    found["misaligned"] += 1
                    found["shifted"] += any(np.array_equal(live, other) for other in near)
            executed = demo.action if demo.executed is None else demo.executed
            seen = env.step(executed[step])[0]
    if env:
        env.close()
    return found


def main() -> int:
    """Record, render and compare every subtask; exit 1 if a frame is wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=10_000, help="fewest images to render")
    parser.add_argument(
        "--episode-stride", type=int, default=1, help="replay only every n-th episode live"
    )
    parser.add_argument("--size", type=int, default=224)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--json", action="store_true", help="accepted for symmetry; the last line is always JSON"
    )
    arguments = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "egl")
    from surgicai_vision.core import names
    from surgicai_vision.core.config import TaskConfig
    from surgicai_vision.core.executor import RunContext
    from surgicai_vision.dataset import render_demos
    from surgicai_vision.demos.record import record
    from surgicai_vision.demos.store import list_demos, read_demo

    root = Path(tempfile.mkdtemp(prefix="surgicai-vision-frames-"))
    began = time.monotonic()
    total: dict[str, int] = {
        "frames": 0,
        "dropped": 0,
        "black": 0,
        "misaligned": 0,
        "shifted": 0,
        "compared": 0,
    }
    for task in names.SUBTASKS:
        wanted = -(-arguments.frames // (len(names.SUBTASKS) * len(VIEWS)))
        demos = root / task
        episodes = 1
        steps = 0
        while steps < wanted:
            shutil.rmtree(demos, ignore_errors=True)
            episodes = max(episodes + 1, -(-episodes * wanted // steps)) if steps else 1
            record(
                TaskConfig(task),
                episodes=episodes,
                out=demos,
                context=RunContext(arguments.workers),
            )
            steps = sum(len(read_demo(path)) for path in list_demos(demos))
        out = root / f"{task}-set"
        render_demos(
            demos,
            out,
            views=VIEWS,
            size=arguments.size,
            depth=True,
            context=RunContext(arguments.workers),
        )
        found = compare(demos, out, arguments.size, arguments.episode_stride)
        print(f"{task}: {episodes} episodes, {len(VIEWS) * steps} frames, {found}", flush=True)
        total["frames"] += len(VIEWS) * steps
        for key, number in found.items():
            total[key] += number
        shutil.rmtree(out)
    shutil.rmtree(root)
    print(json.dumps({**total, "size": arguments.size, "seconds": round(time.monotonic() - began)}))
    return int(
        bool(total["dropped"] or total["black"] or total["misaligned"]) or total["compared"] == 0
    )


if __name__ == "__main__":
    sys.exit(main())
