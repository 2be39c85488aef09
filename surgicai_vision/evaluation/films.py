"""Filming: write episodes of an evaluation as videos, one file per episode.

    filming = Filming(Path("outputs/videos"), of="failures", views=("front", "back"))
    evaluate(make_agent, config, seeds, filming=filming)

`DIR/<task>-<seed>-<outcome>.mp4` shows the views side by side and, below them, what is measured
(`video_frames`). The process that ran an episode films it from every other one of its states, so
filming does not change an evaluation's rows. `DIR/videos.json`, written last, lists the videos. A
folder that holds it may be filmed into again; the videos it lists are removed first.
"""

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import files, names
from surgicai_vision.core.cameras import check_camera
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.untrusted import checked
from surgicai_vision.core.video import SUFFIX, write_video
from surgicai_vision.evaluation.metrics import EpisodeMetrics

if TYPE_CHECKING:
    from surgicai_vision.envs.moment import Moment
    from surgicai_vision.evaluation.slot import Episode

INDEX: Final = "videos.json"
ALL: Final = "all"
FAILURES: Final = "failures"
SUCCESSES: Final = "successes"
CHOICES: Final = (ALL, FAILURES, SUCCESSES)
LAST_S: Final = 1.5
"""Time for which a video's last image is held [s]; the outcome is written on it."""
SIDES: Final = (64, 960)
"""Smallest and largest height of a view [px]."""


@dataclass(frozen=True)
class Look:
    """How a video looks.

    Attributes:
        views: cameras, side by side in this order.
        size: height and width of each view [px], even.
        every: actions from one image to the next; 2 gives 25 images per second where an action is
            held for one control step.
        speed: playback speed, as a share of real time; 0.5 is slow motion.
        quality: of the images, "fast" or "high" (ten times slower).
    """

    views: tuple[str, ...] = ("front", "back")
    size: int = 384
    every: int = 2
    speed: float = 1.0
    quality: str = "fast"

    def __post_init__(self) -> None:
        for view in self.views:
            check_camera(view)
        if not self.views or len(set(self.views)) != len(self.views):
            raise InputError(f"views are {self.views}; give at least one, each once.")
        if not SIDES[0] <= self.size <= SIDES[1] or self.size % 2:
            raise InputError(
                f"The size of a view is {self.size}; it must be even, {SIDES[0]} to {SIDES[1]}."
            )
        if self.every < 1 or not 0.01 <= self.speed <= 100:
            raise InputError(
                f"every is {self.every} and speed {self.speed}; every must be at least 1 and speed "
                "0.01 to 100."
            )

    def fps(self, action_repeat: int) -> float:
        """Return a video's images per second, for actions held that many control steps."""
        return names.FPS / (self.every * action_repeat) * self.speed


@dataclass(frozen=True)
class Filming:
    """Which episodes become videos, where, and how they look.

    Attributes:
        folder: gets the videos.
        of: "all", "failures", "successes", or a number: that many starts, the first ones.
        look: how they look.
        title: text on them, followed by the start's seed; "" takes the policy's name.
        first: seeds of the starts that a number in `of` selects; `begun` sets it.
    """

    folder: Path
    of: str = ALL
    look: Look = Look()
    title: str = ""
    first: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.of not in CHOICES and not (self.of.isdecimal() and int(self.of) > 0):
            raise InputError(
                f"Videos of '{self.of}'; allowed: {', '.join(CHOICES)}, or a number of starts."
            )

    def begun(self, seeds: Sequence[int], kept: Collection[int] = ()) -> "Filming":
        """Return this filming for an evaluation of `seeds`; earlier videos are removed.

        Args:
            seeds: the starts, in order.
            kept: starts whose episodes were run and filmed before; their videos stay.

        Raises:
            OutputExists: the folder holds other files.
            BadFile: its list of videos is damaged.
        """
        files.check_output(self.folder, may_resume=INDEX, option="--video")
        self.folder.mkdir(parents=True, exist_ok=True)
        if (self.folder / INDEX).exists():
            for name, seed in self._listed():
                if seed not in kept:
                    (self.folder / name).unlink(missing_ok=True)
        files.write_json(self.folder / INDEX, {"videos": []})
        count = int(self.of) if self.of.isdecimal() else 0
        return dataclasses.replace(self, first=tuple(int(seed) for seed in seeds[:count]))

    def videos(self) -> list[str]:
        """Return the names of the videos in the folder's list."""
        return [name for name, _ in self._listed()]

    def _listed(self) -> list[tuple[str, int]]:
        """Return name and start of each video in the folder's list."""
        where = str(self.folder / INDEX)
        table = checked(files.read_json(self.folder / INDEX), dict, where)
        listed = []
        for row in checked(table.get("videos"), list, f"{where}: videos"):
            video = checked(row, dict, f"{where}: a video")
            name = checked(video.get("file"), str, f"{where}: a video's file")
            listed.append((Path(name).name, checked(video.get("seed"), int, f"{where}: {name}")))
        return listed

    def wants(self, row: EpisodeMetrics) -> bool:
        """Return True if an episode is to become a video."""
        if self.of.isdecimal():
            return row.seed in self.first
        return self.of == ALL or row.success == (self.of == SUCCESSES)

    def film(
        self,
        config: TaskConfig,
        row: EpisodeMetrics,
        states: Sequence[NDArray[np.float64]],
        moments: "Sequence[Moment]",
    ) -> None:
        """Write an episode's video, if it is wanted and there was anything to see.

        Args:
            config: its task.
            row: how it ended.
            states: its states, from the start on.
            moments: what was measured at each of them.
        """
        if not states or not self.wants(row):
            return
        # An evaluation that was killed may have left a video with another outcome.
        for earlier in self.folder.glob(f"{row.task}-{row.seed}-*{SUFFIX}"):
            earlier.unlink()
        title = f"{self.title or row.policy}, start {row.seed}"
        from surgicai_vision.evaluation.overlay import video_frames  # OpenCV and fonts

        frames = video_frames(config, states, moments, title, outcome_of(row), self.look)
        write_video(self.folder / video_name(row), frames, self.look.fps(config.action_repeat))

    def finish(self, episodes: "Sequence[Episode]") -> None:
        """Write the list of the videos."""
        rows = [episode.row for episode in episodes]
        videos = [
            {
                "file": video_name(row),
                "seed": row.seed,
                "success": row.success,
                "failure": row.failure,
                "steps": row.steps,
            }
            for row in rows
            if self.wants(row) and (self.folder / video_name(row)).exists()
        ]
        files.write_json(self.folder / INDEX, {"views": list(self.look.views), "videos": videos})


def video_name(row: EpisodeMetrics) -> str:
    """Return the name of an episode's video."""
    outcome = "success" if row.success else row.failure
    return f"{row.task}-{row.seed}-{outcome}{SUFFIX}"


def outcome_of(row: EpisodeMetrics) -> str:
    """Return how an episode ended, in words."""
    outcome = "success" if row.success else row.failure.replace("_", " ")
    return f"{outcome} after {row.steps} steps"
