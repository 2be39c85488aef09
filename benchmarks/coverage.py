"""Measure by simulation how often each nominal 95 % interval contains the true value.

    python benchmarks/coverage.py
    python benchmarks/coverage.py --repeats 500

* clopper_pearson: exact, not sampled: the probability over all k of n, at rates from 0.01 to 0.99.
* bootstrap: 3, 5 and 10 training seeds with 20 episodes each. Each seed has its own success rate,
  drawn from the Beta distribution with mean p and correlation r of two episodes of one seed
  (r = 0.2: the seeds' rates scatter by 0.22 at p = 0.5, by 0.1 at 0.95). Its episodes are Bernoulli
  draws.
* lengths: the same for trajectory lengths: normal seeds, log-normal episodes.
* area: 20 starts, five strengths; each start fails from its own strength onwards.

For comparison with `bootstrap`, `percentile` is the plain hierarchical bootstrap of 5 seeds and
shows what it would have covered. `worst` is the smallest coverage of a table; `held` says whether
none is below 95 % by more than three standard errors of the simulation.
"""

import argparse
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from common import emit
from scipy.stats import binom

from surgicai_vision.evaluation.statistics import (
    area_interval,
    area_under_curve,
    clopper_pearson,
    hierarchical_bootstrap,
)

LEVEL = 0.95
RATES = (0.02, 0.05, 0.1, 0.2, 0.5, 0.8, 0.9, 0.95, 0.98)
CORRELATIONS = (0.0, 0.05, 0.1, 0.2)
SIZES = ((3, 20), (5, 20), (10, 20))
PAPER = (5, 20)
LENGTHS = 5
"""Factor by which lengths have more repeats: they have few rows, and an interval that covers only
slightly more than it must.
"""
STRENGTHS = (0.0, 0.25, 0.5, 0.75, 1.0)

Interval = tuple[float, float]


def exact_coverage(trials: int, rate: float) -> float:
    """Return the probability that the Clopper-Pearson interval contains the rate."""
    bounds = [clopper_pearson(k, trials) for k in range(trials + 1)]
    chances = binom.pmf(np.arange(trials + 1), trials, rate)
    return float(
        sum(c for c, (low, high) in zip(chances, bounds, strict=True) if low <= rate <= high)
    )


def draw_rates(rng: np.random.Generator, seeds: int, rate: float, correlation: float) -> np.ndarray:
    """Draw the success rate of each training seed."""
    if not correlation:
        return np.full(seeds, rate)
    size = 1 / correlation - 1
    return rng.beta(rate * size, (1 - rate) * size, seeds)


def percentile(groups: np.ndarray, rng: np.random.Generator, resamples: int) -> Interval:
    """Return the plain hierarchical bootstrap's interval of successes (seeds, episodes)."""
    seeds, episodes = groups.shape
    chosen = rng.integers(seeds, size=(resamples, seeds))
    means = rng.binomial(episodes, groups.mean(axis=1)[chosen]).mean(axis=1) / episodes
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def count(draws: Iterator[tuple[float, Interval]]) -> tuple[float, float]:
    """Return how often the interval contained the true value, and its mean width."""
    held = 0
    width = 0.0
    total = 0
    for truth, (low, high) in draws:
        held = held + (low - 1e-12 <= truth <= high + 1e-12)
        width = width + high - low
        total = total + 1
    return held / total, width / total


def successes(
    seeds: int,
    episodes: int,
    rate: float,
    correlation: float,
    repeats: int,
    interval: Callable[..., Interval],
) -> Iterator[tuple[float, Interval]]:
    """Draw evaluations of `seeds` policies and their intervals."""
    rng = np.random.default_rng((seeds, episodes, round(1000 * rate), round(1000 * correlation)))
    for _ in range(repeats):
        rates = draw_rates(rng, seeds, rate, correlation)
        yield rate, interval((rng.random((seeds, episodes)) < rates[:, None]).astype(float), rng)


def lengths(
    seeds: int, episodes: int, scatter: float, repeats: int, resamples: int
) -> Iterator[tuple[float, Interval]]:
    """Draw trajectory lengths [mm] of `seeds` policies and their intervals."""
    rng = np.random.default_rng((seeds, episodes, round(100 * scatter)))
    for _ in range(repeats):
        means = 60.0 + scatter * rng.normal(size=(seeds, 1))
        values = means + 10.0 * (rng.lognormal(0.0, 0.5, (seeds, episodes)) - math.exp(0.125))
        yield 60.0, hierarchical_bootstrap(values.tolist(), rng, resamples=resamples)


def areas(starts: int, spread: float, repeats: int) -> Iterator[tuple[float, Interval]]:
    """Draw curves of successes and the intervals of their areas.

    Each start fails from a strength drawn from Beta(spread, spread) onwards.
    """
    rng = np.random.default_rng((starts, round(100 * spread)))
    curves = [
        area_under_curve(STRENGTHS, np.array(STRENGTHS) < limit)
        for limit in rng.beta(spread, spread, 200_000)
    ]
    truth = float(np.mean(curves))
    for _ in range(repeats):
        yield (
            truth,
            area_interval([curves[index] for index in rng.integers(len(curves), size=starts)]),
        )


def table(rows: list[dict[str, Any]], repeats: int) -> dict[str, Any]:
    """Return the rows with their smallest coverage and the verdict."""
    worst = min(row["coverage"] for row in rows)
    allowance = 3 * math.sqrt(LEVEL * (1 - LEVEL) / repeats) if repeats else 1e-9
    return {
        "worst": round(worst, 4),
        "held": worst >= LEVEL - allowance,
        "repeats": repeats,
        "rows": rows,
    }


def measure(repeats: int, resamples: int) -> dict[str, Any]:
    """Measure all intervals."""
    exact = [
        {"n": n, "p": p / 100, "coverage": round(exact_coverage(n, p / 100), 4)}
        for n in (10, 20, 50, 100)
        for p in range(1, 100)
    ]
    kinds: dict[str, Callable[..., Interval]] = {
        "bootstrap": lambda values, rng: hierarchical_bootstrap(
            values.tolist(), rng, resamples=resamples
        ),
        "percentile": lambda values, rng: percentile(values, rng, resamples),
    }
    result = {"clopper_pearson": table(exact, 0)}
    for kind, interval in kinds.items():
        rows = []
        for seeds, episodes in SIZES if kind == "bootstrap" else (PAPER,):
            for p in RATES:
                for r in CORRELATIONS:
                    share, width = count(successes(seeds, episodes, p, r, repeats, interval))
                    size = {"seeds": seeds, "episodes": episodes, "p": p, "r": r}
                    rows.append({**size, "coverage": round(share, 4), "width": round(width, 3)})
        result[kind] = table(rows, repeats)
    rows = []
    for seeds, scatter in ((3, 0.0), (3, 10.0), (5, 0.0), (5, 3.0), (5, 10.0)):
        share, width = count(lengths(seeds, 20, scatter, LENGTHS * repeats, resamples))
        rows.append(
            {
                "seeds": seeds,
                "scatter_mm": scatter,
                "coverage": round(share, 4),
                "width": round(width, 1),
            }
        )
    result["lengths"] = table(rows, LENGTHS * repeats)
    shares = {spread: count(areas(20, spread, repeats)) for spread in (0.1, 0.3, 1.0, 5.0)}
    rows = [
        {"spread": key, "coverage": round(c, 4), "width": round(w, 3)}
        for key, (c, w) in shares.items()
    ]
    result["area"] = table(rows, repeats)
    return result


def main() -> None:
    """Measure and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--repeats", type=int, default=2000, help="simulated evaluations of each row"
    )
    parser.add_argument("--resamples", type=int, default=1000, help="resamples of each bootstrap")
    chosen = parser.parse_args()
    emit("coverage", {"resamples": chosen.resamples, **measure(chosen.repeats, chosen.resamples)})


if __name__ == "__main__":
    main()
