"""Kill `render-demos` with SIGKILL at random moments, and compare with an undisturbed run.

    python benchmarks/kill.py --kills 100 --together 2 --json

Each trial renders the same short demonstrations into a new folder, is killed once, and is run
again. The moments are spread evenly over the duration of an undisturbed run under the same load
(one in each hundredth, so that start, work and assembly are all hit). Prints one line per trial and
one JSON object last: how many datasets were identical (digest and file fingerprint, with nothing
left next to them), the most episodes that a kill cost, and how many kills hit unfinished work.
Exits with 1 unless all are identical and no kill cost more episodes than there are workers.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

RENDER = """
import json, sys
from pathlib import Path
from surgicai_vision.dataset import open_dataset, render_demos
from surgicai_vision.core.executor import RunContext, open_engine
if __name__ == "__main__":
    demos, out, workers, size, address = sys.argv[1:]
    engine = open_engine(f"ray,address={address}" if address else "local")
    options = {"size": int(size), "depth": True, "context": RunContext(int(workers), engine)}
    summary = render_demos(Path(demos), Path(out), **options)
    dataset = open_dataset(Path(out))
    print(json.dumps([summary.digest, dataset.fingerprint, summary.frames, summary.episodes]))
"""

SIZE = 64


def make_demos(folder: Path, episodes: int) -> None:
    """Record short demonstrations of the expert."""
    from surgicai_vision.core.config import TaskConfig
    from surgicai_vision.core.executor import RunContext
    from surgicai_vision.demos.record import record

    record(TaskConfig("grasp"), episodes=episodes, out=folder, context=RunContext(0))


def start(
    script: Path, demos: Path, out: Path, workers: int, address: str = ""
) -> subprocess.Popen:
    """Start one rendering, in this machine's processes or on the Ray cluster at `address`."""
    command = [sys.executable, script, demos, out, str(workers), str(SIZE), address]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen) -> list:
    """Wait for a rendering and return its digest, fingerprint, frames and episodes."""
    output, errors = process.communicate()
    if process.returncode:
        raise SystemExit(f"rendering failed:\n{errors}")
    return json.loads(output.splitlines()[-1])


def committed(out: Path) -> int:
    """Return the number of finished episodes in the store next to `out`."""
    work = out.with_name(f"{out.name}.work")
    try:
        return len(
            [path for path in os.listdir(work) if not path.startswith(".") and path != "result"]
        )
    except OSError:
        return 0


def half_done(out: Path) -> int:
    """Return the number of unfinished episodes in the store next to `out`."""
    return len(list(out.with_name(f"{out.name}.work").glob(".partial-*")))


class Trials:
    """What all trials share.

    Attributes:
        reference: digest, fingerprint, frames and episodes of the undisturbed run.
        duration: its duration under the load of the trials [s].
    """

    def __init__(self, root: Path, episodes: int, workers: int, together: int):
        self.root = root
        self.workers = workers
        self.script = root / "render.py"
        self.script.write_text(RENDER)
        make_demos(root / "demos", episodes)
        began = time.monotonic()
        runs = [
            start(self.script, root / "demos", root / f"reference{n}", workers)
            for n in range(together)
        ]
        results = [finish(process) for process in runs]
        self.duration = time.monotonic() - began
        self.reference = results[0]
        assert all(result == self.reference for result in results)

    def run(self, trial: int, moment: float) -> dict:
        """Kill one rendering after `moment` seconds, run it again, and return the outcome."""
        out = self.root / f"set{trial}"
        process = start(self.script, self.root / "demos", out, self.workers)
        time.sleep(moment)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        time.sleep(0.6)  # its workers notice within half a second
        kept = committed(out)
        lost = half_done(out)
        whole = out.exists()
        result = finish(start(self.script, self.root / "demos", out, self.workers))
        left = sorted(path.name for path in self.root.glob(f"*set{trial}[!0-9]*"))
        row = {
            "identical": result == self.reference and not left,
            "kept": kept,
            "redone": lost,
            "left": left,
        }
        state = "complete" if whole else f"{kept} episodes kept, {lost} lost"
        verdict = "identical" if row["identical"] else "DIFFERENT"
        print(f"trial {trial}: killed after {moment:.2f} s, {state}: {verdict}", flush=True)
        shutil.rmtree(out)
        return row


def main() -> int:
    """Run the trials; exit 1 unless every dataset is identical."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--workers", type=int, default=1, help="processes of each rendering")
    parser.add_argument("--together", type=int, default=2, help="trials that run at a time")
    parser.add_argument("--episodes", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--json", action="store_true", help="accepted for symmetry; the last line is always JSON"
    )
    arguments = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "egl")
    root = Path(tempfile.mkdtemp(prefix="surgicai-vision-kill-"))
    began = time.monotonic()
    trials = Trials(root, arguments.episodes, arguments.workers, arguments.together)
    draw = random.Random(arguments.seed)
    moments = [
        trials.duration * (at + draw.random()) / arguments.kills for at in range(arguments.kills)
    ]
    draw.shuffle(moments)
    with ThreadPoolExecutor(arguments.together) as pool:
        rows = list(pool.map(trials.run, range(arguments.kills), moments))
    row = {
        "kills": arguments.kills,
        "identical": sum(row["identical"] for row in rows),
        "most_redone": max(row["redone"] for row in rows),
        "met_unfinished": sum(
            0 < row["kept"] < arguments.episodes or row["redone"] > 0 for row in rows
        ),
        "workers": arguments.workers,
        "episodes": trials.reference[3],
        "frames": trials.reference[2],
        "seconds": round(time.monotonic() - began),
    }
    shutil.rmtree(root)
    print(json.dumps(row))
    return int(row["identical"] != arguments.kills or row["most_redone"] > arguments.workers)


if __name__ == "__main__":
    sys.exit(main())
