"""Gamepad: axes and buttons of a W3C standard gamepad become an `Input`.

A browser's Gamepad API reports gamepads with the mapping "standard" in this order.
"""

from collections.abc import Sequence
from types import MappingProxyType

from surgicai_vision.teleoperation.inputs import DISCARD, JAW, KEEP, START, STOP, VIEW, Input

AXES = 4
"""Left stick x y, right stick x y, each in [-1, 1], y downwards."""
BUTTONS = 16
DEAD_ZONE = 0.12
"""Deflection below which a stick is at rest; worn sticks stay up to a tenth off."""
PRESSED = 0.5
"""Value from which a button counts as pressed."""
_X, _LB, _RB, _LT, _RT, _UP, _DOWN = 2, 4, 5, 6, 7, 12, 13
PRESSES = MappingProxyType({0: JAW, 3: VIEW, 8: STOP, 9: START, 14: DISCARD, 15: KEEP})
"""Button → event."""


class Gamepad:
    """One gamepad; a `Device`."""

    def __init__(self) -> None:
        self._axes = [0.0] * AXES
        self._buttons = [0.0] * BUTTONS
        self._reported = [0.0] * BUTTONS
        self._events: list[str] = []

    def update(self, axes: Sequence[float], buttons: Sequence[float]) -> None:
        """Take over the current state; whatever shorter lists leave out is at rest."""
        self._axes = _filled(axes, AXES)
        before = self._reported
        self._buttons = self._reported = _filled(buttons, BUTTONS)
        for index, event in PRESSES.items():
            if before[index] < PRESSED <= self._buttons[index]:
                self._events.append(event)

    def release_all(self) -> None:
        """Release everything until the next `update`, which presses no button that was down."""
        self._axes = [0.0] * AXES
        self._buttons = [0.0] * BUTTONS

    def poll(self) -> Input:
        """Return the current deflections, and the buttons pressed since the last call."""
        x, y, right_x, right_y = map(curve, self._axes)
        button = self._buttons
        events = tuple(self._events)
        self._events = []
        down = [value >= PRESSED for value in button]
        return Input(
            move=(x, y, curve(button[_RT]) - curve(button[_LT])),
            turn=(-right_y, right_x, float(down[_RB]) - float(down[_LB])),
            jaw=float(down[_UP]) - float(down[_DOWN]),
            fine=down[_X],
            events=events,
        )


def curve(deflection: float) -> float:
    """Return the speed of a deflection: 0 in the dead zone, then quadratic, 1 at the end."""
    share = max(0.0, (min(abs(deflection), 1.0) - DEAD_ZONE) / (1.0 - DEAD_ZONE))
    return share * share if deflection > 0 else -share * share


def _filled(values: Sequence[float], count: int) -> list[float]:
    given = [float(value) for value in values[:count]]
    return given + [0.0] * (count - len(given))
