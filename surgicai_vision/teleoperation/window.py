"""Window: the images in a window of this machine's display, its keyboard and its gamepads.

GLFW comes with MuJoCo. Its window only takes pixels, by the four oldest calls of OpenGL; what is in
them is drawn elsewhere, as for the web. GLFW demands the main thread.
"""

import ctypes
import functools
import os
import warnings
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.teleoperation.gamepad import Gamepad
from surgicai_vision.teleoperation.inputs import Input, merged
from surgicai_vision.teleoperation.keyboard import Keyboard
from surgicai_vision.teleoperation.loop import Images
from surgicai_vision.teleoperation.session import DRIVING, JUDGED, Status

NO_WINDOW = "No window can be opened ({}); add --web for a page that any browser shows, also through ssh -L."
BAR, GAP = 88, 4
"""Height of the lines of text under the images, and space between these [pixel]."""
NARROWEST = 480
"""Width at which the lines fit [pixel]."""
KEYS = (
    "WASD EQ move   IK JL UO turn   Space jaw   Shift fine   V view   → keep   ← again   Esc stop"
)
PAPER, INK, SOFT = (20, 23, 26), (232, 234, 236), (154, 164, 173)
COLOURS = MappingProxyType(
    {"waiting": (92, 195, 224), DRIVING: (255, 107, 107), "stopped": (154, 164, 173)}
)
"""State → colour of its mark; a judged episode is green or orange."""
GOOD, BAD = (95, 194, 138), (239, 138, 114)
_COLOUR_BUFFER, _RGB, _UNSIGNED_BYTE, _ALIGNMENT = 0x4000, 0x1907, 0x1401, 0x0CF5
"""OpenGL's GL_COLOR_BUFFER_BIT, GL_RGB, GL_UNSIGNED_BYTE, GL_UNPACK_ALIGNMENT."""
GL_CALLS: Mapping[str, tuple[Any, ...]] = MappingProxyType(
    {
        "glViewport": (ctypes.c_int,) * 4,
        "glClear": (ctypes.c_uint,),
        "glPixelStorei": (ctypes.c_uint, ctypes.c_int),
        "glRasterPos2f": (ctypes.c_float,) * 2,
        "glPixelZoom": (ctypes.c_float,) * 2,
        "glDrawPixels": (ctypes.c_int, ctypes.c_int, ctypes.c_uint, ctypes.c_uint, ctypes.c_void_p),
    }
)
GLFW_BUTTONS = (0, 1, 2, 3, 4, 5, None, None, 6, 7, 9, 10, 11, 13, 14, 12)
"""For each button of the W3C's order, GLFW's; the triggers are axes there."""


class Window:
    """A window; a `Device` and a `Screen`. Use it as a context manager, in the main thread.

    Args:
        views: the cameras shown.
        title: what stands in its title.
        size: side of an image [pixel].

    Raises:
        InputError: no display, or no OpenGL in its windows.
    """

    def __init__(self, views: tuple[str, ...], title: str, size: int):
        self.invitation = ("The window takes the keys: --help names them.",)
        self._glfw = _started()
        self._keyboard, self._gamepad = Keyboard(), Gamepad()
        width = max(len(views) * (size + GAP) - GAP, NARROWEST)
        self._canvas: NDArray[np.uint8] = np.zeros((size + BAR, width, 3), np.uint8)
        self._views, self._size, self._told = views, size, ""
        self._tags = {view: name_tag(view)[:size, :size] for view in views}
        self._handle = self._opened(title)
        self._codes = _codes(self._glfw)
        # GLFW keeps no reference to what it calls.
        self._listeners = (self._on_key, self._on_focus)
        self._glfw.set_key_callback(self._handle, self._listeners[0])
        self._glfw.set_window_focus_callback(self._handle, self._listeners[1])

    def __enter__(self) -> "Window":
        return self

    def __exit__(self, *_: object) -> None:
        self._glfw.destroy_window(self._handle)
        self._glfw.poll_events()

    @property
    def closed(self) -> bool:
        """Say whether the person shut the window."""
        return bool(self._glfw.window_should_close(self._handle))

    def poll(self) -> Input:
        """Return what keyboard and gamepad do now."""
        self._glfw.poll_events()
        self._gamepad.update(*_standard(self._glfw))
        return merged((self._keyboard.poll(), self._gamepad.poll()))

    def wants(self) -> bool:
        """Say whether the window is seen."""
        return not self._glfw.get_window_attrib(self._handle, self._glfw.ICONIFIED)

    def show(self, images: Images, status: Status) -> None:
        """Show images side by side, the leading one first, and what the session says."""
        for column, view in enumerate(sorted(self._views, key=lambda name: name != status.view)):
            left = column * (self._size + GAP)
            self._canvas[: self._size, left : left + self._size] = images[view]
            tag = self._tags[view]
            self._canvas[: tag.shape[0], left : left + tag.shape[1]] = tag
        lines = status_lines(status)
        if str(lines) != self._told:
            self._told = str(lines)
            self._canvas[self._size :] = text_bar(lines, colour_of(status), self._canvas.shape[1])
        self._present()

    def _opened(self, title: str) -> Any:
        """Return the handle of a new window whose context can change places with the renderer's."""
        glfw = self._glfw
        glfw.default_window_hints()
        if os.environ.get("MUJOCO_GL", "egl").lower() == "egl":
            glfw.window_hint(glfw.CONTEXT_CREATION_API, glfw.EGL_CONTEXT_API)
        height, width = self._canvas.shape[:2]
        handle = glfw.create_window(width, height, title, None, None)
        if not handle:
            raise InputError(NO_WINDOW.format(_reason(glfw)))
        glfw.make_context_current(handle)
        glfw.swap_interval(0)  # the pacer keeps the time
        self._gl = {
            name: ctypes.CFUNCTYPE(None, *types)(glfw.get_proc_address(name))
            for name, types in GL_CALLS.items()
        }
        glfw.make_context_current(None)
        return handle

    def _present(self) -> None:
        """Put the canvas into the window, as large as it fits."""
        glfw, gl = self._glfw, self._gl
        glfw.make_context_current(self._handle)
        across, upright = glfw.get_framebuffer_size(self._handle)
        height, width = self._canvas.shape[:2]
        zoom = min(across / width, upright / height)
        gl["glViewport"](0, 0, across, upright)
        gl["glClear"](_COLOUR_BUFFER)
        gl["glPixelStorei"](_ALIGNMENT, 1)
        gl["glRasterPos2f"](-1.0, 1.0)
        gl["glPixelZoom"](zoom, -zoom)  # OpenGL's first row is the lowest
        gl["glDrawPixels"](width, height, _RGB, _UNSIGNED_BYTE, self._canvas.ctypes.data)
        glfw.swap_buffers(self._handle)
        glfw.make_context_current(None)

    def _on_key(self, _: Any, key: int, scancode: int, action: int, mods: int) -> None:
        code = self._codes.get(key)
        if code is not None and action == self._glfw.PRESS:
            self._keyboard.press(code)
        elif code is not None and action == self._glfw.RELEASE:
            self._keyboard.release(code)

    def _on_focus(self, _: Any, focused: int) -> None:
        if not focused:
            self._keyboard.release_all()


def _started() -> Any:
    """Return the module glfw, ready; `InputError` where there is no display."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import glfw

            glfw.ERROR_REPORTING = "ignore"
            ready = glfw.init()
    except ImportError as error:
        raise InputError(NO_WINDOW.format(error)) from None
    if not ready:
        raise InputError(NO_WINDOW.format(_reason(glfw)))
    return glfw


def _reason(glfw: Any) -> str:
    """Return why GLFW failed."""
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return "there is no display"
    text = glfw.get_error()[1]
    return (text.decode() if isinstance(text, bytes) else str(text or "unknown to GLFW")).split(
        "\n"
    )[0]


def _codes(glfw: Any) -> dict[int, str]:
    """Return GLFW's keys, which are named by place too, as codes of a browser."""
    letters = {
        getattr(glfw, f"KEY_{letter}"): f"Key{letter}" for letter in "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
    }
    return letters | {
        glfw.KEY_RIGHT: "ArrowRight",
        glfw.KEY_LEFT: "ArrowLeft",
        glfw.KEY_ESCAPE: "Escape",
        glfw.KEY_ENTER: "Enter",
        glfw.KEY_KP_ENTER: "Enter",
        glfw.KEY_SPACE: "Space",
        glfw.KEY_LEFT_SHIFT: "ShiftLeft",
        glfw.KEY_RIGHT_SHIFT: "ShiftRight",
    }


def _standard(glfw: Any) -> tuple[list[float], list[float]]:
    """Return axes and buttons of the first gamepad in the W3C's order; nothing where there is
    none.
    """
    for joystick in range(glfw.JOYSTICK_1, glfw.JOYSTICK_LAST + 1):
        if glfw.joystick_present(joystick) and glfw.joystick_is_gamepad(joystick):
            state = glfw.get_gamepad_state(joystick)
            if state:
                return standard(list(state.axes), list(state.buttons))
    return [], []


def standard(axes: list[float], buttons: list[int]) -> tuple[list[float], list[float]]:
    """Return GLFW's axes (6) and buttons (15) in the W3C's order: its triggers rest at -1."""
    pressed = [0.0 if index is None else float(buttons[index]) for index in GLFW_BUTTONS]
    pressed[6:8] = [(axes[index] + 1.0) / 2.0 for index in (4, 5)]
    return axes[:4], pressed


def status_lines(status: Status) -> tuple[str, str]:
    """Return what the session says, in two lines."""
    measured = (
        f"episode {status.episode}, start {status.seed}   {status.steps / names.FPS:.1f} s   {status.subtask}, "
        f"{status.arm}   {status.distance * 1e3:.1f} mm {np.degrees(status.angle):.0f}° to the goal   "
        f"kept {status.kept}, discarded {status.discarded}{'   fine' if status.fine else ''}"
    )
    return f"{status.state}: {status.message}", measured


def colour_of(status: Status) -> tuple[int, int, int]:
    """Return the colour of the state's mark."""
    if status.state == JUDGED:
        return GOOD if status.success else BAD
    return COLOURS[status.state]


def text_bar(lines: tuple[str, str], colour: tuple[int, int, int], width: int) -> NDArray[np.uint8]:
    """Return the lines, and the keys below them, as an image (BAR, width, 3), in sizes at which
    they fit.
    """
    from PIL import Image, ImageDraw

    image = Image.new("RGB", (width, BAR), PAPER)
    pen = ImageDraw.Draw(image)
    pen.rectangle((0, 0, 5, BAR), fill=colour)
    for row, (line, ink) in enumerate(((lines[0], INK), (lines[1], INK), (KEYS, SOFT))):
        fonts = [_font(size) for size in (15, 13, 11, 9, 7)]
        font = next(
            (font for font in fonts if pen.textlength(line, font=font) <= width - 20), fonts[-1]
        )
        pen.text((14, 17 + 27 * row), line, fill=ink, font=font, anchor="lm")
    return np.asarray(image)


def name_tag(name: str) -> NDArray[np.uint8]:
    """Return a small image of a view's name, (height, width, 3)."""
    from PIL import Image, ImageDraw

    font = _font(12)
    image = Image.new("RGB", (int(font.getlength(name)) + 12, 20), PAPER)
    ImageDraw.Draw(image).text((6, 10), name, fill=INK, font=font, anchor="lm")
    return np.asarray(image)


@functools.cache
def _font(size: int) -> Any:
    """Return matplotlib's DejaVu Sans, which has arrows."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)
