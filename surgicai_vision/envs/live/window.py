"""Window: MuJoCo's own viewer of an env while it is stepped, if there is a display.

The viewer has its own mouse controls: drag to turn, right button to shift, wheel to zoom; Tab and
F1 show its menus and its keys.
"""

import os
import threading
import warnings
from types import MappingProxyType
from typing import final

import glfw
import mujoco
from mujoco import viewer

from surgicai_vision.core.errors import InputError
from surgicai_vision.scene.orbit import Orbit

KEYS = MappingProxyType(
    {32: "play", 262: "step", ord("N"): "next", ord("R"): "again", 45: "slower", 61: "faster"}
)
"""GLFW's key code → what it requests of a player: space, →, N, R, − and =."""
CLOSING_S = 5.0
"""Time allowed for the viewer to close [s]."""
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")


def has_display() -> bool:
    """Return True if this process's environment names a display."""
    return any(os.environ.get(name) for name in DISPLAYS)


def check_display() -> None:
    """Raise `InputError` if there is no display for a window, or none opens on it."""
    if not has_display():
        raise InputError(
            f"A window needs a display, and none of {', '.join(DISPLAYS)} is set; leave --window "
            "out to watch in a browser, also from another machine."
        )
    # Otherwise the viewer's thread would fail unnoticed and its caller would wait for ever.
    with warnings.catch_warnings(action="ignore"):
        opens = glfw.init()
        if opens:
            glfw.window_hint(glfw.VISIBLE, False)
            probe = glfw.create_window(16, 16, "", None, None)
            opens = bool(probe)
            if probe:
                glfw.destroy_window(probe)
            glfw.default_window_hints()
    if not opens:
        shown = ", ".join(f"{name}={os.environ[name]}" for name in DISPLAYS if name in os.environ)
        raise InputError(
            f"No window opens on the display {shown}; leave --window out to watch in a browser, "
            "also from another machine."
        )


@final
class Window:
    """MuJoCo's viewer of one env. Use it as a context manager.

    It shows a copy of the env's data: opening it and dragging bodies with the mouse do not affect
    the episode.

    Args:
        model: the env's.
        data: the env's.

    Raises:
        InputError: there is no display, or the viewer does not open on it.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        check_display()
        self._lock = threading.Lock()
        self._pressed: list[str] = []
        self._model = model
        self._data = data
        self._copy = mujoco.MjData(model)
        mujoco.mj_copyData(self._copy, model, data)
        before = set(threading.enumerate())
        self._viewer = viewer.launch_passive(
            model, self._copy, key_callback=self._press, show_left_ui=False, show_right_ui=False
        )
        self._threads = set(threading.enumerate()) - before
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
        with self._viewer.lock():
            mujoco.mj_copyData(self._copy, self._model, self._data)
        self._viewer.sync()

    def pressed(self) -> list[str]:
        """Return what keys have requested since the last call, as values of `KEYS`."""
        with self._lock:
            pressed = self._pressed
            self._pressed = []
            return pressed

    def close(self) -> None:
        """Close the window and wait for its thread: GLFW breaks if the process ends first."""
        self._viewer.close()
        for thread in self._threads:
            thread.join(CLOSING_S)

    def _press(self, key: int) -> None:
        if key in KEYS:
            with self._lock:
                self._pressed.append(KEYS[key])
