"""Examples: recorded states → whole images of cameras, with the true places of the jaws.

    examples = render_examples(demos, store, cameras=("front", "back"), per_demo=14)
    examples.images    # (N, 120, 160, 3) uint8: whole images, shrunk to the network's input
    examples.places    # (N, 2, 2): x and y of psm1's and psm2's jaws, shares of width and height

An example is a recorded state in which the cameras, their fields of view, the lights, the tints and
the look are drawn anew (`WORLD`: the strengths of `robustness` at 1, looks of training only), and
half of the images have smoke, blur or noise. One job renders one demonstration, so that a run
which was killed continues.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON
from surgicai_vision.core.corruption import Image
from surgicai_vision.core.executor import Job, RunContext, register_job, run
from surgicai_vision.core.files import sha256_file
from surgicai_vision.core.progress import Progress, silent

if TYPE_CHECKING:
    from surgicai_vision.scene.cameras import Crop

EXAMPLES_FILE = "examples.safetensors"
WHOLE = (480, 640)
"""Height and width of a whole image [pixel], as SurgicAI's cameras have them."""
SIZE = (120, 160)
"""Height and width of the network's input [pixel]."""
WORLD: Mapping[str, JSON] = MappingProxyType(
    {
        "camera_shift": 10.0,
        "camera_turn": 10.0,
        "camera_fovy": 10.0,
        "light": 0.8,
        "colour": 0.8,
        "distractors": 5,
        "appearance": names.TRAIN,
    }
)
"""Axis of the randomisation → what is drawn anew for every example."""

PART = 0.5
"""Share of a whole image's height that a crop shows: its blur is that of a crop."""

register_job(
    "detector-examples",
    "surgicai_vision.detection.example_jobs:render_examples",
    stages=("scene", "envs", "demos", "detection"),
)


@dataclass(frozen=True)
class Examples:
    """Labelled images of several cameras.

    Attributes:
        images: (N, 120, 160, 3) uint8.
        places: (N, 2, 2) float32: x and y of each arm's jaws, in the order of `names.ARMS`, as
            shares of the image's width and height.
        cameras: (N,) index of each image's camera.
        demos: (N,) index of the demonstration that each image is from.
    """

    images: NDArray[np.uint8]
    places: NDArray[np.float32]
    cameras: NDArray[np.int64]
    demos: NDArray[np.int64]


def render_examples(
    demos: Sequence[Path],
    store: Path,
    cameras: Sequence[str],
    per_demo: int,
    context: RunContext = RunContext(),
    progress: Progress = silent,
) -> Examples:
    """Render the examples of demonstrations; what is in the store is not rendered again.

    Args:
        demos: files of demonstrations, of any tasks.
        store: folder of the rendered examples.
        cameras: names of cameras, not of crops.
        per_demo: states of each demonstration, at most as many as it has.
        context: workers and engine.
        progress: called as progress(images, all images).
    """
    jobs = [
        Job(
            "detector-examples",
            {"demo": str(path.resolve()), "cameras": list(cameras), "count": per_demo},
            (sha256_file(path),),
            per_demo * len(cameras),
            ("demo",),
        )
        for path in demos
    ]
    folders = run(jobs, store, context, progress=progress, unit="images")
    shards = [load_file(folder / EXAMPLES_FILE) for folder in folders]
    counts = [len(shard["images"]) for shard in shards]
    images = np.concatenate([shard["images"] for shard in shards])
    places = np.concatenate([shard["places"] for shard in shards])
    return Examples(
        images.reshape(-1, *images.shape[2:]),
        places.reshape(-1, *places.shape[2:]),
        np.tile(np.arange(len(cameras)), len(images)),
        np.repeat(np.arange(len(shards)), np.array(counts) * len(cameras)),
    )


def can_be_aimed(crop: "Crop") -> bool:
    """Return whether the images of a crop's camera are as wide as those of a detector."""
    return math.isclose(crop.aspect, WHOLE[1] / WHOLE[0])


def shrunk(image: Image) -> NDArray[np.uint8]:
    """Return a whole image at the size of the network's input, each pixel a mean of pixels."""
    small = cv2.resize(image, SIZE[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def are_shown(places: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which places (…, 2) lie within the image, (…)."""
    shown: NDArray[np.bool_] = np.asarray(((places >= 0) & (places <= 1)).all(axis=-1))
    return shown


def distances(found: NDArray[np.floating], true: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return how far places (…, 2) are from the true ones, as shares of the image's height (…)."""
    height, width = WHOLE
    off: NDArray[np.floating] = np.linalg.norm((found - true) * (width / height, 1.0), axis=-1)
    return off
