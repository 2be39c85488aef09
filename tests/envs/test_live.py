"""Live: the free camera, the page's commands and curves, and `render_mode="human"`."""

import http.client
import json
import os
import subprocess
import sys

import cv2
import gymnasium
import numpy as np
import pytest
from browser import CHROMIUM, Browser

from surgicai_vision import envs
from surgicai_vision.core.cameras import camera_names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.envs.live import human
from surgicai_vision.envs.live.browser import FREE, SPEEDS, Command, LivePage
from surgicai_vision.envs.live.views import LiveViews
from surgicai_vision.envs.live.window import check_display
from surgicai_vision.scene.orbit import FARTHEST, NEAREST, Orbit
from surgicai_vision.scene.rendering import FrameRenderer


@pytest.fixture(scope="module")
def env():
    made = envs.make(TaskConfig("handoff"))
    made.reset(seed=5)
    yield made
    made.close()


# -- the free camera -------------------------------------------------------------------------------


def test_a_whole_turn_comes_home_and_a_drag_back_undoes_one():
    orbit = Orbit()
    there = orbit.turned(360.0, 0.0)
    assert there.azimuth == pytest.approx(orbit.azimuth)
    back = orbit.turned(25.0, 5.0).turned(-25.0, -5.0)
    assert (back.azimuth, back.elevation) == pytest.approx((orbit.azimuth, orbit.elevation))
    back = orbit.shifted(0.3, -0.2).shifted(-0.3, 0.2)
    assert back.target == pytest.approx(orbit.target)


def test_a_shift_is_across_the_direction_of_view_and_its_length_that_of_the_distance():
    orbit = Orbit(azimuth=35.0, elevation=-50.0, distance=0.2)
    azimuth, elevation = np.radians([orbit.azimuth, orbit.elevation])
    forward = [
        np.cos(azimuth) * np.cos(elevation),
        np.sin(azimuth) * np.cos(elevation),
        np.sin(elevation),
    ]
    for right, down in ((0.5, 0.0), (0.0, 0.5)):
        way = np.subtract(orbit.shifted(right, down).target, orbit.target)
        assert np.linalg.norm(way) == pytest.approx(0.1)
        assert np.dot(way, forward) == pytest.approx(0.0, abs=1e-12)


def test_the_camera_never_goes_over_the_top_nor_too_near_nor_too_far():
    orbit = Orbit()
    assert orbit.turned(0, 1000).elevation == -89 == orbit.turned(0, 9000).elevation
    assert orbit.zoomed(1e-6).distance == NEAREST
    assert orbit.zoomed(1e6).distance == FARTHEST


def test_what_is_dragged_to_the_right_goes_to_the_right(env):
    """The phantom's pixels move with the hand; nearer is larger."""

    def place(orbit):
        with FrameRenderer(env.model, 120, 120) as renderer:
            parts = renderer.render(env.data, orbit, "segmentation")[..., 0]
        rows, columns = np.nonzero(parts == 1)
        return rows.mean(), columns.mean(), len(rows)

    far = Orbit(distance=0.5)
    row, column, size = place(far)
    assert size > 200
    assert place(far.shifted(0.1, 0.0))[1] > column + 5
    assert place(far.shifted(0.0, 0.1))[0] > row + 5
    assert place(far.zoomed(0.8))[2] > 1.2 * size


def test_a_named_camera_is_drawn_as_before(env):
    views = LiveViews(env, ("front", FREE), 96)
    images = views.render()
    np.testing.assert_array_equal(images["front"], env.image("front", (96, 96)))
    before = images[FREE]
    assert views.handle(Command("turn", (30.0, 0.0)))
    assert (views.render()[FREE] != before).any()
    assert views.handle(Command("home"))
    np.testing.assert_array_equal(views.render()[FREE], before)
    assert views.handle(Command("views", views=("back",)))
    assert list(views.render()) == ["back"]
    assert not views.handle(Command("play"))
    views.close()


def test_who_watches_changes_nothing_of_what_the_env_observes():
    """Not even where views and observations have the same size and the needle changes its shape."""
    config = TaskConfig("handoff", randomisation=RandomisationConfig(needle_size=0.2))
    seen = []
    for watched in (False, True):
        env = envs.make(config, obs_type="pixels", cameras=("back",), image_size=64)
        views = LiveViews(env, ("back", FREE), 64)
        for seed in (1, 2, 3):
            seen.append(env.reset(seed=seed)[0]["back"])
            if watched:
                views.render()
        views.close()
        env.close()
    for plain, watched in zip(seen[:3], seen[3:], strict=True):
        np.testing.assert_array_equal(plain, watched)


# -- the page --------------------------------------------------------------------------------------


@pytest.fixture
def page():
    with LivePage("expert: <grasp>", camera_names(), controls=True) as page:
        yield page


def ask(page, path, body=None):
    connection = http.client.HTTPConnection("127.0.0.1", page.server.port, timeout=10)
    connection.request(
        "GET" if body is None else "POST",
        f"/{page.server.token}/{path}",
        body,
        {} if body is None else {"Content-Type": "application/json"},
    )
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, content


def test_the_page_stands_alone(page):
    status, content = ask(page, "")
    text = content.decode()
    assert status == 200
    assert "expert: &lt;grasp&gt;" in text
    for view in (*camera_names(), FREE):
        assert f'data-view-choice="{view}"' in text
    for path in ("live.js", "live.css", "base.css", "screen.js"):
        status, script = ask(page, path)
        assert status == 200
        assert b"://" not in script
    assert "://" not in text
    assert ask(page, "live.html.j2")[0] == 404


def test_without_a_player_there_are_no_buttons_and_no_commands_for_one():
    with LivePage("x", ("front",), controls=False) as page:
        assert b'data-command="next"' not in ask(page, "")[1]
        assert ask(page, "input", json.dumps({"command": "next"}))[0] == 400
        assert ask(page, "input", json.dumps({"command": "home"}))[0] == 204
        assert page.commands() == [Command("home")]


def test_commands_come_in_order_and_once(page):
    bodies = [
        {"command": "play"},
        {"command": "speed", "numbers": [SPEEDS[0]]},
        {"command": "views", "views": [FREE, "back"]},
        {"command": "turn", "numbers": [3, -4.5]},
    ]
    for body in bodies:
        assert ask(page, "input", json.dumps(body))[0] == 204
    assert page.commands() == [
        Command("play"),
        Command("speed", (SPEEDS[0],)),
        Command("views", (), (FREE, "back")),
        Command("turn", (3.0, -4.5)),
    ]
    assert page.commands() == []


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (None, "must be a table"),
        ([], "must be a table"),
        ({}, "must be one of"),
        ({"command": "fly"}, "must be one of"),
        ({"command": 3}, "must be one of"),
        ({"command": ["play"]}, "must be one of"),
        ({"command": "play", "numbers": [1]}, "a list of length 0"),
        ({"command": "speed", "numbers": [3]}, "speed must be one of"),
        ({"command": "speed", "numbers": ["1"]}, "between -1000 and 1000"),
        ({"command": "turn", "numbers": [1]}, "a list of length 2"),
        ({"command": "turn", "numbers": [1, float("nan")]}, "between -1000 and 1000"),
        ({"command": "zoom", "numbers": [0]}, "0.1 to 10"),
        ({"command": "views", "views": []}, "must name a view"),
        ({"command": "views", "views": ["front", "front"]}, "each once"),
        ({"command": "views", "views": ["nowhere"]}, "must be among"),
        ({"command": "views", "views": [["front"]]}, "must be among"),
        ({"command": "views", "views": list(camera_names())[:7]}, "at most 6"),
        ({"command": "play", "views": ["front"]}, "no other command"),
    ],
)
def test_what_is_no_command_is_refused(page, content, problem):
    with pytest.raises(InputError, match=problem):
        page.receive(content)
    assert page.commands() == []


def test_curves_are_sent_once_and_begin_anew_with_an_episode(page):
    page.begin(1)
    for value in range(4):
        page.add_point(1e-3 * value, 0.1 * value)

    def curves(after):
        return json.loads(ask(page, f"curves?after={after}")[1])

    assert curves(0) == {
        "episode": 1,
        "next": 4,
        "points": [[v, 0.1 * v] for v in (0, 1, 2)] + [[3, 0.3]],
    }
    assert curves(3)["points"] == [[3, 0.3]]
    assert curves(4)["points"] == []
    page.begin(2)
    page.add_point(5e-3, 0.0)
    for after in (0, 3, 4):
        assert curves(after) == {"episode": 2, "next": 5, "points": [[5, 0]]}


# -- render_mode="human" ---------------------------------------------------------------------------


def test_another_render_mode_is_refused():
    with pytest.raises(UnknownName, match="human, rgb_array"):
        envs.make(TaskConfig("grasp"), render_mode="ansi")


def test_human_shows_what_is_stepped_and_changes_nothing(monkeypatch, capsys):
    monkeypatch.setattr(human, "has_display", lambda: False)
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 7)).astype(np.float32)
    states = {}
    for mode in (None, "human"):
        env = gymnasium.make("surgicai_vision/Handoff-v0", render_mode=mode)
        env.reset(seed=3)
        for action in actions:
            env.step(action)
        states[mode] = env.unwrapped.get_state()
        if mode == "human":
            shown = env.unwrapped._human._page
            live = shown._live
            live.receive({"command": "views", "views": ["back"]})
            status = live.screen.status(0)  # a page asks, and waits until an image is due
            while "moment" not in status:
                env.step(actions[0])
                status = live.screen.status(0)
            assert status["moment"]["step"] == env.unwrapped.simulation.task_state.steps
            assert status["views"] == ("back",)
            image = cv2.imdecode(np.frombuffer(live.screen.jpeg("back"), np.uint8), 1)[..., ::-1]
            truth = env.unwrapped.image("back", (human.SIZE, human.SIZE))
            assert np.abs(image.astype(int) - truth).mean() < 8
            assert len(live.curves(0)["points"]) == status["moment"]["step"] + 1
            assert env.render() is None
        env.close()
    np.testing.assert_array_equal(states[None], states["human"])
    assert f"Open {live.server.url}" in capsys.readouterr().err


def test_human_shows_an_env_that_was_restored_instead_of_reset(monkeypatch):
    monkeypatch.setattr(human, "has_display", lambda: False)
    plain = envs.make(TaskConfig("handoff"))
    plain.reset(seed=3)
    shown = envs.make(TaskConfig("handoff"), render_mode="human")
    shown.set_state_vector(plain.get_state())
    for _ in range(3):
        shown.step(np.zeros(7, np.float32))
    assert len(shown._human._page._live.curves(0)["points"]) == 3
    shown.close()


HUMAN = """
import gymnasium, surgicai_vision
env = gymnasium.make("surgicai_vision/Handoff-v0", render_mode="human")
for seed in range(40):
    env.reset(seed=seed)
    for _ in range(100):
        env.step(env.action_space.sample())
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: apt-get install chromium")
def test_a_browser_sees_what_another_program_steps(tmp_path):
    bare = {key: value for key, value in os.environ.items() if not key.endswith("DISPLAY")}
    code = [sys.executable, "-c", HUMAN]
    process = subprocess.Popen(code, stderr=subprocess.PIPE, text=True, env=bare)
    try:
        address = next(word for line in process.stderr for word in line.split() if "//" in word)
        with Browser(tmp_path / "profile", 420, 800) as browser:
            browser.open(address)
            step = "Number(document.getElementById('step').textContent.split(' ')[0])"
            assert browser.until(f"{step} > 2", 60)
            assert browser.value("document.querySelectorAll('[data-command]').length") == 0
            assert browser.until("document.querySelector('#lead canvas').width === 448")
            browser.key("Escape", True)
            episode = browser.value("document.getElementById('episode').textContent")
            assert browser.until(f"document.getElementById('episode').textContent !== '{episode}'")
            assert browser.until("curves.points.length > 5")
            assert browser.complaints == []
    finally:
        process.kill()
        process.wait()


def test_without_a_display_there_is_no_window(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(InputError, match="needs a display"):
        check_display()


def test_a_display_that_nobody_serves_is_said_at_once():
    code = "from surgicai_vision.envs.live.window import check_display as c; c()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=120,
        env={"PATH": "/usr/bin", "HOME": "/tmp", "DISPLAY": ":4711"},
        check=False,
    )
    assert "No window opens on the display DISPLAY=:4711" in done.stderr
