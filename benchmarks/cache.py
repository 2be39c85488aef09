"""Measure random reads of the feature cache.

Rows of 2,048 float16 values, in random order, as training reads them.

    python benchmarks/cache.py --json

An entry is written by `surgicai_vision.features.cache.encode` itself, with an encoder that costs
nothing. Each repetition reads batches of 256 rows drawn at random from all of them: as stored
(`float16`), and cast to float32 as `training` does. The pages are in memory, as they are from the
second epoch on. Every batch is checked to hold the requested rows. Prints one JSON line.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from common import emit, median

from surgicai_vision.features import encoders
from surgicai_vision.features.cache import encode

DIM = 2048


class Source:
    """A dataset of tiny frames, each different."""

    views = ("back",)
    policy_views = views
    fingerprint = "benchmark"

    def __init__(self, length: int):
        self.length = length

    def frames(self, view: str, start: int, stop: int) -> np.ndarray:
        """Return frames start..stop; their values are the frame's number."""
        return np.broadcast_to(np.arange(start, stop)[:, None, None, None], (stop - start, 1, 1, 3))


class Filler:
    """An encoder whose rows hold the frame's number."""

    card = encoders.encoder_card("random")
    pool = "global"
    dim = DIM
    shape = (DIM,)
    fingerprint = "filler"
    weights_sha256 = ""

    def __call__(self, frames: np.ndarray) -> np.ndarray:
        """Return (B, DIM) float32 rows."""
        return np.repeat(frames[:, 0, 0, :1] % 2048, DIM, axis=1).astype(np.float32)


def read(
    rows: np.ndarray, count: int, batch: int, kind: type, generator: np.random.Generator
) -> float:
    """Read `count` random rows; return rows/s."""
    order = generator.integers(0, len(rows), (count // batch, batch))
    began = time.perf_counter()
    total = 0.0
    for chosen in order:
        total += float(rows[chosen].astype(kind, copy=False)[0, 0])
    seconds = time.perf_counter() - began
    assert total == float(np.sum(order[:, 0] % 2048)), "a different row from the one requested"
    return order.size / seconds


def main() -> None:
    """Write an entry, read it and print the speeds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, default=50_000, help="rows of the entry, 4 KiB each")
    parser.add_argument("--read", type=int, default=200_000, help="rows read in each repetition")
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--json", action="store_true", help="accepted for symmetry; the output is always JSON"
    )
    arguments = parser.parse_args()
    generator = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        entry = encode(Source(arguments.rows), "back", Filler(), Path(folder))  # type: ignore[arg-type]
        kinds = {"float16": np.float16, "float32": np.float32}
        rates: dict[str, list[float]] = {name: [] for name in kinds}
        for _ in range(arguments.repeats):
            for name, kind in kinds.items():
                rates[name].append(
                    read(entry.rows, arguments.read, arguments.batch, kind, generator)
                )
    row = {
        "rows": arguments.rows,
        "dim": DIM,
        "batch": arguments.batch,
        "repeats": arguments.repeats,
        "rows_per_s": {name: round(median(values)) for name, values in rates.items()},
        "slowest_rows_per_s": {name: round(min(values)) for name, values in rates.items()},
    }
    emit("cache", row)


if __name__ == "__main__":
    main()
