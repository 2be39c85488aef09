"""Intervals and tests against SciPy's own and other formulas, on random tables.

Coverage is checked by simulation and by exact sums.
"""

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.stats import beta, binom, binomtest, hypergeom, multinomial, t

from surgicai_vision.core.errors import InputError
from surgicai_vision.evaluation.statistics import (
    area_interval,
    area_under_curve,
    clopper_pearson,
    differ,
    hierarchical_bootstrap,
    holm,
    mcnemar,
    mean_and_std,
    retention,
)

TABLES = 1000


def test_interval_equals_scipy_on_random_tables():
    rng = np.random.default_rng(0)
    for _ in range(TABLES):
        trials, level = int(rng.integers(1, 150)), float(rng.choice([0.8, 0.9, 0.95, 0.99]))
        successes = int(rng.integers(0, trials + 1))
        expected = binomtest(successes, trials).proportion_ci(level, method="exact")
        assert clopper_pearson(successes, trials, level) == pytest.approx(
            (expected.low, expected.high), abs=1e-9
        )


@pytest.mark.parametrize("trials", [1, 2, 20, 10_000])
def test_interval_at_none_and_all(trials):
    low, high = clopper_pearson(0, trials)
    assert low == 0.0 and 0 < high < 1
    low, high = clopper_pearson(trials, trials)
    assert high == 1.0 and 0 < low < 1


@pytest.mark.parametrize(("successes", "trials"), [(-1, 3), (4, 3), (0, 0)])
def test_interval_refuses_impossible_counts(successes, trials):
    with pytest.raises(InputError, match="allowed"):
        clopper_pearson(successes, trials)


@pytest.mark.parametrize("level", [0.0, 1.0, 95.0])
def test_level_is_checked(level):
    with pytest.raises(InputError, match="between 0 and 1"):
        clopper_pearson(3, 7, level)


def test_mcnemar_equals_scipy_on_random_tables():
    rng = np.random.default_rng(1)
    for _ in range(TABLES):
        count = int(rng.integers(1, 60))
        one, other = rng.random(count) < rng.random(), rng.random(count) < rng.random()
        first, second = int((one & ~other).sum()), int((other & ~one).sum())
        expected = binomtest(first, first + second, 0.5).pvalue if first + second else 1.0
        assert mcnemar(one, other) == pytest.approx(expected, abs=1e-9)
        assert mcnemar(other, one) == mcnemar(one, other)


def test_mcnemar_refuses_other_starts():
    with pytest.raises(InputError, match="same starts"):
        mcnemar([True], [True, False])


def holm_by_definition(p_values):
    """Adjusted p = largest of (m - j) p_j over the p-values that are not larger (Holm 1979)."""
    ordered, adjusted = sorted(p_values), []
    for p in p_values:
        terms = [(len(ordered) - index) * q for index, q in enumerate(ordered) if q <= p]
        adjusted.append(min(1.0, max(terms)))
    return adjusted


def holm_by_closure(p_values):
    """Holm is the closed test whose every intersection is tested by Bonferroni."""
    every = range(len(p_values))
    return [
        max(
            min(1.0, size * min(p_values[k] for k in chosen))
            for size in range(1, len(p_values) + 1)
            for chosen in itertools.combinations(every, size)
            if index in chosen
        )
        for index in every
    ]


def test_two_parts_differ_as_by_fishers_exact_test():
    """With two parts and all permutations, the two-sided test by the sum of squares is Fisher's."""
    rng = np.random.default_rng(4)
    for _ in range(30):
        sizes = rng.integers(1, 5, 2)
        won = [(rng.random(size) < 0.5).astype(float) for size in sizes]
        counts = [[int(part.sum()), int((1 - part).sum())] for part in won]
        spread = [part.size * part.mean() ** 2 for part in won]
        total, all_ = int(sum(part.sum() for part in won)), int(sum(sizes))
        chances = hypergeom(all_, total, int(sizes[0])).pmf
        expected = sum(
            chances(first)
            for first in range(min(total, int(sizes[0])) + 1)
            if total - first <= sizes[1]
            and first**2 / sizes[0] + (total - first) ** 2 / sizes[1] >= sum(spread) - 1e-9
        )
        p = differ(won, rng, resamples=math.factorial(all_))
        assert p == pytest.approx(expected, abs=1e-9), counts


def test_parts_that_are_alike_differ_by_chance_alone():
    rng = np.random.default_rng(5)
    chances = [
        differ([rng.random(size) < 0.7 for size in (30, 25, 1)], rng, resamples=199)
        for _ in range(400)
    ]
    for level in (0.05, 0.2):
        # A permutation test is exact: at most that share, within five standard errors.
        share = np.mean(np.array(chances) <= level)
        assert share <= level + 5 * math.sqrt(level * (1 - level) / len(chances))
    assert differ([[1.0] * 30, [0.0] * 30, [1.0] * 30], rng) < 0.001


@pytest.mark.parametrize("parts", [[], [[1.0]], [[1.0], []]])
def test_one_part_cannot_differ(parts):
    with pytest.raises(InputError, match="two or more"):
        differ(parts, np.random.default_rng(0))


def test_holm_equals_its_definition_on_random_tables():
    rng = np.random.default_rng(2)
    for _ in range(TABLES):
        p_values = (
            (rng.random(int(rng.integers(1, 12))) ** 3).round(int(rng.integers(1, 12))).tolist()
        )
        assert holm(p_values) == pytest.approx(holm_by_definition(p_values), abs=1e-9)
    for _ in range(50):
        p_values = (rng.random(int(rng.integers(1, 7))) ** 3).tolist()
        assert holm(p_values) == pytest.approx(holm_by_closure(p_values), abs=1e-9)


def test_holm_of_nothing_and_of_what_is_no_p_value():
    assert holm([]) == []
    with pytest.raises(InputError, match="between 0 and 1"):
        holm([0.5, 1.5])


def test_area_equals_scipy_on_random_curves():
    rng = np.random.default_rng(4)
    for _ in range(TABLES):
        strength = np.cumsum(rng.random(int(rng.integers(2, 9))) + 1e-3)
        success = rng.random(strength.size)
        expected = trapezoid(success, strength) / (strength[-1] - strength[0])
        assert area_under_curve(strength, success) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("strength", "success"), [([0.0], [1.0]), ([0, 1], [1.0]), ([0, 0], [1, 1]), ([1, 0], [1, 1])]
)
def test_area_refuses_what_is_no_curve(strength, success):
    with pytest.raises(InputError, match="increasing"):
        area_under_curve(strength, success)


def test_an_area_stays_within_its_successes_where_its_strengths_round():
    area = area_under_curve([0.0, 0.3, 0.9], [1.0, 1.0, 1.0])
    assert area == 1.0  # the trapezoids' own sum is 1.0000000000000002
    assert area_interval([area] * 4)[1] == 1.0


def test_bootstrap_of_one_seed_is_the_exact_interval():
    values = [1.0] * 7 + [0.0] * 13
    assert hierarchical_bootstrap([values], np.random.default_rng(0)) == clopper_pearson(7, 20)


def korn_graubard(groups):
    """The interval of success counts with the bootstrap's error in closed form.

    It is the limit of infinitely many resamples.
    """
    p, seeds = np.mean([np.mean(g) for g in groups]), len(groups)
    rates, sizes = np.array([np.mean(g) for g in groups]), np.array([len(g) for g in groups])
    variance = rates.var() / seeds + np.mean(rates * (1 - rates) / sizes) / seeds
    trials = sizes.sum()
    worth = min(trials, p * (1 - p) / variance) if variance else trials
    worth *= (t.ppf(0.975, trials - 1) / t.ppf(0.975, seeds - 1)) ** 2
    k = p * worth
    low = 0.0 if k == 0 else beta.ppf(0.025, k, worth - k + 1)
    return low, 1.0 if k == worth else beta.ppf(0.975, k + 1, worth - k)


@pytest.mark.parametrize(
    "rates", [(0.2, 0.5, 0.9), (0.5,) * 5, (0.0, 0.0, 0.1, 0.0, 0.0), (1.0,) * 5]
)
def test_bootstrap_equals_its_limit(rates):
    groups = [[1.0] * round(20 * rate) + [0.0] * (20 - round(20 * rate)) for rate in rates]
    found = hierarchical_bootstrap(groups, np.random.default_rng(0), resamples=40_000)
    assert found == pytest.approx(korn_graubard(groups), abs=6e-3)


def test_bootstrap_of_lengths_is_students_interval_where_episodes_do_not_vary():
    groups = [[value] * 4 for value in (50.0, 56.0, 61.0, 53.0, 70.0)]
    means = np.array([group[0] for group in groups])
    half = t.ppf(0.975, 4) * means.std(ddof=1) / np.sqrt(5)
    found = hierarchical_bootstrap(groups, np.random.default_rng(0), resamples=40_000)
    assert found == pytest.approx((means.mean() - half, means.mean() + half), rel=0.01)


def test_bootstrap_is_the_same_for_the_same_generator():
    groups = [[1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 1.0]]
    one, again = (hierarchical_bootstrap(groups, np.random.default_rng(5)) for _ in range(2))
    assert one == again


@pytest.mark.parametrize("groups", [[], [[]], [[1.0], []], [[float("nan")]]])
def test_bootstrap_refuses_what_is_no_table(groups):
    with pytest.raises(InputError, match="training seeds"):
        hierarchical_bootstrap(groups, np.random.default_rng(0))


def test_clopper_pearson_covers_what_it_says():
    for trials in (5, 20, 60):
        bounds = np.array([clopper_pearson(k, trials) for k in range(trials + 1)])
        for rate in np.linspace(0.01, 0.99, 99):
            holds = (bounds[:, 0] <= rate) & (rate <= bounds[:, 1])
            assert binom.pmf(np.arange(trials + 1), trials, rate)[holds].sum() >= 0.95


@pytest.mark.parametrize("rate", [0.05, 0.5, 0.9])
@pytest.mark.parametrize("correlation", [0.0, 0.2])
def test_bootstrap_covers_what_it_says(rate, correlation):
    rng = np.random.default_rng(6)
    held = []
    for _ in range(400):
        size = 1 / correlation - 1 if correlation else np.inf
        rates = rng.beta(rate * size, (1 - rate) * size, 5) if correlation else np.full(5, rate)
        groups = (rng.random((5, 20)) < rates[:, None]).astype(float)
        low, high = hierarchical_bootstrap(groups.tolist(), rng, resamples=200)
        held.append(low <= rate <= high)
    assert np.mean(held) >= 0.95


def test_area_interval_covers_what_it_says():
    rng, strengths = np.random.default_rng(7), np.linspace(0, 1, 5)
    areas = [area_under_curve(strengths, strengths < limit) for limit in rng.beta(0.3, 0.3, 4000)]
    truth, held = np.mean(areas), []
    for _ in range(400):
        low, high = area_interval(rng.choice(areas, 20).tolist())
        held.append(low <= truth <= high)
    assert np.mean(held) >= 0.95
    assert area_interval([1.0, 1.0]) == clopper_pearson(2, 2)
    with pytest.raises(InputError, match="areas"):
        area_interval([1.2])


def test_mean_and_std():
    assert mean_and_std([]) == {"mean": None, "std": None}
    assert mean_and_std([3.0]) == {"mean": 3.0, "std": None}
    values = [1.0, 2.0, 4.0]
    assert mean_and_std(values)["std"] == pytest.approx(np.std(values, ddof=1))


def test_retention_is_the_ratio_of_rates_on_the_same_starts():
    plain = [1, 1, 1, 1, 0, 0]
    shift = [1, 1, 0, 0, 1, 0]
    kept = retention(plain, shift)
    assert kept.ratio == pytest.approx(3 / 4)
    assert kept.low < kept.ratio < kept.high
    assert retention([0, 0], [1, 0]) == (None, None, None)
    assert retention(plain, plain).ratio == 1.0
    with pytest.raises(InputError, match="same starts"):
        retention([1], [1, 0])


@pytest.mark.parametrize(
    ("both", "lost", "won"), [(0.5, 0.3, 0.05), (0.2, 0.6, 0.0), (0.85, 0.1, 0.02), (0.4, 0.2, 0.2)]
)
def test_the_interval_of_retention_covers_by_exact_sums(both, lost, won):
    """All outcomes of 30 starts, weighted by their probability: at least 93 % are covered."""
    n = 30
    truth = (both + won) / (both + lost)
    covered = 0.0
    for a in range(n + 1):
        for b in range(n + 1 - a):
            for c in range(n + 1 - a - b):
                weight = multinomial.pmf(
                    [a, b, c, n - a - b - c], n, [both, lost, won, 1 - both - lost - won]
                )
                if weight < 1e-9 or a + b == 0:
                    continue
                plain = [1] * (a + b) + [0] * (n - a - b)
                shift = [1] * a + [0] * b + [1] * c + [0] * (n - a - b - c)
                kept = retention(plain, shift)
                covered += weight * (kept.low <= truth <= kept.high)
    assert covered >= 0.93
