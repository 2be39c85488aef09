"""Check a dataset: counts, order, pictures, numbers, statistics and the digest, every frame of it.

    report = check_dataset(Path("dataset"))
    report.ok, report.problems        # each problem one line

What is checked: `meta/surgicai.json`, LeRobot's `meta/info.json`, `meta/episodes` and `meta/stats.json` agree
with the data and with each other; index columns are gapless and in order; every number is finite; every
picture decodes, has its size, is not of one colour and is not the one before it while the arm or the needle
moved; depth is positive; the digest over the decoded content is the one recorded when it was rendered.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from surgicai_vision import names
from surgicai_vision.dataset import layout
from surgicai_vision.dataset.reading import Dataset, open_dataset
from surgicai_vision.dataset.statistics import column_statistics
from surgicai_vision.errors import BadFile
from surgicai_vision.executor import Progress
from surgicai_vision.files import read_json

MOVED = 0.001
"""An arm or a needle that went further than this between two frames [m] must be seen to have moved."""
MOST_PROBLEMS = 50
"""Problems listed; the rest is counted."""
STATISTICS_TOLERANCE = 1e-4
"""Largest deviation of a column's statistics from the recomputed ones, relative to the largest value."""


@dataclass(frozen=True)
class CheckReport:
    """What a check found: frames and episodes read, the digest of the content, and one line a problem."""

    frames: int
    episodes: int
    digest: str
    problems: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Say whether there is no problem."""
        return not self.problems


def check_dataset(path: Path, progress: Progress | None = None) -> CheckReport:
    """Read all of a dataset and report what is wrong with it.

    Raises:
        BadFile: it cannot be opened at all.
    """
    dataset = open_dataset(path)
    problems: list[str] = []
    columns = dataset.columns()
    keys = [key for key, _, _ in layout.picture_keys(dataset.views, dataset.has_depth, dataset.has_segmentation)]
    _check_order(dataset, columns, problems)
    _check_numbers(columns, problems)
    _check_lerobot(dataset, columns, keys, problems)
    digests = []
    bounds = _bounds(dataset.episode_index)
    for start, stop in bounds:
        rows = {key: columns[key][start:stop] for key in layout.COLUMNS}
        digests.append(_check_episode(dataset, keys, start, stop, rows, problems))
        if progress:
            progress(stop, dataset.length, "frames")
    digest = layout.dataset_digest(digests)
    if digest != dataset.meta.get("digest"):
        problems.append(f"digest: the content has {digest[:16]}…, its {names.META_FILE} says otherwise.")
    listed = problems[:MOST_PROBLEMS]
    if len(problems) > MOST_PROBLEMS:
        listed.append(f"… and {len(problems) - MOST_PROBLEMS} more.")
    return CheckReport(dataset.length, len(bounds), digest, tuple(listed))


def _bounds(episode_index: np.ndarray) -> list[tuple[int, int]]:
    """Return (first frame, frame after the last) of every episode."""
    if not len(episode_index):
        return []
    starts = [0, *(np.flatnonzero(np.diff(episode_index)) + 1).tolist()]
    return list(zip(starts, [*starts[1:], len(episode_index)], strict=True))


def _check_order(dataset: Dataset, columns: Mapping[str, np.ndarray], problems: list[str]) -> None:
    """Check the index columns and the ends of the episodes."""
    if not np.array_equal(columns["index"], np.arange(dataset.length)):
        problems.append("index: not 0, 1, 2, … over the dataset.")
    bounds = _bounds(dataset.episode_index)
    if [int(dataset.episode_index[start]) for start, _ in bounds] != list(range(len(bounds))):
        problems.append("episode_index: episodes are not 0, 1, 2, … in order.")
    if len(bounds) != dataset.meta.get("episodes"):
        problems.append(f"episodes: {len(bounds)} in the data, {dataset.meta.get('episodes')} in {names.META_FILE}.")
    for number, (start, stop) in enumerate(bounds):
        steps = np.arange(stop - start)
        if not np.array_equal(columns["frame_index"][start:stop], steps):
            problems.append(f"episode {number}: frame_index is not 0, 1, 2, …")
        if not np.allclose(columns["timestamp"][start:stop], steps / names.FPS, atol=1e-4):
            problems.append(f"episode {number}: timestamp is not frame_index / {names.FPS}.")
        if not np.array_equal(columns[names.DONE][start:stop], steps == stop - start - 1):
            problems.append(f"episode {number}: {names.DONE} is not true at its last frame alone.")
        if len(np.unique(columns[names.SEED][start:stop])) != 1:
            problems.append(f"episode {number}: its frames have different seeds.")


def _check_numbers(columns: Mapping[str, np.ndarray], problems: list[str]) -> None:
    """Check that numbers are finite and actions within [-1, 1]."""
    for key in layout.COLUMNS:
        wrong = ~np.isfinite(columns[key].astype(np.float64)).reshape(len(columns[key]), -1).all(axis=1)
        if wrong.any():
            problems.append(f"{key}: {wrong.sum()} frames with numbers that are not finite, first {wrong.argmax()}.")
    if len(columns[names.ACTION]) and np.nanmax(np.abs(columns[names.ACTION])) > 1.0:
        problems.append(f"{names.ACTION}: values outside [-1, 1].")


def _check_lerobot(dataset: Dataset, columns: Mapping[str, np.ndarray], keys: list[str], problems: list[str]) -> None:
    """Check LeRobot's own metadata against the data."""
    try:
        info = read_json(dataset.path / "meta/info.json")
        statistics = read_json(dataset.path / "meta/stats.json")
        table = pa.concat_tables(
            pq.read_table(file, columns=["episode_index", "length", "dataset_from_index", "dataset_to_index"])
            for file in sorted(dataset.path.glob("meta/episodes/chunk-*/file-*.parquet"))
        )
    except (BadFile, OSError, pa.ArrowException) as error:
        problems.append(f"LeRobot's metadata cannot be read ({(str(error).splitlines() or [''])[0]}).")
        return
    bounds = _bounds(dataset.episode_index)
    if (info.get("total_frames"), info.get("total_episodes")) != (dataset.length, len(bounds)):
        problems.append("meta/info.json: its counts are not those of the data.")
    missing = [key for key in (*keys, *layout.COLUMNS) if key not in info.get("features", {})]
    if missing:
        problems.append(f"meta/info.json: no feature {', '.join(missing)}.")
    expected = [(number, stop - start, start, stop) for number, (start, stop) in enumerate(bounds)]
    if list(zip(*(column.to_pylist() for column in table.columns), strict=True)) != expected:
        problems.append("meta/episodes: its rows are not the episodes of the data.")
    for key in layout.COLUMNS:
        _check_statistics(key, statistics.get(key), columns[key], problems)
    problems.extend(f"meta/stats.json: no statistics of {key}." for key in keys if key not in statistics)


def _check_statistics(key: str, recorded: Any, values: np.ndarray, problems: list[str]) -> None:
    """Check a column's recorded statistics against its values."""
    if not isinstance(recorded, dict):
        problems.append(f"meta/stats.json: no statistics of {key}.")
        return
    exact = column_statistics(values)
    scale = max(1.0, *(abs(value) for value in (*exact["min"], *exact["max"])))
    for name in ("min", "max", "mean", "std", "count"):
        given = np.ravel(np.asarray(recorded.get(name, np.nan), dtype=np.float64))
        fits = given.shape == np.shape(exact[name])
        if not fits or not np.allclose(given, exact[name], atol=STATISTICS_TOLERANCE * scale):
            problems.append(f"meta/stats.json: {name} of {key} is not that of the data.")


def _check_episode(
    dataset: Dataset, keys: list[str], start: int, stop: int, rows: Mapping[str, np.ndarray], problems: list[str]
) -> str:
    """Check one episode's pictures; return the digest of its content."""
    shown = np.concatenate([rows[names.STATE][:, :3], rows[names.NEEDLE_POSE][:, :3]], axis=1)
    # A wrist camera need not see what moved, and a part's outline can stay the same.
    still = [view for view in dataset.views if not view.startswith("wrist")]
    watched = {key(view) for view in still for key in (names.image_key, names.depth_key)}
    digest = layout.EpisodeDigest(keys)
    for key in keys:
        before: np.ndarray | None = None
        last = shown[0]
        for index, frame in enumerate(_frames(dataset, key, start, stop, problems)):
            digest.add(key, frame)
            problem = _picture_problem(frame, dataset.image_size)
            if before is not None and np.array_equal(frame, before):
                if key in watched and np.abs(shown[index] - last).max() > MOVED:
                    problem = problem or "the picture before it again, although something moved"
            else:
                before, last = frame, shown[index]
            if problem:
                problems.append(f"frame {start + index}, {key}: {problem}.")
    return digest.hexdigest(rows)


def _frames(dataset: Dataset, key: str, start: int, stop: int, problems: list[str]) -> list[np.ndarray]:
    """Return an episode's pictures of one column; those before the first that cannot be decoded."""
    frames = []
    try:
        for frame in dataset.decoded(key, start, stop):
            frames.append(frame)
    except BadFile as error:
        problems.append(str(error))
    return frames


def _picture_problem(frame: np.ndarray, size: int) -> str:
    """Return what is wrong with a picture by itself, or nothing."""
    if frame.shape[:2] != (size, size):
        return f"it is {frame.shape[0]} × {frame.shape[1]}, not {size} × {size}"
    if frame.dtype == np.float32 and not (np.isfinite(frame).all() and frame.min() > 0.0):
        return "depth that is not finite and positive"
    low, high = frame.min(), frame.max()
    if low == high:
        return "black" if high == 0 else "of one colour"
    return ""
