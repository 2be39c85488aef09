"""Films: which episodes are shown, and their strips, within the page's budget.

A strip is a few frames of one episode as small JPEGs, rendered again from the states kept. Episodes
are chosen in rounds, so that even a page with few strips shows every policy: first each task's
compared start, then a success and a failure of each condition, then the other kinds of failure.
"""

import base64
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.config import to_mapping
from surgicai_vision.core.errors import SurgicaiError
from surgicai_vision.core.tasks import task_names
from surgicai_vision.envs import contact_sheet
from surgicai_vision.evaluation.storage import read_film
from surgicai_vision.report.groups import Group, of_task
from surgicai_vision.report.reader import Result
from surgicai_vision.scene import opengl

FRAMES = 8
SIZE = 128
QUALITY = 72
"""Frames of a strip, their height and width [px] and their JPEG quality."""
BUDGET = 4_000_000
"""Characters of base64 that all strips together may take: with the rest, the page stays below 8
MB.
"""
WHOLE_VIEW = "front"
"""View in which whole procedures are shown: a crop around one arm misses what the other does."""
MOST_STRIPS = 160
COMPARED = 5
"""Policies whose rollouts from one start are shown side by side."""


@dataclass(frozen=True)
class Choice:
    """An episode to be shown."""

    group: Group
    result: Result
    row: dict[str, Any]

    @property
    def identity(self) -> tuple[str, int]:
        """What distinguishes the episode from all others."""
        return str(self.result.folder), self.row["seed"]

    @property
    def view(self) -> str:
        """The view it is shown in: the policy's first, or `WHOLE_VIEW` for whole procedures."""
        condition = self.group.condition
        seen = () if condition.task == names.SUTURE else condition.views
        return next(iter(seen), WHOLE_VIEW)


@dataclass(frozen=True)
class Strip:
    """A rendered episode: its frames as base64 of JPEG, and the control step of each."""

    choice: Choice
    view: str
    steps: tuple[int, ...]
    frames: tuple[str, ...]

    @property
    def outcome(self) -> str:
        """How the episode ended, in words."""
        row = self.choice.row
        end = f"after {row['steps']} steps"
        return (
            f"success {end}" if row["success"] else f"{str(row['failure']).replace('_', ' ')} {end}"
        )


@dataclass
class Reel:
    """All strips of a page.

    Attributes:
        strips: an episode's identity → its strip.
        compared: task → the rollouts from one start.
        wanted: how many episodes are worth a strip.
        left_out: an episode's identity → why it cannot be shown: a damaged film, a state that is
            none of its scene.
        problem: why there are no images, or "".
    """

    strips: dict[tuple[str, int], Strip] = field(default_factory=dict)
    compared: dict[str, list[Choice]] = field(default_factory=dict)
    wanted: int = 0
    left_out: dict[tuple[str, int], str] = field(default_factory=dict)
    problem: str = ""


def make_reel(
    groups: Sequence[Group], most: int = MOST_STRIPS, progress: Callable[..., None] | None = None
) -> Reel:
    """Choose episodes and render their strips.

    Args:
        groups: the conditions of the page.
        most: maximum number of strips; 0 renders nothing.
        progress: called as progress(strips done, strips).
    """
    reel = Reel(
        compared={task: chosen for task in task_names() if (chosen := comparison(groups, task))}
    )
    wanted = {choice.identity: choice for choice in _wanted(groups, reel.compared)}
    reel.wanted = len(wanted)
    chosen = list(wanted.values())[:most]
    left = BUDGET
    try:
        for done, strip in enumerate(_render(chosen, reel.left_out), 1):
            size = sum(map(len, strip.frames))
            if size > left:
                continue
            left -= size
            reel.strips[strip.choice.identity] = strip
            if progress:
                progress(done, len(chosen))
    except SurgicaiError as error:
        reel.problem = f"No images: {error}"
    return reel


def comparison(groups: Sequence[Group], task: str) -> list[Choice]:
    """Choose the start on which policies disagree most, and `COMPARED` rollouts from it."""
    shown = [item for item in of_task(groups, task) if item.episodes]
    trained = [item for item in shown if item.condition.trained]
    if len(shown) < 2 or not trained:
        return []
    starts: dict[int, list[Choice]] = {}
    for item in shown:
        for row in item.results[0].rows:
            starts.setdefault(row["seed"], []).append(Choice(item, item.results[0], row))

    def disagreement(start: int) -> tuple[int, int, int]:
        wins = [choice.row["success"] for choice in starts[start] if choice.group.condition.trained]
        return len(starts[start]), min(sum(wins), len(wins) - sum(wins)), sum(wins)

    best = max(sorted(starts, reverse=True), key=disagreement)
    ranked = sorted(
        starts[best], key=lambda choice: (not choice.group.condition.trained, -choice.group.rate)
    )
    won = [choice for choice in ranked if choice.row["success"]]
    lost = [choice for choice in ranked if not choice.row["success"]]
    half = COMPARED // 2
    picked = won[: max(COMPARED - len(lost), half + 1)] + lost[: max(COMPARED - len(won), half)]
    return sorted(picked, key=ranked.index)[:COMPARED]


def _wanted(groups: Sequence[Group], compared: dict[str, list[Choice]]) -> Iterator[Choice]:
    """Yield every episode worth a strip, in order of priority."""
    for choices in compared.values():
        yield from choices
    kinds: list[Callable[[dict[str, Any]], bool]] = [
        lambda row: bool(row["success"]),
        lambda row: not row["success"],
    ]
    for wish in kinds:
        for item in groups:
            yield from _first(item, wish)
    for item in groups:
        seen: set[str] = set()
        for result in item.results:
            for row in result.rows:
                if not row["success"] and row["failure"] not in seen:
                    seen.add(row["failure"])
                    yield Choice(item, result, row)


def _first(item: Group, wish: Callable[[dict[str, Any]], bool]) -> Iterator[Choice]:
    for result in item.results:
        for row in result.rows:
            if wish(row) and not row["error"]:
                yield Choice(item, result, row)
                return


def _render(choices: Sequence[Choice], left_out: dict[tuple[str, int], str]) -> Iterator[Strip]:
    """Render strips; those of one scene together, since making a scene costs more than a strip.

    Args:
        choices: the episodes.
        left_out: where it is noted why an episode cannot be shown (`Reel.left_out`).

    Raises:
        SurgicaiError: a scene cannot be made, or nothing can be drawn on this machine.
    """
    scenes: dict[str, list[Choice]] = {}
    for choice in choices:
        scenes.setdefault(repr(sorted(to_mapping(choice.result.config).items())), []).append(choice)
    for members in scenes.values():
        opengl.make_current()  # what is raised below is then about one episode, not the machine
        with contact_sheet.state_renderer(members[0].result.config, SIZE, "fast") as image:
            for choice in members:
                try:
                    strip = _strip(choice, image)
                except SurgicaiError as error:
                    left_out[choice.identity] = str(error)
                    continue
                if strip is not None:
                    yield strip


def _strip(choice: Choice, image: contact_sheet.Draw) -> Strip | None:
    """Render one episode in its view; None if none of its states were kept."""
    view = choice.view
    film = read_film(choice.result.folder, choice.row["seed"])
    if not len(film.steps):
        return None
    kept = np.unique(np.linspace(0, len(film.steps) - 1, FRAMES).round().astype(int))
    frames = [
        base64.b64encode(
            contact_sheet.jpeg(image(film.states[at], *camera_and_modality(view)), QUALITY)
        ).decode()
        for at in kept
    ]
    return Strip(choice, view, tuple(int(film.steps[at]) for at in kept), tuple(frames))


def camera_and_modality(view: str) -> tuple[str, str]:
    """Return camera and modality of a view."""
    return names.camera_of(view), names.DEPTH if names.is_depth_view(view) else names.RGB
