"""One run: a policy from features to measured successes.

A quickstart is a list of runs, a sweep a grid of them. Every step leaves a complete folder and is
skipped if that folder exists, so running again continues.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from encoders.base import Encoder
from policies.base import Plugin, Policy, Recipe
from policies.chunks import ChunkRecipe
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.files import read_json
from surgicai_vision.core.progress import Stage
from surgicai_vision.dataset.protocol import Dataset
from surgicai_vision.dataset.subset import (
    DatasetSubset,
    first_episodes,
    of_subtask,
    with_frame_stride,
)
from surgicai_vision.features.cache import Features, encode
from surgicai_vision.features.devices import AUTO, CPU, find_device
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource, load_encoder
from surgicai_vision.training import policies
from surgicai_vision.training.checkpoint import REQUEST
from surgicai_vision.training.chunks import Timeline, timeline_of, with_chunks
from surgicai_vision.training.progress_input import check_progress_policy, with_progress
from surgicai_vision.training.run_config import RunConfig
from surgicai_vision.training.train import epochs_within, train


def train_run(
    run: RunConfig,
    dataset: Dataset,
    out: Path,
    stage: Stage,
    weights: WeightsSource = ANYWHERE,
    *,
    start: Path | None = None,
    progress_from: Path | None = None,
    subtask: str | None = None,
    demos: Sequence[Path] = (),
    save_every: int = 0,
    device: str | None = None,
    log: Callable[[int, dict[str, float]], None] | None = None,
) -> None:
    """Encode a run's views, or take them from the cache, and train its policy.

    Args:
        run: what to train.
        dataset: an opened dataset of the run's task.
        out: checkpoint folder; one of the same training is continued, or left if complete.
        stage: shows progress.
        weights: where pretrained weights come from.
        start: checkpoint folder to start from (fine-tuning).
        progress_from: checkpoint folder of the policy that predicts the progress, for a recipe with
            `progress_input`.
        subtask: train on this subtask's frames of the dataset's whole procedures.
        demos: folders of the dataset's demonstrations, in order, for a policy that plans chunks
            where the dataset was rendered with fewer frames than control steps.
        save_every: also keep a checkpoint every `save_every` epochs.
        device: where to encode and train, one of `features.devices.DEVICES`; by default a
            GPU encodes, if there is one, and the CPU trains.
        log: called with (epoch, losses by name).
    """
    recipe = policies.recipe_of(run)
    policies.check_progress_from(recipe, progress_from)
    policies.check_retries(recipe, subtask or dataset.config.task, run.demonstrator)
    plugin = policies.policy_plugin(run.policy)
    if plugin.offsets is not None:
        plugin.make(recipe, ())  # refuses its settings before anything is encoded
    encodes_on = AUTO if device is None else find_device(device)
    trains_on = CPU if device is None else encodes_on
    dataset = with_frame_stride(dataset, recipe.frame_stride)
    # Missing demonstrations are found before anything is encoded.
    timeline = timeline_of(dataset, demos) if plugin.offsets is not None else None
    progress_policy = policies.load_policy(progress_from) if progress_from else None
    if progress_policy is not None:
        check_progress_policy(progress_policy.checkpoint, dataset)
    start_policy = policies.load_policy(start) if start else None
    if start_policy is not None:
        _check_start(start_policy, run, recipe)
    learned = _Learned(dataset, _encode(run, dataset, stage, weights, encodes_on))
    if progress_policy is not None:
        learned = learned.select(_fed(dataset, progress_policy, stage, weights))
    for select in _selections(run, plugin, recipe, dataset, subtask, timeline):
        learned = learned.select(select(learned.dataset))
    recipe = _within_budget(recipe, learned, run, out, trains_on)
    with stage(f"policy: {run.name}", "epochs") as progress:
        train(
            learned.dataset,
            learned.features,
            plugin,
            recipe,
            seed=run.seed,
            out=out,
            progress=progress,
            run=run,
            start=start_policy,
            progress_policy=progress_policy.checkpoint if progress_policy else None,
            save_every=save_every,
            device=trains_on,
            log=log,
        )


def _check_start(start: Policy, run: RunConfig, recipe: Recipe) -> None:
    """Refuse to start from a policy of other inputs, before anything is encoded.

    Raises:
        InputError: its inputs differ; the message names them.
    """
    known = start.checkpoint
    inputs = {
        "encoder": (known.run.encoder, run.encoder),
        "views": (known.run.views, run.views),
        "pool": (known.run.pool, run.pool),
        **{
            key: (known.recipe.get(key), getattr(recipe, key, None))
            for key in ("proprioception", "setpoint", "clock", "progress_input", "privileged")
        },
    }
    differ = [
        f"{name} {_words(was)}, not {_words(now)}"
        for name, (was, now) in inputs.items()
        if was != now
    ]
    if differ:
        raise InputError(
            f"The policy to start from has {'; '.join(differ)}. Train with the inputs that it has."
        )


def _words(value: object) -> str:
    """Return an input's value in words."""
    return ", ".join(map(str, value)) or "none" if isinstance(value, tuple) else str(value).lower()


class _Learned(NamedTuple):
    """The frames a policy learns from and their features, one entry per view."""

    dataset: Dataset
    features: Sequence[Features]

    def select(self, subset: DatasetSubset) -> "_Learned":
        """Return the same for a subset of the dataset."""
        parts = [entry.part(subset.rows, subset.fingerprint) for entry in self.features]
        return _Learned(subset, parts)


def _fed(
    dataset: Dataset, progress_policy: Policy, stage: Stage, weights: WeightsSource
) -> DatasetSubset:
    """Return the dataset with the progress that a policy predicts for its frames."""
    encoder = policies.load_encoder_of(progress_policy.checkpoint, weights)
    views = progress_policy.checkpoint.views
    seen = _encode_views(encoder, views, dataset, stage, "features of the progress")
    return with_progress(dataset, progress_policy, seen)


def _selections(
    run: RunConfig,
    plugin: Plugin,
    recipe: Recipe,
    dataset: Dataset,
    subtask: str | None,
    timeline: Timeline | None,
) -> Iterator[Callable[[Dataset], DatasetSubset]]:
    """Yield the selections of a run's frames of `dataset`, each applied to the result before it.

    Chunks of actions come first, because they reach into frames that are left out later.
    """
    if plugin.offsets is not None and timeline is not None:
        offsets = plugin.offsets(recipe)
        yield lambda present: with_chunks(present, timeline, offsets)
    if run.demonstrations not in (None, len(np.unique(dataset.demonstration_index))):
        yield functools.partial(first_episodes, count=run.demonstrations)
    if subtask is not None:
        yield functools.partial(of_subtask, subtask=subtask)


def _within_budget(
    recipe: Recipe, learned: _Learned, run: RunConfig, out: Path, device: str
) -> Recipe:
    """Return the recipe with the epochs that fit into its minutes, where it has a budget.

    An interrupted training continues with the number of epochs it was begun with.
    """
    if not (isinstance(recipe, ChunkRecipe) and recipe.minutes):
        return recipe
    if (out / REQUEST).is_file():
        begun = read_json(out / REQUEST).get("recipe", {}).get("epochs", recipe.epochs)
        return replace(recipe, epochs=int(begun))
    plugin = policies.policy_plugin(run.policy)
    epochs = epochs_within(recipe.minutes, *learned, plugin, recipe, seed=run.seed, device=device)
    return replace(recipe, epochs=epochs)


def encode_run(
    run: RunConfig,
    dataset: Dataset,
    stage: Stage,
    weights: WeightsSource = ANYWHERE,
    device: str = AUTO,
) -> list[Features]:
    """Encode a run's views, all frames that its recipe takes, or find them in the cache."""
    recipe = policies.recipe_of(run)
    return _encode(run, with_frame_stride(dataset, recipe.frame_stride), stage, weights, device)


def _encode(
    run: RunConfig, dataset: Dataset, stage: Stage, weights: WeightsSource, device: str
) -> list[Features]:
    """Encode a run's views, all frames of `dataset`."""
    encoder = load_encoder(run.encoder, run.pool, weights, device) if run.encoder else None
    return _encode_views(encoder, run.views, dataset, stage, f"features: {run.encoder}")


def _encode_views(
    encoder: Encoder | None, views: Sequence[str], dataset: Dataset, stage: Stage, title: str
) -> list[Features]:
    """Encode all frames of `dataset`, one entry per view; none without an encoder."""
    features: list[Features] = []
    if encoder is None:
        return features
    for view in views:
        with stage(f"{title}, {view}", "frames") as progress:
            features.append(encode(dataset, view, encoder, progress=progress))
    return features
