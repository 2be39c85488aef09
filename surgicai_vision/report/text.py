"""Text: numbers as tables print them, with intervals in brackets and a dash for absent ones.

Rates are written by `core.percentages`.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np

ABSENT = "–"


def either(values: Iterable[object]) -> str:
    """Return what differs among `values`, in order, as "200, 300 or 2000"."""
    words = [str(value) for value in dict.fromkeys(values)]
    return " or ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def mean(value: dict[str, float | None]) -> str:
    """Return {"mean", "std"} as "41.5 ± 2.0"."""
    if value["mean"] is None:
        return ABSENT
    return f"{value['mean']:.1f}" + (f" ± {value['std']:.1f}" if value["std"] is not None else "")


def finite(values: Sequence[float | None]) -> list[float]:
    """Return the numbers among `values`: neither None nor NaN."""
    return [float(value) for value in values if value is not None and math.isfinite(value)]


def quartiles(values: Sequence[float | None]) -> tuple[float, float, float] | None:
    """Return lower quartile, median and upper quartile of the numbers among `values`.

    Return None if there are none.
    """
    known = finite(values)
    if not known:
        return None
    low, middle, high = np.percentile(known, (25, 50, 75))
    return float(low), float(middle), float(high)


def spread(values: Sequence[float | None]) -> str:
    """Return the median and quartiles as "0.8 (0.5–1.2)", with two significant digits.

    If some are missing, it also says how many there are.
    """
    found = quartiles(values)
    if found is None:
        return ABSENT
    digits = next(
        (digits for digits, least in enumerate((100, 1, 0.1, 0.01)) if found[2] >= least), 3
    )
    low, middle, high = (f"{value:.{digits}f}" for value in found)
    count = len(finite(values))
    return f"{middle} ({low}–{high})" + (f", n = {count}" if count < len(values) else "")


def probability(p: float, sign: str = "") -> str:
    """Return a p-value: "0.031", or "< 0.001" below that.

    `sign` comes before a number that is given exactly.
    """
    return "< 0.001" if p < 0.001 else f"{sign}{p:.3f}"
