"""Statistics: intervals of success rates, tests of pairs of policies, areas under curves.

Interface:
    clopper_pearson(k, n)                exact interval of one success rate
    hierarchical_bootstrap(groups, rng)  interval of a mean over training seeds and their episodes
    mcnemar(a, b)                        exact test of two policies on the same starts
    retention(plain, shifted)            what is left of a success rate, with its interval
    differ(parts, rng)                   permutation test of several rates
    holm(p)                              p-values corrected for their number
    area_under_curve(strength, success)  mean success over a range of strengths
    area_interval(areas)                 its interval, from each episode's own area
    mean_and_std(values)                 sample mean and deviation

SciPy is imported where it is used: it takes 0.3 s, and the command line's --help must not pay for
it.
"""

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgicai_vision.core.errors import InputError

Array = NDArray[np.float64]


def clopper_pearson(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact (Clopper-Pearson) interval of a success rate.

    Clopper and Pearson, Biometrika 26 (1934): the bounds are quantiles of Beta(k, n-k+1) and
    Beta(k+1, n-k).

    Args:
        successes: k, 0 ≤ k ≤ n.
        trials: n ≥ 1.
        level: coverage, between 0 and 1.

    Returns:
        Lower and upper bound, both in [0, 1]; 0 exactly for k = 0 and 1 exactly for k = n.

    Raises:
        InputError: counts or level outside their range.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise InputError(
            f"{successes} successes of {trials} trials; "
            "allowed: 0 ≤ successes ≤ trials, trials ≥ 1."
        )
    return _beta_bounds(successes, trials, level)


def _beta_bounds(successes: float, trials: float, level: float) -> tuple[float, float]:
    """Return Clopper and Pearson's bounds; the counts may be fractions of effective trials."""
    from scipy.stats import beta

    tail = (1 - _checked(level)) / 2
    low = 0.0 if successes <= 0 else float(beta.ppf(tail, successes, trials - successes + 1))
    high = (
        1.0 if successes >= trials else float(beta.ppf(1 - tail, successes + 1, trials - successes))
    )
    return low, high


def hierarchical_bootstrap(
    groups: Sequence[Sequence[float]],
    generator: np.random.Generator,
    level: float = 0.95,
    resamples: int = 10_000,
) -> tuple[float, float]:
    """Return an interval of the mean over training seeds, and over episodes within each.

    Seeds are drawn with replacement, then episodes within each drawn seed; the mean of the drawn
    seeds' means is kept. The plain percentiles of those means cover far less than they claim with
    five seeds (77 % for a rate of 0.95 whose seeds scatter by 0.1), so only the bootstrap's
    standard error e is taken from them. Then

    * successes (values 0 and 1): Korn and Graubard, Survey Methodology 24 (1998). The episodes are
      worth n* = min(n, p(1-p)/e²) · (t(n-1)/t(m-1))² independent ones, t(d) being Student's
      quantile for d degrees of freedom, n episodes and m seeds in all; the interval is Clopper and
      Pearson's for n* trials;
    * other values: mean ± t(m-1) e √(m/(m-1)); the factor is there because m drawn seeds scatter by
      (m-1)/m too little.

    A single seed says nothing about others: its interval is that of its own episodes.
    `benchmarks/coverage.py` measures the coverage.

    Args:
        groups: for each training seed its episodes' values; seeds may differ in their number of
            episodes.
        generator: draws the resamples.
        level: coverage, between 0 and 1.
        resamples: at least 100.

    Raises:
        InputError: no seeds, a seed without episodes, a value that is not finite, level or
            resamples out of range.
    """
    seeds = [np.asarray(group, np.float64) for group in groups]
    if (
        not seeds
        or any(seed.size == 0 for seed in seeds)
        or not all(np.isfinite(seed).all() for seed in seeds)
    ):
        raise InputError(
            f"{len(seeds)} training seeds; give at least one, each with episodes of finite values."
        )
    if resamples < 100:
        raise InputError(f"resamples is {resamples}; it must be at least 100.")
    are_rates = all(np.isin(seed, (0.0, 1.0)).all() for seed in seeds)
    is_single = len(seeds) == 1
    if are_rates and is_single:
        return _beta_bounds(float(seeds[0].sum()), seeds[0].size, level)
    # With one seed, its episodes are the independent units.
    units = [seeds[0][[episode]] for episode in range(seeds[0].size)] if is_single else seeds
    mean = float(np.mean([unit.mean() for unit in units]))
    error = _bootstrap_error(units, generator, resamples)
    if are_rates:
        return _rate_bounds(mean, error, len(seeds), sum(seed.size for seed in seeds), level)
    return _mean_bounds(mean, error, len(units), level)


def _rate_bounds(
    rate: float, error: float, seeds: int, episodes: int, level: float
) -> tuple[float, float]:
    """Return Korn and Graubard's interval of a success rate; see `hierarchical_bootstrap`.

    Args:
        rate: the mean of the seeds' rates.
        error: its standard error.
        seeds: number of training seeds, at least 2.
        episodes: number of episodes in all.
        level: coverage, between 0 and 1.
    """
    worth = min(episodes, rate * (1 - rate) / error**2) if error > 0 else episodes
    worth *= (_student(level, episodes - 1) / _student(level, seeds - 1)) ** 2
    return _beta_bounds(rate * worth, worth, level)


def _mean_bounds(mean: float, error: float, units: int, level: float) -> tuple[float, float]:
    """Return Student's interval of a mean; see `hierarchical_bootstrap`.

    Args:
        mean: the mean of the independent units.
        error: its standard error by the bootstrap.
        units: their number; the interval of a single one is infinite.
        level: coverage, between 0 and 1.
    """
    if units == 1:
        return -math.inf, math.inf
    half = _student(level, units - 1) * error * math.sqrt(units / (units - 1))
    return mean - half, mean + half


def _bootstrap_error(groups: list[Array], generator: np.random.Generator, resamples: int) -> float:
    """Return the standard deviation of the mean of group means over hierarchical resamples."""
    drawn = generator.integers(len(groups), size=(resamples, len(groups)))
    means = np.empty(drawn.shape)
    for index, group in enumerate(groups):
        places = drawn == index
        picks = generator.integers(group.size, size=(int(places.sum()), group.size))
        means[places] = group[picks].mean(axis=1)
    return float(means.mean(axis=1).std())


def _student(level: float, freedom: int) -> float:
    """Return Student's two-sided quantile."""
    from scipy.stats import t

    return float(t.ppf((1 + _checked(level)) / 2, freedom))


def mcnemar(one: ArrayLike, other: ArrayLike) -> float:
    """Return the exact two-sided p-value of two policies' successes on the same starts.

    McNemar, Psychometrika 12 (1947), exact: under the null hypothesis, a fair coin decides which
    policy solves a start that only one of them solves. p is twice the smaller binomial tail, at
    most 1. Starts that both or neither solve carry no information.

    Args:
        one: successes of the first policy, booleans (n,).
        other: those of the second on the same n starts, in the same order.

    Raises:
        InputError: different lengths, or no starts.
    """
    from scipy.stats import binom

    a, b = np.asarray(one, bool), np.asarray(other, bool)
    if a.shape != b.shape or a.ndim != 1 or not a.size:
        raise InputError(
            f"Successes of shapes {a.shape} and {b.shape}; "
            "give the same starts of both, at least one."
        )
    first, second = int((a & ~b).sum()), int((b & ~a).sum())
    return min(1.0, 2.0 * float(binom.cdf(min(first, second), first + second, 0.5)))


class Retention(NamedTuple):
    """What is left of a success rate: shifted / plain on the same starts, with its interval.

    All are None where the plain policy never succeeded.
    """

    ratio: float | None
    low: float | None
    high: float | None


def retention(plain: ArrayLike, shifted: ArrayLike, level: float = 0.95) -> Retention:
    """Return the ratio of two success rates on the same starts.

    The interval is Bonett and Price's (Communications in Statistics 35, 2006): Wilson's bounds of
    both rates, narrowed for their correlation. A test checks its coverage by exact sums.

    Args:
        plain: successes (n,) by start; the denominator.
        shifted: successes (n,) on the same starts.
        level: coverage.

    Raises:
        InputError: different lengths, or no start.
    """
    one = np.asarray(plain, dtype=bool)
    other = np.asarray(shifted, dtype=bool)
    if one.shape != other.shape or one.ndim != 1 or not len(one):
        raise InputError(
            f"retention got successes of shapes {one.shape} and {other.shape}; "
            "it needs the same starts, at least one."
        )
    if not one.any():
        return Retention(None, None, None)
    first = int(other.sum())
    second = int(one.sum())
    lost = int((one & ~other).sum())
    won = int((other & ~one).sum())
    seen = int((one | other).sum())
    both = math.sqrt((lost + won + 2) / ((first + 1) * (second + 1)))
    spread = sum(
        math.sqrt((1 - (count + 1) / (seen + 2)) / (count + 1)) for count in (first, second)
    )
    quantile = NormalDist().inv_cdf(0.5 + _checked(level) / 2) * both / spread
    above = _wilson(first, seen, quantile)
    below = _wilson(second, seen, quantile)
    return Retention(first / second, above[0] / below[1], above[1] / below[0])


def _wilson(successes: int, trials: int, quantile: float) -> tuple[float, float]:
    """Return Wilson's bounds of a rate for a normal quantile."""
    square = quantile * quantile
    middle = 2 * successes + square
    reach = quantile * math.sqrt(square + 4 * successes * (1 - successes / trials))
    return (
        max(0.0, (middle - reach) / (2 * (trials + square))),
        min(1.0, (middle + reach) / (2 * (trials + square))),
    )


def differ(
    parts: Sequence[ArrayLike], generator: np.random.Generator, resamples: int = 4_999
) -> float:
    """Return the p-value of several parts having the same mean: a permutation test.

    Under the null hypothesis, which part a start is in does not matter. The statistic is the sum of
    squares between the parts. With few starts all permutations are counted, else `resamples`.

    Args:
        parts: the successes of each part's starts, numbers from 0 to 1; at least two parts, none
            of them empty.
        generator: draws the permutations.
        resamples: most permutations, besides the parts as they are.

    Raises:
        InputError: fewer than two parts, or an empty one.
    """
    from scipy.stats import permutation_test

    samples = [np.asarray(part, np.float64) for part in parts]
    if len(samples) < 2 or not all(part.size for part in samples):
        raise InputError(
            f"Parts of {[part.size for part in samples]} starts; give two or more, none empty."
        )

    edges = np.cumsum([part.size for part in samples])[:-1]

    def between(values: Array, axis: int = -1) -> Array:
        parts = np.split(values, edges, axis=axis)
        squares = [part.shape[axis] * np.square(part.mean(axis=axis)) for part in parts]
        total: Array = np.sum(squares, axis=0)
        return total

    test = permutation_test(
        (np.concatenate(samples),),
        between,
        permutation_type="pairings",
        vectorized=True,
        n_resamples=resamples,
        alternative="greater",
        rng=generator,
    )
    return float(test.pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for their number by Holm's step-down method, in the order given.

    Holm, Scandinavian Journal of Statistics 6 (1979): the i-th smallest of m is multiplied by m - i
    + 1, is at least as large as the one before, and at most 1. Rejecting those below α keeps the
    chance of any false rejection below α.

    Raises:
        InputError: a p-value outside [0, 1].
    """
    values = np.asarray(p_values, np.float64)
    if not ((values >= 0) & (values <= 1)).all():
        raise InputError(f"p-values {list(p_values)}; each must lie between 0 and 1.")
    order = np.argsort(values, kind="stable")
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(
        1.0, np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1))
    )
    return [float(value) for value in adjusted]


def area_under_curve(strength: ArrayLike, success: ArrayLike) -> float:
    """Return the mean success over the range of strengths: the trapezoids' area over its width.

    Args:
        strength: increasing, (k,), at least two.
        success: rate at each, (k,).

    Raises:
        InputError: lengths differ, fewer than two strengths, or they do not increase.
    """
    x, y = np.asarray(strength, np.float64), np.asarray(success, np.float64)
    if x.shape != y.shape or x.ndim != 1 or x.size < 2 or not (np.diff(x) > 0).all():
        raise InputError(
            f"Strengths {x.tolist()} with {y.size} successes; "
            "give at least two, increasing, one success for each."
        )
    area = float(np.sum(np.diff(x) * (y[1:] + y[:-1])) / 2 / (x[-1] - x[0]))
    # A mean, which rounding must not take out of the range of what it is a mean of.
    return min(max(area, float(y.min())), float(y.max()))


def area_interval(areas: Sequence[float], level: float = 0.95) -> tuple[float, float]:
    """Return an interval of the mean of values in [0, 1].

    The values are each start's own area under its successes.

    A value in [0, 1] varies at most as much as a success of the same mean. Clopper and Pearson's
    bounds of their sum (which need not be an integer) out of their number are therefore at least as
    wide as they must be.

    Raises:
        InputError: no values, or one outside [0, 1].
    """
    values = np.asarray(areas, np.float64)
    if not values.size or not ((values >= 0) & (values <= 1)).all():
        raise InputError(f"{values.size} areas; give at least one, each between 0 and 1.")
    return _beta_bounds(float(values.sum()), values.size, level)


def mean_and_std(values: Sequence[float]) -> dict[str, float | None]:
    """Return {"mean", "std"} of `values` (sample deviation); None where it is not defined."""
    count = len(values)
    if count == 0:
        return {"mean": None, "std": None}
    mean = sum(values) / count
    if count == 1:
        return {"mean": mean, "std": None}
    return {
        "mean": mean,
        "std": (sum((value - mean) ** 2 for value in values) / (count - 1)) ** 0.5,
    }


def _checked(level: float) -> float:
    if not 0 < level < 1:
        raise InputError(f"level is {level}; it must lie between 0 and 1.")
    return level
