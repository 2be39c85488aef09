"""Measure training from the feature cache.

30 epochs of 5,000 transitions with recipe `paper`, two views with 2,048 features.

    python benchmarks/training.py --json
    python benchmarks/training.py --views 1 --dim 1280

The features are noise in separate cache entries (their values do not affect the time). Data, split,
policy, checkpoint and its training states are those of `surgicai_vision.training.train.train`.
Prints one JSON line.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from common import emit

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.features import encoders
from surgicai_vision.features.cache import encode
from surgicai_vision.training import policies
from surgicai_vision.training.train import train

EPISODE = 100  # transitions per episode: the paper's demonstrations of grasp have 94


class Noise:
    """A dataset of noise; its frames are blank, as only their number matters."""

    task = "grasp"
    image_size = 224
    fingerprint = "noise"
    fps = names.FPS

    def __init__(self, length: int, views: int):
        self.length = length
        self.views = names.CAMERAS[:views]
        self.policy_views = self.views
        self.config = TaskConfig("grasp")
        self.episode_index = np.arange(length) // EPISODE
        self.demonstration_index = self.episode_index

    def frames(self, view: str, start: int, stop: int) -> np.ndarray:
        """Return frames start..stop."""
        return np.zeros((stop - start, 1, 1, 3), np.uint8)

    def columns(self) -> dict[str, np.ndarray]:
        """Return poses and actions."""
        noise = np.random.default_rng(0).normal(size=(self.length, 14)).astype(np.float32)
        return {names.STATE: noise[:, :7], names.ACTION: np.tanh(noise[:, 7:])}


def encoder(dim: int) -> Any:
    """Return an encoder that outputs noise."""
    generator = np.random.default_rng(1)

    def answer(frames: np.ndarray) -> np.ndarray:
        return generator.normal(size=(len(frames), dim)).astype(np.float32)

    about = {
        "pool": "global",
        "dim": dim,
        "shape": (dim,),
        "fingerprint": f"noise{dim}",
        "weights_sha256": "",
    }
    vars(answer).update(about, card=encoders.encoder_card("random"))
    return answer


def main() -> None:
    """Train once per repetition and print the times."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--transitions", type=int, default=5000)
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--dim", type=int, default=2048)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--json", action="store_true", help="accepted for symmetry; the output is always JSON"
    )
    arguments = parser.parse_args()
    dataset = Noise(arguments.transitions, arguments.views)
    network = encoder(arguments.dim)
    recipe = policies.load_recipe("bc", "paper", {"epochs": arguments.epochs})
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        features = [encode(dataset, view, network, Path(folder)) for view in dataset.views]
        for repeat in range(arguments.repeats):
            began = time.perf_counter()
            checkpoint = train(
                dataset,
                features,
                policies.policy_plugin("bc"),
                recipe,
                seed=repeat,
                out=Path(folder) / str(repeat),
            )
            seconds.append(round(time.perf_counter() - began, 2))
    row = {
        "transitions": arguments.transitions,
        "trained_on": checkpoint.frames,
        "epochs": arguments.epochs,
        "views": arguments.views,
        "dim": arguments.dim,
        "seconds": seconds,
        "slowest_s": max(seconds),
    }
    emit("training", row)


if __name__ == "__main__":
    main()
