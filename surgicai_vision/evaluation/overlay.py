"""Overlay: compose one image of a video, the views side by side above what is measured.

    ┌────────────┬────────────┐
    │ front      │ back       │
    ├────────────┴────────────┤
    │ title          ╱╲__ mm  │   text on the left; on the right the distance to the goal and the
    │ insert, 3 of 5 __╱╲  N  │   force on the tissue over the whole episode, as far as it has run
    └─────────────────────────┘

The font is DejaVu, which comes with matplotlib, so text looks the same on every machine.
"""

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.video import Image
from surgicai_vision.envs import contact_sheet
from surgicai_vision.envs.moment import Moment
from surgicai_vision.evaluation.films import LAST_S, Look

type Colour = tuple[int, int, int]

PAPER: Final[Colour] = (20, 23, 26)
INK: Final[Colour] = (232, 234, 236)
SOFT: Final[Colour] = (154, 164, 173)
RULE: Final[Colour] = (45, 51, 57)
DISTANCE: Final[Colour] = (92, 195, 224)
FORCE: Final[Colour] = (240, 160, 90)
GOOD: Final[Colour] = (95, 194, 138)
BAD: Final[Colour] = (239, 138, 114)
"""The colours of the pages' dark scheme (`teleoperation/page/page.css`)."""

BAND: Final = 96
"""Height of the overlay [px]."""
LEAST_WIDTH: Final = 640
"""Width of the overlay [px] where the views are narrower."""
EDGE: Final = 12
TEXT_SHARE: Final = 0.44
"""Share of the overlay's width that the text takes."""
LEAST_MM: Final = 5.0
LEAST_N: Final = 0.5
"""Smallest range of the curves [mm, N], where an episode stays below it."""


class Overlay:
    """Composes the images of one episode's video.

    Args:
        moments: what was measured at each state.
        look: views and their size.
        title: first line of the text.
        config: the task.
    """

    def __init__(self, moments: Sequence[Moment], look: Look, title: str, config: TaskConfig):
        self._moments = moments
        self._look = look
        self._title = title
        self._config = config
        self._views_width = look.size * len(look.views)
        self.width = max(self._views_width, LEAST_WIDTH)
        self.height = look.size + BAND
        self._millimetres = np.array([1e3 * moment.distance for moment in moments])
        self._newtons = np.array([moment.force for moment in moments])
        self._tops = (
            max(LEAST_MM, float(np.nanmax(self._millimetres))),
            max(LEAST_N, float(np.nanmax(self._newtons))),
        )

    def frame(self, images: Mapping[str, Image], index: int, outcome: str = "") -> Image:
        """Return one image of the video, (height, width, 3).

        Args:
            images: view → its image (size, size, 3).
            index: number of the state.
            outcome: how the episode ended; "" while it runs.
        """
        size = self._look.size
        canvas = np.full((self.height, self.width, 3), PAPER, np.uint8)
        left = (self.width - self._views_width) // 2
        for place, view in enumerate(self._look.views):
            start = left + place * size
            canvas[:size, start : start + size] = images[view]
        moment = self._moments[index]
        colour = (GOOD if moment.success else BAD) if outcome else RULE
        cv2.line(canvas, (0, size), (self.width, size), colour, 3 if outcome else 1)
        self._curves(canvas, index)
        drawn = Pillow.fromarray(canvas)
        pen = ImageDraw.Draw(drawn)
        for place, view in enumerate(self._look.views):
            _caption(pen, left + place * size + 8, 8, view)
        self._text(pen, moment, outcome, colour)
        return np.asarray(drawn, np.uint8)

    def _text(self, pen: ImageDraw.ImageDraw, moment: Moment, outcome: str, colour: Colour) -> None:
        """Write title, subtask and time, or the outcome, and the two measured numbers."""
        top = self._look.size + 8
        room = int(self.width * TEXT_SHARE) - EDGE
        pen.text((EDGE, top), _fitting(self._title, 13, room), SOFT, _font(13))
        heading = outcome or _subtask_text(moment, self._config.task)
        pen.text(
            (EDGE, top + 20),
            _fitting(heading, 20, room, bold=True),
            colour if outcome else INK,
            _font(20, bold=True),
        )
        held = ", needle held" if moment.contact else ""
        clock = f"{moment.step / names.FPS:.2f} s, step {moment.step}{held}"
        pen.text((EDGE, top + 52), _fitting(clock, 15, room), SOFT, _font(15))
        for row, (label, value, ink) in enumerate(
            (
                ("to the goal", f"{1e3 * moment.distance:.1f} mm", DISTANCE),
                ("on the tissue", f"{moment.force:.2f} N", FORCE),
            )
        ):
            y = top + 2 + 42 * row
            right = self.width - EDGE
            pen.text((right, y), value, ink, _font(17, bold=True), anchor="ra")
            pen.text((right, y + 21), label, SOFT, _font(11), anchor="ra")
        for row, (top_value, unit) in enumerate(zip(self._tops, ("mm", "N"), strict=True)):
            place = (int(self.width * TEXT_SHARE), top + 42 * row - 4)
            pen.text(place, f"{top_value:.2g} {unit}", SOFT, _font(10))

    def _curves(self, canvas: NDArray[np.uint8], index: int) -> None:
        """Draw both curves up to `index`."""
        left = int(self.width * TEXT_SHARE)
        right = self.width - EDGE - 92
        for row, (values, top, colour) in enumerate(
            (
                (self._millimetres, self._tops[0], DISTANCE),
                (self._newtons, self._tops[1], FORCE),
            )
        ):
            low = self._look.size + 8 + 42 * row + 36
            high = low - 26
            cv2.line(canvas, (left, low), (right, low), RULE, 1)
            steps = np.arange(index + 1)
            x = left + (right - left) * steps / max(1, len(values) - 1)
            share = np.clip(np.nan_to_num(values[: index + 1]) / top, 0.0, 1.0)
            y = low - (low - high) * share
            # In sixteenths of a pixel, as `shift` requires.
            points = np.stack([x, y], axis=1) * 16
            line = [points.round().astype(np.int32)]
            cv2.polylines(canvas, line, False, colour, 1, cv2.LINE_AA, shift=4)
            dot = (round(float(points[-1, 0])), round(float(points[-1, 1])))
            cv2.circle(canvas, dot, 3 * 16, colour, -1, cv2.LINE_AA, shift=4)


def _subtask_text(moment: Moment, task: str) -> str:
    """Return the current subtask; in the whole procedure, with its number."""
    if task != names.SUTURE:
        return moment.subtask
    number = names.SUBTASKS.index(moment.subtask) + 1
    return f"{moment.subtask}, {number} of {len(names.SUBTASKS)}"


def _caption(pen: ImageDraw.ImageDraw, x: int, y: int, text: str) -> None:
    """Write a view's name on its image."""
    font = _font(13)
    box = pen.textbbox((x + 6, y + 2), text, font=font)
    pen.rounded_rectangle((x, y, math.ceil(box[2]) + 6, y + 21), 4, fill=(0, 0, 0))
    pen.text((x + 6, y + 2), text, (255, 255, 255), font)


def _fitting(text: str, size: int, room: int, *, bold: bool = False) -> str:
    """Return a text, cut if it is wider than `room` pixels."""
    font = _font(size, bold=bold)
    if font.getlength(text) <= room:
        return text
    while text and font.getlength(f"{text}…") > room:
        text = text[:-1]
    return f"{text}…"


@functools.cache
def _font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Return DejaVu Sans in a size [px]."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)


def video_frames(
    config: TaskConfig,
    states: Sequence[NDArray[np.float64]],
    moments: Sequence[Moment],
    title: str,
    outcome: str,
    look: Look,
) -> Iterator[Image]:
    """Yield the images of an episode's video; the last state is always among them.

    Args:
        config: the task.
        states: for the env's `set_state_vector`, from the start on.
        moments: what was measured at each of them.
        title: first line of the overlay's text.
        outcome: how the episode ended, shown at the end for `LAST_S`.
        look: views, size and pace.
    """
    last = len(states) - 1
    overlay = Overlay(moments, look, title, config)
    with contact_sheet.state_renderer(config, look.size, look.quality) as draw:
        for index in [*range(0, last, look.every), last]:
            images = {view: draw(states[index], view) for view in look.views}
            if index == last:
                end = overlay.frame(images, index, outcome)
                held = round(LAST_S * look.fps(config.action_repeat) / look.speed)
                for _ in range(max(1, held)):
                    yield end
            else:
                yield overlay.frame(images, index)
