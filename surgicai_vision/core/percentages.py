"""Percentages: how rates and their intervals are written, on pages, in cards and on the console."""

from collections.abc import Sequence


def percent(rate: float) -> str:
    """Return 0.654 as "65 %", and 299 of 300 as "99.7 %": only all are "100 %", only none "0 %"."""
    whole = f"{100 * rate:.0f}"
    if whole in ("0", "100") and rate not in (0.0, 1.0):
        return f"{100 * rate:.1f} %"
    return f"{whole} %"


def interval(bounds: Sequence[float]) -> str:
    """Return (0.4078, 0.8461) as "41–85 %", and (0.9975, 1) as "99.8–100.0 %"."""
    low, high = bounds
    digits = 1 if low != high and f"{100 * low:.0f}" == f"{100 * high:.0f}" else 0
    return f"{100 * low:.{digits}f}–{100 * high:.{digits}f} %"
