"""Run a sweep of many small cells while its workers, its driver and a node are killed.

Compare with an undisturbed run.

    python benchmarks/sweep_kill.py --cells 300 --json

Runs the same grid three times: undisturbed; with local processes, where workers are killed ten
times and the driver once; and on a Ray cluster of two nodes on loopback, where a node is lost as
well. After the driver is killed, the sweep is started again; nothing else is repaired. A second
call of the undisturbed command shows what a finished sweep costs. A cell is a policy without
images: two epochs, one episode. Prints one JSON object last; exits with 1 unless every run has
every cell once and the undisturbed run's digest.
"""

import argparse
import functools
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from cluster import children, kill_one, spread, two_nodes

GRID = """
task: [grasp]
encoder: []
view: []
seed: {seeds}
proprioception: true
expert: false
demonstrations: 2
epochs: 2
episodes: 1
size: 32
"""


class Sweep:
    """One sweep in its own folder.

    Args:
        grid: file of its grid.
        out: its output folder.
        options: further options of the command.
    """

    def __init__(self, grid: Path, out: Path, *options: str):
        command = [
            sys.executable,
            "-m",
            "surgicai_vision",
            "sweep",
            str(grid),
            "--out",
            str(out),
            "--json",
        ]
        self.command = [*command, "--workers", "2", *options]
        self.out = out
        self.starts = 0
        self.process: subprocess.Popen | None = None

    def start(self) -> None:
        """Start or restart the sweep."""
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(self.command, stdout=pipe, stderr=pipe, text=True)
        self.starts += 1

    def filed(self) -> int:
        """Return the number of finished cells."""
        try:
            return len(os.listdir(self.out / "runs"))
        except OSError:
            return 0

    def kill_driver(self) -> bool:
        """Kill the command itself and start it again."""
        self.process.kill()
        self.process.communicate()
        self.start()
        return True

    def run(self, events: list[tuple[int, Callable[[], bool]]]) -> dict:
        """Run to the end, with events on the way; return the last line printed and the time [s]."""
        began = time.monotonic()
        self.start()
        while self.process.poll() is None:
            if events and self.filed() >= events[0][0] and events[0][1]():
                events.pop(0)
            time.sleep(0.02)
        output, errors = self.process.communicate()
        if self.process.returncode:
            raise SystemExit(f"the sweep failed:\n{output}\n{errors}")
        return {
            **json.loads(output.splitlines()[-1]),
            "seconds": round(time.monotonic() - began, 1),
        }

    def verdict(self, result: dict, digest: str, cells: int) -> dict:
        """Return a comparison of what is in the folder with what should be."""
        import pyarrow.parquet as pq

        rows = pq.read_table(self.out / "episodes.parquet", columns=["run", "seed"]).to_pylist()
        different = {(row["run"], row["seed"]) for row in rows}
        return {
            "results": len({row["run"] for row in rows}),
            "duplicates": len(rows) - len(different),
            "identical": result["digest"] == digest,
            "left": sorted(path.name for path in self.out.iterdir() if path.name == "work"),
            "starts": self.starts,
            "seconds": result["seconds"],
            "good": len(rows) == len(different) == cells and result["digest"] == digest,
        }


def main() -> int:
    """Run the sweeps; exit 1 unless each is complete."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=300)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--skip-ray", action="store_true", help="use local processes only")
    parser.add_argument(
        "--json", action="store_true", help="accepted for symmetry; the last line is always JSON"
    )
    arguments = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "egl")
    root = Path(tempfile.mkdtemp(prefix="surgicai-vision-sweep-"))
    os.environ["SURGICAI_VISION_CACHE"] = str(root / "cache")
    grid = root / "grid.yaml"
    moments = random.Random(arguments.seed)
    grid.write_text(GRID.format(seeds=list(range(arguments.cells))))
    quiet = Sweep(grid, root / "quiet")
    result = quiet.run([])
    again = quiet.run([])
    digest = result["digest"]
    row = {"cells": arguments.cells, "kills": arguments.kills, "quiet_seconds": result["seconds"]}
    row["second_run"] = {
        "seconds": again["seconds"],
        "done": again["done"],
        "same": again["digest"] == digest,
    }
    good = result["done"] == arguments.cells and again["done"] == 0 and again["digest"] == digest

    local = Sweep(grid, root / "local")
    kill = lambda: kill_one(children(local.process.pid), moments)  # noqa: E731
    events = spread([kill] * arguments.kills + [local.kill_driver], arguments.cells - 1, moments)
    row["local"] = local.verdict(local.run(events), digest, arguments.cells)
    good = good and row["local"]["good"] and not events
    if not arguments.skip_ray:
        with two_nodes() as cluster:
            ray = Sweep(grid, root / "ray", "--executor", f"ray,address={cluster.address}")
            kills = [functools.partial(cluster.kill_worker, moments)] * arguments.kills
            events = spread(
                [*kills, cluster.lose_node, ray.kill_driver], arguments.cells - 1, moments
            )
            row["ray"] = ray.verdict(ray.run(events), digest, arguments.cells)
        good = good and row["ray"]["good"] and not events
    shutil.rmtree(root)
    print(json.dumps(row))
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
