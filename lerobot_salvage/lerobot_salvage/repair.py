"""Repair a broken LeRobot dataset: keep its longest verified prefix.

    repair_dataset(Path("dataset"))                     # the original becomes dataset.broken
    repair_dataset(Path("dataset"), Path("mended"))     # the original stays as it is

A killed LeRobot writer leaves data files without footers, no `meta/episodes` and an `info.json`
that counts missing episodes. The episodes that can be verified, starting from the first (`verify`),
are written into a new folder with new metadata and statistics. This folder appears only when it is
complete, and is checked before it replaces the old one.
"""

import ctypes
import os
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_salvage.check import check_dataset
from lerobot_salvage.verify import Verified, Verifier, claimed_episodes, task_name
from surgicai_vision.core import names
from surgicai_vision.core.errors import BadFile, InputError, SurgicaiError
from surgicai_vision.core.executor import claim, work_folder
from surgicai_vision.core.files import (
    check_output,
    check_renamed,
    sync_folder,
    whole_folder,
    write_json,
)
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.dataset import schema
from surgicai_vision.dataset.check import CheckReport
from surgicai_vision.dataset.lerobot_files import LeRobotFiles
from surgicai_vision.dataset.metadata import (
    INDEX_FEATURES,
    EpisodeMetadata,
    video_path,
    write_metadata,
)
from surgicai_vision.dataset.schema import Table
from surgicai_vision.dataset.writer import DataFiles

EXCHANGE = 2
"""RENAME_EXCHANGE of renameat2(2): swap two names in one step."""
HERE = -100
"""AT_FDCWD: paths are relative to the working directory."""


@dataclass(frozen=True)
class Repair:
    """The result of a repair.

    Attributes:
        path: the whole dataset.
        episodes: episodes kept.
        frames: frames kept.
        claimed: number of episodes according to the broken dataset's `info.json`.
        original: where the broken dataset is; None if nothing was broken.
        problems: the problems found, one line each.
    """

    path: Path
    episodes: int
    frames: int
    claimed: int
    original: Path | None
    problems: tuple[str, ...]


def repair_dataset(path: Path, out: Path | None = None, progress: Progress = silent) -> Repair:
    """Write the longest verified prefix of a dataset.

    A dataset without problems is left alone, and `out` is not created.

    Args:
        path: a LeRobot v3 dataset.
        out: folder to create; by default `path` is replaced and the original becomes
            `<path>.broken`.
        progress: called with (episodes verified, episodes claimed, "episodes").

    Raises:
        BadFile: `path` is not a LeRobot dataset, or contains no whole episode.
        InputError: the result cannot be renamed to `out`, or to `path` without it.
        OutputExists: `out` is not empty.
    """
    before = _checked(path)
    files = LeRobotFiles(path)
    claimed = claimed_episodes(files)
    if before is not None and before.ok:
        return Repair(path, before.episodes, before.frames, claimed, None, ())
    if out is not None:
        check_output(out)
        check_renamed(out)
    elif path.name in ("", ".."):
        raise InputError(
            f"{path} is the current folder or one above it, which cannot be replaced; give --out "
            "DIR, or run the command elsewhere."
        )
    elif _free(path, "broken") is None:
        raise BadFile(f"100 broken datasets already exist next to {path}; give --out DIR.")
    work = work_folder(out or path)
    with claim(work):
        try:
            made = work / "result"
            shutil.rmtree(made, ignore_errors=True)
            rows = _write(files, made, work, claimed, progress)
            after = check_dataset(made)
            if not after.ok:
                raise SurgicaiError(
                    f"The repair of {path} does not pass its own check: {after.problems[0]}"
                )
            problems = tuple(files.problems) or (before.problems if before else ())
            original = _commit(made, path, out)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    return Repair(out or path, len(rows), rows[-1].stop, claimed, original, problems)


def _checked(path: Path) -> CheckReport | None:
    """Check a dataset; return None if it cannot even be opened."""
    try:
        return check_dataset(path)
    except BadFile:
        return None


def _write(
    files: LeRobotFiles, made: Path, scratch: Path, claimed: int, progress: Progress
) -> list[EpisodeMetadata]:
    """Write the verified prefix as the folder `made`; return its episodes' rows."""
    verifier = Verifier(files)
    features = {key: row for key, row in files.features.items() if key not in INDEX_FEATURES}
    rows: list[EpisodeMetadata] = []
    digests: list[str] = []
    tasks = dict(files.tasks)
    with whole_folder(made) as folder, tempfile.TemporaryDirectory(dir=scratch) as mended:
        data = DataFiles(folder, features, files.fps)
        for episode in verifier.episodes(Path(mended)):
            rows.append(_append(data, len(rows), episode))
            digests.append(episode.digest)
            tasks.update(episode.tasks)
            progress(len(rows), max(claimed, len(rows)), "episodes")
        data.close()
        if not rows:
            raise BadFile(
                f"{files.path} cannot be repaired: no episode is complete ({_why(files.problems)})"
            )
        for key, videos in verifier.video_files.items():
            for number in sorted({row.videos[key][0] for row in rows}):
                target = folder / video_path(key, number)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(videos[number], target)
        texts = [tasks.get(index, task_name(index)) for index in range(max(tasks) + 1)]
        write_metadata(folder, features, texts, rows, files.info)
        if verifier.meta:
            digest = schema.dataset_digest(digests) if verifier.ours else None
            write_json(folder / names.META_FILE, _meta(verifier.meta, rows, digest, claimed))
    return rows


def _append(data: DataFiles, number: int, episode: Verified) -> EpisodeMetadata:
    """Write one episode."""
    row = data.append(number, episode.table, episode.statistics)
    texts = tuple(episode.tasks.values())
    return EpisodeMetadata(row.start, row.stop, row.file, row.statistics, texts, episode.videos)


def _meta(
    before: Table, rows: Sequence[EpisodeMetadata], digest: str | None, claimed: int
) -> Table:
    """Return `meta/surgicai.json` of the prefix, which is no longer the result of a request.

    Its digest is None where it is not known: in a layout other than surgicai-vision's own.
    """
    return {
        **before,
        "request": None,
        "repaired": {"episodes_before": claimed, "digest_before": before.get("digest")},
        "frames": rows[-1].stop,
        "episodes": len(rows),
        "digest": digest,
    }


def _why(problems: Sequence[str]) -> str:
    return " ".join(problems[-2:]) or "its data files are missing."


def _free(path: Path, ending: str) -> Path | None:
    """Return an unused name next to `path`."""
    tried = [path.with_name(f"{path.name}.{ending}{number or ''}") for number in range(100)]
    return next((name for name in tried if not name.exists()), None)


def _commit(made: Path, path: Path, out: Path | None) -> Path:
    """Move the repaired folder to its place; return where the original is."""
    if out is not None:
        if out.exists():
            out.rmdir()  # empty: checked before
        os.rename(made, out)
        sync_folder(out.parent)
        return path
    original = _free(path, "broken")
    assert original is not None
    os.rename(made, original)
    if not _exchange(original, path):
        # This file system cannot exchange: between the renames, both folders are whole, under other
        # names.
        aside = _free(path, "repaired")
        assert aside is not None
        os.rename(original, aside)
        os.rename(path, original)
        os.rename(aside, path)
    sync_folder(path.parent)
    return original


def _exchange(one: Path, other: Path) -> bool:
    """Swap two folders' names in one step; return False where the file system cannot."""
    try:
        swap = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    return not swap(HERE, os.fsencode(one.resolve()), HERE, os.fsencode(other.resolve()), EXCHANGE)
