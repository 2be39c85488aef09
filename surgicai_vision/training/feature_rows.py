"""Feature rows: the cached features of a training, read from the disk or held by the GPU.

Feature maps of a few thousand demonstrations take gigabytes. Read from the disk batch by batch,
they and not the arithmetic decide how long a training on a GPU takes; so they move to its memory
where they leave half of it free. The values are the same in both places.
"""

from collections.abc import Sequence
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray

from surgicai_vision.features.cache import Features
from surgicai_vision.features.devices import CPU, CUDA

MOVED_ROWS = 4096  # rows moved at a time


@final
class FeatureRows:
    """The features of several views of one dataset.

    Args:
        features: one entry per view, in the order of a policy's inputs.
        device: the device that trains.

    Attributes:
        home: the device that has the features: the GPU that trains, or the CPU.
    """

    def __init__(self, features: Sequence[Features], device: torch.device) -> None:
        self._mapped = [entry.rows for entry in features]
        held = bool(features) and device.type == CUDA and _fits(self._mapped, device)
        self.home = device if held else torch.device(CPU)
        self._held = [_moved(rows, device) for rows in self._mapped] if held else []

    def write(self, rows: NDArray[np.int64], observed: torch.Tensor) -> int:
        """Write some frames' features, one view after the other, into the first columns.

        Args:
            rows: (n,) indices of the frames.
            observed: (n, inputs) float32 on `home`.

        Returns:
            The number of columns written.
        """
        # Each view is copied only once, into place: the maps of a batch are tens of megabytes.
        at = 0
        index = torch.from_numpy(rows).to(self.home) if self._held else None
        for place, mapped in enumerate(self._mapped):
            seen = torch.from_numpy(mapped[rows]) if index is None else self._held[place][index]
            observed[:, at : at + seen.shape[1]] = seen
            at += seen.shape[1]
        return at


def _fits(mapped: Sequence[NDArray[np.float16]], device: torch.device) -> bool:
    """Return True if the features take at most half of what is free on a GPU."""
    free, _ = torch.cuda.mem_get_info(device)
    return 2 * sum(rows.nbytes for rows in mapped) <= free


def _moved(rows: NDArray[np.float16], device: torch.device) -> torch.Tensor:
    """Return one view's features on a device, moved piece by piece."""
    moved = torch.empty(rows.shape, dtype=torch.float16, device=device)
    for at in range(0, len(rows), MOVED_ROWS):
        piece = np.array(rows[at : at + MOVED_ROWS])  # in memory: a map's pages are read-only
        moved[at : at + MOVED_ROWS] = torch.from_numpy(piece)
    return moved
