"""Compare policies properly: the same held-out starts, exact intervals, paired tests.

python examples/compare_policies.py expert random --task grasp --episodes 20

A policy is a checkpoint folder, a hierarchical.yaml, module:factory, or the name of a baseline.
"""

import argparse
import itertools

import numpy as np

from surgicai_vision.core.names import TEST_SEED
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.evaluation.statistics import clopper_pearson, holm, mcnemar


def main() -> None:
    """Evaluate every policy on the same starts and test every pair."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policies", nargs="*", default=["expert", "random"])
    parser.add_argument("--task", help="task to evaluate; default: the checkpoint's, or grasp")
    parser.add_argument("--episodes", type=int, default=20)
    arguments = parser.parse_args()

    # Each seed is one start, so row i of every policy began in the same state.
    starts = range(TEST_SEED, TEST_SEED + arguments.episodes)
    successes = {}
    for given in arguments.policies:
        spec = open_policy(given, task=arguments.task)
        rows = [episode.row for episode in evaluate(spec.make_agent, spec.config, starts)]
        successes[given] = np.array([row.success for row in rows])
        low, high = clopper_pearson(int(successes[given].sum()), len(rows))
        failures = ", ".join(sorted({row.failure for row in rows if row.failure})) or "none"
        print(
            f"{given}: {successes[given].sum()}/{len(rows)} ({low:.2f}–{high:.2f}); "
            f"kinds of failure: {failures}"
        )

    # Only starts that exactly one of two policies solves show which is better; chance would split
    # them evenly.
    pairs = list(itertools.combinations(successes, 2))
    p_values = [mcnemar(successes[one], successes[other]) for one, other in pairs]
    for (one, other), p in zip(pairs, holm(p_values), strict=True):  # many tests, one error rate
        only_one = int((successes[one] & ~successes[other]).sum())
        only_other = int((successes[other] & ~successes[one]).sum())
        print(f"{one} against {other}: {only_one} : {only_other} starts, p = {p:.2g} (Holm)")


if __name__ == "__main__":  # spawned workers import this file
    main()
