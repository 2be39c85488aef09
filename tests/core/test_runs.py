"""Runs of equal neighbours."""

import numpy as np
import pytest

from surgicai_vision.core.runs import first_of_group, runs_of


@pytest.mark.parametrize(
    ("values", "found"),
    [([], []), ([3], [(0, 1)]), ([0, 0, 1, 0, 0, 0], [(0, 2), (2, 3), (3, 6)])],
)
def test_runs_of_small_arrays(values, found):
    assert runs_of(np.array(values, int)) == found


def test_runs_cover_an_array_and_neighbours_differ():
    values = np.random.default_rng(0).integers(0, 3, 200)
    runs = runs_of(values)
    assert [place for run in runs for place in range(*run)] == list(range(200))
    assert all(len(set(values[first:end])) == 1 for first, end in runs)
    assert all(values[end - 1] != values[end] for _, end in runs[:-1])


def test_first_of_group():
    assert first_of_group(np.array([0, 0, 1, 3, 3, 3])).tolist() == [0, 0, 2, 3, 3, 3]
    assert first_of_group(np.array([], int)).tolist() == []
