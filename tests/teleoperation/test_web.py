"""The web view: access, keys that arrive, images that change, and a real browser."""

import http.client
import itertools
import json
import shutil
import subprocess
import sys
import threading
import time
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, Browser
from teleoperators import REST, SHORT, VIEWS, FakeMapping, KeyboardOperator, SessionEnv

from surgicai_vision import envs
from surgicai_vision.commands.main import main
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.pacer import Pacer
from surgicai_vision.core.web.server import MAX_INPUT_BYTES
from surgicai_vision.demos.store import list_demos, read_demo
from surgicai_vision.teleoperation.input_map import InputMapping
from surgicai_vision.teleoperation.inputs import JAW, KEEP, START, Input
from surgicai_vision.teleoperation.loop import run_session
from surgicai_vision.teleoperation.recordings import open_recordings
from surgicai_vision.teleoperation.session import DRIVING, JUDGED, WAITING, Rules, Session
from surgicai_vision.teleoperation.web import (
    FOLDER,
    MAX_PAGES,
    SILENCE_S,
    PageInputs,
    WebView,
)


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def page_message(number, held=(), pressed=(), client="a", axes=(), buttons=()):
    return {
        "client": client,
        "number": number,
        "held": list(held),
        "pressed": list(pressed),
        "axes": list(axes),
        "buttons": list(buttons),
    }


# -- inputs ----------------------------------------------------------------------------------------


def test_keys_arrive_once_and_stay_while_they_are_heard_of():
    inputs = PageInputs(clock := Clock())
    inputs.receive(page_message(0, ["KeyD", "ArrowRight"], ["KeyD", "ArrowRight"]))
    assert inputs.poll() == Input((1, 0, 0), events=(KEEP,))
    clock.now += 0.9 * SILENCE_S
    inputs.receive(page_message(1, ["KeyD", "ArrowRight"]))
    clock.now += 0.9 * SILENCE_S
    assert inputs.poll() == Input((1, 0, 0)), "a key that stays down is no second press"
    clock.now += 0.2 * SILENCE_S
    assert inputs.poll() == REST, "a browser that fell silent holds nothing"
    inputs.receive(page_message(2, ["KeyD", "Space"]))
    assert inputs.poll() == Input((1, 0, 0)), "heard again: held keys count, and press nothing"
    inputs.receive(page_message(3))
    assert inputs.poll() == REST


def test_a_gamepad_that_is_heard_again_presses_nothing_anew():
    inputs = PageInputs(clock := Clock())
    held = {"axes": [1, 0, 0, 0], "buttons": [0] * 9 + [1]}
    inputs.receive(page_message(0, **held))
    assert inputs.poll() == Input((1, 0, 0), events=(START,))
    clock.now += 1.1 * SILENCE_S
    assert inputs.poll() == REST
    inputs.receive(page_message(1, **held))
    assert inputs.poll() == Input((1, 0, 0))


def test_a_tap_between_two_messages_counts():
    inputs = PageInputs(Clock())
    inputs.receive(page_message(0, pressed=["KeyE", "Space", "Space"]))
    assert inputs.poll() == Input((0, 0, 1), events=(JAW, JAW))
    assert inputs.poll() == REST


def test_messages_that_come_late_or_twice_are_passed_over():
    inputs = PageInputs(Clock())
    inputs.receive(page_message(5, ["KeyD"], ["KeyD"]))
    inputs.receive(page_message(4, ["KeyA"], ["KeyA"]))
    inputs.receive(page_message(5, ["KeyA", "Enter"], ["KeyA", "Enter"]))
    assert inputs.poll() == Input((1, 0, 0))


def test_gamepads_and_several_pages_add_up_and_the_oldest_page_makes_room():
    inputs = PageInputs(clock := Clock())
    inputs.receive(page_message(0, axes=[1, 0, 0, 0], buttons=[0] * 9 + [1]))
    assert inputs.poll() == Input((1, 0, 0), events=(START,))
    for index in range(MAX_PAGES):
        clock.now += 0.01
        inputs.receive(page_message(0, ["KeyL"], ["KeyL"], client=f"page {index}"))
    assert inputs.poll() == Input(turn=(0, 1, 0)), "the gamepad's page is forgotten"


@pytest.mark.parametrize(
    "message",
    [
        None,
        [],
        {},
        page_message("0"),
        page_message(0, client="x" * 65),
        {**page_message(0), "held": "KeyD"},
        page_message(0, held=[1]),
        page_message(0, held=["KeyD"] * 65),
        page_message(0, axes=["1"]),
        page_message(0, axes=[float("nan")]),
        page_message(0, buttons=[1e9]),
        {**page_message(0), "axes": None},
    ],
)
def test_what_no_page_would_say_is_refused(message):
    with pytest.raises(InputError, match="An input must"):
        PageInputs().receive(message)


# -- the server ------------------------------------------------------------------------------------


@pytest.fixture
def web():
    with WebView(VIEWS, "Grasp <the> needle.", port=0) as web:
        web.screen.watched = False
        yield web
        web.screen.watched = False  # nobody to wait for


def ask(web, path, method="GET", body=None, token=None, **headers):
    """Send a request; return the answer's status, headers and body."""
    connection = http.client.HTTPConnection("127.0.0.1", web.server.port, timeout=10)
    connection.request(
        method, f"/{web.server.token if token is None else token}/{path}", body, headers
    )
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, answer.headers, content


def post(web, message, **headers):
    body = message if isinstance(message, bytes) else json.dumps(message).encode()
    return ask(web, "input", "POST", body, **{"Content-Type": "application/json", **headers})[0]


def test_the_page_stands_alone_and_names_every_key(web):
    status, headers, content = ask(web, "")
    text = content.decode()
    assert status == 200
    assert headers["Content-Type"].startswith("text/html")
    assert "default-src 'self'" in headers["Content-Security-Policy"]
    assert "Grasp &lt;the&gt; needle." in text
    assert "://" not in text
    for name in (
        "<kbd>W</kbd> <kbd>S</kbd>",
        "<kbd>Esc</kbd>",
        "<kbd>Shift</kbd>",
        "D-pad right",
        'data-view="back"',
    ):
        assert name in text, name
    for path, kind in (("page.js", "text/javascript"), ("page.css", "text/css")):
        status, headers, content = ask(web, path)
        assert (status, headers["Content-Type"].split(";")[0]) == (200, kind)
        assert b"://" not in content


@pytest.mark.parametrize("token", ["", "x", "..", "wrong" * 5, "%2e%2e"])
@pytest.mark.parametrize("path", ["", "status", "page.js", "view/front.jpg", "input"])
def test_without_the_token_there_is_nothing(web, token, path):
    assert ask(web, path, token=token)[0] == 404
    assert (
        ask(web, path, "POST", b"{}", token=token, **{"Content-Type": "application/json"})[0] == 404
    )


@pytest.mark.parametrize(
    "path", ["../web.py", "view/../page.js", "page.html.j2", "view/front", "view/none.jpg", "x"]
)
def test_there_is_nothing_else_below_the_token(web, path):
    web.show({"front": np.zeros((8, 8, 3), np.uint8)}, status_of())
    assert ask(web, path)[0] == 404


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "evil.example"}, 403),
        ({"Host": "127.0.0.1.evil.example"}, 403),
        ({"Host": "[::"}, 403),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Host": "localhost:7", "Origin": "http://localhost:7"}, 204),
        ({"Host": "localhost:7", "Origin": "http://localhost:8"}, 403),
        ({"Content-Type": "text/plain"}, 404),
        ({}, 204),
    ],
)
def test_pages_of_other_sites_are_refused(web, headers, status):
    assert post(web, page_message(0, ["KeyD"], ["KeyD"]), **headers) == status
    assert web.poll().is_moving == (status == 204)


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b"", 400),
        (b"{", 400),
        (b"[" * 3000, 400),
        (b"\xff\xfe", 400),
        (b"[]", 400),
        (b" " * (MAX_INPUT_BYTES + 1), 413),
    ],
)
def test_broken_inputs_are_refused_and_the_server_lives(web, body, status):
    assert post(web, body) == status
    assert post(web, page_message(0, ["KeyD"], ["KeyD"])) == 204
    assert web.poll().move == (1, 0, 0)


def status_of(config=SHORT):
    """Return a session's status."""

    class Nowhere:
        seeds, next_seed = (), 3

    return Session(SessionEnv(config), FakeMapping(), Nowhere(), VIEWS).status()


def test_images_are_jpegs_and_change(web):
    frames = [np.full((48, 48, 3), colour, np.uint8) for colour in ((200, 40, 40), (40, 40, 200))]
    assert ask(web, "view/front.jpg")[0] == 404, "nothing was shown yet"
    seen = []
    for frame in frames:
        web.show({"front": frame, "back": frame[::-1]}, status_of())
        status, headers, content = ask(web, "view/front.jpg?n=1")
        assert (status, headers["Content-Type"]) == (200, "image/jpeg")
        seen.append(content)
        decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert np.abs(decoded.astype(int) - frame).max() < 12
    assert seen[0] != seen[1]


def test_a_page_waits_for_the_next_image_and_asks_for_it(web):
    image = {"front": np.zeros((8, 8, 3), np.uint8)}
    assert not web.wants_image(), "nobody looks: nothing is drawn"
    web.show(image, status_of())
    first = json.loads(ask(web, "status?after=0")[2])
    assert (first["number"], first["image"], first["state"], first["seed"]) == (1, 1, WAITING, 3)
    answers = []
    thread = threading.Thread(
        target=lambda: answers.append(json.loads(ask(web, "status?after=1")[2]))
    )
    thread.start()
    while not web.wants_image():
        time.sleep(0.001)
    web.show(image, status_of())
    thread.join()
    assert (answers[0]["number"], answers[0]["image"]) == (2, 1), "the same image keeps its number"
    assert not web.wants_image()
    assert json.loads(ask(web, "status?after=x")[2])["number"] == 2


def test_a_port_in_use_is_said_in_one_line(web, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["teleoperate", "--port", str(web.server.port)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"--port {web.server.port} is not free" in line
    assert not (tmp_path / "outputs" / "teleoperation" / "grasp").exists()


def test_it_listens_on_loopback_alone(web):
    assert web.server.address == "127.0.0.1"


def test_keys_that_came_by_http_grasp_the_needle(web, tmp_path):
    config = TaskConfig("grasp", max_steps=1500)
    env = envs.make(config)
    with open_recordings(tmp_path / "demos", config, env.scene.hash) as recordings:
        mapping = InputMapping(env)
        session = Session(env, mapping, recordings, VIEWS, Rules(episodes=1))
        person, numbers = KeyboardOperator(session, mapping), itertools.count()
        connection = http.client.HTTPConnection("127.0.0.1", web.server.port, timeout=10)
        while not session.over:
            presses = {WAITING: ["Enter"], JUDGED: ["ArrowRight"]}.get(session.status().state, [])
            person.poll()
            held = list(person.keyboard._held) if session.status().state == DRIVING else []
            body = json.dumps(page_message(next(numbers), held, presses))
            connection.request(
                "POST", f"/{web.server.token}/input", body, {"Content-Type": "application/json"}
            )
            assert connection.getresponse().read() == b""
            session.tick(web.poll())
        connection.close()
    env.close()
    demo = read_demo(list_demos(tmp_path / "demos")[0])
    assert demo.success[-1] and demo.contact[-1]


def test_the_command_records_stops_and_sums_up(tmp_path):
    command = [
        sys.executable,
        "-m",
        "surgicai_vision",
        "teleoperate",
        "--port",
        "0",
        "--size",
        "64",
    ]
    command += ["--keep-failures", "--out", str(tmp_path / "demos"), "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    address = urlsplit(process.stderr.readline().split()[-1])
    connection = http.client.HTTPConnection(address.netloc, timeout=20)

    def status(after=0):
        connection.request("GET", f"{address.path}status?after={after}")
        return json.loads(connection.getresponse().read())

    for number, (code, state, kept) in enumerate(
        (("Enter", DRIVING, 0), ("ArrowRight", WAITING, 1), ("Escape", "stopped", 1))
    ):
        body = json.dumps(page_message(number, pressed=[code]))
        connection.request(
            "POST", f"{address.path}input", body, {"Content-Type": "application/json"}
        )
        assert connection.getresponse().read() == b""
        now = status()
        while now.get("state") != state or (state == DRIVING and now["steps"] < 3):
            now = status(after=now["number"])
        assert now["kept"] == kept
    out, error = process.communicate(timeout=30)
    assert process.returncode == 0, error
    summary = json.loads(out.splitlines()[-1])
    demo = read_demo(list_demos(tmp_path / "demos")[0])
    assert summary == {
        "task": "grasp",
        "kept": 1,
        "discarded": 0,
        "skipped": 0,
        "steps": len(demo),
        "episodes": 1,
        "demos": str(tmp_path / "demos"),
    }
    assert demo.config.max_steps == 3000
    assert "Kept as episode 0" in error


# -- a browser -------------------------------------------------------------------------------------


class Painted:
    """Views of the stand-in env, whose grey level is its state."""

    def __init__(self, env):
        self.env = env

    def render(self):
        grey = int(40 + 150 * self.env.state[1])
        return {view: np.full((32, 32, 3), grey, np.uint8) for view in VIEWS}


@pytest.mark.skipif(shutil.which("node") is None, reason="no node here: apt-get install nodejs")
def test_the_pages_script_is_valid():
    subprocess.run(["node", "--check", str(FOLDER / "page.js")], check=True)


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: apt-get install chromium")
def test_a_browser_drives_keeps_discards_and_stops(web, tmp_path):
    config = TaskConfig("grasp", max_steps=2000)
    grey = (
        "document.querySelector('#lead canvas').getContext('2d').getImageData(9, 9, 1, 1).data[0]"
    )
    state = "document.getElementById('message').className"
    with open_recordings(tmp_path / "demos", config, "f" * 64) as recordings:
        session = Session(SessionEnv(config), FakeMapping(), recordings, VIEWS)
        loop = threading.Thread(
            target=run_session, args=(session, web, web, Painted(session.env), Pacer())
        )
        loop.start()
        try:
            with Browser(tmp_path / "profile") as browser:
                browser.open(web.server.url)
                assert browser.until(f"{state} === 'waiting'")
                assert browser.until(f"{grey} > 30")
                before = browser.value(grey)
                for answer, counts in (("ArrowLeft", "0 / 1"), ("ArrowRight", "1 / 1")):
                    browser.key("KeyD", True)
                    assert browser.until(f"{state} === 'good'"), browser.value(
                        "document.body.innerText"
                    )
                    browser.key("KeyD", False)
                    assert browser.until(f"{grey} > {before} + 20"), "the image changed"
                    browser.key(answer, True)
                    browser.key(answer, False)
                    assert browser.until(
                        f"document.getElementById('counts').textContent === '{counts}'"
                    )
                    assert browser.until(f"{state} === 'waiting'")
                browser.key("KeyV", True)
                browser.key("KeyV", False)
                assert browser.until(
                    "document.querySelector('#lead figure').dataset.view === 'back'"
                )
                browser.key("Escape", True)
                assert browser.until(f"{state} === 'stopped'")
                assert browser.complaints == []
        finally:
            session.tick(Input(events=("stop",)))
            loop.join()
    assert [read_demo(path).seed for path in list_demos(tmp_path / "demos")] == [0]
