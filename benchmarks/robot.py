"""Measure a policy on the served simulation: successes, jitter and latency.

    python benchmarks/robot.py --episodes 50
    python benchmarks/robot.py --policy released:grasp --episodes 2 --clock stepped

`robot serve` and `robot drive` run in a process each, over a transport on the loopback; for
comparison, the same policy and starts run in one process (`evaluate`). When the client steps the
clock, every episode must end in the same way after the same steps. In real time, the served
simulation reports how late its control steps began, and the driver how long after the newest pose
and the newest image it sent. On a shared machine neither is meaningful; the load average of the
last minute is reported with them (the benchmark itself causes two to three).

Runs ten episodes at a time. Finished ones are kept in `--out`/counted.jsonl, and the same command
continues from there. The result is in `--out`/robot.json.
"""

import argparse
import functools
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

from common import emit, spread_resumable

from surgicai_vision.core import names
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.evaluation.policy_spec import PolicySpec, open_policy
from surgicai_vision.evaluation.provenance import episode_code
from surgicai_vision.evaluation.rollout import evaluate

PROCEDURE = "released:suture"
COMMAND = (sys.executable, "-m", "surgicai_vision", "robot")
IN_PROCESS = "in process"
CLOCKS = ("stepped", "real")
CHUNK = 10
"""Episodes that run at a time, and are lost if the run is interrupted."""
BEGINS_S = 120.0
ENDS_S = 30.0
"""Time limits for `robot serve` to begin, and to end after Ctrl-C [s]."""


@dataclass(frozen=True)
class Job:
    """Episodes to run: their `repr` identifies them in the file of finished jobs."""

    way: str
    policy: str
    transport: str
    code: str
    first: int
    count: int


def count(job: Job, domain: int) -> dict[str, Any]:
    """Run a job's episodes: return success, steps and subtasks of each, and the delays."""
    begun = time.monotonic()
    counted = in_process(job) if job.way == IN_PROCESS else at_robot(job, domain)
    done = counted["episodes"]
    print(
        f"{job.way}: starts {job.first}-{job.first + job.count - 1}: "
        f"{sum(success for success, _, _ in done)} of {len(done)} succeeded, "
        f"{sum(subtasks for _, _, subtasks in done)} subtasks; {time.monotonic() - begun:.0f} s",
        file=sys.stderr,
        flush=True,
    )
    return counted


@functools.cache
def opened(policy: str) -> tuple[PolicySpec, Agent]:
    """Return a policy and an agent that runs it."""
    spec = open_policy(policy)
    return spec, spec.make_agent()


def in_process(job: Job) -> dict[str, Any]:
    """Run a job in this process and its workers."""
    spec, _ = opened(job.policy)
    seeds = range(job.first, job.first + job.count)
    rows = [entry.row for entry in evaluate(spec.make_agent, spec.config, seeds)]
    return {"episodes": [(bool(row.success), row.steps, row.stages) for row in rows]}


def at_robot(job: Job, domain: int) -> dict[str, Any]:
    """Run a job with `robot serve` and `robot drive`."""
    spec, agent = opened(job.policy)
    network = ("--transport", job.transport, "--domain", str(domain), "--clock", job.way)
    serve = [*COMMAND, "serve", "--task", spec.config.task, "--advance", spec.config.advance]
    serve += ["--size", str(agent.image_size), "--image-rate", "50", *network, "--json"]
    serve += ["--view", ",".join(agent.cameras)] if agent.cameras else []
    drive = [*COMMAND, "drive", job.policy, "--simulated", "--send", *network, "--json"]
    drive += ["--episodes", str(job.count), "--seed", str(job.first)]
    with tempfile.TemporaryDirectory() as folder:
        said = Path(folder) / "serve.json"
        with serving(serve, said, Path(folder) / "serve.log"):
            driven = subprocess.run(
                [*drive, "--out", f"{folder}/drive"], capture_output=True, text=True
            )
            if driven.returncode:
                raise SystemExit(f"robot drive failed:\n{driven.stderr}")
        served = last_line(said.read_text())
    row = last_line(driven.stdout)
    late = (
        "latency_ms_median",
        "latency_ms_p99",
        "image_latency_ms_median",
        "image_latency_ms_p99",
    )
    return {
        "episodes": [
            (bool(entry["success"]), entry["steps"] + entry["held"], entry["progress"])
            for entry in row["episodes"]
        ],
        "held": sum(entry["held"] for entry in row["episodes"]),
        "control_steps": served["steps"],
        "late_ms_median": served["late_ms_median"],
        "late_ms_p99": served["late_ms_p99"],
        **{name: row[name] for name in late},
        "load_average": os.getloadavg()[0],
    }


@contextmanager
def serving(command: list[str], said: Path, log: Path) -> Iterator[None]:
    """Run `robot serve` in parallel; `said` holds what it printed once it has ended."""
    with said.open("w") as out, log.open("w") as notes:
        server = subprocess.Popen(command, stdout=out, stderr=notes)
    try:
        ends = time.monotonic() + BEGINS_S
        while "serving" not in log.read_text():
            if server.poll() is not None or time.monotonic() > ends:
                raise SystemExit(f"robot serve did not start:\n{log.read_text()}")
            time.sleep(0.1)
        yield
        server.send_signal(signal.SIGINT)
        server.wait(ENDS_S)
    finally:
        if server.poll() is None:
            server.kill()
            server.wait()


def last_line(text: str) -> dict[str, Any]:
    """Return the JSON of a text's last line."""
    found: dict[str, Any] = json.loads(text.strip().splitlines()[-1])
    return found


def result(jobs: list[Job], counted: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the sums of each way, and how they compare with one process, episode by episode."""
    parts: dict[str, list[dict[str, Any]]] = {}
    for job, part in zip(jobs, counted, strict=True):
        parts.setdefault(job.way, []).append(part)
    ends = {
        way: [tuple(end) for part in chunks for end in part["episodes"]]
        for way, chunks in parts.items()
    }
    own = ends[IN_PROCESS]
    row: dict[str, Any] = {}
    for way, found in ends.items():
        sums: dict[str, Any] = {
            "successes": sum(success for success, _, _ in found),
            "subtasks": sum(subtasks for _, _, subtasks in found),
        }
        if way != IN_PROCESS:
            sums["same_success"] = sum(a[0] == b[0] for a, b in zip(own, found, strict=True))
            sums["held"] = sum(part["held"] for part in parts[way])
        if way == "stepped":
            sums["same_end"] = sum(a == b for a, b in zip(own, found, strict=True))
        if way == "real":
            solved = sum(subtasks for _, _, subtasks in own)
            sums["subtasks_over_in_process"] = round(sums["subtasks"] / max(solved, 1), 3)
            for name in ("late", "latency", "image_latency"):  # per ten episodes; the worst counts
                for of in ("median", "p99"):
                    key = f"{name}_ms_{of}"
                    sums[key] = round(max(part[key] for part in parts[way]), 2)
            sums["load_average"] = round(max(part["load_average"] for part in parts[way]), 2)
        row[way.replace(" ", "_")] = sums
    return row


def main() -> None:
    """Measure, keep the result and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", default=PROCEDURE)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=names.TEST_SEED)
    parser.add_argument("--clock", choices=(*CLOCKS, "both"), default="both")
    parser.add_argument("--transport", default="cyclonedds")
    parser.add_argument("--domain", type=int, default=211)
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks/robot"))
    chosen = parser.parse_args()
    # A shell's background jobs ignore Ctrl-C; `robot serve` would inherit this, but ends by Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    clocks = CLOCKS if chosen.clock == "both" else (chosen.clock,)
    code = episode_code()
    jobs = [
        Job(way, chosen.policy, chosen.transport, code, first, min(CHUNK, end - first))
        for end in (chosen.seed + chosen.episodes,)
        for way in (IN_PROCESS, *clocks)
        for first in range(chosen.seed, end, CHUNK)
    ]
    chosen.out.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    counted = spread_resumable(
        lambda job: count(job, chosen.domain), jobs, 0, chosen.out / "counted.jsonl"
    )
    row = {**vars(chosen), "out": str(chosen.out), **result(jobs, counted)}
    row["seconds"] = round(time.monotonic() - begun)
    (chosen.out / "robot.json").write_text(json.dumps(row, indent=2) + "\n")
    emit("robot", row, render=True)


if __name__ == "__main__":
    main()
