"""Charts: small SVG drawings with their intervals visible, safe for the colour-blind.

Each series has one of Okabe and Ito's colours and its own marker, so that no chart relies on colour
alone. The colours of text and axes come from the page's style sheet.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#56b4e9", "#7a5195", "#666666")
"""Okabe and Ito, "Color Universal Design" (2008), the yellow darkened; two more for the seventh and
eighth series.
"""

KIND_COLOURS = {
    "success": "#0072b2",
    "missed": "#999999",
    "dropped": "#e69f00",
    "wrong_hole": "#cc79a7",
    "time": "#56b4e9",
    "physics": "#d55e00",
    "error": "#333333",
}
"""Outcome of an episode → its colour; an unknown kind is drawn as "error"."""

_HEAT = ((247, 251, 255), (198, 219, 239), (107, 174, 214), (33, 113, 181), (8, 48, 107))
"""Brewer's sequential blues at 0, ¼, ½, ¾ and 1: lightness alone carries the value."""

_MARKERS = ("circle", "square", "triangle", "diamond")
_MIDDLE = 0.179
"""Relative luminance at which black and white letters have the same contrast (WCAG 2)."""
WIDTH = 340
HEIGHT = 210
LEFT = 38
RIGHT = 22
TOP = 10
BOTTOM = 40
"""Size and margins of a curve's drawing, in its own units."""
FEW_MARKS = 8
"""How many numbers fit below a curve's axis."""
NAMES = 104
BAR = 20
"""Width of the names next to bars, and height of a bar including its gap."""
BAR_COLOUR = COLOURS[5]


@dataclass(frozen=True)
class Point:
    """A success rate at x, with its interval and its text for tooltips and screen readers."""

    x: float
    rate: float
    low: float
    high: float
    text: str


@dataclass(frozen=True)
class Series:
    """One line of a chart."""

    name: str
    points: tuple[Point, ...]


@dataclass(frozen=True)
class Frame:
    """Where a chart's points are in its drawing.

    Attributes:
        first: the smallest x.
        last: the largest x.
        logarithmic: whether the x axis is logarithmic; every x is then above 0.
    """

    first: float
    last: float
    logarithmic: bool = False

    def across(self, x: float) -> float:
        """Return the horizontal position of x."""
        low, high = self._scaled(self.first), self._scaled(self.last)
        span = (high - low) or 1.0
        return LEFT + (WIDTH - LEFT - RIGHT) * (self._scaled(x) - low) / span

    def down(self, rate: float) -> float:
        """Return the vertical position of a rate, from the top."""
        return TOP + (HEIGHT - TOP - BOTTOM) * (1 - rate)

    def _scaled(self, x: float) -> float:
        return math.log(x) if self.logarithmic else x


@dataclass(frozen=True)
class Bar:
    """A share, optionally a second one with its bounds, and the text as in `Point`."""

    name: str
    share: float
    beside: tuple[float, float, float] | None
    text: str


def bars(rows: Sequence[Bar], label: str) -> Markup:
    """Draw shares as bars on an axis from 0 to 1; values beyond 1.1 are cut off.

    Args:
        rows: from top to bottom.
        label: what a screen reader says.
    """
    height = TOP + BAR * len(rows) + 24

    def place(share: float) -> float:
        return NAMES + (WIDTH - NAMES - RIGHT) * min(share, 1.1)

    parts = []
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        x = place(share)
        parts.append(
            f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{height - 22}"/>'
            f'<text x="{x:.1f}" y="{height - 8}" text-anchor="middle">{100 * share:.0f}</text>'
        )
    for index, row in enumerate(rows):
        y = TOP + BAR * index + BAR / 2
        beside = ""
        if row.beside is not None:
            at, low, high = map(place, row.beside)
            beside = (
                f'<line class="beside" x1="{low:.1f}" x2="{high:.1f}" y1="{y:.1f}" y2="{y:.1f}"/>'
                f'<circle class="beside" cx="{at:.1f}" cy="{y:.1f}" r="3"/>'
            )
        parts.append(
            f'<g><title>{escape(row.text)}</title><text class="name" x="{NAMES - 6}"'
            f' y="{y + 4:.1f}" text-anchor="end">{escape(row.name)}</text><rect x="{NAMES}"'
            f' y="{y - 6:.1f}" width="{place(row.share) - NAMES:.1f}" height="12"'
            f' fill="{BAR_COLOUR}"/>{beside}</g>'
        )
    box = f'viewBox="0 0 {WIDTH} {height}" role="img"'
    return Markup(f'<svg class="curve" {box} aria-label="{escape(label)}">{"".join(parts)}</svg>')


def heat(rate: float) -> tuple[str, str]:
    """Return the background and text colours of a rate."""
    at = min(max(rate, 0.0), 1.0) * (len(_HEAT) - 1)
    low = min(int(at), len(_HEAT) - 2)
    share = at - low
    red, green, blue = (
        round((1 - share) * a + share * b) for a, b in zip(_HEAT[low], _HEAT[low + 1], strict=True)
    )
    return f"#{red:02x}{green:02x}{blue:02x}", (
        "#ffffff" if _luminance(red, green, blue) < _MIDDLE else "#000000"
    )


def _luminance(*channels: int) -> float:
    """Return the relative luminance of an sRGB colour (WCAG 2)."""
    shares = [channel / 255 for channel in channels]
    linear = [
        share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4 for share in shares
    ]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def interval(
    rate: float,
    low: float,
    high: float,
    label: str,
    paper: tuple[float, float, float] | None = None,
) -> Markup:
    """Draw a rate with its interval on an axis from 0 to 1.

    The paper's rate and interval, if it has one, are drawn below.

    Args:
        rate: ours.
        low: lower bound of its interval.
        high: upper bound.
        label: what a screen reader says.
        paper: rate, lower and upper bound.
    """
    y = 12 if paper is None else 7
    x = [8 + 160 * value for value in (low, high, rate)]
    theirs = ""
    if paper is not None:
        at, left, right = (8 + 160 * value for value in paper)
        theirs = (
            f'<line class="paper-range" x1="{left:.1f}" x2="{right:.1f}" y1="18" y2="18"/>'
            f'<path class="paper" d="M{at:.1f} 13 l4.5 5 l-4.5 5 l-4.5 -5 z"/>'
        )
    return Markup(
        f'<svg class="interval" viewBox="0 0 176 24" role="img" aria-label="{escape(label)}"><line'
        ' class="axis" x1="8" x2="168" y1="12" y2="12"/><line class="axis" x1="8" x2="8" y1="6"'
        ' y2="18"/><line class="axis" x1="88" x2="88" y1="9" y2="15"/><line class="axis" x1="168"'
        f' x2="168" y1="6" y2="18"/><line class="range" x1="{x[0]:.1f}" x2="{x[1]:.1f}" y1="{y}"'
        f' y2="{y}"/><circle class="point" cx="{x[2]:.1f}" cy="{y}"'
        f' r="{5 if paper is None else 4.5}"/>{theirs}</svg>'
    )


def outcomes(successes: int, failures: dict[str, int]) -> Markup:
    """Draw how episodes ended as one stacked bar."""
    total = successes + sum(failures.values())
    at = 0.0
    parts = []
    for kind, count in {"success": successes, **failures}.items():
        width = 160 * count / total
        colour = KIND_COLOURS.get(kind, KIND_COLOURS["error"])
        title = f"<title>{escape(kind.replace('_', ' '))}: {count} of {total}</title>"
        parts.append(
            f'<rect x="{at:.2f}" y="1" width="{width:.2f}" height="12"'
            f' fill="{colour}">{title}</rect>'
        )
        at += width
    words = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in failures.items())
    label = escape(f"{successes} of {total} succeeded" + (f"; {words}" if words else ""))
    box = 'viewBox="0 0 160 14" preserveAspectRatio="none" role="img"'
    return Markup(f'<svg class="outcomes" {box} aria-label="{label}">{"".join(parts)}</svg>')


def curves(
    series: Sequence[Series],
    x_name: str,
    *,
    logarithmic: bool = False,
    label: str = "",
    ticks: Mapping[float, str] | None = None,
    joined: bool = True,
) -> Markup:
    """Draw success against x, one line per series, with intervals as bars at the points.

    Args:
        series: the lines, each with its own x values. A series without points is not drawn, but
            no other series gets its colour.
        x_name: what x is.
        logarithmic: use a logarithmic axis; every x must be above 0.
        label: what a screen reader says.
        ticks: x → its label, if that is not the number.
        joined: draw a line through the points of a series.
    """
    xs = sorted({point.x for line in series for point in line.points})
    marks = xs if ticks or logarithmic else _marks(xs)
    frame = Frame(xs[0], xs[-1], logarithmic)
    parts = [_axes(marks, frame, x_name, ticks or {})]
    for index, line in enumerate(series):
        shift = (
            3.0 * (index - (len(series) - 1) / 2) / max(1, len(series) - 1)
            if len(series) > 1
            else 0.0
        )
        if line.points:
            parts.append(_line(line, index, shift if joined else 0.0, frame, joined))
    body = "".join(parts)
    return Markup(
        f'<svg class="curve" viewBox="0 0 {WIDTH} {HEIGHT}" role="img"'
        f' aria-label="{escape(label or x_name)}">{body}</svg>'
    )


def key(series: Sequence[Series]) -> Markup:
    """Draw the legend of the series that have points."""
    items = []
    for index, line in enumerate(series):
        if not line.points:
            continue
        colour = COLOURS[index % len(COLOURS)]
        marker = _marker(index, 10, 8, colour)
        stroke = f'<line x1="0" x2="20" y1="8" y2="8" stroke="{colour}" stroke-width="2"/>'
        sign = f'<svg class="sign" viewBox="0 0 20 16" aria-hidden="true">{stroke}{marker}</svg>'
        items.append(f"<span>{sign}{escape(line.name)}</span>")
    return Markup(f'<p class="key">{"".join(items)}</p>')


def _marks(xs: Sequence[float]) -> list[float]:
    """Return where a linear axis is marked: at every x, or at round numbers if not all x fit.

    They do not fit if there are too many, or if one has too many digits.
    """
    if len(xs) == 1 or (len(xs) <= FEW_MARKS and all(len(f"{x:g}") <= 4 for x in xs)):
        return list(xs)
    low, high = xs[0], xs[-1]
    power = 10.0 ** math.floor(math.log10((high - low) / FEW_MARKS))
    step = next(power * m for m in (1, 2, 5, 10) if (high - low) / (power * m) <= FEW_MARKS)
    first, last = math.ceil(low / step), math.floor(high / step)
    return [round(step * index, 9) for index in range(first, last + 1)]


def _axes(xs: Sequence[float], frame: Frame, x_name: str, ticks: Mapping[float, str]) -> str:
    """Draw the grid of rates, and the marks below the x axis as far as there is room."""
    parts = []
    for rate in (0.0, 0.25, 0.5, 0.75, 1.0):
        y = frame.down(rate)
        parts.append(
            f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
        )
        parts.append(
            f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{100 * rate:.0f}</text>'
        )
    last = -1e9
    for x in xs:
        at = frame.across(x)
        if at - last < 26:
            continue
        last = at
        word = escape(ticks.get(x, f"{x:g}"))
        parts.append(
            f'<text x="{at:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{word}</text>'
        )
    middle = LEFT + (WIDTH - LEFT - RIGHT) / 2
    parts.append(
        f'<text class="name" x="{middle:.1f}" y="{HEIGHT - 6}"'
        f' text-anchor="middle">{escape(x_name)}</text>'
    )
    return "".join(parts)


def _line(line: Series, index: int, shift: float, frame: Frame, with_path: bool) -> str:
    """Draw one series.

    `shift` moves it sideways, so that intervals at the same x do not overlap.
    """
    colour = COLOURS[index % len(COLOURS)]
    path = []
    parts = []
    for point in line.points:
        x = frame.across(point.x) + shift
        y = frame.down(point.rate)
        top = frame.down(point.high)
        bottom = frame.down(point.low)
        path.append(f"{x:.1f},{y:.1f}")
        bar = (
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{top:.1f}" y2="{bottom:.1f}" stroke-width="1.6"'
            ' opacity=".6"/>'
        )
        title = escape(f"{line.name}: {point.text}")
        parts.append(f"<g><title>{title}</title>{bar}{_marker(index, x, y, colour)}</g>")
    joined = (
        f'<polyline points="{" ".join(path)}" fill="none" stroke-width="1.8"/>' if with_path else ""
    )
    return f'<g stroke="{colour}">{joined}{"".join(parts)}</g>'


def _marker(index: int, x: float, y: float, colour: str) -> str:
    """Draw a point; beyond four series the markers are hollow."""
    fill = colour if index < len(_MARKERS) else "var(--card)"
    style = f'fill="{fill}" stroke="{colour}" stroke-width="1.5"'
    shape = _MARKERS[index % len(_MARKERS)]
    if shape == "circle":
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.6" {style}/>'
    if shape == "square":
        return f'<rect x="{x - 3.3:.1f}" y="{y - 3.3:.1f}" width="6.6" height="6.6" {style}/>'
    steps = "l4 7 h-8 z" if shape == "triangle" else "l4.4 4.4 l-4.4 4.4 l-4.4 -4.4 z"
    return f'<path d="M{x:.1f} {y - 4.3:.1f} {steps}" {style}/>'
