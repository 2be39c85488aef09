"""Helpers that the benchmarks share.

Workers, medians, and one JSON line that names the machine and the versions of a measurement.
"""

import json
import os
import statistics
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

from surgicai_vision.evaluation.provenance import provenance

Job = TypeVar("Job")
Result = TypeVar("Result")


def emit(name: str, row: dict[str, Any], *, render: bool = False) -> None:
    """Print one JSON line: the benchmark's name, its numbers, the machine and versions."""
    print(json.dumps({"benchmark": name, **row, "made_with": provenance(render=render)}))


def spread(function: Callable[[Job], Result], jobs: Iterable[Job], workers: int) -> list[Result]:
    """Return the results of `function` over `jobs`, in order; with 0 workers, in this process."""
    if workers < 1:
        return [function(job) for job in jobs]
    with ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_settle_in
    ) as pool:
        return list(pool.map(function, jobs))


def spread_resumable(
    function: Callable[[Job], dict[str, Any]],
    jobs: Sequence[Job],
    workers: int,
    out: Path | None = None,
) -> list[dict[str, Any]]:
    """Return the results of `function` over `jobs`, in order, and report progress on stderr.

    Args:
        function: takes one job; returns what JSON can hold.
        jobs: what to do, each with a unique `repr`.
        workers: processes; 0 runs the jobs in this one.
        out: file for each result as a line; a later call with the same jobs continues from it.
    """
    done: dict[str, dict[str, Any]] = {}
    if out is not None and out.exists():
        # A line that was cut off by an interruption is ignored.
        whole = out.read_text().split("\n")[:-1]
        done = {row["job"]: row["result"] for row in map(json.loads, whole)}
        out.write_text("".join(line + "\n" for line in whole))
    waiting = [job for job in jobs if repr(job) not in done]
    with ExitStack() as stack:
        if workers < 1:
            results: Iterable[dict[str, Any]] = map(function, waiting)
        else:
            pool = stack.enter_context(
                ProcessPoolExecutor(
                    workers, mp_context=get_context("spawn"), initializer=_settle_in
                )
            )
            results = pool.map(function, waiting)
        for job, result in zip(waiting, results, strict=True):
            done[repr(job)] = result
            if out is not None:
                with out.open("a") as file:
                    print(json.dumps({"job": repr(job), "result": result}), file=file)
            count = sum(repr(job) in done for job in jobs)
            print(f"{count} of {len(jobs)} jobs", file=sys.stderr, flush=True)
    return [done[repr(job)] for job in jobs]


def _settle_in() -> None:
    """Change to a new folder, where MuJoCo may write its log of warnings."""
    os.chdir(tempfile.mkdtemp(prefix="benchmark-"))


def chunks(first: int, count: int, size: int = 25) -> list[range]:
    """Return `count` seeds from `first` in ranges of at most `size`."""
    end = first + count
    return [range(start, min(start + size, end)) for start in range(first, end, size)]


def median(values: Sequence[float], digits: int = 3) -> float:
    """Return the median, rounded."""
    return round(statistics.median(values), digits)
