"""OpenGL without a display: one context per process, made on first use, freed at its end.

Software rendering runs in the calling thread ($LP_NUM_THREADS is set to 0): one process per core is
faster than one threaded process, and a forked child, which lacks its parent's threads, would wait
for them for ever.
"""

import atexit
import importlib
import os
import platform
import warnings
from collections.abc import Callable
from types import MappingProxyType
from typing import Protocol, cast

from surgicai_vision.core.errors import InputError

BACKENDS = MappingProxyType(
    {"egl": "mujoco.egl", "osmesa": "mujoco.osmesa", "glfw": "mujoco.glfw", "cgl": "mujoco.cgl"}
)
"""$MUJOCO_GL → the module that has its `GLContext`."""


class _Context(Protocol):
    """An OpenGL context of one of MuJoCo's backends."""

    def make_current(self) -> None:
        """Direct this thread's OpenGL calls to it."""

    def free(self) -> None:
        """Free it."""


_context: _Context | None = None
_closers: list[Callable[[], None]] = []


def make_current() -> None:
    """Direct this thread's OpenGL calls to the process's context; make it if there is none yet.

    Raises:
        InputError: no OpenGL on this machine; says what to install.
    """
    global _context
    if _context is None:
        os.environ["LP_NUM_THREADS"] = "0"
        warnings.filterwarnings("ignore", module="glfw")  # `no_image` reports what it warns of
        _context = _new_context()
        atexit.register(_close)  # after the backend's own handler, hence run before it
    _context.make_current()


def renderer_string() -> str:
    """Return what draws the images, as OpenGL names it: "llvmpipe (LLVM 15.0.6, 256 bits)".

    Raises:
        InputError: no OpenGL on this machine; says what to install.
    """
    make_current()
    from OpenGL import GL  # only now: the backend's module has told PyOpenGL its platform

    name = GL.glGetString(GL.GL_RENDERER)
    if name is None:  # a windowing backend that can open no window
        raise no_image("it opens no window; is $DISPLAY set?")
    return str(name.decode())


def before_closing(closer: Callable[[], None]) -> None:
    """Register `closer`, to be called at the end of the process while the context is current."""
    _closers.append(closer)


def _new_context() -> _Context:
    """Return a context of the backend that $MUJOCO_GL names."""
    backend = _backend()
    if backend not in BACKENDS:
        raise no_image("$MUJOCO_GL does not name a backend")
    try:
        module = importlib.import_module(BACKENDS[backend])
        return cast(_Context, module.GLContext(64, 64))
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        raise no_image(_reason(error)) from error


def _backend() -> str:
    """Return what $MUJOCO_GL names, or else the platform's default (EGL on Linux)."""
    default = {"Linux": "egl", "Darwin": "cgl"}.get(platform.system(), "glfw")
    return os.environ.get("MUJOCO_GL", "").lower().strip() or default


def no_image(reason: str) -> InputError:
    """Return the error for a machine that cannot draw images: the reason and what to do."""
    return InputError(
        f"No image can be drawn: '{_backend()}' provides no OpenGL ({reason}). On Debian or "
        "Ubuntu run: sudo apt-get install --yes --no-install-recommends libegl1 libgl1 (Mesa; "
        "`make setup` does it too). Set $MUJOCO_GL to use another backend: "
        f"{', '.join(BACKENDS)}. Recording and the expert's evaluations need no images."
    )


def _reason(error: Exception) -> str:
    """Return why a backend gives no context, in one sentence.

    PyOpenGL leaves None instead of a library that it cannot load.
    """
    if isinstance(error, AttributeError):
        return "its library is not on this machine"
    return (str(error) or type(error).__name__).splitlines()[0].split(". ")[0].rstrip(".")


def check_opengl() -> None:
    """Refuse a machine that cannot draw images, before the work that leads to images.

    Raises:
        InputError: no OpenGL on this machine; says what to install.
    """
    renderer_string()


def _close() -> None:
    """Free everything while the backend still exists."""
    global _context
    if _context is not None:
        _context.make_current()
        for closer in _closers:
            closer()
        _context.free()
        _context = None


def _forget() -> None:
    """Leave the parent's context alone in a forked child, which makes its own."""
    global _context
    _context = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
