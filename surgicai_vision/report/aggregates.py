"""Aggregates over tasks and training seeds, after Agarwal et al. 2021.

"Deep reinforcement learning at the edge of the statistical precipice" (NeurIPS 2021,
arXiv:2108.13264), whose library is rliable. The aggregates are the interquartile mean of a method's
runs, and the probability that a run of one method does better than a run of another on the same
task. Both have percentile intervals from a bootstrap that draws runs within each task.

`Scores` are success rates: for each task, one per training seed. Tasks may differ in their number
of seeds.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import InputError

Scores = Sequence[Sequence[float]]
RESAMPLES = 2000
"""rliable's default is 50,000; 2,000 determine a percentile to about a hundredth."""
TAIL = 0.25
"""Share of the runs left out at each end."""


def interquartile_mean(scores: Scores) -> float:
    """Return the mean of the middle half of all runs, whatever their task.

    As in rliable (`scipy.stats.trim_mean`), a quarter of the runs, rounded down, is left out at
    each end.
    """
    runs = np.sort(np.concatenate([np.asarray(task, np.float64) for task in _checked(scores)]))
    cut = int(TAIL * len(runs))
    return float(runs[cut : len(runs) - cut].mean())


def probability_of_improvement(first: Scores, second: Scores) -> float:
    """Return the probability that a run of `first` beats one of `second` on the same task.

    It is the mean over tasks of the share of pairs of runs in which the first is better; ties count
    half (Mann and Whitney's U over the number of pairs).

    Raises:
        InputError: the two differ in their number of tasks.
    """
    if len(first) != len(second):
        raise InputError(f"{len(first)} tasks against {len(second)}; give the same tasks for both.")
    shares = []
    for mine, theirs in zip(_checked(first), _checked(second), strict=True):
        difference = np.subtract.outer(np.asarray(mine), np.asarray(theirs))
        shares.append(np.mean((difference > 0) + 0.5 * (difference == 0)))
    return float(np.mean(shares))


def bootstrap(
    statistic: Callable[..., float],
    scores: Sequence[Scores],
    generator: np.random.Generator,
    level: float = 0.95,
    resamples: int = RESAMPLES,
) -> tuple[float, float]:
    """Return the percentile interval of a statistic of one or two methods.

    Args:
        statistic: `interquartile_mean` or `probability_of_improvement`.
        scores: its arguments.
        generator: draws the runs, with replacement, within each task and method.
        level: coverage, between 0 and 1.
        resamples: number of bootstrap resamples.
    """
    values: NDArray[np.float64] = np.empty(resamples)
    for index in range(resamples):
        drawn = [
            [generator.choice(np.asarray(task), len(task)) for task in method] for method in scores
        ]
        values[index] = statistic(*drawn)
    tail = (1.0 - level) / 2.0
    low, high = np.quantile(values, (tail, 1.0 - tail))
    return float(low), float(high)


def _checked(scores: Scores) -> Scores:
    if not len(scores) or any(not len(task) for task in scores):
        raise InputError("A task has no runs; give at least one run of each task.")
    return scores
