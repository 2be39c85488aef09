"""Kill `render-demos` with SIGKILL at random moments, run it again to the end, and compare with an undisturbed run.

    python benchmarks/kill.py --kills 100 --workers 2 --seed 0

Each trial renders the same demonstrations into a new folder, is killed once, and is run again. Prints one line a trial
and, last, how many datasets were identical (digest and file fingerprint) and the most episodes that a kill cost.
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
from pathlib import Path

RENDER = """
import json, sys
from pathlib import Path
from surgicai_vision.dataset import open_dataset, render_demos
if __name__ == "__main__":
    demos, out, workers = sys.argv[1:]
    summary = render_demos(Path(demos), Path(out), size=96, depth=True, workers=int(workers))
    print(json.dumps([summary.digest, open_dataset(Path(out)).fingerprint, summary.frames, summary.episodes]))
"""


def make_demos(folder: Path, episodes: int) -> None:
    """Record short demonstrations of the expert."""
    from surgicai_vision.config import TaskConfig
    from surgicai_vision.demos.record import record

    record(TaskConfig("grasp"), episodes=episodes, out=folder, workers=0)


def start(script: Path, demos: Path, out: Path, workers: int) -> subprocess.Popen:
    """Start one rendering."""
    command = [sys.executable, script, demos, out, str(workers)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen) -> list:
    """Wait for a rendering and return its digest, fingerprint, frames and episodes."""
    output, errors = process.communicate()
    if process.returncode:
        raise SystemExit(f"rendering failed:\n{errors}")
    return json.loads(output.splitlines()[-1])


def committed(out: Path) -> int:
    """Return the number of finished episodes in the store beside `out`."""
    work = out.with_name(f"{out.name}.work")
    return len([path for path in work.glob("*") if not path.name.startswith(".")]) if work.exists() else 0


def main() -> int:
    """Run the trials; exit 1 unless every dataset is identical."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "egl")
    moments = random.Random(arguments.seed)
    root = Path(tempfile.mkdtemp(prefix="surgicai-vision-kill-"))
    script = root / "render.py"
    script.write_text(RENDER)
    make_demos(root / "demos", arguments.episodes)
    began = time.monotonic()
    reference = finish(start(script, root / "demos", root / "reference", arguments.workers))
    duration = time.monotonic() - began
    same = 0
    for trial in range(arguments.kills):
        out = root / f"set{trial}"
        moment = moments.uniform(0.0, duration)
        process = start(script, root / "demos", out, arguments.workers)
        time.sleep(moment)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        kept, whole = committed(out), out.exists()
        result = finish(start(script, root / "demos", out, arguments.workers))
        left = sorted(path.name for path in root.glob(f"*set{trial}*") if path != out)
        identical = result == reference and not left
        same += identical
        state = "complete" if whole else f"{kept} of {arguments.episodes} episodes kept"
        verdict = "identical" if identical else f"DIFFERENT {left}"
        print(f"trial {trial}: killed after {moment:.2f} s, {state}: {verdict}", flush=True)
        shutil.rmtree(out)
    print(f"{same} of {arguments.kills} identical ({reference[2]} frames, {arguments.workers} workers)")
    shutil.rmtree(root)
    return int(same != arguments.kills)


if __name__ == "__main__":
    sys.exit(main())
