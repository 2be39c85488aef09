"""Linear probe: read the needle's pose from an encoder's features, before any rollout.

`probe(dataset, features, seed=…, progress=…) -> Probe`: ridge regression in closed form from the
features to the position of the needle's tip and to its orientation, tested on episodes it was not
fitted on.

Every episode is held out once (`FOLDS` folds of whole episodes). Each penalty is chosen on the
other episodes alone, by cross-validation over folds of whole episodes among them. At most `FRAMES`
frames are used, evenly spread over every episode: neighbouring frames show nearly the same. An
orientation is fitted as two columns of its matrix and turned back into a rotation (Gram–Schmidt).
An episode's error is the median over its frames; the reported error is the median over episodes,
with a percentile bootstrap over episodes. `chance` is the error of the mean pose of the episodes
fitted on.

A crop shows where the needle is relative to the jaws, not where it is in the world. With
`proprioception` the active arm's reported tip pose and jaw are inputs as well, as for a policy.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.core.progress import Progress
from surgicai_vision.dataset.protocol import Dataset
from surgicai_vision.features.cache import Features
from surgicai_vision.scene.needle import TIP_ANGLE, point
from surgicai_vision.scene.rotations import quaternion_to_matrix

FOLDS = 5
FRAMES = 1000
FEWEST = 5  # episodes: fewer leave no episodes to choose a penalty on
PENALTIES = np.logspace(-7, 2, 28)
"""Tried penalties, as shares of the features' total variance."""
SMALLEST_STD = 1e-6  # a feature that varies less counts as constant
RESAMPLES = 10_000
SHAPE_AXES = ("needle_arc", "needle_size")
"""Axes of randomisation that move the tip relative to the needle's pose."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measure:
    """One error: its median over episodes with a 95 % interval, and that of the mean pose."""

    median: float
    low: float
    high: float
    chance: float


@dataclass(frozen=True)
class Probe:
    """The result of a probe.

    Attributes:
        tip: error of the tip's position in the world [mm].
        angle: angle between the needle's orientation and the predicted one [deg].
        n: number of episodes.
        frames: number of frames used.
        tip_of_episode: (n,) median error of each episode [mm].
        angle_of_episode: (n,) median angle of each episode [deg].
    """

    tip: Measure
    angle: Measure
    n: int
    frames: int
    tip_of_episode: tuple[float, ...]
    angle_of_episode: tuple[float, ...]

    def row(self) -> dict[str, float]:
        """Return the errors as a row of `probe.json`."""
        row: dict[str, float] = {"n": self.n, "frames": self.frames}
        for key, measure in (("tip_mm", self.tip), ("angle_deg", self.angle)):
            row[key] = measure.median
            row[f"{key}_low"] = measure.low
            row[f"{key}_high"] = measure.high
            row[f"{key}_chance"] = measure.chance
        return row


def probe(
    dataset: Dataset,
    features: Sequence[Features],
    *,
    proprioception: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> Probe:
    """Probe the features of one or several views, concatenated.

    Args:
        dataset: an opened dataset.
        features: one entry of the cache per view; none to probe proprioception alone.
        proprioception: also use the active arm's reported tip pose and jaw as inputs.
        seed: seed of the folds and of the bootstrap.
        progress: called with (folds done, folds in total).

    Raises:
        UnknownName: a dataset without the needle's pose.
        InputError: a dataset that `needle_pose` refuses, features of another dataset, or nothing
            to probe.
    """
    pose = needle_pose(dataset)
    if not features and not proprioception:
        raise InputError("A probe needs the features of at least one view, or proprioception.")
    for entry in features:
        if entry.manifest["dataset"] != dataset.fingerprint or len(entry.rows) != dataset.length:
            raise InputError(
                f"The features of view '{entry.view}' are of another dataset; encode this one."
            )
    index = np.asarray(dataset.demonstration_index)  # its variants are held out together
    rows = spread(index, FRAMES)
    tables: list[NDArray[np.float64]] = [
        np.asarray(entry.rows[rows], np.float64).reshape(len(rows), -1) for entry in features
    ]
    if proprioception:
        tables.append(np.asarray(dataset.columns()[names.STATE][rows], np.float64))
    scale = np.sqrt(max(table.shape[1] for table in tables))
    # All tables have the same weight, however many columns they have.
    weights = np.concatenate(
        [np.full(table.shape[1], scale / np.sqrt(table.shape[1])) for table in tables]
    )
    seen = np.concatenate(tables, axis=1)
    position, rotation = _targets(pose[rows])
    folds = _folds(index[rows], FOLDS, np.random.default_rng(seed))
    # Every episode is held out once; row 0 of the errors is the probe's, row 1 the mean pose's.
    tip = np.empty((2, len(rows)))
    angle = np.empty((2, len(rows)))
    for done, fold in enumerate(np.unique(folds)):
        held = folds == fold
        reader = _Reader(seen[~held], seen[held], folds[~held], weights)
        for at, answer in enumerate((reader.answer, reader.mean)):
            tip[at, held] = 1e3 * np.linalg.norm(answer(position[~held]) - position[held], axis=1)
            angle[at, held] = _angles(answer(rotation[~held]), rotation[held])
        if progress:
            progress(done + 1, len(np.unique(folds)))
    generator = np.random.default_rng((seed, 1))
    measures = [_measure(errors, index[rows], generator) for errors in (tip, angle)]
    (tip_measure, tips), (angle_measure, angles) = measures
    return Probe(
        tip_measure,
        angle_measure,
        len(tips),
        len(rows),
        tuple(tips.tolist()),
        tuple(angles.tolist()),
    )


def spread(episode_index: NDArray[np.int64], frames: int) -> NDArray[np.int64]:
    """Return at most `frames` row numbers, evenly spread over every episode.

    Every episode contributes equally many; a shorter one contributes all its rows.
    """
    episodes = np.unique(episode_index)
    each = max(1, frames // len(episodes))
    chosen = []
    for episode in episodes:
        rows = np.flatnonzero(episode_index == episode)
        places = np.linspace(0, len(rows) - 1, min(each, len(rows))).round().astype(int)
        chosen.append(rows[places])
    return np.concatenate(chosen)


def needle_pose(dataset: Dataset) -> Array:
    """Return the needle's pose, (N, 7); refuse a dataset that cannot be probed.

    Raises:
        UnknownName: a dataset without the needle's pose.
        InputError: fewer than `FEWEST` episodes, a pose that is not finite, or needles of several
            shapes, whose tips no column tells.
    """
    columns = dataset.columns()
    if names.NEEDLE_POSE not in columns:
        raise UnknownName("column", names.NEEDLE_POSE, columns)
    pose = np.asarray(columns[names.NEEDLE_POSE], np.float64)
    episodes = len(np.unique(dataset.demonstration_index))
    if episodes < FEWEST:
        raise InputError(f"The dataset has {episodes} episodes; a probe needs at least {FEWEST}.")
    if not np.isfinite(pose).all():
        raise InputError(
            f"Column '{names.NEEDLE_POSE}' of the dataset holds values that are not finite."
        )
    varied = [axis for axis in SHAPE_AXES if axis in dataset.config.randomisation.on]
    if varied:
        raise InputError(
            f"The needle's shape varies in the dataset ({', '.join(varied)}), and no column tells "
            "where the tip is; probe a dataset without these axes of randomisation."
        )
    return pose


def _targets(pose: Array) -> tuple[Array, Array]:
    """Return the tip in the world (n, 3) [m] and two columns of its orientation (n, 6)."""
    matrices = np.stack([quaternion_to_matrix(quaternion) for quaternion in pose[:, 3:]])
    tip = pose[:, :3] + matrices @ point(TIP_ANGLE)
    return tip, matrices[:, :, :2].transpose(0, 2, 1).reshape(len(pose), 6)


def _angles(answers: Array, wanted: Array) -> Array:
    """Return the angles between two tables of orientations (n, 6) [deg]."""
    products = np.einsum("nij,nij->n", _matrices(answers), _matrices(wanted))
    angles: Array = np.degrees(np.arccos(np.clip((products - 1) / 2, -1, 1)))
    return angles


def _matrices(columns: Array) -> Array:
    """Return the rotations (n, 3, 3) nearest to two columns (n, 6), by Gram–Schmidt."""
    x = columns[:, :3]
    y = columns[:, 3:]
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    y = y - (x * y).sum(1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=2)


def _folds(
    episode: NDArray[np.int64], count: int, generator: np.random.Generator
) -> NDArray[np.int64]:
    """Return the fold of each row; folds hold whole episodes, equally many each."""
    episodes, place = np.unique(episode, return_inverse=True)
    return (generator.permutation(len(episodes)) % count)[place]


class _Reader:
    """Ridge regression from one table of features, in its dual form.

    There are fewer frames than features.

    Args:
        fitted: features of the rows fitted on, (n, d).
        asked: features of the rows to predict, (m, d).
        folds: fold of each row fitted on, for choosing a penalty.
        weights: standard deviation to which each feature is scaled, (d,).
    """

    def __init__(
        self, fitted: Array, asked: Array, folds: NDArray[np.int64], weights: Array
    ) -> None:
        mean = fitted.mean(0)
        std = fitted.std(0)
        std = np.where(std > SMALLEST_STD, std, np.inf) / weights
        fitted = (fitted - mean) / std
        asked = (asked - mean) / std
        gram = fitted @ fitted.T
        self._whole = _Ridge(gram, asked @ fitted.T)
        parts = [folds == fold for fold in np.unique(folds)]
        self._parts = [
            (held, _Ridge(gram[np.ix_(~held, ~held)], gram[np.ix_(held, ~held)])) for held in parts
        ]
        self._asked = len(asked)

    def mean(self, target: Array) -> Array:
        """Return the mean target as every answer, (m, k) for targets (n, k)."""
        return np.broadcast_to(target.mean(0), (self._asked, target.shape[1]))

    def answer(self, target: Array) -> Array:
        """Return the answers (m, k) for targets (n, k), with the best penalty across the folds."""
        errors = np.zeros(len(PENALTIES))
        for held, ridge in self._parts:
            for at, penalty in enumerate(PENALTIES):
                errors[at] += ((ridge.answer(target[~held], penalty) - target[held]) ** 2).sum()
        return self._whole.answer(target, PENALTIES[int(errors.argmin())])


class _Ridge:
    """One eigendecomposition, from which ridge regression with any penalty follows.

    Args:
        gram: (n, n) dot products of the rows fitted on.
        cross: (m, n) dot products of the rows to predict with those fitted on.
    """

    def __init__(self, gram: Array, cross: Array) -> None:
        row = gram.mean(0)
        centred = gram - row[None] - row[:, None] + row.mean()
        values, self._vectors = np.linalg.eigh(centred)
        self._values = np.maximum(values, 0.0)
        self._scale = self._values.sum() or 1.0  # 0 where every feature is constant
        self._projected = (
            cross - cross.mean(1, keepdims=True) - row[None] + row.mean()
        ) @ self._vectors

    def answer(self, target: Array, penalty: float) -> Array:
        """Return the answers (m, k) for targets (n, k).

        Args:
            target: the targets of the rows fitted on.
            penalty: a share of the features' total variance.
        """
        mean = target.mean(0)
        turned = self._vectors.T @ (target - mean) / (self._values + penalty * self._scale)[:, None]
        answers: Array = self._projected @ turned + mean
        return answers


def _measure(
    errors: Array, episode: NDArray[np.int64], generator: np.random.Generator
) -> tuple[Measure, Array]:
    """Return the measure of (2, n) errors, probe and chance, and each episode's median error."""
    of_episode = np.array(
        [np.median(errors[:, episode == one], axis=1) for one in np.unique(episode)]
    )
    draws = generator.integers(0, len(of_episode), (RESAMPLES, len(of_episode)))
    low, high = np.quantile(np.median(of_episode[draws, 0], axis=1), (0.025, 0.975))
    median, chance = np.median(of_episode, axis=0)
    return Measure(float(median), float(low), float(high), float(chance)), of_episode[:, 0]
