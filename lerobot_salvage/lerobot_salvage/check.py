"""Check a LeRobot dataset from any source.

    report = check_dataset(Path("dataset"))
    report.ok, report.problems        # one line per problem

LeRobot's metadata files must agree with the data and with each other, and every episode must be
whole as `verify` defines it. The digest is over the data and video files. A dataset of
surgicai-vision gets that package's own check, unless it was rendered in another layout.
"""

import tempfile
from pathlib import Path

from lerobot_salvage.verify import Verifier, claimed_episodes, rendered_meta
from surgicai_vision.core import names
from surgicai_vision.core.config import digest
from surgicai_vision.core.files import sha256_file
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.dataset import check
from surgicai_vision.dataset.check import CheckReport, first_problems
from surgicai_vision.dataset.lerobot_files import INFO, TASKS, LeRobotFiles


def check_dataset(path: Path, progress: Progress = silent) -> CheckReport:
    """Read a whole dataset and report its problems.

    Args:
        path: a LeRobot v3 dataset.
        progress: called with (done, total, "frames" or "episodes").

    Raises:
        BadFile: it cannot be opened at all.
    """
    if (path / names.META_FILE).exists() and "layout" not in rendered_meta(path):
        return check.check_dataset(path, progress)
    files = LeRobotFiles(path)
    info = files.info
    claimed = claimed_episodes(files)
    rows: list[tuple[int, int, int]] = []
    start = 0
    tasks: set[int] = set()
    with tempfile.TemporaryDirectory(prefix="lerobot-salvage-") as scratch:
        for number, episode in enumerate(Verifier(files).episodes(Path(scratch))):
            count = len(episode.table)
            rows.append((count, start, start + count))
            start += count
            tasks |= episode.tasks.keys()
            progress(number + 1, max(claimed, number + 1), "episodes")
    problems = list(files.problems)
    if (info.get("total_frames"), info.get("total_episodes")) != (start, len(rows)):
        problems.append(
            f"{INFO}: it counts {info.get('total_episodes')} episodes and "
            f"{info.get('total_frames')} frames; {len(rows)} episodes and {start} frames are whole."
        )
    written = [
        tuple(row.get(key) for key in ("length", "dataset_from_index", "dataset_to_index"))
        for row in files.rows
    ]
    if written != rows:
        problems.append("meta/episodes: its rows do not match the episodes in the data.")
    unnamed = sorted(tasks - files.tasks.keys())
    if unnamed:
        problems.append(
            f"{TASKS}: no task for {len(unnamed)} task_index of the data, first {unnamed[0]}."
        )
    missing = [
        key
        for key, row in files.features.items()
        if row["dtype"] != "string" and key not in files.statistics
    ]
    if missing:
        problems.append(f"meta/stats.json: no statistics of {', '.join(missing)}.")
    data = [*files.data_files(), *sorted(path.glob("videos/*/chunk-*/file-*.mp4"))]
    content = digest([sha256_file(file) for file in data])
    return CheckReport(start, len(rows), content, first_problems(problems))
