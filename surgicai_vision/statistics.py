"""Statistics of success counts."""

from surgicai_vision.errors import InputError


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the exact (Clopper-Pearson) interval of a success rate.

    Clopper and Pearson, Biometrika 26 (1934): the bounds are quantiles of Beta(k, n-k+1) and Beta(k+1, n-k).

    Args:
        successes: k, 0 ≤ k ≤ n.
        trials: n ≥ 1.
        confidence: coverage, between 0 and 1.

    Returns:
        Lower and upper bound, both in [0, 1]; 0 exactly for k = 0 and 1 exactly for k = n.

    Raises:
        InputError: counts or confidence outside their range.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise InputError(f"{successes} successes of {trials} trials; allowed: 0 ≤ successes ≤ trials, trials ≥ 1.")
    if not 0 < confidence < 1:
        raise InputError(f"confidence is {confidence}; it must lie between 0 and 1.")
    from scipy.stats import beta  # 0.3 s to import; the command line's --help must not pay for it

    tail = (1 - confidence) / 2
    low = 0.0 if successes == 0 else float(beta.ppf(tail, successes, trials - successes + 1))
    high = 1.0 if successes == trials else float(beta.ppf(1 - tail, successes + 1, trials - successes))
    return low, high


def mean_and_std(values: list[float]) -> dict[str, float | None]:
    """Return {"mean", "std"} of `values` (sample deviation, n - 1); None where it is not defined."""
    count = len(values)
    if count == 0:
        return {"mean": None, "std": None}
    mean = sum(values) / count
    if count == 1:
        return {"mean": mean, "std": None}
    return {"mean": mean, "std": (sum((value - mean) ** 2 for value in values) / (count - 1)) ** 0.5}
