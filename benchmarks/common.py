"""What the benchmarks share.

Workers, medians, and one JSON line that says where and with what it was measured.
"""

import json
import os
import statistics
import tempfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, TypeVar

from surgicai_vision.evaluation.provenance import provenance

Job = TypeVar("Job")
Result = TypeVar("Result")


def emit(name: str, row: dict[str, Any], *, render: bool = False) -> None:
    """Print one JSON line: the benchmark's name, its numbers, machine and versions."""
    print(json.dumps({"benchmark": name, **row, "made_with": provenance(render=render)}))


def spread(function: Callable[[Job], Result], jobs: Iterable[Job], workers: int) -> list[Result]:
    """Return the results of `function` over `jobs`, in order; 0 workers run in this process."""
    if workers < 1:
        return [function(job) for job in jobs]
    with ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_settle_in
    ) as pool:
        return list(pool.map(function, jobs))


def _settle_in() -> None:
    """Work in a folder of its own, where MuJoCo may write its log of warnings."""
    os.chdir(tempfile.mkdtemp(prefix="benchmark-"))


def chunks(first: int, count: int, size: int = 25) -> list[range]:
    """Return `count` seeds from `first` in ranges of at most `size`."""
    end = first + count
    return [range(start, min(start + size, end)) for start in range(first, end, size)]


def median(values: Sequence[float], digits: int = 3) -> float:
    """Return the median, rounded."""
    return round(statistics.median(values), digits)
