"""Measure how often the recovery expert completes a whole procedure after one upset.

    python benchmarks/recovery.py --episodes 160 --noise 0.3

Every episode has one upset (`surgicai_vision.envs.upset`), drawn from its seed. The last row,
`none`, has the same starts and noise without an upset. An upset that had not happened when its
episode ended counts as `none`.
"""

import argparse
from collections import Counter
from functools import partial
from typing import Any

from common import chunks, emit, spread

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.recovery_expert import RecoveryExpert
from surgicai_vision.demos.rollout import Disturbance, rollout
from surgicai_vision.envs.upset import KINDS
from surgicai_vision.evaluation.statistics import clopper_pearson


def play(seeds: range, fraction: float, noise: float) -> list[tuple[str, bool, str]]:
    """Play the seeds; return for each its upset, whether it succeeded, and why not."""
    env = envs.make(TaskConfig(names.SUTURE))
    wrong = Disturbance(noise=noise, upset_fraction=fraction)
    rows = []
    for seed in seeds:
        result = rollout(env, RecoveryExpert(env), seed, "recover", wrong)
        rows.append((result.upset or "none", result.success, result.reason))
    return rows


def main() -> None:
    """Measure every kind and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=160)
    parser.add_argument("--undisturbed", type=int, default=40)
    parser.add_argument("--seed", type=int, default=700_000)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    rows = []
    for fraction, episodes in ((1.0, given.episodes), (0.0, given.undisturbed)):
        job = partial(play, fraction=fraction, noise=given.noise)
        played = spread(job, chunks(given.seed, episodes, 20), given.workers)
        rows += [row for part in played for row in part]
    table: dict[str, Any] = {}
    for kind in (*KINDS, "none"):
        mine = [row for row in rows if row[0] == kind]
        wins = sum(success for _, success, _ in mine)
        low, high = clopper_pearson(wins, len(mine)) if mine else (None, None)
        reasons = Counter(reason for _, success, reason in mine if not success)
        table[kind] = {"k": wins, "n": len(mine), "low": low, "high": high, "why": dict(reasons)}
    emit("recovery", {"noise": given.noise, **table})


if __name__ == "__main__":
    main()
