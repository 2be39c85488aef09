"""Keyboard: keys held and pressed become an `Input`.

Keys are named by their place, as in a browser's `KeyboardEvent.code`: "KeyW" is the key left of E,
whatever is printed on it.
"""

from collections.abc import Iterable
from types import MappingProxyType
from typing import NamedTuple

from surgicai_vision.teleoperation.inputs import DISCARD, JAW, KEEP, START, STOP, VIEW, Input


class Row(NamedTuple):
    """A row of the key table.

    Attributes:
        codes: the keys.
        gamepad: what does the same on a gamepad.
        meaning: what they do.
    """

    codes: tuple[str, ...]
    gamepad: str
    meaning: str


TABLE = (
    Row(("KeyW", "KeyS"), "left stick", "move up, down in the image"),
    Row(("KeyA", "KeyD"), "left stick", "move left, right in the image"),
    Row(("KeyE", "KeyQ"), "triggers RT, LT", "move into the image, out of it"),
    Row(("KeyI", "KeyK"), "right stick", "tilt up, down"),
    Row(("KeyJ", "KeyL"), "right stick", "swing left, right"),
    Row(("KeyU", "KeyO"), "bumpers LB, RB", "roll anticlockwise, clockwise"),
    Row(("Space",), "A", "close or open the jaw"),
    Row(("KeyX", "KeyZ"), "D-pad up, down", "open, close the jaw a little"),
    Row(("ShiftLeft", "ShiftRight"), "X, held", "slow and fine, a fifth of the speed"),
    Row(("KeyV",), "Y", "switch to the next view: it is shown large, and its axes apply"),
    Row(("Enter",), "Start", "start without moving"),
    Row(
        ("ArrowRight",),
        "D-pad right",
        "keep a success and go on; else give up this start and go on",
    ),
    Row(("ArrowLeft",), "D-pad left", "discard and do the same start again"),
    Row(("Escape",), "Back", "stop; a success not yet answered is kept"),
)
"""What the help, the page and the documentation show."""

MOTIONS = MappingProxyType(
    {
        "KeyD": (0, 1.0),
        "KeyA": (0, -1.0),
        "KeyS": (1, 1.0),
        "KeyW": (1, -1.0),
        "KeyE": (2, 1.0),
        "KeyQ": (2, -1.0),
        "KeyI": (3, 1.0),
        "KeyK": (3, -1.0),
        "KeyL": (4, 1.0),
        "KeyJ": (4, -1.0),
        "KeyO": (5, 1.0),
        "KeyU": (5, -1.0),
        "KeyX": (6, 1.0),
        "KeyZ": (6, -1.0),
    }
)
"""Key → its place in (move, turn, jaw) and its sign."""
FINE_KEYS = ("ShiftLeft", "ShiftRight")
PRESSES = MappingProxyType(
    {
        "ArrowRight": KEEP,
        "ArrowLeft": DISCARD,
        "Escape": STOP,
        "Enter": START,
        "Space": JAW,
        "KeyV": VIEW,
    }
)
CODES = frozenset((*MOTIONS, *FINE_KEYS, *PRESSES))
"""Every key that has a meaning."""
_NAMES = MappingProxyType(
    {
        "ArrowRight": "→",
        "ArrowLeft": "←",
        "Escape": "Esc",
        "ShiftLeft": "Shift",
        "ShiftRight": "Shift",
    }
)


class Keyboard:
    """The keys of one keyboard; a `Device`."""

    def __init__(self) -> None:
        self._held: dict[str, None] = {}
        self._tapped: dict[str, None] = {}
        self._events: list[str] = []

    def press(self, code: str) -> None:
        """Note that a key went down; autorepeat and keys without a meaning change nothing."""
        if code not in CODES or code in self._held:
            return
        self._held[code] = self._tapped[code] = None
        if code in PRESSES:
            self._events.append(PRESSES[code])

    def release(self, code: str) -> None:
        """Note that a key went up."""
        self._held.pop(code, None)

    def hold(self, codes: Iterable[str]) -> None:
        """Note that these keys are down and no others, without the events of a press."""
        down = {code: None for code in codes if code in CODES}
        self._tapped |= {code: None for code in down if code in MOTIONS}
        self._held = down

    def release_all(self) -> None:
        """Note that no key is down: the page lost the keyboard."""
        self._held.clear()

    def poll(self) -> Input:
        """Return what is held or was tapped since the last call, and the events of presses."""
        down = {**self._held, **self._tapped}
        motion = [0.0] * 7
        for code in down:
            if code in MOTIONS:
                axis, sign = MOTIONS[code]
                motion[axis] += sign
        events = tuple(self._events)
        self._tapped = {}
        self._events = []
        fine = any(code in down for code in FINE_KEYS)
        x, y, z, tilt, swing, roll, jaw = motion
        return Input((x, y, z), (tilt, swing, roll), jaw, fine, events)


def key_name(code: str) -> str:
    """Return a key's name for people: "KeyW" is W."""
    return _NAMES.get(code, code.removeprefix("Key"))


def key_names(row: Row) -> tuple[str, ...]:
    """Return the names of a row's keys, each once: W, S."""
    return tuple(dict.fromkeys(map(key_name, row.codes)))


def key_table() -> str:
    """Return the key table as text."""
    rows = [
        ("key", "gamepad", "what it does"),
        *((" ".join(key_names(row)), row.gamepad, row.meaning) for row in TABLE),
    ]
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    return "\n".join(
        f"  {key:<{widths[0]}}  {pad:<{widths[1]}}  {meaning}" for key, pad, meaning in rows
    )
