"""Finished episodes: what a killed evaluation has already run, kept one file per episode.

    finished = FinishedEpisodes(out / FOLDER, owner)
    episodes = evaluate(make_agent, config, seeds, finished=finished)
    finished.remove()                                    # once the evaluation is written

`OUT/finished/<seed>.safetensors` holds the states of an episode's film and, as JSON in the file's
metadata, its row and visits. The process that ran the episode writes it as a whole, so a kill
costs the episodes in flight. The metadata also name the owner: what an episode depends on besides
its seed. A file of another owner, or one that cannot be read, is ignored: its episode runs again
and replaces it.
"""

import json
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from surgicai_vision.core import files
from surgicai_vision.core.config import from_mapping, to_mapping
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.core.untrusted import checked, parse_json
from surgicai_vision.envs.visits import Visit
from surgicai_vision.evaluation.metrics import EpisodeMetrics
from surgicai_vision.evaluation.slot import Episode, Film

FOLDER: Final = "finished"
"""Name of the folder inside that of an evaluation."""
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

    def keep(self, episode: Episode) -> None:
        """Write an episode."""
        from safetensors.numpy import save

        content = {
            "row": to_mapping(episode.row),
            "visits": [to_mapping(visit) for visit in episode.visits],
        }
        metadata = {"owner": self.owner, "episode": json.dumps(content)}
        arrays = {"steps": episode.film.steps, "states": episode.film.states}
        self.folder.mkdir(exist_ok=True)
        files.write_bytes(self._path(episode.row.seed), save(arrays, metadata))

    def read(self, seeds: Iterable[int]) -> dict[int, Episode]:
        """Return the episodes of this owner that are there, by the seeds of their starts."""
        found = {}
        for seed in seeds:
            if self._path(seed).is_file():
                try:
                    episode = self._read(self._path(seed))
                except InputError:  # damaged: the episode runs again
                    continue
                if episode:
                    found[seed] = episode
        return found

    def remove(self) -> None:
        """Forget all episodes; they are part of a written evaluation."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, seed: int) -> Path:
        return self.folder / f"{seed}{SUFFIX}"

    def _read(self, path: Path) -> Episode | None:
        """Read one episode; None if it is another owner's.

        Raises:
            InputError: the file is damaged.
        """
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(str(path), framework="numpy") as file:
                metadata = file.metadata()
                if metadata["owner"] != self.owner:
                    return None
                film = Film(file.get_tensor("steps"), file.get_tensor("states"))
                text = metadata["episode"]
        except (OSError, SafetensorError, KeyError, TypeError) as error:
            raise BadFile(f"{path} is damaged ({error}).") from None
        content = checked(parse_json(text, str(path)), dict, str(path))
        row = checked(content.get("row"), dict, f"{path}: row")
        visits = checked(content.get("visits"), list, f"{path}: visits")
        return Episode(
            from_mapping(EpisodeMetrics, row, str(path)),
            film,
            tuple(from_mapping(Visit, visit, str(path)) for visit in visits),
        )
