"""Intervals against SciPy's own, on random tables and at the edges."""

import numpy as np
import pytest
from scipy.stats import binomtest

from surgicai_vision.errors import InputError
from surgicai_vision.statistics import clopper_pearson, mean_and_std


def test_interval_equals_scipy_on_random_tables():
    rng = np.random.default_rng(0)
    for _ in range(200):
        trials = int(rng.integers(1, 150))
        successes = int(rng.integers(0, trials + 1))
        expected = binomtest(successes, trials).proportion_ci(0.95, method="exact")
        assert clopper_pearson(successes, trials) == pytest.approx((expected.low, expected.high), abs=1e-9)


@pytest.mark.parametrize("trials", [1, 2, 20, 10_000])
def test_interval_at_none_and_all(trials):
    low, high = clopper_pearson(0, trials)
    assert low == 0.0 and 0 < high < 1
    low, high = clopper_pearson(trials, trials)
    assert high == 1.0 and 0 < low < 1


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.99])
def test_interval_at_other_confidences(confidence):
    expected = binomtest(7, 20).proportion_ci(confidence, method="exact")
    assert clopper_pearson(7, 20, confidence) == pytest.approx((expected.low, expected.high), abs=1e-9)


@pytest.mark.parametrize(("successes", "trials"), [(-1, 3), (4, 3), (0, 0)])
def test_interval_refuses_impossible_counts(successes, trials):
    with pytest.raises(InputError, match="allowed"):
        clopper_pearson(successes, trials)


def test_nominal_coverage_is_kept():
    rng = np.random.default_rng(1)
    bounds = [clopper_pearson(k, 20) for k in range(21)]
    for rate in (0.05, 0.3, 0.5, 0.9):
        draws = rng.binomial(20, rate, size=4000)
        assert np.mean([bounds[k][0] <= rate <= bounds[k][1] for k in draws]) >= 0.95


def test_mean_and_std():
    assert mean_and_std([]) == {"mean": None, "std": None}
    assert mean_and_std([3.0]) == {"mean": 3.0, "std": None}
    values = [1.0, 2.0, 4.0]
    assert mean_and_std(values)["std"] == pytest.approx(np.std(values, ddof=1))
