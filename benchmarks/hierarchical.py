"""Measure the evaluation of a hierarchical policy: rendering on demand against every view.

    python benchmarks/hierarchical.py
    python benchmarks/hierarchical.py --episodes 2 --steps 40 --repeats 1

A subtask's policy sees two crops, the high-level policy all four; heads are fixed random matrices,
so that no training is needed and every episode takes all its steps. Three ways take turns in one
process:

* `all`: every view is rendered and the high-level policy is queried in every step;
* `asked`: as `all`, but the high-level policy is queried every five steps;
* `looked_at`: as `asked`, and an image is rendered only when a policy reads it (the default).

The last two must give the same row and the same states for every seed. Whatever is loaded once per
process is loaded beforehand. Figures are medians over the turns; ratios are medians of the turns'
ratios of CPU time, which alone is meaningful on a shared machine.
"""

import argparse
import contextlib
import dataclasses
import functools
import os
import time
from collections.abc import Iterator
from unittest import mock

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
from common import emit, median
from evaluate import cpu_time, same

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.evaluation.hierarchical import HierarchicalAgent
from surgicai_vision.evaluation.hierarchical_config import HierarchicalConfig
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.evaluation.slot import Episode

PSM2 = ("front_psm2", "back_psm2")
PSM1 = ("front_psm1", "back_psm1")
LOW = (PSM2, PSM2, PSM2, PSM1, PSM1)
"""Views of each subtask's policy, in the order of the subtasks."""


class Head:
    """A policy that turns features and proprioception into answers by a fixed random matrix."""

    def __init__(self, answers: int):
        self._answers = answers
        self._weights = np.zeros((0, answers))

    def act(self, features: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """Return answers (n, `answers`)."""
        inputs = np.concatenate([features, vectors], axis=1).astype(np.float64)
        if not len(self._weights):
            rng = np.random.default_rng(0)
            self._weights = rng.normal(0, 0.05, (inputs.shape[1], self._answers))
        return np.tanh(np.einsum("bi,ia->ba", inputs, self._weights)).astype(np.float32)


def make_agent(encoder: str, size: int, decide_every: int) -> Agent:
    """Make the agent; it decides after at most twenty steps."""
    from surgicai_vision.features.encoders import load_encoder

    loaded = load_encoder(encoder)
    config = HierarchicalConfig("hlp", *names.SUBTASKS, steps=20, decide_every=decide_every)
    low = [functools.partial(PolicyAgent, "low", Head(7), loaded, views, size) for views in LOW]
    high = PolicyAgent("high", Head(5), loaded, (*PSM1, *PSM2), size, (names.BOTH_ARMS,))
    return HierarchicalAgent(config, low, lambda: high)


@contextlib.contextmanager
def rendered_at_once() -> Iterator[None]:
    """Render every view in every step."""
    with mock.patch.object(SuturingEnv, "defer_images", return_value=None):
        yield


WAYS = {
    "all": (1, rendered_at_once),
    "asked": (5, rendered_at_once),
    "looked_at": (5, contextlib.nullcontext),
}
"""Way → steps between queries, and how images are rendered."""


def measure(chosen: argparse.Namespace) -> dict[str, object]:
    """Time all ways and compare the last two row by row."""
    config = TaskConfig(names.SUTURE, max_steps=chosen.steps, advance="told")
    seeds = range(names.TEST_SEED, names.TEST_SEED + chosen.episodes)
    wall: dict[str, list[float]] = {way: [] for way in WAYS}
    cpu: dict[str, list[float]] = {way: [] for way in WAYS}
    found: dict[str, list[Episode]] = {}
    equal = chosen.episodes
    first = dataclasses.replace(config, max_steps=1)
    evaluate(functools.partial(make_agent, chosen.encoder, chosen.size, 1), first, seeds, workers=1)
    for turn in range(chosen.repeats):
        for way in list(WAYS)[:: -1 if turn % 2 else 1]:
            decide_every, rendering = WAYS[way]
            make = functools.partial(make_agent, chosen.encoder, chosen.size, decide_every)
            with rendering():
                start, used = time.perf_counter(), cpu_time()
                found[way] = evaluate(make, config, seeds, workers=1)
                wall[way].append(time.perf_counter() - start)
                cpu[way].append(cpu_time() - used)
        equal = min(equal, same(found["asked"], found["looked_at"]))
    total = chosen.steps * chosen.episodes
    row: dict[str, object] = {"paired_rows": chosen.episodes, "equal_rows": equal}
    for way in WAYS:
        row[f"{way}_steps_per_s"] = round(total / median(wall[way], 9), 1)
        row[f"{way}_steps_per_cpu_s"] = round(total / median(cpu[way], 9), 1)
        ratios = [a / b for a, b in zip(cpu["all"], cpu[way], strict=True)]
        row[f"{way}_times_as_fast_by_cpu"] = median(ratios)
    return row


def main() -> None:
    """Measure and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--steps", type=int, default=100, help="steps of each episode")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--encoder", default="imagenet-lite-early")
    parser.add_argument("--size", type=int, default=224, help="side of an image [px]")
    chosen = parser.parse_args()
    row = {**vars(chosen), **measure(chosen)}
    row["load_average"] = [round(value, 2) for value in os.getloadavg()]
    emit("hierarchical", row, render=True)


if __name__ == "__main__":
    main()
