"""Watch: the player plays what is evaluated; the page in a real browser; the window."""

import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from browser import CHROMIUM, Browser

from surgicai_vision.commands.main import main
from surgicai_vision.core.cameras import camera_names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import PhysicsError
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.live.browser import (
    ENDED,
    MAX_VIEWS,
    PAUSED,
    PLAYING,
    STOPPED,
    Command,
    LivePage,
)
from surgicai_vision.envs.live.window import KEYS
from surgicai_vision.evaluation.agents import ExpertAgent, RandomAgent
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.evaluation.watch import REST_TICKS, Player, _command_of

SHORT = TaskConfig("handoff", max_steps=6)


class Recorder:
    """Records a player's curves."""

    def __init__(self):
        self.episodes = []

    def begin(self, episode):
        self.episodes.append((episode, []))

    def add_point(self, distance, force):
        self.episodes[-1][1].append((distance, force))


@pytest.fixture
def player():
    made = Player(RandomAgent(), SHORT, seed=7, playing=False)
    yield made
    made.close()


def play_to_the_end(player):
    player.handle(Command("play"))
    while player.state == PLAYING:
        player.tick()


def test_what_is_watched_is_what_is_counted():
    config = TaskConfig("handoff")
    told = []
    player = Player(ExpertAgent(), config, 900_000, episodes=2, go_on=True, told=told.append)
    for _ in range(2000):
        player.tick()
        if player.over:
            break
    player.close()
    counted = evaluate(ExpertAgent, config, [900_000, 900_001], workers=1)
    assert [str(row) for row in told] == [str(episode.row) for episode in counted]
    assert player.status(("front",), 0).successes == 2


def test_play_pause_step_again_next_and_stop(player):
    assert player.state == PAUSED
    player.tick()
    assert player.moment.step == 0, "a paused player does nothing"
    player.handle(Command("step"))
    assert (player.moment.step, player.state) == (1, PAUSED)
    player.handle(Command("play"))
    player.tick()
    player.handle(Command("step"))
    assert (player.moment.step, player.state) == (3, PAUSED), "a step pauses what plays"
    player.handle(Command("pause"))
    player.tick()
    assert player.moment.step == 3
    play_to_the_end(player)
    assert (player.state, player.moment.step, list(player.rows)) == (ENDED, 6, [7])
    player.handle(Command("step"))
    player.tick()
    assert player.moment.step == 6, "an ended episode has no next step"
    end = player.env.get_state()
    player.handle(Command("again"))
    assert (player.seed, player.moment.step, player.state) == (7, 0, PLAYING)
    play_to_the_end(player)
    np.testing.assert_array_equal(player.env.get_state(), end)
    assert list(player.rows) == [7], "a start counts once"
    player.handle(Command("play"))
    assert (player.seed, player.number, player.state) == (8, 3, PLAYING)
    player.handle(Command("pause"))
    player.handle(Command("next"))
    assert (player.seed, player.state) == (9, PAUSED), "who paused stays paused"
    player.handle(Command("speed", (0.5,)))
    assert player.status((), 0).speed == 0.5
    player.handle(Command("stop"))
    assert player.over
    player.handle(Command("play"))
    assert player.state == STOPPED


def test_going_on_by_itself_rests_first():
    curves = Recorder()
    player = Player(RandomAgent(), SHORT, seed=7, curves=curves)
    player.handle(Command("go_on", (1.0,)))
    for _ in range(6 + REST_TICKS - 1):
        player.tick()
    assert (player.seed, player.state) == (7, ENDED)
    player.tick()
    assert (player.seed, player.state) == (8, PLAYING)
    player.close()
    assert [(episode, len(points)) for episode, points in curves.episodes] == [(1, 7), (2, 1)]
    assert all(distance > 0 for _, points in curves.episodes for distance, _ in points)


def test_an_episode_that_was_left_is_not_one_that_has_ended():
    player = Player(RandomAgent(), SHORT, seed=7, episodes=2)
    player.handle(Command("next"))
    player.handle(Command("next"))
    play_to_the_end(player)
    assert (player.state, list(player.rows)) == (ENDED, [9])
    play_to_the_end(player)
    assert (player.state, list(player.rows)) == (STOPPED, [9, 10])
    player.close()


def test_a_start_that_cannot_be_made_is_an_episode_that_has_ended(monkeypatch):
    def refuse(self, **_):
        raise PhysicsError("No start was physical.")

    monkeypatch.setattr(SuturingEnv, "reset", refuse)
    player = Player(RandomAgent(), SHORT, seed=7)
    assert player.state == ENDED
    status = player.status(("front",), 1)
    assert "No start was physical." in status.message
    assert (status.episodes, status.successes, status.moment.step) == (1, 0, 0)


def test_the_windows_keys_are_commands(player):
    assert {KEYS[32], KEYS[262]} == {"play", "step"}
    assert _command_of("play", player) == Command("play")
    player.handle(Command("play"))
    assert _command_of("play", player) == Command("pause")
    assert _command_of("slower", player) == Command("speed", (0.5,))
    assert _command_of("faster", player) == Command("speed", (2.0,))
    player.speed = 4.0
    assert _command_of("faster", player) == Command("speed", (4.0,))


def test_a_port_in_use_and_a_missing_display_are_said_before_any_work(capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with LivePage("x", ("front",), controls=True) as page:
        assert main(["watch", "zero", "--port", str(page.server.port)]) == 2
    assert "is not free" in capsys.readouterr().err
    assert main(["watch", "zero", "--window"]) == 2
    assert "needs a display" in capsys.readouterr().err


def test_more_views_than_the_page_takes_are_refused(capsys):
    views = camera_names()[: MAX_VIEWS + 1]
    assert main(["watch", "zero", "--view", ",".join(views)]) == 2
    assert f"shows at most {MAX_VIEWS}" in capsys.readouterr().err


def start(*arguments, prefix=()):
    return subprocess.Popen(
        [*prefix, sys.executable, "-m", "surgicai_vision", "watch", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


GREEN = (
    "(() => { const c = document.querySelector('#lead canvas'); const d = c.getContext('2d')"
    ".getImageData(0, 0, c.width, c.height).data; let s = 0;"
    " for (let i = 1; i < d.length; i += 4) s += d[i] * (i % 97); return s; })()"
)
"""A number that changes with the leading image."""


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: apt-get install chromium")
@pytest.mark.parametrize(("width", "height"), [(1280, 860), (420, 860)])
def test_a_browser_watches_the_expert(tmp_path, width, height):
    process = start("expert", "--task", "handoff", "--port", "0", "--paused", "--json")
    address = re.search(r"Open (\S+)", process.stderr.readline())[1]

    def text(name):
        return f"document.getElementById('{name}').textContent"

    def click(selector):
        browser.value(f"document.querySelector('{selector}').click()")

    try:
        with Browser(tmp_path / "profile", width, height) as browser:
            size = {"width": width, "height": height, "deviceScaleFactor": 1}
            browser.call("Emulation.setDeviceMetricsOverride", **size, mobile=width < 500)
            browser.open(address)
            assert browser.until(f"{text('state')} === 'paused'")
            assert browser.until(f"{text('step')} === '0 of 200' && {GREEN} > 0")
            before = browser.value(GREEN)
            browser.key("ArrowRight", True)
            browser.key("ArrowRight", False)
            assert browser.until(f"{text('step')} === '1 of 200'")
            click('[data-command=speed][data-number="4.0"]')
            click("[data-command=play]")
            assert browser.until(f"{text('state')}.startsWith('playing')")
            assert browser.until(f"{GREEN} !== {before}"), "the image changes while it plays"
            assert browser.until(f"{text('state')}.startsWith('ended')", seconds=60)
            assert browser.value("document.getElementById('message').className") == "good"
            assert re.match(r"Success after \d+ steps", browser.value(text("text")))
            steps = int(browser.value(text("step")).split()[0])
            assert browser.until(f"curves.points.length === {steps + 1}")
            assert browser.value("curves.points[0][0] > curves.points.at(-1)[0]")
            click("[data-view-choice=free]")
            assert browser.until("document.querySelectorAll('figure').length === 3")
            click("figure[data-view=free]")
            assert browser.until("document.querySelector('#lead figure').dataset.view === 'free'")
            assert browser.until("document.querySelector('#lead canvas').width > 100")
            still = browser.value(GREEN)
            browser.value("send('turn', [40, 5])")
            assert browser.until(f"{GREEN} !== {still}"), "the free camera turns"
            overflow = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
            assert browser.value(overflow) <= 0, "nothing sticks out to the side"
            click("[data-command=next]")
            assert browser.until(f"{text('seed')} === '900001'")
            browser.key("Escape", True)
            browser.key("Escape", False)
            assert browser.until(f"{text('state')}.startsWith('stopped')")
            assert browser.complaints == []
        out, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, error
    result = json.loads(out.splitlines()[-1])
    assert result["episodes"] == [{"seed": 900_000, "success": True, "failure": "", "steps": steps}]


@pytest.mark.skipif(
    shutil.which("xvfb-run") is None, reason="no virtual display here: apt-get install xvfb"
)
def test_mujocos_window_shows_an_episode_and_changes_nothing_of_it():
    arguments = ("expert", "--task", "handoff", "--window", "--episodes", "1", "--json")
    process = start(*arguments, prefix=("xvfb-run", "-a"))
    out, error = process.communicate(timeout=300)
    assert process.returncode == 0, error
    (row,) = json.loads(out.splitlines()[-1])["episodes"]
    counted = evaluate(ExpertAgent, TaskConfig("handoff"), [900_000], workers=1)[0].row
    assert (row["success"], row["steps"]) == (counted.success, counted.steps)
