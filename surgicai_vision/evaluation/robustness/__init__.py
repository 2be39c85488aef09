"""Robustness: the same policy on the same starts while one thing at a time shifts.

`axes` says what can shift, `corrupted_agent` sees corrupted images (`core.corruption`), `curves`
evaluates a policy along the axes.
"""

from surgicai_vision.evaluation.robustness.axes import ALL, AXES, SHIFTS, SINGLE, axes_of, shifted

__all__ = [
    "ALL",
    "AXES",
    "CURVES",
    "MARK",
    "SHIFTS",
    "SINGLE",
    "STRENGTHS",
    "axes_of",
    "shifted",
]

STRENGTHS = (0.0, 0.25, 0.5, 0.75, 1.0)
CURVES, MARK = "robustness.parquet", "robustness.json"
