"""BatchNorm drift: what the released code's "frozen" networks became while policies were trained on
them.

`drift(dataset, views, encoder, …) -> Path`: the statistics' file, made once and kept in the feature
cache. Only for the deviation `batch_norm_drift` (`config.Deviations`).
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surgicai_vision.core.config import digest
from surgicai_vision.core.files import write_bytes
from surgicai_vision.features import encoders
from surgicai_vision.features.cache import Progress, default_cache_root

BATCH, STEPS = 32, 40
"""After 40 steps with BatchNorm's momentum of 0.1 the old statistics weigh 1.5 %."""


def drift(
    dataset: Any,
    views: Sequence[str],
    encoder: Any,
    *,
    weights: str | None = None,
    accept_licence: bool = False,
    seed: int = 0,
    cache_root: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Return the file of the statistics that `encoder` drifts to on images of a dataset.

    Args:
        dataset: an opened dataset.
        views: its views, in equal shares.
        encoder: the encoder before it drifts, with the preprocessing it is used with.
        weights: file with its pretrained weights.
        accept_licence: accept weights under a non-commercial licence.
        seed: of the draw of images.
        cache_root: folder of the feature cache.
        progress: called with (steps done, steps in all).
    """
    identity = [dataset.fingerprint, list(views), encoder.fingerprint, seed, BATCH, STEPS]
    path = (cache_root or default_cache_root()) / "drift" / f"{digest(identity)}.safetensors"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        batches = _batches(dataset, views, encoder, seed, progress or (lambda done, total: None))
        name = encoder.card.name
        write_bytes(path, encoders.drifted_statistics(name, weights, accept_licence, batches))
    return path


def _batches(
    dataset: Any, views: Sequence[str], encoder: Any, seed: int, progress: Progress
) -> Iterator[Any]:
    """Yield normalised batches of frames drawn at random; frames are read in order, which is
    fast.
    """
    generator = np.random.default_rng((seed, 2))
    rows = np.sort(generator.integers(0, dataset.length, BATCH * STEPS))
    sight = generator.integers(0, len(views), BATCH * STEPS)
    frames = np.concatenate(
        [
            dataset.frames(views[view], row, row + 1)
            for row, view in zip(rows.tolist(), sight, strict=True)
        ]
    )
    for step, chosen in enumerate(np.split(generator.permutation(BATCH * STEPS), STEPS)):
        yield encoder.preprocess(frames[chosen])
        progress(step + 1, STEPS)
