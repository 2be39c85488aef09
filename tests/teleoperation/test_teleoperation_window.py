"""The window: on a display without hardware, with keys as an X server delivers them; and without
any display.
"""

import ctypes.util
import os
import shutil
import struct
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from surgicai_vision.teleoperation.session import DRIVING, JUDGED, Status
from surgicai_vision.teleoperation.window import (
    BAD,
    BAR,
    GAP,
    GOOD,
    NARROWEST,
    colour_of,
    name_tag,
    status_lines,
    text_bar,
)

STATUS = Status(
    state=DRIVING, message="Recording.", success=False, episode=3, seed=7, kept=2, discarded=1, skipped=0, steps=90,
    limit=3000, subtask="grasp", arm="psm2", distance=0.0042, angle=0.1, contact=False, view="front", fine=True,
)  # fmt: skip
XVFB, XTST = shutil.which("Xvfb"), ctypes.util.find_library("Xtst")
SIZE = 64

CLIENT = """
import ctypes, dataclasses, sys, time
sys.path.insert(0, sys.argv[1])
import numpy as np
from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.teleoperation.inputs import Input, KEEP
from surgicai_vision.teleoperation.loop import Views
from surgicai_vision.teleoperation.window import Window
from test_teleoperation_window import SIZE, STATUS

x11, xtst = ctypes.CDLL("libX11.so.6"), ctypes.CDLL(sys.argv[2])
x11.XOpenDisplay.restype = ctypes.c_void_p
display = ctypes.c_void_p(x11.XOpenDisplay(None))

def key(symbol, down):
    xtst.XTestFakeKeyEvent(display, x11.XKeysymToKeycode(display, ctypes.c_ulong(symbol)), down, 0)
    x11.XSync(display, 0)

def until(window, wanted):
    for _ in range(500):
        given = window.poll()
        if wanted(given):
            return
        time.sleep(0.01)
    raise SystemExit(f"the last input was {given}")

env = envs.make(TaskConfig("grasp"))
env.reset(seed=0)
with Window(("front", "back"), "test", SIZE) as window:
    views = Views(env, ("front", "back"), SIZE)
    window.show(views.look(), STATUS)
    window._glfw.focus_window(window._handle)
    until(window, lambda given: window._glfw.get_window_attrib(window._handle, window._glfw.FOCUSED))
    key(ord("d"), 1)
    until(window, lambda given: given.move == (1.0, 0.0, 0.0))
    key(ord("d"), 0)
    until(window, lambda given: given == Input())
    key(0xFF53, 1)  # XK_Right
    until(window, lambda given: given.events == (KEEP,))
    key(0xFF53, 0)
    for view in ("back", "front"):
        images = views.look()  # the renderer's context and the window's take turns
        window.show(images, dataclasses.replace(STATUS, view=view))
    np.save(sys.argv[3], np.stack([images["front"], images["back"]]))
    assert window.wants() and not window.closed
    print("shown", flush=True)
    sys.stdin.readline()
    window._glfw.set_window_should_close(window._handle, True)
    assert window.closed
env.close()
"""


def framebuffer(path):
    """Return the screen (height, width, 3) from the file of an X server, in the format of xwd."""
    content = path.read_bytes()
    header = struct.unpack(">25I", content[:100])
    size, width, height, line, colours = header[0], header[4], header[5], header[12], header[19]
    start = size + 12 * colours
    rows = np.frombuffer(content[start : start + line * height], np.uint8).reshape(height, line)
    return rows[:, : 4 * width].reshape(height, width, 4)[..., 2::-1]


@pytest.mark.skipif(
    XVFB is None or XTST is None, reason="no X server to try with: apt-get install xvfb libxtst6"
)
def test_the_window_shows_the_images_and_takes_keys(root, tmp_path):
    ready, told = os.pipe()
    command = [
        XVFB,
        "-displayfd",
        str(told),
        "-screen",
        "0",
        "640x300x24",
        "-fbdir",
        str(tmp_path),
        "-nolisten",
        "tcp",
    ]
    server = subprocess.Popen(command, pass_fds=(told,), stderr=subprocess.DEVNULL)
    os.close(told)
    try:
        with os.fdopen(ready) as number:
            display = number.readline().strip()
        assert display
        images = tmp_path / "images.npy"
        client = subprocess.Popen(
            [
                sys.executable,
                "-c",
                CLIENT,
                str(root / "tests" / "teleoperation"),
                XTST,
                str(images),
            ],
            env={**os.environ, "DISPLAY": f":{display}"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert client.stdout is not None
        shown = client.stdout.readline()
        screen = framebuffer(tmp_path / "Xvfb_screen0").astype(int)
        _, error = client.communicate("\n", timeout=60)
        assert (shown.strip(), client.returncode) == ("shown", 0), error
    finally:
        server.terminate()
        server.wait()
    front, back = np.load(images).astype(int)
    tag = name_tag("front")
    front[: tag.shape[0], : tag.shape[1]] = tag[:SIZE, :SIZE]
    assert np.abs(screen[:SIZE, :SIZE] - front).max() <= 1
    assert np.abs(screen[24:SIZE, SIZE + GAP : 2 * SIZE + GAP] - back[24:]).max() <= 1
    bar = text_bar(status_lines(STATUS), colour_of(STATUS), NARROWEST)
    assert np.abs(screen[SIZE : SIZE + BAR, :NARROWEST] - bar).max() <= 1


def test_without_a_display_one_line_says_what_to_do(tmp_path):
    environment = {
        key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")
    }
    command = [
        sys.executable,
        "-m",
        "surgicai_vision",
        "teleoperate",
        "--out",
        str(tmp_path / "demos"),
    ]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "there is no display" in line
    assert "--web" in line
    assert list(tmp_path.iterdir()) == []


def test_the_lines_say_what_matters_and_fit():
    first, second = status_lines(STATUS)
    assert first == "driving: Recording."
    for part in (
        "episode 3",
        "start 7",
        "1.8 s",
        "grasp",
        "psm2",
        "4.2 mm 6°",
        "kept 2, discarded 1",
        "fine",
    ):
        assert part in second, part
    for width in (NARROWEST, 900):
        bar = text_bar((first, second), (1, 2, 3), width)
        assert bar.shape == (BAR, width, 3)
        assert (bar[:, 0] == (1, 2, 3)).all()
        assert (bar[:, -8:] == bar[0, -1]).all(), "text runs out of the image"


def test_a_judgement_has_its_colour():
    judged = replace(STATUS, state=JUDGED)
    assert colour_of(judged) == BAD
    assert colour_of(replace(judged, success=True)) == GOOD
    assert colour_of(STATUS) not in (GOOD, BAD)
