"""Percentages: nearly all is not shown as all, and an interval has two distinct ends."""

from surgicai_vision.core.percentages import interval, percent
from surgicai_vision.evaluation.statistics import clopper_pearson


def test_only_all_are_a_hundred_percent_and_only_none_nothing():
    rates = (0, 1 / 300, 0.654, 299 / 300, 1)
    assert list(map(percent, rates)) == ["0 %", "0.3 %", "65 %", "99.7 %", "100 %"]


def test_the_ends_of_an_interval_differ():
    assert interval(clopper_pearson(13, 20)) == "41–85 %"
    assert interval(clopper_pearson(1500, 1500)) == "99.8–100.0 %"
    assert interval((1.0, 1.0)) == "100–100 %", "no interval at all"
