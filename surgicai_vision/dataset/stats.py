"""Statistics of one episode in LeRobot's form: min, max, mean, std, count and quantiles.

Images stream through `ImageStatistics` one at a time, so memory is bounded. RGB statistics use
every pixel (values in [0, 1] as LeRobot stores them), depth statistics a fixed sixteenth of them
[m]. Statistics of other columns are exact.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""LeRobot's quantiles (lerobot 0.6.1, datasets/compute_stats.py)."""

DEPTH_STRIDE = 4
"""Statistics of a depth image use every fourth pixel of every fourth row."""

Statistics = dict[str, list[Any]]


class ImageStatistics:
    """Running statistics of one image column: (H, W, channels) frames, uint8 or float32 [m]."""

    def __init__(self) -> None:
        self._count = 0
        self._histogram = np.zeros((1, 256))
        self._depths: list[NDArray[np.float32]] = []

    def add(self, frame: NDArray[np.uint8 | np.float32]) -> None:
        """Add one frame."""
        self._count += 1
        if frame.dtype == np.uint8:
            counts = [
                cv2.calcHist([frame], [channel], None, [256], [0, 256]).ravel()
                for channel in range(frame.shape[2])
            ]
            self._histogram = self._histogram + np.stack(counts)  # one row per channel
        else:
            part = frame[::DEPTH_STRIDE, ::DEPTH_STRIDE].astype(np.float32)
            self._depths.append(part.reshape(-1, frame.shape[2]))

    def result(self) -> Statistics:
        """Return the statistics, each of shape (channels, 1, 1); the count is (1,)."""
        if self._depths:
            depths = np.concatenate(self._depths).astype(np.float64)
            channels = [_column_statistics(column) for column in depths.T]
        else:
            channels = [_histogram_statistics(row) for row in self._histogram]
        table: Statistics = {name: [[[row[name]]] for row in channels] for name in channels[0]}
        return {**table, "count": [self._count]}


def column_statistics(values: NDArray[np.generic]) -> Statistics:
    """Return the statistics of a column (T,) or (T, n), each of shape (n,); the count is (1,)."""
    columns = values.reshape(len(values), -1).astype(np.float64).T
    rows = [_column_statistics(column) for column in columns]
    return {**{name: [row[name] for row in rows] for name in rows[0]}, "count": [len(values)]}


def _column_statistics(values: NDArray[np.float64]) -> dict[str, float]:
    quantiles = np.quantile(values, list(QUANTILES.values()))
    return {
        "min": float(values.min()),
        "max": float(values.max()),
        "mean": float(values.mean()),
        "std": float(values.std()),
        **{name: float(value) for name, value in zip(QUANTILES, quantiles, strict=True)},
    }


def _histogram_statistics(histogram: NDArray[np.float64]) -> dict[str, float]:
    """Return the statistics of values 0..255, divided by 255, from their histogram."""
    levels = np.arange(256) / 255.0
    total = histogram.sum()
    present = levels[histogram > 0]
    mean = float(histogram @ levels / total)
    cumulative = np.cumsum(histogram)
    return {
        "min": float(present[0]),
        "max": float(present[-1]),
        "mean": mean,
        "std": float(np.sqrt(max(histogram @ (levels - mean) ** 2 / total, 0.0))),
        **{
            name: float(levels[np.searchsorted(cumulative, q * total)])
            for name, q in QUANTILES.items()
        },
    }
