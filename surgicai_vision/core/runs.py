"""Runs: stretches of equal neighbours, such as the frames of an episode or the steps of a phase."""

import itertools

import numpy as np
from numpy.typing import NDArray


def runs_of(values: NDArray[np.generic]) -> list[tuple[int, int]]:
    """Return (first index, index after the last) of every run of equal values in `values`, (N,)."""
    count = len(values)
    edges = np.flatnonzero(values[1:] != values[:-1]) + 1
    return list(itertools.pairwise([0, *edges.tolist(), count])) if count else []


def first_of_group(values: NDArray[np.generic]) -> NDArray[np.int64]:
    """Return the index of the first element equal to each element of `values`, (N,) int64.

    Args:
        values: (N,), ascending, such as the episode of every frame.
    """
    return np.searchsorted(values, values)
