"""Measure how many two-view steps/s are written.

`render-demos` with 1 and 2 workers against LeRobot's own writer in one process.

    python benchmarks/render.py --episodes 12 --repeats 3 --json

Both write the same demonstrations as lossless images of 224 × 224, each in a separate process. For
LeRobot's writer, every state is set in the same environment, both views are rendered and written
with `LeRobotDataset.add_frame` and `save_episode` (`use_videos=False`). Its clock starts after
LeRobot's imports, ours before the workers start. They take turns; the best of each counts. Prints
one JSON object last.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

OURS = """
import json, sys
from pathlib import Path
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import render_demos
if __name__ == "__main__":
    demos, out, workers, size = sys.argv[1:]
    summary = render_demos(Path(demos), Path(out), size=int(size), context=RunContext(int(workers)))
    print(json.dumps([summary.frames, summary.seconds]))
"""

THEIRS = """
import json, sys, time
from pathlib import Path
from lerobot.datasets.lerobot_dataset import LeRobotDataset
import surgicai_vision.envs as envs
from surgicai_vision.core import names
from surgicai_vision.demos.store import list_demos, read_demo
if __name__ == "__main__":
    demos, out, _, size = sys.argv[1:]
    size = int(size)
    began = time.monotonic()
    image = {"dtype": "image", "shape": (size, size, 3), "names": ["height", "width", "channels"]}
    features = {
        **{names.image_key(view): image for view in ("front", "back")},
        names.STATE: {"dtype": "float32", "shape": (7,), "names": None},
        names.ACTION: {"dtype": "float32", "shape": (7,), "names": None},
    }
    dataset = LeRobotDataset.create("local/bench", names.FPS, features, root=out, use_videos=False)
    env, frames = None, 0
    for path in list_demos(Path(demos)):
        demo = read_demo(path)
        env = env or envs.make(
            demo.config, obs_type="pixels_agent_pos", cameras=("front", "back"), image_size=size
        )
        for state, action in zip(demo.state, demo.action):
            env.set_state_vector(state)
            seen = env.observe()
            row = {names.image_key(view): seen[view] for view in ("front", "back")}
            text = names.TASK_TEXTS[demo.config.task]
            row |= {names.STATE: seen["agent_pos"], names.ACTION: action, "task": text}
            dataset.add_frame(row)
            frames += 1
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    print(json.dumps([frames, time.monotonic() - began]))
    env.close()
"""

WAYS = {"lerobot": (THEIRS, 0), "one_worker": (OURS, 1), "two_workers": (OURS, 2)}


def measure(root: Path, name: str, size: int) -> float:
    """Return the steps/s of one way."""
    code, workers = WAYS[name]
    script = root / f"write_{name}.py"
    out = root / "set"
    script.write_text(code)
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_DATASETS_DISABLE_PROGRESS_BARS": "1"}
    environment["HF_DATASETS_CACHE"] = str(root / "cache")
    command = [sys.executable, script, root / "demos", out, str(workers), str(size)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise SystemExit(f"{name} failed:\n{done.stderr}")
    frames, seconds = json.loads(done.stdout.splitlines()[-1])
    shutil.rmtree(out)
    print(
        f"{name}: {frames} steps in {seconds:.1f} s, {frames / seconds:.1f} steps/s",
        file=sys.stderr,
        flush=True,
    )
    return frames / seconds


def main() -> None:
    """Measure every way in turns and print one JSON object."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="place")
    parser.add_argument("--episodes", type=int, default=12)
    parser.add_argument("--size", type=int, default=224)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--json", action="store_true", help="accepted for symmetry; the last line is always JSON"
    )
    arguments = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "egl")
    from surgicai_vision.core.config import TaskConfig
    from surgicai_vision.core.executor import RunContext
    from surgicai_vision.demos.record import record

    root = Path(tempfile.mkdtemp(prefix="surgicai-vision-render-"))
    record(
        TaskConfig(arguments.task),
        episodes=arguments.episodes,
        out=root / "demos",
        context=RunContext(0),
    )
    rates: dict[str, list[float]] = {name: [] for name in WAYS}
    for _ in range(arguments.repeats):
        for name in WAYS:
            rates[name].append(measure(root, name, arguments.size))
    best = {name: max(values) for name, values in rates.items()}
    row = {
        "task": arguments.task,
        "episodes": arguments.episodes,
        "size": arguments.size,
        "cores": len(os.sched_getaffinity(0)),
        "steps_per_s": {name: round(value, 1) for name, value in best.items()},
        "all": {name: [round(value, 1) for value in values] for name, values in rates.items()},
        "two_workers_to_lerobot": round(best["two_workers"] / best["lerobot"], 2),
        "two_workers_to_one": round(best["two_workers"] / best["one_worker"], 2),
    }
    shutil.rmtree(root)
    print(json.dumps(row))


if __name__ == "__main__":
    main()
