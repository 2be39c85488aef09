"""Finished episodes: what a killed evaluation has already run, kept one file per episode.

    finished = FinishedEpisodes.open(out, owner)         # forgets what belongs to another owner
    episodes = evaluate(make_agent, config, seeds, finished=finished)
    finished.remove()                                    # once the evaluation is written

`OUT/finished/<seed>.safetensors` holds the states of an episode's film and, as JSON in the file's
metadata, its row and visits. The process that ran the episode writes it as a whole, so a kill
costs the episodes in flight. `OUT/finished/owner.json` says what the episodes depend on besides
the seeds. A file that cannot be read is ignored, and its episode runs again.
"""

import dataclasses
import json
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self, final

import numpy as np

from surgicai_vision.core import files
from surgicai_vision.core.config import JSON, from_mapping
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.core.untrusted import checked, parse_json
from surgicai_vision.envs.visits import Visit
from surgicai_vision.evaluation.metrics import EpisodeMetrics
from surgicai_vision.evaluation.slot import Episode, Film

FOLDER: Final = "finished"
"""Name of the folder inside that of an evaluation."""
OWNER: Final = "owner.json"
SUFFIX: Final = ".safetensors"


@final
@dataclass(frozen=True)
class FinishedEpisodes:
    """The finished episodes of one evaluation.

    Attributes:
        folder: where they are kept; made with the first of them.
        owner: hash of everything that an episode depends on besides its seed.
    """

    folder: Path
    owner: str

    @classmethod
    def open(cls, out: Path, owner: str) -> Self:
        """Return the finished episodes in an evaluation's folder; those of another owner go.

        Args:
            out: folder of the evaluation.
            owner: as the attribute.
        """
        folder = out / FOLDER
        try:
            is_same = files.read_json(folder / OWNER) == owner
        except BadFile:  # there are none, or the file is damaged
            is_same = False
        if not is_same:
            shutil.rmtree(folder, ignore_errors=True)
        return cls(folder, owner)

    def keep(self, episode: Episode) -> None:
        """Write an episode."""
        from safetensors.numpy import save

        if not (self.folder / OWNER).exists():
            self.folder.mkdir(exist_ok=True)
            files.write_json(self.folder / OWNER, self.owner)
        content = {
            "row": dataclasses.asdict(episode.row),
            "visits": [dataclasses.asdict(visit) for visit in episode.visits],
        }
        metadata = {"episode": json.dumps(content, default=_plain)}
        arrays = {"steps": episode.film.steps, "states": episode.film.states}
        files.write_bytes(self._path(episode.row.seed), save(arrays, metadata))

    def read(self, seeds: Iterable[int]) -> dict[int, Episode]:
        """Return the episodes that are there, by the seeds of their starts."""
        found = {}
        for seed in seeds:
            if self._path(seed).is_file():
                try:
                    found[seed] = _read(self._path(seed))
                except InputError:  # damaged: the episode runs again
                    continue
        return found

    def remove(self) -> None:
        """Forget all episodes; they are part of a written evaluation."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, seed: int) -> Path:
        return self.folder / f"{seed}{SUFFIX}"


def _plain(value: object) -> JSON:
    """Return a NumPy number as a Python one."""
    assert isinstance(value, np.generic)
    plain: JSON = value.item()
    return plain


def _read(path: Path) -> Episode:
    """Read one episode.

    Raises:
        InputError: the file is damaged.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="numpy") as file:
            film = Film(np.asarray(file.get_tensor("steps")), np.asarray(file.get_tensor("states")))
            text = file.metadata()["episode"]
    except (SafetensorError, KeyError, TypeError) as error:
        raise BadFile(f"{path} is damaged ({error}).") from None
    content = checked(parse_json(text, str(path)), dict, str(path))
    row = checked(content.get("row"), dict, f"{path}: row")
    visits = checked(content.get("visits"), list, f"{path}: visits")
    return Episode(
        from_mapping(EpisodeMetrics, row, str(path)),
        film,
        tuple(from_mapping(Visit, visit, str(path)) for visit in visits),
    )
