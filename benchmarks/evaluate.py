"""Measure the speed of closed-loop evaluation.

The default of `evaluate` against one env at a time in one process.

    python benchmarks/evaluate.py
    python benchmarks/evaluate.py --episodes 8 --steps 40 --repeats 1

The policy sees one view through imagenet-lite; its head is a fixed random matrix, so that no
training is needed and every episode takes all its steps. One env at a time: one process, one slot
(the encoder sees one frame). Default: one process per core with eight slots (the encoder sees up to
eight frames at once). Starting processes and loading the encoder are included on both sides. Both
must give the same row and the same states for every seed.

The two take turns; figures are medians over the turns, ratios are medians of the turns' ratios.
Next to the wall-clock time, the CPU time of all processes divided by their number is given: the
time it would take if each had its own core. On a shared machine only the latter is meaningful.
"""

import argparse
import os
import time
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
from common import emit, median

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.evaluation.slot import Episode

ENCODER = "imagenet-lite"
VIEW = "front"
SIZE = 224


class Head:
    """A policy that turns features and proprioception into actions by a fixed random matrix."""

    def __init__(self, dim: int):
        self._weights = np.random.default_rng(0).normal(0, 0.05, (dim + 7, 7))

    def act(self, features: np.ndarray, agent_pos: np.ndarray) -> np.ndarray:
        """Return actions (n, 7)."""
        inputs = np.concatenate([features, agent_pos], axis=1).astype(np.float64)
        return np.tanh(np.einsum("bi,ia->ba", inputs, self._weights)).astype(np.float32)


def make_agent() -> Agent:
    """Make the agent (in a worker process)."""
    from surgicai_vision.features.encoders import load_encoder

    encoder = load_encoder(ENCODER)
    return PolicyAgent("benchmark", Head(encoder.dim), encoder, (VIEW,), SIZE)


def same(one: list[Episode], other: list[Episode]) -> int:
    """Return how many episodes have the same row (NaN equals NaN) and states on both sides."""
    pairs = zip(one, other, strict=True)
    return sum(
        repr(a.row) == repr(b.row) and np.array_equal(a.film.states, b.film.states)
        for a, b in pairs
    )


def cpu_time() -> float:
    """Return the CPU time of this process and its finished children [s]."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def measure(episodes: int, steps: int, repeats: int) -> dict[str, Any]:
    """Time both and compare their rows."""
    config = TaskConfig("grasp", max_steps=steps)
    seeds = range(names.TEST_SEED, names.TEST_SEED + episodes)
    kinds: tuple[dict[str, Any], ...] = ({"batch": 1, "workers": 1}, {})
    times: tuple[list[float], list[float]] = ([], [])
    cpu: tuple[list[float], list[float]] = ([], [])
    processes = (1, min(len(os.sched_getaffinity(0)), -(-episodes // 4)))
    equal = episodes
    for turn in range(repeats):
        found: dict[int, list[Episode]] = {}
        for index in (0, 1) if turn % 2 else (1, 0):
            start = time.perf_counter()
            used = cpu_time()
            found[index] = evaluate(make_agent, config, seeds, **kinds[index])
            times[index].append(time.perf_counter() - start)
            cpu[index].append((cpu_time() - used) / processes[index])
        equal = min(equal, same(found[0], found[1]))
    total = sum(episode.row.steps for episode in found[0])
    return {
        "one_env_at_a_time_s": median(times[0]),
        "default_s": median(times[1]),
        "one_env_at_a_time_steps_per_s": round(total / median(times[0], 9), 1),
        "default_steps_per_s": round(total / median(times[1], 9), 1),
        "times_as_fast": median([a / b for a, b in zip(*times, strict=True)]),
        "one_env_at_a_time_cpu_s": median(cpu[0]),
        "default_cpu_s_a_process": median(cpu[1]),
        "times_as_fast_by_cpu": median([a / b for a, b in zip(*cpu, strict=True)]),
        "paired_rows": episodes,
        "equal_rows": equal,
    }


def main() -> None:
    """Measure and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--steps", type=int, default=200, help="control steps of each episode")
    parser.add_argument("--repeats", type=int, default=3)
    chosen = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    row = {**vars(chosen), "encoder": ENCODER, "view": VIEW, "cores": cores}
    row |= measure(chosen.episodes, chosen.steps, chosen.repeats)
    row["load_average"] = [round(value, 2) for value in os.getloadavg()]
    emit("evaluate", row, render=True)


if __name__ == "__main__":
    main()
