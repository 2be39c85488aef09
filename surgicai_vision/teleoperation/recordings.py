"""Recordings: the folder that teleoperation fills, one episode at a time.

It is a folder of demonstrations like any other (`demos.store`), complete after every episode.
`demos.json` also says which seeds were kept and which were given up. If the process was killed
before it could enter an episode there, the episode is found by its file. The folder is locked while
a session runs, so that two cannot write the same numbers.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from surgicai_vision.core import names
from surgicai_vision.core.banks import check_training_starts
from surgicai_vision.core.config import TaskConfig, to_mapping
from surgicai_vision.core.errors import BadFile, OutputExists, SurgicaiError
from surgicai_vision.core.files import TEMPORARY, check_output, locked
from surgicai_vision.core.untrusted import checked
from surgicai_vision.demos.store import (
    MARKER,
    Demo,
    is_same_request,
    list_demos,
    read_demo,
    read_marker,
    write_demo,
    write_marker,
)

DEMONSTRATOR = "teleoperate"


class Recordings:
    """The episodes of one folder; made by `open_recordings`.

    Args:
        folder: the folder.
        request: what the folder is for; kept in its marker.
        seeds: of the episodes in the folder, in their order.
        skipped: seeds given up, {"seed", "reason"}.
    """

    def __init__(
        self,
        folder: Path,
        request: Mapping[str, Any],
        seeds: list[int],
        skipped: list[dict[str, Any]],
    ):
        self.folder = folder
        self._request = request
        self.seeds = seeds
        self.skipped = skipped

    @property
    def next_seed(self) -> int:
        """Return the first seed after all that were kept or given up.

        Raises:
            InputError: it is reserved for validation or tests.
        """
        used = [*self.seeds, *(row["seed"] for row in self.skipped)]
        seed = max(used, default=int(self._request["seed"]) - 1) + 1
        check_training_starts(seed, 1)
        return seed

    def keep(self, demo: Demo) -> Path:
        """Write an episode, whole or not at all; the folder has a marker before its first one."""
        if not (self.folder / MARKER).exists():
            self._write_marker()
        path = write_demo(self.folder, len(self.seeds), demo)
        self.seeds.append(demo.seed)
        self._write_marker()
        return path

    def skip(self, seed: int, reason: str) -> None:
        """Note that no episode is wanted from `seed`."""
        self.skipped.append({"seed": seed, "reason": reason})
        self._write_marker()

    def _write_marker(self) -> None:
        details = {
            "request": self._request,
            "seeds": self.seeds,
            "skipped": self.skipped,
            "episodes": len(self.seeds),
        }
        write_marker(self.folder, self._request["task"]["task"], DEMONSTRATOR, **details)


@contextmanager
def open_recordings(
    folder: Path, config: TaskConfig, scene_hash: str, seed: int | None = None
) -> Iterator[Recordings]:
    """Open a folder to add episodes to, and lock out other sessions meanwhile.

    Args:
        folder: created if it does not exist, and then removed again if nothing was written to it.
        config: the task; a folder holds a single one.
        scene_hash: hash of the compiled scene.
        seed: first seed of a new folder, 0 by default; an existing one is continued.

    Raises:
        InputError: the start is reserved for validation or tests.
        OutputExists: the folder holds something else.
        SurgicaiError: another session has it open.
        BadFile: damaged episodes or marker.
    """
    check_training_starts(seed or names.TRAIN_SEED, 1)
    check_output(folder, may_resume=MARKER)
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    whole = folder.resolve()  # a folder has one lock, whatever link or "." it is given as
    refusal = SurgicaiError(
        f"--out {folder}: another session is recording there; give another folder."
    )
    with locked(whole.with_name(f".{whole.name}.lock"), refusal=refusal):
        for leftover in folder.glob(f"{TEMPORARY}*"):
            leftover.unlink(missing_ok=True)
        try:
            yield _read(folder, config, scene_hash, seed)
        finally:
            if is_new and not any(folder.iterdir()):
                folder.rmdir()


def _read(folder: Path, config: TaskConfig, scene_hash: str, seed: int | None) -> Recordings:
    """Return the recordings in a folder; a new one starts at `seed`."""
    request = {
        "task": to_mapping(config),
        "demonstrator": DEMONSTRATOR,
        "scene": scene_hash,
        "seed": seed or names.TRAIN_SEED,
    }
    if not (folder / MARKER).exists() and not any(folder.glob("episode_*")):
        return Recordings(folder, request, [], [])
    marker = read_marker(folder)
    stored = marker.get("request")
    if seed is None and isinstance(stored, dict):
        request["seed"] = checked(stored.get("seed", 0), int, f"{folder / MARKER}: request: seed")
    if not is_same_request(stored, request):
        raise OutputExists(
            f"--out {folder} holds demonstrations of another command, task or scene "
            f"(see {folder / MARKER}); give another folder."
        )
    paths = list_demos(folder) if any(folder.glob("episode_*")) else []
    seeds = marker.get("seeds")
    skipped = marker.get("skipped")
    if not (
        isinstance(seeds, list)
        and isinstance(skipped, list)
        and all(isinstance(row, dict) for row in skipped)
        and all(isinstance(used, int) for used in [*seeds, *(row.get("seed") for row in skipped)])
    ):
        raise BadFile(
            f"{folder / MARKER} does not say which seeds were kept and given up; "
            "give another folder."
        )
    if len(seeds) != len(paths):  # killed between an episode and its entry
        seeds = [read_demo(path).seed for path in paths]
    return Recordings(folder, request, seeds, skipped)
