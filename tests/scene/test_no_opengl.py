"""A machine without OpenGL: reported in one line, before any work."""

import ctypes.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

Done = subprocess.CompletedProcess[str]
WITHOUT = {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"}


def run(
    verb: str, *options: str, where: Path, **variables: str
) -> subprocess.CompletedProcess[str]:
    # If this process has drawn with EGL, PyOpenGL has recorded that in its environment.
    ours = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    return subprocess.run(
        [sys.executable, "-m", "surgicai_vision", verb, *options],
        cwd=where,
        env={**ours, **variables},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("verb", ["quickstart", "release", "render-demos"])
def test_work_that_ends_in_images_is_refused_at_once(verb: str, tmp_path: Path) -> None:
    released = str(tmp_path / "released")
    done = run(verb, "--out", "out", where=tmp_path, **WITHOUT, SURGICAI_VISION_RELEASED=released)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2, line
    assert "No image can be drawn: 'egl' provides no OpenGL" in line
    assert "apt-get install --yes --no-install-recommends libegl1 libgl1" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("backend", "draws"),
    [
        ("bogus", "check_opengl()"),
        ("glfw", "check_opengl()"),
        ("glfw", "FrameRenderer(build_scene().model, 64, 64)"),
    ],
)
def test_a_backend_that_draws_nothing_is_refused_in_one_line(backend: str, draws: str) -> None:
    program = (
        "from surgicai_vision.core.errors import InputError\n"
        "from surgicai_vision.scene import build_scene\n"
        "from surgicai_vision.scene.opengl import check_opengl\n"
        "from surgicai_vision.scene.rendering import FrameRenderer\n"
        f"try: {draws}\nexcept InputError as error: print(error)"
    )
    ours = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**ours, "DISPLAY": "", "WAYLAND_DISPLAY": "", "MUJOCO_GL": backend},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.startswith(f"No image can be drawn: '{backend}'"), done.stderr
    assert done.stderr == ""


@pytest.mark.skipif(bool(ctypes.util.find_library("OSMesa")), reason="OSMesa is on this machine")
def test_what_draws_nothing_runs_without_the_library_that_is_named(tmp_path: Path) -> None:
    options = ("--task", "handoff", "--episodes", "1", "--out", "demos")
    done = run("record-demos", *options, where=tmp_path, MUJOCO_GL="osmesa")
    assert done.returncode == 0, done.stderr
    done = run("render-demos", "--demos", "demos", where=tmp_path, MUJOCO_GL="osmesa")
    assert done.returncode == 2
    assert "'osmesa' provides no OpenGL (its library is not on this machine)" in done.stderr
    assert "Traceback" not in done.stderr
