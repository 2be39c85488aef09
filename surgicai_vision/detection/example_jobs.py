"""The job that renders one demonstration's examples; see `examples`.

This module needs MuJoCo, so only the processes that render import it.
"""

import atexit
import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_number
from surgicai_vision.core.config import RandomisationConfig, TaskConfig, from_mapping, to_mapping
from surgicai_vision.core.corruption import CORRUPTIONS, Image, Moment, spoilt
from surgicai_vision.core.errors import BadFile
from surgicai_vision.core.files import write_bytes
from surgicai_vision.demos.store import read_demo
from surgicai_vision.detection.examples import EXAMPLES_FILE, PART, WHOLE, WORLD, shrunk
from surgicai_vision.envs import randomisation
from surgicai_vision.envs.projection import jaws_in_image

STREAM = 0xDE7EC7
"""Separates the random numbers of examples from all others."""
SPOILT = 0.5
"""Share of images with smoke; likewise with blur and with noise."""


@functools.lru_cache(maxsize=1)
def _env(config: str) -> envs.SuturingEnv:
    """Return this process's environment; the previous one is closed with its GL context."""
    atexit.register(_env.cache_clear)
    return envs.make(from_mapping(TaskConfig, json.loads(config)))


def render_examples(folder: Path, demo: str, cameras: Sequence[str], count: int) -> None:
    """Write `count` examples of one demonstration into `folder`; the job "detector-examples".

    Every example is a recorded state with cameras, lights and tints of its own.
    """
    episode = read_demo(Path(demo))
    axes = from_mapping(RandomisationConfig, {**to_mapping(episode.config.randomisation), **WORLD})
    table = {**to_mapping(episode.config), "randomisation": to_mapping(axes)}
    env = _env(json.dumps(table))
    if env.scene.hash != episode.scene_hash:
        raise BadFile(
            f"{demo} was recorded in another scene (hash {episode.scene_hash[:12]}, now "
            f"{env.scene.hash[:12]}); record it again with this version."
        )
    recorded = int(hashlib.sha256(episode.state.tobytes()).hexdigest(), 16)
    rng = np.random.default_rng([STREAM, recorded])
    steps = rng.choice(len(episode.state), min(count, len(episode.state)), replace=False)
    look: Mapping[str, Sequence[float]] = {}
    images: list[list[Image]] = []
    places: list[list[list[tuple[float, float]]]] = []
    for index, step in enumerate(sorted(steps.tolist())):
        drawn = randomisation.report(axes, randomisation.draw(axes, rng))
        shown = {axis: np.atleast_1d(drawn[axis]).tolist() for axis in WORLD}
        # Painting a look takes as long as several images, so one demonstration shows one look.
        look = look or {axis: shown[axis] for axis in ("appearance", "distractors")}
        env.set_state_vector(env.simulation.redrawn(episode.state[step], {**shown, **look}))
        seed = int(rng.integers(2**32))
        images.append([])
        places.append([])
        for camera in cameras:
            strengths = {
                kind: float(rng.random()) * (rng.random() < SPOILT) for kind in CORRUPTIONS
            }
            image = env.image(camera, WHOLE).astype(np.uint8, copy=False)
            moment = Moment(seed, index, camera_number(camera), PART)
            images[-1].append(shrunk(spoilt(image, strengths, moment)))
            places[-1].append(
                [jaws_in_image(env.simulation, camera, arm, WHOLE) for arm in names.ARMS]
            )
    content: dict[str, NDArray[np.generic]] = {
        "images": np.array(images, np.uint8),
        "places": np.array(places, np.float32),
    }
    write_bytes(folder / EXAMPLES_FILE, save(content))
