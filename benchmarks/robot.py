"""Measure a policy at the served simulation: successes, jitter and latency.

    python benchmarks/robot.py --policy released:grasp --episodes 50
    python benchmarks/robot.py --policy released:grasp --episodes 2 --clock stepped

`robot serve` and `robot drive`, a process each, over a transport on the loopback; beside them the
same policy and starts in one process (`evaluate`). Where the client steps the clock, every episode
must have the same end after the same steps. In real time the served simulation is asked how late
its control steps began, and the driver how long after the newest pose it sent: a shared machine
says nothing about either, and the load average stands beside them.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

from common import emit

from surgicai_vision.core import names
from surgicai_vision.evaluation.policy_spec import PolicySpec, open_policy
from surgicai_vision.evaluation.rollout import evaluate

COMMAND = (sys.executable, "-m", "surgicai_vision", "robot")
ENDS_S = 30.0
"""Time that `robot serve` has to end after Ctrl-C [s]."""


def served_and_driven(
    spec: PolicySpec, chosen: argparse.Namespace, clock: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what `robot serve` and `robot drive` say of the episodes, as JSON."""
    agent = spec.make_agent()
    network = ("--transport", chosen.transport, "--domain", str(chosen.domain), "--clock", clock)
    serve = [*COMMAND, "serve", "--task", spec.config.task, "--advance", spec.config.advance]
    serve += ["--size", str(agent.image_size), "--image-rate", "50", *network, "--json"]
    serve += ["--view", ",".join(agent.cameras)] if agent.cameras else []
    drive = [*COMMAND, "drive", chosen.policy, "--simulated", "--send", *network, "--json"]
    drive += ["--episodes", str(chosen.episodes), "--seed", str(chosen.seed)]
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen(
            serve, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as server,
    ):
        assert server.stderr is not None
        while "serving" not in (line := server.stderr.readline()):
            if not line:
                raise SystemExit("robot serve ended; run it by itself to see why")
        driven = subprocess.run(
            [*drive, "--out", folder], stdout=subprocess.PIPE, text=True, check=True
        )
        server.send_signal(signal.SIGINT)
        said, _ = server.communicate(timeout=ENDS_S)
    return last_line(said), last_line(driven.stdout)


def last_line(text: str) -> dict[str, Any]:
    """Return the JSON of a text's last line."""
    found: dict[str, Any] = json.loads(text.strip().splitlines()[-1])
    return found


def measure(chosen: argparse.Namespace) -> dict[str, Any]:
    """Drive in both clocks and in one process, and compare episode by episode."""
    spec = open_policy(chosen.policy)
    seeds = range(chosen.seed, chosen.seed + chosen.episodes)
    own = evaluate(spec.make_agent, spec.config, seeds, batch=1, workers=1)
    ends = [(entry.row.success, entry.row.steps) for entry in own]
    row: dict[str, Any] = {"task": spec.config.task, "in_process": sum(end for end, _ in ends)}
    if chosen.clock in ("stepped", "both"):
        _, driven = served_and_driven(spec, chosen, "stepped")
        found = [(entry["success"], entry["steps"]) for entry in driven["episodes"]]
        row |= {
            "stepped": driven["successes"],
            "stepped_same_ends": sum(a == b for a, b in zip(ends, found, strict=True)),
        }
    if chosen.clock in ("real", "both"):
        served, driven = served_and_driven(spec, chosen, "real")
        row |= {
            "real_time": driven["successes"],
            "real_time_held": sum(entry["held"] for entry in driven["episodes"]),
            "late_ms_p50": round(served["late_ms_median"], 3),
            "late_ms_p99": round(served["late_ms_p99"], 3),
            "latency_ms_p50": round(driven["latency_ms_median"], 2),
            "latency_ms_p99": round(driven["latency_ms_p99"], 2),
        }
    return row


def main() -> None:
    """Measure and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", default="released:grasp")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=names.TEST_SEED)
    parser.add_argument("--clock", choices=("stepped", "real", "both"), default="both")
    parser.add_argument("--transport", default="cyclonedds")
    parser.add_argument("--domain", type=int, default=211)
    chosen = parser.parse_args()
    row = {**vars(chosen), **measure(chosen)}
    row["load_average"] = [round(value, 2) for value in os.getloadavg()]
    emit("robot", row, render=True)


if __name__ == "__main__":
    main()
