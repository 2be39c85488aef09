"""The job that renders one episode: its states → images and columns.

Every recorded state of a demonstration is set in the environment and observed; frame t is the state
before action t. This module needs MuJoCo, so only the processes that render import it.
"""

import atexit
import dataclasses
import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from surgicai_vision import envs
from surgicai_vision.core import names, shifts
from surgicai_vision.core.cameras import camera_number
from surgicai_vision.core.config import RandomisationConfig, TaskConfig, from_mapping, to_mapping
from surgicai_vision.core.corruption import CORRUPTIONS, Image, Moment, spoilt
from surgicai_vision.core.errors import BadFile
from surgicai_vision.core.files import write_json
from surgicai_vision.core.variants import Variants
from surgicai_vision.dataset import codecs, schema
from surgicai_vision.dataset.layouts import LAYOUTS, SURGICAI
from surgicai_vision.dataset.schema import Table
from surgicai_vision.dataset.stats import ImageStatistics, column_statistics
from surgicai_vision.dataset.writer import EPISODE_FILE, SUMMARY_FILE, column_array, compression
from surgicai_vision.demos.store import Demo, read_demo
from surgicai_vision.envs import randomisation
from surgicai_vision.envs.aimed_calibration import AimedCalibration
from surgicai_vision.envs.looks import draw as draw_look
from surgicai_vision.scene.cameras import crop_of
from surgicai_vision.scene.rendering import renderer_string

LOOK_STREAM = 0x100C5
"""Separates the random numbers of variants' looks from all others."""


def _calibration(env: envs.SuturingEnv, view: str, size: int) -> dict[str, NDArray[np.float32]]:
    """Return a view's nominal K (9,) and T_world_camera (16,) in the env's present state."""
    known = env.calibration
    return {
        names.intrinsics_key(view): known.intrinsics(view, (size, size)).astype(np.float32).ravel(),
        names.extrinsics_key(view): known.extrinsics(view).astype(np.float32).ravel(),
    }


@functools.lru_cache(maxsize=1)
def _env(
    config: str, views: tuple[str, ...], size: int, depth: bool, segmentation: bool, aimed: bool
) -> envs.SuturingEnv:
    """Return this process's environment; the previous one is closed with its GL context.

    One whose crops are aimed serves no others, for it keeps the place of its crops.
    """
    # The GL context must be freed before the interpreter exits.
    atexit.register(_env.cache_clear)
    return envs.make(
        from_mapping(TaskConfig, json.loads(config)),
        obs_type="pixels_agent_pos",
        cameras=views,
        image_size=size,
        depth=depth,
        segmentation=segmentation,
    )


def render_episode(
    folder: Path,
    demo: str,
    views: Sequence[str],
    size: int,
    depth: bool,
    segmentation: bool,
    frame_stride: int = 1,
    variants: Mapping[str, str | int] = MappingProxyType({}),
    variant: int = 0,
    layout: str = SURGICAI,
) -> None:
    """Write one episode's columns and images into `folder`; the job "render-episode".

    `variants` holds the fields of `variants.Variants`, `variant` is the number of one variant;
    `layout` is a key of `layouts.LAYOUTS`.
    """
    chosen = LAYOUTS[layout]
    episode = read_demo(Path(demo))
    looks = from_mapping(Variants, variants) if variants else None
    config = _rendered_in(looks, episode.config) if looks else episode.config
    is_aimed = looks is not None and looks.aimed
    env = _env(json.dumps(to_mapping(config)), tuple(views), size, depth, segmentation, is_aimed)
    if env.scene.hash != episode.scene_hash:
        raise BadFile(
            f"{demo} was recorded in another scene (hash {episode.scene_hash[:12]}, now "
            f"{env.scene.hash[:12]}); record it again with this version."
        )
    # Per frame: the encoded images, their statistics and digest, and what the env measures.
    keys = chosen.image_keys(views, depth, segmentation)
    content: dict[str, list[bytes]] = {key: [] for key, _, _ in keys}
    statistics = {key: ImageStatistics() for key in content}
    digest = schema.EpisodeDigest(content)
    measured: dict[str, list[NDArray[np.float32]]] = {
        key: [] for key in (*chosen.measured, *schema.calibration_keys(views))
    }
    shown = _Shown.drawn(looks, episode, variant) if looks else _Shown()
    if is_aimed:
        env.place_crops_by(AimedCalibration(env.simulation, shown.seed))
    for step, state in enumerate(episode.state[:-1:frame_stride]):
        env.set_state_vector(env.simulation.redrawn(state, shown.look) if shown.look else state)
        observation = env.observe()
        assert isinstance(observation, dict)  # the env shows images
        for key, view, modality in keys:
            frame = observation[names.frame_key(view, modality)]
            # LeRobot accepts one-channel images only as depth.
            frame = np.repeat(frame, 3, axis=2) if modality == names.SEGMENTATION else frame
            if modality == names.RGB:
                frame = shown.spoilt(frame, step * frame_stride, view)
            content[key].append(codecs.encode(frame))
            statistics[key].add(frame)
            digest.add(key, frame)
        for key, measure in chosen.measured.items():
            measured[key].append(measure(env))
        for view in views:
            for key, matrix in _calibration(env, view, size).items():
                measured[key].append(matrix)
    # The columns; then everything in one file, and a summary.
    unordered: dict[str, NDArray[np.generic]] = {
        **{key: np.stack(rows).astype(np.float32) for key, rows in measured.items()},
        **chosen.recorded(episode, frame_stride, env),
    }
    order = chosen.columns(views)
    columns = {key: unordered[key] for key in order}
    depth_keys = [key for key, _, modality in keys if modality == names.DEPTH]
    _write_episode(folder, content, columns, depth_keys)
    summary = {
        "frames": len(columns[names.DONE]),
        "digest": digest.hexdigest(columns, views, order),
        "statistics": {
            **{key: statistics[key].result() for key in content},
            **{
                key: column_statistics(values)
                for key, values in columns.items()
                if values.dtype.kind != "U"  # LeRobot has no statistics of texts either
            },
        },
        "renderer": _renderer(),
        "cameras": {view: _camera(view) for view in views},
    }
    write_json(folder / SUMMARY_FILE, summary)


def _rendered_in(looks: Variants, config: TaskConfig) -> TaskConfig:
    """Return the task with everything that is drawn for the variants of its demonstrations."""
    shown = looks.shown(config)
    axes = shifts.added(shown.randomisation, shifts.RENDERED, looks.shift)
    return dataclasses.replace(shown, randomisation=axes)


@dataclass(frozen=True)
class _Shown:
    """The appearance of a variant.

    Attributes:
        look: axis of randomisation → its numbers; empty keeps what was recorded.
        strengths: corruption of its images → strength.
        seed: seed of the corruptions and of the crops' aim.
    """

    look: Mapping[str, Sequence[float]] = MappingProxyType({})
    strengths: Mapping[str, float] = MappingProxyType({})
    seed: int = 0

    @classmethod
    def drawn(cls, looks: Variants, demo: Demo, variant: int) -> "_Shown":
        """Draw a variant from the recorded states and the variant's number."""
        recorded = int(hashlib.sha256(demo.state.tobytes()).hexdigest(), 16)
        rng = np.random.default_rng([LOOK_STREAM, recorded, variant])
        look = {**draw_look(looks.shown(TaskConfig()).randomisation, rng)}
        if looks.shift:
            off = shifts.added(RandomisationConfig(), shifts.RENDERED, looks.shift)
            numbers = randomisation.report(
                off, randomisation.draw(off, randomisation.generator(rng))
            )
            look |= {axis: np.atleast_1d(drawn).tolist() for axis, drawn in numbers.items()}
        strengths = {kind: looks.corruption * rng.random() for kind in CORRUPTIONS}
        return cls(look, strengths if looks.corruption else {}, int(rng.integers(2**32)))

    def spoilt(self, image: Image, step: int, view: str) -> Image:
        """Return an image (height, width, 3) after the corruptions of a control step."""
        return spoilt(image, self.strengths, Moment(self.seed, step, camera_number(view)))


def _write_episode(
    folder: Path,
    content: Mapping[str, list[bytes]],
    columns: Mapping[str, NDArray[np.generic]],
    depth_keys: Sequence[str],
) -> None:
    """Write one episode as parquet, images as LeRobot's (bytes, path) pairs."""
    arrays: dict[str, pa.Array] = {}
    for key, images in content.items():
        paths = [f"frame-{index:06d}" for index in range(len(images))]
        arrays[key] = pa.StructArray.from_arrays(
            [pa.array(images, pa.binary()), pa.array(paths, pa.string())], ["bytes", "path"]
        )
    for key, values in columns.items():
        arrays[key] = column_array(values)
    table = pa.table(arrays)
    codec = compression(table.schema, depth_keys)
    pq.write_table(table, folder / EPISODE_FILE, compression=codec, use_dictionary=False)


def _renderer() -> str:
    """Return the GL renderer that drew the images."""
    return renderer_string()


def _camera(view: str) -> Table:
    """Return what a view is: its camera and, for a crop, the arm that it follows.

    Its pose and intrinsics are in the dataset's calibration columns.
    """
    crop = crop_of(view)
    if crop is None:
        return {"camera": view, "crop": None}
    return {
        "camera": crop.camera,
        "crop": {"arm": crop.arm, "distance": crop.distance, "span": crop.span},
    }
