"""A naive test whether a needle's polyline crosses a hole, as a reference for the closed form."""

import numpy as np

from surgicai_vision.scene.holes import OPENING


def crosses(polyline, hole, inward):
    """Return True if a polyline (n, 3) from base to tip crosses the opening in this direction."""
    local = (polyline - np.asarray(hole.centre)) @ hole.rotation
    before, after = local[:-1], local[1:]
    passes = (
        (before[:, 2] > 0) & (after[:, 2] <= 0)
        if inward
        else (before[:, 2] <= 0) & (after[:, 2] > 0)
    )
    if not passes.any():
        return False
    start, end = before[passes], after[passes]
    share = start[:, 2] / (start[:, 2] - end[:, 2])
    points = start[:, :2] + share[:, None] * (end[:, :2] - start[:, :2])
    nearest = points[np.argmin((points**2).sum(axis=1))]
    return bool(np.all(np.abs(nearest) < OPENING / 2))
