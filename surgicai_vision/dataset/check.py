"""Check a dataset of ours: every frame, and its metadata against the frames.

    report = check_dataset(Path("dataset"))
    report.ok, report.problems        # one line per problem

`meta/surgicai.json` and LeRobot's `meta/info.json`, `meta/tasks.parquet`, `meta/episodes` and
`meta/stats.json` must agree with the data and with each other. Index columns must be gapless and in
order, and every number finite. Every image must decode, have the right size, not be of one colour,
and differ from the previous one if the arm or the needle moved; depth must be positive. The digest
of the decoded content must be the one recorded at rendering.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.errors import BadFile, first_line
from surgicai_vision.core.files import read_json
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.core.untrusted import checked
from surgicai_vision.dataset import schema
from surgicai_vision.dataset.lerobot_files import EPISODES, INFO, TASKS
from surgicai_vision.dataset.reader import RenderedDataset, open_dataset
from surgicai_vision.dataset.rules import ImageWatch, episode_problems, number_problems
from surgicai_vision.dataset.stats import column_statistics

MOST_PROBLEMS = 50
"""Number of problems that are listed; the others are only counted."""
STATISTICS_TOLERANCE = 1e-4
"""Largest deviation of a column's statistics, relative to the column's largest value."""


@dataclass(frozen=True)
class CheckReport:
    """The result of a check.

    Attributes:
        frames: number of frames that were read.
        episodes: number of episodes that were read.
        digest: digest of the content.
        problems: one line per problem.
    """

    frames: int
    episodes: int
    digest: str
    problems: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """True if there is no problem."""
        return not self.problems


def check_dataset(path: Path, progress: Progress = silent) -> CheckReport:
    """Read a whole dataset and report what is wrong with it.

    Args:
        path: a dataset of ours.
        progress: called with (frames done, frames, "frames").

    Raises:
        BadFile: it cannot be opened at all, or was not rendered by surgicai-vision.
    """
    if (path / INFO).is_file() and not (path / names.META_FILE).exists():
        raise BadFile(
            f"{path} is a LeRobot dataset that surgicai-vision did not render; check it with "
            f"'lerobot-salvage check {path}' (the distribution lerobot_salvage)."
        )
    dataset = open_dataset(path)
    problems: list[str] = []
    columns = dataset.columns()
    keys = dataset.image_keys
    _check_order(dataset, columns, problems)
    problems.extend(number_problems(columns))
    _check_lerobot(dataset, columns, keys, problems)
    digests = []
    bounds = dataset.bounds()
    for start, stop in bounds:
        rows = {key: columns[key][start:stop] for key in schema.columns(dataset.views)}
        digests.append(_check_episode(dataset, keys, start, stop, rows, problems))
        progress(stop, dataset.length, "frames")
    digest = schema.dataset_digest(digests)
    if digest != dataset.meta.get("digest"):
        problems.append(
            f"digest: the content has {digest[:16]}…, its {names.META_FILE} says otherwise."
        )
    return CheckReport(dataset.length, len(bounds), digest, first_problems(problems))


def first_problems(problems: list[str]) -> tuple[str, ...]:
    """Return the first `MOST_PROBLEMS` problems and, if there are more, how many more."""
    more = len(problems) - MOST_PROBLEMS
    return (*problems[:MOST_PROBLEMS], *([f"… and {more} more."] if more > 0 else []))


def _check_order(
    dataset: RenderedDataset, columns: Mapping[str, NDArray[np.generic]], problems: list[str]
) -> None:
    """Check the index columns and the ends of the episodes."""
    if not np.array_equal(columns["index"], np.arange(dataset.length)):
        problems.append("index: not 0, 1, 2, … over the dataset.")
    if dataset.task_index.any():
        problems.append("task_index: not 0 in every frame.")
    bounds = dataset.bounds()
    if [int(dataset.episode_index[start]) for start, _ in bounds] != list(range(len(bounds))):
        problems.append("episode_index: episodes are not 0, 1, 2, … in order.")
    if len(bounds) != dataset.meta.get("episodes"):
        problems.append(
            f"episodes: {len(bounds)} in the data, {dataset.meta.get('episodes')} in "
            f"{names.META_FILE}."
        )
    for number, (start, stop) in enumerate(bounds):
        episode = {key: rows[start:stop] for key, rows in columns.items()}
        problems.extend(episode_problems(number, episode, dataset.fps))


def _check_lerobot(
    dataset: RenderedDataset,
    columns: Mapping[str, NDArray[np.generic]],
    keys: list[str],
    problems: list[str],
) -> None:
    """Check LeRobot's own metadata against the data."""
    try:
        info = checked(read_json(dataset.path / "meta/info.json"), dict, "meta/info.json")
        features = checked(info.get("features"), dict, "meta/info.json: features")
        statistics = checked(read_json(dataset.path / "meta/stats.json"), dict, "meta/stats.json")
        counts = ["episode_index", "length", "dataset_from_index", "dataset_to_index"]
        files = sorted(dataset.path.glob(EPISODES))
        table = pa.concat_tables(pq.read_table(file, columns=counts) for file in files)
        tasks = pq.read_table(dataset.path / TASKS).num_rows
    except (BadFile, OSError, ValueError, pa.ArrowException) as error:
        problems.append(f"LeRobot's metadata cannot be read ({first_line(error)}).")
        return
    bounds = dataset.bounds()
    if (info.get("total_frames"), info.get("total_episodes")) != (dataset.length, len(bounds)):
        problems.append("meta/info.json: its counts differ from the data.")
    if info.get("fps") != dataset.fps:
        problems.append(f"meta/info.json: its fps is not {dataset.fps}.")
    if not tasks:
        problems.append(f"{TASKS}: it holds no task.")
    own = schema.columns(dataset.views)
    missing = [key for key in (*keys, *own) if key not in features]
    if missing:
        problems.append(f"meta/info.json: no feature {', '.join(missing)}.")
    expected = [(number, stop - start, start, stop) for number, (start, stop) in enumerate(bounds)]
    if list(zip(*(column.to_pylist() for column in table.columns), strict=True)) != expected:
        problems.append("meta/episodes: its rows do not match the episodes in the data.")
    for key in own:
        _check_statistics(key, statistics.get(key), columns[key], problems)
    problems.extend(
        f"meta/stats.json: no statistics of {key}." for key in keys if key not in statistics
    )


def _check_statistics(
    key: str, recorded: object, values: NDArray[np.generic], problems: list[str]
) -> None:
    """Check a column's recorded statistics against its values."""
    if not isinstance(recorded, dict):
        problems.append(f"meta/stats.json: no statistics of {key}.")
        return
    exact = column_statistics(values)
    scale = max(1.0, *(abs(value) for value in (*exact["min"], *exact["max"])))
    for name in ("min", "max", "mean", "std", "count"):
        try:
            given = np.ravel(np.asarray(recorded.get(name, np.nan), dtype=np.float64))
        except (TypeError, ValueError, OverflowError):  # not a number, or one with too many digits
            given = np.zeros(0)
        fits = given.shape == np.shape(exact[name])
        if not fits or not np.allclose(given, exact[name], atol=STATISTICS_TOLERANCE * scale):
            problems.append(f"meta/stats.json: {name} of {key} does not match the data.")


def _check_episode(
    dataset: RenderedDataset,
    keys: list[str],
    start: int,
    stop: int,
    rows: Mapping[str, NDArray[np.generic]],
    problems: list[str],
) -> str:
    """Check one episode's images; return the digest of its content."""
    digest = schema.EpisodeDigest(keys)
    for key in keys:
        watch = ImageWatch(
            key, dataset.image_size, dataset.views, rows, key not in dataset.video_keys
        )
        for index, frame in enumerate(_frames(dataset, key, start, stop, problems)):
            digest.add(key, frame)
            problem = watch.problem(index, frame)
            if problem:
                problems.append(f"frame {start + index}, {key}: {problem}.")
    return digest.hexdigest(rows, dataset.views)


def _frames(
    dataset: RenderedDataset, key: str, start: int, stop: int, problems: list[str]
) -> Iterator[NDArray[np.uint8 | np.float32]]:
    """Yield an episode's images of one column, up to the first that cannot be decoded."""
    try:
        yield from dataset.decoded(key, start, stop)
    except BadFile as error:
        problems.append(str(error))
