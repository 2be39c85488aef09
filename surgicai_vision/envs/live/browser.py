"""Browser: the page on which an env is watched.

`core.web` serves it. Besides the status and the images there is

    GET  curves?after=N     JSON: {"episode", "points": [[mm, N], …], "next"}; the points of the
                            present episode after the Nth point of all episodes
    POST input              JSON: {"command": name, "numbers": [float], "views": [name]}

A page sends commands and changes nothing by itself: whoever steps the env takes them (`commands`),
and the next status shows their effect. `VIEW_COMMANDS` control what is shown, `PLAY_COMMANDS` what
runs.
"""

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import final

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.web.screen import PageScreen
from surgicai_vision.core.web.site import ScreenPage, ScreenSite, render_page
from surgicai_vision.envs.moment import Moment

PLAYING = "playing"
PAUSED = "paused"
ENDED = "ended"
STOPPED = "stopped"
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Playback speeds, as shares of real time."""
FREE = "free"
"""The view of the free camera."""
MAX_VIEWS = 6
"""Views shown at the same time."""
VIEW_COMMANDS = MappingProxyType({"views": 0, "turn": 2, "shift": 2, "zoom": 1, "home": 0})
"""Command → how many numbers it takes."""
PLAY_COMMANDS = MappingProxyType(
    {
        "play": 0,
        "pause": 0,
        "step": 0,
        "again": 0,
        "next": 0,
        "speed": 1,
        "go_on": 1,
        "stop": 0,
    }
)
FOLDER = Path(__file__).parent / "page"
LARGEST = 1000
"""Limit of the numbers of a command, in any unit."""
WAITING = 256
"""Most commands that may wait; further ones are dropped."""


@dataclass(frozen=True)
class Command:
    """A request from a page.

    Attributes:
        name: a key of `VIEW_COMMANDS` or `PLAY_COMMANDS`.
        numbers: "turn": right and down [deg]; "shift": right and down [share of the image]; "zoom":
            factor of the distance; "speed": one of `SPEEDS`; "go_on": 1 or 0.
        views: "views": the views to show from now on, the leading one first.
    """

    name: str
    numbers: tuple[float, ...] = ()
    views: tuple[str, ...] = ()


@dataclass(frozen=True)
class LiveStatus:
    """What a page shows of an env.

    Attributes:
        state: "playing", "paused", "ended" or "stopped".
        message: what happened and what to do, one line.
        views: the views shown, the leading one first.
        episode: number of the episode, from 1 on.
        seed: seed of its start.
        limit: control steps it may take.
        is_procedure: the task is all five subtasks in a row.
        moment: what is measured now.
        speed: requested share of real time.
        reached: share of real time actually reached; 0 if it is not playing.
        go_on: the next start begins automatically.
        successes, episodes: counts over the episodes that have ended.
        points: points of the curves shown so far, in all episodes.
    """

    state: str
    message: str
    views: tuple[str, ...]
    episode: int
    seed: int
    limit: int
    is_procedure: bool
    moment: Moment
    speed: float
    reached: float
    go_on: bool
    successes: int
    episodes: int
    points: int


@final
class LivePage(ScreenPage):
    """The page's server. Use it as a context manager.

    Args:
        title: what is watched, in a few words.
        views: all views that may be shown; the free camera is added to them.
        controls: whether `PLAY_COMMANDS` are handled; if not, the page has no buttons for them.
        port: port to listen on; 0 takes any free one.

    Raises:
        InputError: the port is not free.
    """

    def __init__(self, title: str, views: Sequence[str], controls: bool, port: int = 0):
        self.views = (*views, FREE)
        screen = PageScreen()
        self._allowed = {**VIEW_COMMANDS, **(PLAY_COMMANDS if controls else {})}
        self._lock = threading.Lock()
        self._waiting: list[Command] = []
        self._episode = 0
        self._begin = 0
        self._points: list[tuple[float, float]] = []
        html = render_page(
            FOLDER / "live.html.j2",
            title=title,
            views=self.views,
            controls=controls,
            speeds=SPEEDS,
            subtasks=names.SUBTASKS,
        )
        files = {name: FOLDER / name for name in ("live.js", "live.css")}
        site = ScreenSite(html, files, screen, self.receive, {"curves": self.curves})
        super().__init__(site, port)

    @property
    def points(self) -> int:
        """Return the number of points of the curves in all episodes."""
        with self._lock:
            return self._begin + len(self._points)

    def begin(self, episode: int) -> None:
        """Begin the curves of another episode."""
        with self._lock:
            self._begin += len(self._points)
            self._points = []
            self._episode = episode

    def add_point(self, distance: float, force: float) -> None:
        """Append to the curves: the distance to the goal [m] and the force on the tissue [N]."""
        with self._lock:
            self._points.append((round(1e3 * distance, 3), round(force, 4)))

    def curves(self, after: int) -> dict[str, object]:
        """Return the present episode's points after the `after`th of all."""
        with self._lock:
            points = self._points[max(0, after - self._begin) :]
            total = self._begin + len(self._points)
            return {"episode": self._episode, "points": points, "next": total}

    def commands(self) -> list[Command]:
        """Return the commands that pages have sent since the last call."""
        with self._lock:
            waiting = self._waiting
            self._waiting = []
            return waiting

    def receive(self, content: object) -> None:
        """Take a page's command.

        Raises:
            InputError: it is not a valid command.
        """
        command = read_command(content, self._allowed, self.views)
        with self._lock:
            if len(self._waiting) < WAITING:
                self._waiting.append(command)


def read_command(content: object, allowed: Mapping[str, int], views: Sequence[str]) -> Command:
    """Return a checked command, or raise `InputError`.

    Args:
        content: {"command": name, "numbers": [float], "views": [name]}.
        allowed: command → how many numbers it takes.
        views: all views that may be shown.
    """
    if not isinstance(content, dict):
        raise InputError("A command must be a table.")
    name = content.get("command")
    numbers = content.get("numbers", [])
    shown = content.get("views", [])
    if not isinstance(name, str) or name not in allowed:
        raise InputError(f"A command must be one of {', '.join(allowed)}.")
    if not isinstance(numbers, list) or len(numbers) != allowed[name]:
        raise InputError(f"The numbers of '{name}' must be a list of length {allowed[name]}.")
    for number in numbers:
        if not isinstance(number, int | float) or not -LARGEST < number < LARGEST:
            raise InputError(f"A command's numbers must be between -{LARGEST} and {LARGEST}.")
    if not isinstance(shown, list) or len(shown) > MAX_VIEWS:
        raise InputError(f"The views must be a list of at most {MAX_VIEWS}.")
    for view in shown:
        if view not in views or shown.count(view) > 1:
            raise InputError(f"The views must be among {', '.join(views)}, each once.")
    if (name == "views") != bool(shown):
        raise InputError("The command 'views' must name a view, and no other command may.")
    if name == "speed" and numbers[0] not in SPEEDS:
        raise InputError(f"The speed must be one of {SPEEDS}.")
    if name == "zoom" and not 0.1 <= numbers[0] <= 10:
        raise InputError("A zoom's factor must be 0.1 to 10.")
    return Command(name, tuple(map(float, numbers)), tuple(shown))
