"""Features of our datasets, and the digest of their content.

`features(views, size, …)` is the LeRobot feature table. `EpisodeDigest` hashes one episode's
decoded images and columns in a fixed order, and `dataset_digest` the episodes in order. A dataset's
digest therefore does not depend on how it was compressed, split into files or rendered.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos.store import Demo

Table = Mapping[str, Any]
"""A JSON object, as read from a file."""

FORMAT = 3
"""Version of `meta/surgicai.json`; surgicai-vision 0.1 wrote none, 2 had no set points."""

VECTORS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        names.STATE: names.STATE_NAMES,
        names.ACTION: names.ACTION_NAMES,
        names.NEEDLE_POSE: ("x", "y", "z", "qw", "qx", "qy", "qz"),
        names.BOTH_ARMS: names.BOTH_ARMS_NAMES,
        names.SETPOINT: names.SETPOINT_NAMES,
        names.PRIVILEGED_STATE: names.PRIVILEGED_NAMES,
    }
)
"""float32 column → names of its elements: [m], [rad], unit quaternions; privileged state [cm]."""

SCALARS: Mapping[str, str] = MappingProxyType(
    {
        names.REWARD: "float32",
        names.DONE: "bool",
        names.SUCCESS: "bool",
        names.CONTACT: "bool",
        names.PHASE: "int64",
        names.SEED: "int64",
    }
)
"""One-element column → dtype; reward, done, success and contact are those after the action."""

COLUMNS = (*VECTORS, *SCALARS)
"""The columns of every dataset that are not images, in the order of the digest."""

SIZES = (16, 1024)
"""Smallest and largest image side [px]; the latter is the size of MuJoCo's off-screen buffer."""
IMAGE_AXES = ("height", "width", "channels")


def calibration_keys(views: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Return key of every calibration column → shape of its matrix."""
    keys: dict[str, tuple[int, int]] = {}
    for view in views:
        keys[names.intrinsics_key(view)] = (3, 3)
        keys[names.extrinsics_key(view)] = (4, 4)
    return keys


def is_calibration(key: str) -> bool:
    """Return True for a calibration column."""
    return key.startswith(names.CALIBRATION)


def columns(views: Sequence[str]) -> tuple[str, ...]:
    """Return every column of a dataset that is not an image, in the order of the digest."""
    return (*COLUMNS, *calibration_keys(views))


def width(key: str, views: Sequence[str]) -> int:
    """Return how many numbers each frame has in a column; 0 for one number that is no vector."""
    sides = calibration_keys(views).get(key)
    return math.prod(sides) if sides else len(VECTORS.get(key, ()))


def image_keys(views: Sequence[str], depth: bool, segmentation: bool) -> list[tuple[str, str, str]]:
    """Return (key, view, modality) of every image column, in the order of the digest."""
    keys = [(names.image_key(view), view, names.RGB) for view in views]
    if depth:
        keys += [(names.depth_key(view), view, names.DEPTH) for view in views]
    if segmentation:
        keys += [(names.segmentation_key(view), view, names.SEGMENTATION) for view in views]
    return keys


def features(views: Sequence[str], size: int, depth: bool, segmentation: bool) -> dict[str, Table]:
    """Return the LeRobot feature table.

    A segmentation image is stored as RGB with the part's index in all three channels: LeRobot
    accepts one-channel images only as depth.
    """
    table = image_features(image_keys(views, depth, segmentation), size)
    for key, elements in VECTORS.items():
        table[key] = {"dtype": "float32", "shape": (len(elements),), "names": list(elements)}
    for key, dtype in SCALARS.items():
        table[key] = {"dtype": dtype, "shape": (1,), "names": None}
    for key, (rows, width) in calibration_keys(views).items():
        places = [f"{row}{column}" for row in range(rows) for column in range(width)]
        table[key] = {"dtype": "float32", "shape": (rows * width,), "names": places}
    return table


def image_features(keys: Iterable[tuple[str, str, str]], size: int) -> dict[str, Table]:
    """Return the features of image columns, (key, view, modality) each."""
    table: dict[str, Table] = {}
    for key, _, modality in keys:
        shape = (size, size, 1 if modality == names.DEPTH else 3)
        image = {"dtype": "image", "shape": shape, "names": list(IMAGE_AXES)}
        info = {"is_depth_map": True, "depth_unit": "m"}
        table[key] = image | ({"info": info} if modality == names.DEPTH else {})
    return table


def labels(demo: Demo, frame_stride: int) -> dict[str, NDArray[np.generic]]:
    """Return the columns of `SCALARS` for the rendered frames, (frames,), as recorded."""
    frames = len(range(0, len(demo), frame_stride))
    return {
        names.REWARD: demo.reward[::frame_stride],
        names.DONE: np.arange(frames) == frames - 1,
        names.SUCCESS: demo.success[::frame_stride],
        names.CONTACT: demo.contact[::frame_stride],
        names.PHASE: demo.phase[::frame_stride].astype(np.int64),
        names.SEED: np.full(frames, demo.seed, np.int64),
    }


def check_spacing(frame_stride: int, action_repeat: int) -> None:
    """Refuse frames of which there would be no whole number in a second.

    Args:
        frame_stride: recorded steps from frame to frame.
        action_repeat: control steps of a recorded step.

    Raises:
        InputError: their product does not divide `names.FPS`.
    """
    spacing = frame_stride * action_repeat
    if names.FPS % spacing:
        raise InputError(
            f"frame_stride is {frame_stride} and action_repeat {action_repeat}: the dataset would "
            f"have a frame every {spacing} control steps, which must divide the {names.FPS} of a "
            "second. Give another frame_stride, or record with another action_repeat."
        )


def column_bytes(key: str, values: NDArray[np.generic]) -> bytes:
    """Return the bytes of a column as they enter the digest."""
    if values.dtype.kind == "U":
        return "\0".join(map(str, values)).encode()
    dtype = SCALARS.get(key, "float32")
    return np.ascontiguousarray(values, dtype=np.dtype(dtype).newbyteorder("<")).tobytes()


class ImageDigest:
    """sha256 over the decoded frames of one image column."""

    def __init__(self) -> None:
        self._total = hashlib.sha256()

    def add(self, frame: NDArray[np.uint8 | np.float32]) -> None:
        """Add the next frame (H, W, channels)."""
        self._total.update(str((frame.shape, frame.dtype.name)).encode())
        self._total.update(np.ascontiguousarray(frame))

    def hexdigest(self) -> str:
        """Return the column's digest."""
        return self._total.hexdigest()


class EpisodeDigest:
    """sha256 over one episode: its columns in order, then each image column."""

    def __init__(self, keys: Iterable[str]):
        self._images = {key: ImageDigest() for key in keys}
        self._known: dict[str, str] = {}

    def add(self, key: str, frame: NDArray[np.uint8 | np.float32]) -> None:
        """Add the next decoded frame (H, W, channels) of an image column."""
        self._images[key].add(frame)

    def take(self, key: str, digest: str) -> None:
        """Use an image column's `ImageDigest` instead of its frames."""
        self._known[key] = digest

    def hexdigest(
        self,
        rows: Mapping[str, NDArray[np.generic]],
        views: Sequence[str] = (),
        order: Sequence[str] = (),
    ) -> str:
        """Return the episode's digest.

        Args:
            rows: its columns.
            views: the dataset's views.
            order: keys of its columns, by default those of `columns(views)`.
        """
        total = hashlib.sha256()
        for key in order or columns(views):
            total.update(key.encode() + b"\0" + column_bytes(key, rows[key]))
        for key, image in self._images.items():
            total.update(
                key.encode() + b"\0" + bytes.fromhex(self._known.get(key) or image.hexdigest())
            )
        return total.hexdigest()


def dataset_digest(episodes: Iterable[str]) -> str:
    """Return the sha256 (hex) of the episodes' digests, in order."""
    return hashlib.sha256("".join(episodes).encode()).hexdigest()
