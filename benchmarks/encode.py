"""Measure encoding speed.

`Encoder` and the cached `encode` against a bare torch loop with the same network and batch.

    python benchmarks/encode.py --json
    python benchmarks/encode.py --encoder random --frames 512 --repeats 3

The bare loop is what one would write by hand: eval mode, bfloat16 where the processor supports it,
channels_last, all cores, `inference_mode`. For each batch, uint8 images are normalised, encoded and
collected as float16. It runs with our own batch and with 16, and the faster one counts. `cached` is
`surgicai_vision.features.cache.encode` into an empty cache; its frames come from memory, like the
bare loop's. `--dataset DIR` also measures the cost of decoding our images. The methods take turns
within one process; the best time of each counts. Prints one JSON line per encoder.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import emit

from encoders.base import CUDA_BATCH, best_device, best_dtype
from surgicai_vision.evaluation.rollout import BATCH
from surgicai_vision.features import encoders
from surgicai_vision.features.cache import encode

ENCODERS = ("imagenet-lite", "random", "imagenet")
"""`random` is the ResNet-50 of `imagenet` without its weights, which do not affect the speed."""


class Memory:
    """Frames in memory that `features.encode` can read like a dataset."""

    views = ("back",)
    policy_views = views
    fingerprint = "memory"

    def __init__(self, frames: np.ndarray):
        self._frames = frames
        self.length = len(frames)

    def frames(self, view: str, start: int, stop: int) -> np.ndarray:
        """Return frames start..stop."""
        return self._frames[start:stop]


def bare(name: str, weights: str | None) -> Callable[[np.ndarray, int], np.ndarray]:
    """Return the bare loop: (frames (N, H, W, 3) uint8, batch) → features (N, dim) float16."""
    plugin = encoders.encoder_plugin(name)
    card, network = plugin.build(
        plugin.card, encoders.find_weights(name, encoders.WeightsSource.of(weights))
    )
    device = best_device()
    kind = best_dtype(device)
    network = (
        network.eval().requires_grad_(False).to(device, kind).to(memory_format=torch.channels_last)
    )
    low, high = card.input_range
    mean, std = (
        torch.tensor(values, device=device)[:, None, None] for values in (card.mean, card.std)
    )

    @torch.inference_mode()
    def loop(frames: np.ndarray, batch: int) -> np.ndarray:
        rows = []
        for at in range(0, len(frames), batch):
            images = (
                torch.from_numpy(frames[at : at + batch]).to(device).permute(0, 3, 1, 2).float()
            )
            images = (images / 255 * (high - low) + low - mean) / std
            rows.append(
                network(images.to(kind).contiguous(memory_format=torch.channels_last)).half().cpu()
            )
        return torch.cat(rows).numpy()

    return loop


def cached(source: Any, encoder: Any) -> int:
    """Encode a source into an empty cache; return its number of frames."""
    with tempfile.TemporaryDirectory() as folder:
        return len(encode(source, source.views[0], encoder, Path(folder)).rows)


def ways(
    name: str, weights: str | None, frames: np.ndarray, dataset: Any
) -> dict[str, Callable[[], int]]:
    """Return the functions to time, by name; each returns how many frames it encoded."""
    loop = bare(name, weights)
    encoder = encoders.load_encoder(name, weights=encoders.WeightsSource.of(weights))
    batch = CUDA_BATCH if torch.cuda.is_available() else BATCH
    error = np.abs(loop(frames[:batch], batch).astype(np.float32) - encoder(frames[:batch])).max()
    print(
        f"{name}: largest difference between the two implementations {error:.4f}", file=sys.stderr
    )
    made = {
        f"bare_{batch}": lambda: len(loop(frames, batch)),
        "bare_16": lambda: len(loop(frames, 16)),
        "encoder": lambda: len(encoder(frames)),
        "cached": lambda: cached(Memory(frames), encoder),
    }
    return made | ({"cached_dataset": lambda: cached(dataset, encoder)} if dataset else {})


def measure(
    name: str, weights: str | None, frames: np.ndarray, dataset: Any, repeats: int
) -> dict[str, Any]:
    """Return the speeds of one encoder [frames/s]."""
    chosen = ways(name, weights, frames, dataset)
    rates: dict[str, list[float]] = {way: [] for way in chosen}
    for repeat in range(repeats + 1):  # the first round warms up
        for way, run in chosen.items():
            began = time.perf_counter()
            count = run()
            rate = count / (time.perf_counter() - began)
            if repeat:
                rates[way].append(rate)
    best = {way: max(values) for way, values in rates.items()}
    hand = max(value for way, value in best.items() if way.startswith("bare"))
    return {
        "encoder": name,
        "frames": len(frames),
        "repeats": repeats,
        "threads": torch.get_num_threads(),
        "frames_per_s": {way: round(value, 1) for way, value in best.items()},
        "to_bare": {way: round(best[way] / hand, 3) for way in best if not way.startswith("bare")},
    }


def main() -> None:
    """Measure each encoder."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--encoder", help="measure only this encoder", metavar="NAME")
    parser.add_argument("--weights", help="file with the encoder's weights", metavar="FILE")
    parser.add_argument(
        "--dataset", help="a surgicai-vision dataset whose images to encode as well", metavar="DIR"
    )
    parser.add_argument("--frames", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--json", action="store_true", help="accepted for symmetry; the output is always JSON"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    frames = np.random.default_rng(0).integers(0, 256, (arguments.frames, 224, 224, 3), np.uint8)
    dataset = None
    if arguments.dataset:
        from surgicai_vision.dataset.reader import open_dataset

        dataset = open_dataset(Path(arguments.dataset))
    names = (
        [arguments.encoder] if arguments.encoder else [name for name in ENCODERS if at_hand(name)]
    )
    for name in names:
        emit("encode", measure(name, arguments.weights, frames, dataset, arguments.repeats))


def at_hand(name: str) -> bool:
    """Return True if an encoder's weights are on this machine."""
    from surgicai_vision.core.errors import SurgicaiError

    try:
        encoders.find_weights(name)
    except SurgicaiError:
        return False
    return True


if __name__ == "__main__":
    main()
