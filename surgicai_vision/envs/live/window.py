"""Window: MuJoCo's own viewer beside an env that is stepped, where a display exists.

The viewer has its own mouse: drag to turn, right button to shift, wheel to come nearer; Tab and
F1 show its menus and its keys.
"""

import os
import threading
from types import MappingProxyType
from typing import final

import mujoco

from surgicai_vision.core.errors import InputError, first_line
from surgicai_vision.scene.orbit import Orbit

KEYS = MappingProxyType(
    {32: "play", 262: "step", ord("N"): "next", ord("R"): "again", 45: "slower", 61: "faster"}
)
"""GLFW's key codes → what they ask of a player: space, →, N, R, − and =."""
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")


def has_display() -> bool:
    """Return True if this process has been told of a display."""
    return any(os.environ.get(name) for name in DISPLAYS)


def check_display() -> None:
    """Raise `InputError` where there is no display for a window."""
    if not has_display():
        raise InputError(
            f"A window needs a display, and none of {', '.join(DISPLAYS)} is set; leave --window "
            "out to watch in a browser, also from another machine."
        )


@final
class Window:
    """MuJoCo's viewer of one env. Use it as a context manager.

    Args:
        model: the env's.
        data: the env's.

    Raises:
        InputError: there is no display, or the viewer does not open on it.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        check_display()
        from mujoco import viewer  # it loads GLFW, which complains without a display

        self._lock = threading.Lock()
        self._pressed: list[str] = []
        try:
            self._viewer = viewer.launch_passive(
                model, data, key_callback=self._press, show_left_ui=False, show_right_ui=False
            )
        except Exception as error:  # GLFW's errors have many types
            raise InputError(
                f"MuJoCo's viewer does not open here ({first_line(error)}); leave --window out to "
                "watch in a browser."
            ) from None
        orbit = Orbit()
        with self._viewer.lock():
            self._viewer.cam.lookat[:] = orbit.target
            self._viewer.cam.distance = orbit.distance
            self._viewer.cam.azimuth = orbit.azimuth
            self._viewer.cam.elevation = orbit.elevation

    def __enter__(self) -> "Window":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_open(self) -> bool:
        """Return True until the person closes it."""
        return bool(self._viewer.is_running())

    def draw(self) -> None:
        """Show the env's present state."""
        self._viewer.sync()

    def pressed(self) -> list[str]:
        """Return what was asked for by keys since the last call, values of `KEYS`."""
        with self._lock:
            pressed = self._pressed
            self._pressed = []
            return pressed

    def close(self) -> None:
        """Close the window."""
        self._viewer.close()

    def _press(self, key: int) -> None:
        if key in KEYS:
            with self._lock:
                self._pressed.append(KEYS[key])
