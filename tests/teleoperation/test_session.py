"""Sessions driven by scripted inputs: kept episodes are demonstrations like any others."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from teleoperators import REST, SHORT, VIEWS, FakeMapping, Script, SessionEnv, event, right
from told_clock import Clock

from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import (
    BadFile,
    InputError,
    OutputExists,
    PhysicsError,
    SurgicaiError,
)
from surgicai_vision.core.files import write_json
from surgicai_vision.core.pacer import Pacer
from surgicai_vision.demos.store import list_demos, read_demo, read_marker, write_marker
from surgicai_vision.teleoperation import recordings
from surgicai_vision.teleoperation.inputs import DISCARD, KEEP, START, STOP, VIEW, Input
from surgicai_vision.teleoperation.keyboard import TABLE, key_names, key_table
from surgicai_vision.teleoperation.loop import run_session
from surgicai_vision.teleoperation.recordings import open_recordings
from surgicai_vision.teleoperation.session import DRIVING, JUDGED, STOPPED, WAITING, Rules, Session

LONG = TaskConfig("grasp", max_steps=1500)


# -- sessions --------------------------------------------------------------------------------------


@pytest.fixture
def open_session(tmp_path):
    """Return a function that opens a session of the stand-in env on one folder."""
    opened = []

    def open_session(config=SHORT, seed=None, **rules):
        for before in opened:
            before.__exit__(None, None, None)
        opened[:] = [open_recordings(tmp_path / "demos", config, "f" * 64, seed)]
        return Session(
            SessionEnv(config), FakeMapping(), opened[0].__enter__(), VIEWS, Rules(**rules)
        )

    yield open_session
    for before in opened:
        before.__exit__(None, None, None)


def ticks(session, *inputs):
    for given in inputs:
        session.tick(given)
    return session.status()


def succeed(session):
    """Drive to a success."""
    session.tick(REST)
    for _ in range(12):
        if session.status().state == JUDGED:
            break
        session.tick(right())
    return session.status()


def test_keep_goes_on_to_the_next_start(open_session, tmp_path):
    session = open_session()
    status = succeed(session)
    assert (status.state, status.success, status.kept) == (JUDGED, True, 0)
    assert not list((tmp_path / "demos").iterdir()), "nothing is written before it is kept"
    status = ticks(session, event(KEEP))
    assert (status.state, status.kept, status.episode, status.seed) == (WAITING, 1, 1, 1)
    (path,) = list_demos(tmp_path / "demos")
    demo = read_demo(path)
    assert (demo.demonstrator, demo.seed, demo.config) == ("teleoperate", 0, SHORT)
    assert demo.success.tolist() == [False] * (len(demo) - 1) + [True]


def test_discard_does_the_same_start_again(open_session, tmp_path):
    session = open_session()
    succeed(session)
    status = ticks(session, event(DISCARD))
    assert (status.state, status.seed, status.steps, status.discarded) == (WAITING, 0, 0, 1)
    status = ticks(session, REST, right(), right(), event(DISCARD))
    assert (status.state, status.seed, status.discarded) == (WAITING, 0, 2), "also in the middle"
    assert ticks(session, event(DISCARD)).discarded == 2, (
        "there is nothing to discard while waiting"
    )
    succeed(session)
    ticks(session, event(KEEP))
    assert read_demo(list_demos(tmp_path / "demos")[0]).seed == 0


def test_a_start_is_given_up(open_session, tmp_path):
    session = open_session()
    assert ticks(session, event(KEEP)).seed == 1, "at once while waiting"
    status = ticks(session, REST, right(), event(KEEP))
    assert (status.state, status.success, status.seed) == (JUDGED, False, 1), (
        "never without a word while driving"
    )
    assert ticks(session, event(KEEP)).seed == 2
    assert [row["seed"] for row in read_marker(tmp_path / "demos")["skipped"]] == [0, 1]
    assert not list((tmp_path / "demos").glob("episode*"))


def test_time_ends_an_attempt_and_a_failure_is_not_kept(open_session):
    session = open_session()
    status = ticks(session, REST, event(START), *[REST] * 11)
    assert (status.state, status.success, status.steps) == (JUDGED, False, 12)
    assert "time is up" in status.message
    assert ticks(session, event(KEEP)).kept == 0


def test_failures_are_kept_on_request(open_session, tmp_path):
    session = open_session(keep_failures=True)
    assert ticks(session, REST, right(), right(), event(KEEP)).kept == 1
    assert ticks(session, event(START), *[REST] * 11, event(KEEP)).kept == 2
    demos = [read_demo(path) for path in list_demos(tmp_path / "demos")]
    assert [(len(demo), demo.success.any()) for demo in demos] == [(2, False), (12, False)]


def test_successes_are_kept_without_asking_on_request_and_counted(open_session):
    session = open_session(auto_keep=True, episodes=2)
    for _ in range(60):
        if session.over:
            break
        ticks(session, REST, right())
    status = session.status()
    assert (status.state, status.kept) == (STOPPED, 2)
    assert ticks(session, right(), event(KEEP)).kept == 2, "after the end nothing happens"


@pytest.mark.parametrize(
    ("before", "kept", "discarded"), [("waiting", 0, 0), ("driving", 0, 1), ("judged", 1, 0)]
)
def test_escape_stops_and_loses_no_success(open_session, before, kept, discarded):
    session = open_session()
    if before == "driving":
        ticks(session, REST, right())
    elif before == "judged":
        succeed(session)
    status = ticks(session, Input(events=(STOP, DISCARD)))
    assert session.over
    assert (status.kept, status.discarded) == (kept, discarded)


def test_a_key_still_held_does_not_start_the_next_episode(open_session):
    session = open_session()
    succeed(session)
    status = ticks(session, Input((1, 0, 0), events=(KEEP,)), *[right()] * 5)
    assert (status.state, status.steps) == (WAITING, 0)
    assert ticks(session, REST, right()).state == DRIVING


def test_pauses_are_recorded_unless_told_otherwise(open_session):
    assert ticks(open_session(), REST, right(), REST, REST, right()).steps == 4
    assert ticks(open_session(skip_idle=True), REST, right(), REST, REST, right()).steps == 2


def test_the_next_view_leads(open_session):
    session = open_session()
    seen = [session.view] + [ticks(session, event(VIEW)).view for _ in range(2)]
    assert seen == ["front", "back", "front"]


def test_an_episode_that_diverged_is_never_kept(open_session):
    session = open_session(keep_failures=True)
    step = session.env.step
    session.env.step = lambda action: (
        *step(action)[:2],
        True,
        False,
        {**step(action)[4], "physics_error": True},
    )
    assert "physics error" in ticks(session, REST, right()).message
    assert ticks(session, event(KEEP)).kept == 0


def test_a_dropped_needle_is_said(open_session):
    session = open_session()
    step = session.env.step
    session.env.step = lambda action: (
        *step(action)[:3],
        True,
        {**step(action)[4], "dropped": True},
    )
    assert "the needle is dropped" in ticks(session, REST, right()).message


def test_a_start_that_cannot_be_made_is_left_out(open_session, tmp_path, monkeypatch):
    reset = SessionEnv.reset

    def failing(env, *, seed=None, options=None):
        if seed in (0, 2):
            raise PhysicsError("No start was physical.")
        return reset(env, seed=seed)

    monkeypatch.setattr(SessionEnv, "reset", failing)
    session = open_session()
    assert (session.status().seed, session.status().skipped) == (1, 1)
    succeed(session)
    status = ticks(session, event(KEEP))
    assert (status.kept, status.seed) == (1, 3)
    assert "Start 2 cannot be made" in status.message
    assert open_session().status().seed == 3, "the folder goes on after it"
    assert read_marker(tmp_path / "demos")["seeds"] == [1]

    monkeypatch.setattr(SessionEnv, "reset", lambda *_, **__: failing(None, seed=0))
    with pytest.raises(PhysicsError, match="in a row"):
        open_session()


# -- recordings ------------------------------------------------------------------------------------


def keep_one(session):
    assert succeed(session).success
    session.tick(event(KEEP))


def test_the_same_folder_goes_on_with_numbers_and_seeds(open_session, tmp_path):
    session = open_session(seed=7)
    keep_one(session)
    ticks(session, event(KEEP))  # seed 8 is given up
    session = open_session()
    assert (session.status().seed, session.status().episode) == (9, 1)
    keep_one(session)
    assert [read_demo(path).seed for path in list_demos(tmp_path / "demos")] == [7, 9]
    assert read_marker(tmp_path / "demos")["seeds"] == [7, 9]


def test_an_episode_whose_entry_a_kill_prevented_counts(open_session, tmp_path):
    session = open_session()
    keep_one(session)
    marker = (tmp_path / "demos" / "demos.json").read_bytes()
    keep_one(session)
    (tmp_path / "demos" / "demos.json").write_bytes(marker)
    (tmp_path / "demos" / ".partial-1-episode_000002.safetensors").write_bytes(b"half")
    session = open_session()
    assert (session.status().seed, session.status().episode) == (2, 2)
    keep_one(session)
    assert len(list_demos(tmp_path / "demos")) == 3
    assert not list((tmp_path / "demos").glob(".partial*"))


@pytest.mark.parametrize("episode", [None, "episode_000000.safetensors"])
def test_a_kill_around_the_first_episode_loses_no_folder(
    open_session, tmp_path, monkeypatch, episode
):
    """Killed while the first kept episode was written, or before it was entered."""
    session = open_session()
    folder = tmp_path / "demos"
    write_demo = recordings.write_demo

    def killed(folder, index, demo):
        (folder / ".partial-1-episode_000000.safetensors").write_bytes(b"half")
        if episode:
            write_demo(folder, index, demo)
        raise KeyboardInterrupt

    monkeypatch.setattr(recordings, "write_demo", killed)
    with pytest.raises(KeyboardInterrupt):
        keep_one(session)
    monkeypatch.undo()
    session = open_session()
    kept = 1 if episode else 0
    assert (session.status().seed, session.status().episode) == (kept, kept)
    keep_one(session)
    assert len(list_demos(folder)) == kept + 1
    assert not list(folder.glob(".partial*"))


def test_a_folder_from_before_the_config_gained_a_field_goes_on(open_session, tmp_path):
    keep_one(open_session())
    marker = read_marker(tmp_path / "demos")
    del marker["request"]["task"]["scene"]["ink"]
    write_json(tmp_path / "demos" / "demos.json", marker)
    assert open_session().status().episode == 1


def test_a_folder_is_one_sessions_at_a_time(open_session, tmp_path):
    keep_one(open_session())
    with (
        pytest.raises(SurgicaiError, match="another session"),
        open_recordings(tmp_path / "demos", SHORT, "f" * 64),
    ):
        pass


def test_starts_that_are_counted_on_are_refused(tmp_path):
    with (
        pytest.raises(InputError, match=f"seed {names.TEST_SEED} on"),
        open_recordings(tmp_path / "demos", SHORT, "f" * 64, names.TEST_SEED),
    ):
        pass
    assert not list(tmp_path.iterdir())


def test_a_session_does_not_run_on_into_starts_that_are_counted_on(open_session, tmp_path):
    session = open_session(seed=names.VALIDATION_SEED - 1)
    succeed(session)
    with pytest.raises(InputError, match="reserved for validation"):
        session.tick(event(KEEP))
    assert len(list_demos(tmp_path / "demos")) == 1, "the episode is kept all the same"
    with pytest.raises(InputError, match="reserved for validation"):
        open_session()


@pytest.mark.parametrize(
    "damage",
    [
        {"seeds": ["a"]},
        {"skipped": [7]},
        {"skipped": [{"reason": "given up"}]},
        {"request": "seed"},
    ],
)
def test_a_damaged_list_of_seeds_is_one_line(open_session, tmp_path, damage):
    keep_one(open_session())
    marker = read_marker(tmp_path / "demos")
    if damage == {"request": "seed"}:
        damage = {"request": {**marker["request"], "seed": "first"}}
    write_json(tmp_path / "demos" / "demos.json", {**marker, **damage})
    with pytest.raises(BadFile, match=r"demos\.json"):
        open_session()


def test_the_current_folder_and_a_link_are_folders_like_others(tmp_path, monkeypatch):
    (tmp_path / "demos").mkdir()
    (tmp_path / "link").symlink_to("demos")
    monkeypatch.chdir(tmp_path / "demos")
    with (
        open_recordings(Path(), SHORT, "f" * 64),
        pytest.raises(SurgicaiError, match="another session"),
        open_recordings(tmp_path / "link", SHORT, "f" * 64),
    ):
        pass
    assert (tmp_path / "demos").is_dir(), "a folder that was there before stays"


def test_another_task_scene_or_seed_is_refused(tmp_path):
    with open_recordings(tmp_path / "demos", SHORT, "f" * 64) as recordings:
        recordings.skip(0, "given up")
    for config, scene, seed in ((LONG, "f", None), (SHORT, "e", None), (SHORT, "f", 3)):
        with (
            pytest.raises(OutputExists),
            open_recordings(tmp_path / "demos", config, scene * 64, seed),
        ):
            pass
    write_marker(
        tmp_path / "demos",
        "grasp",
        "teleoperate",
        request=read_marker(tmp_path / "demos")["request"],
    )
    with (
        pytest.raises(BadFile, match="does not say which seeds"),
        open_recordings(tmp_path / "demos", SHORT, "f" * 64),
    ):
        pass
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "thesis.txt").write_text("mine")
    with (
        pytest.raises(OutputExists, match="already holds files"),
        open_recordings(tmp_path / "notes", SHORT, "f" * 64),
    ):
        pass


def test_a_session_without_a_result_leaves_no_folder(tmp_path):
    with open_recordings(tmp_path / "demos", SHORT, "f" * 64):
        assert (tmp_path / "demos").is_dir()
    assert not (tmp_path / "demos").exists()


# -- the loop --------------------------------------------------------------------------------------


class Canvas:
    """A screen that wants every image; each costs `cost` seconds."""

    def __init__(self, clock, cost):
        self.clock, self.cost, self.shown = clock, cost, []

    def wants_image(self):
        return True

    def show(self, images, status):
        self.shown.append(status)

    def render(self):
        self.clock.now += self.cost
        return {}


def run_loop(session, cost, inputs, pace=1.0):
    clock = Clock()
    canvas = Canvas(clock, cost)
    heard = []
    run_session(
        session, Script(*inputs), canvas, canvas, Pacer(pace, clock, clock.sleep), heard.append
    )
    return clock.now, canvas.shown, heard


@pytest.mark.parametrize(("cost", "images"), [(0.001, 102), (0.03, 68), (0.09, 22)])
def test_a_slow_screen_loses_images_and_no_ticks(open_session, cost, images):
    config = TaskConfig("grasp", max_steps=1000)
    inputs = [REST, event(START), *[right(1e-6)] * 99, event(STOP)]
    session = open_session(config, keep_failures=True)
    seconds, shown, _ = run_loop(session, cost, inputs)
    assert shown[-1].steps == 100, "a step a tick, whatever is drawn"
    assert len(shown) == pytest.approx(images, abs=3)
    assert seconds == pytest.approx(102 / 50, abs=0.15), "in real time all the same"


def test_pace_slows_the_clock_and_not_the_world(open_session):
    inputs = [REST, event(START), *[right(1e-6)] * 8, event(STOP)]
    times = {pace: run_loop(open_session(), 0.0, inputs, pace)[0] for pace in (1.0, 0.5)}
    assert times[0.5] == pytest.approx(2 * times[1.0])


def test_what_happened_is_heard_once(open_session):
    _, _, heard = run_loop(
        open_session(), 0.0, [REST, *[right()] * 9, event(KEEP), REST, REST, event(STOP)]
    )
    messages = [status.message for status in heard]
    assert len(messages) == len(set(messages))
    assert any(message.startswith("Kept as episode 0") for message in messages)


# -- the command -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--veiw", "front"], "Did you mean '--view'?"),
        (["--view", "frnt"], "Did you mean 'front'?"),
        (["--view", ""], "--view is empty"),
        (["--frame", "cam"], "Did you mean 'camera'?"),
        (["--speed", "2"], "Invalid value '2.0' for --speed. Must be <= 1"),
        (["--seconds", "nan"], "Invalid value 'nan' for --seconds"),
        (["--port", "99999"], "Invalid value '99999' for --port. Must be <= 65535"),
        (["--episodes", "0"], "'0' for --episodes. Must be >= 1"),
        (["--out", "/proc/x"], "cannot be written"),
    ],
)
def test_wrong_input_is_one_line(arguments, said, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["teleoperate", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_held_actions_are_refused(monkeypatch, tmp_path, capsys):
    """The world would run at twice real time."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "held.yaml").write_text("env: {action_repeat: 2}")
    assert main(["teleoperate", "--config", "held.yaml"]) == 2
    assert "action_repeat is 2" in capsys.readouterr().err


def test_a_procedure_that_nobody_tells_to_go_on_is_refused(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "told.yaml").write_text("env: {advance: told}")
    assert main(["teleoperate", "--task", "suture", "--config", "told.yaml"]) == 2
    assert "advance is 'told'" in capsys.readouterr().err


def test_help_and_documentation_have_the_key_table(root, capsys):
    assert main(["teleoperate", "--help"]) == 0
    assert key_table() in capsys.readouterr().out
    text = (root / "docs" / "teleoperation.md").read_text()
    for row in TABLE:
        keys = " ".join(f"<kbd>{name}</kbd>" for name in key_names(row))
        assert f"| {keys} | {row.gamepad} | {row.meaning} |" in text


# -- the process -----------------------------------------------------------------------------------

ENDLESS = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from teleoperators import REST, SHORT, VIEWS, SessionEnv, FakeMapping, right
from surgicai_vision.teleoperation.recordings import open_recordings
from surgicai_vision.teleoperation.session import Rules, Session
with open_recordings(Path(sys.argv[2]), SHORT, "f" * 64) as recordings:
    session = Session(SessionEnv(SHORT), FakeMapping(), recordings, VIEWS, Rules(auto_keep=True))
    while True:
        for _ in range(12):
            session.tick(right() if session.status().steps else REST)
            session.tick(right())
        print(session.kept, flush=True)
"""


def test_a_killed_process_leaves_whole_episodes_and_the_next_goes_on(open_session, root, tmp_path):
    for enough in (3, 6):
        command = [
            sys.executable,
            "-c",
            ENDLESS,
            str(root / "tests" / "helpers"),
            str(tmp_path / "demos"),
        ]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) >= 3:
                break
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
        demos = [read_demo(path) for path in list_demos(tmp_path / "demos")]
        assert len(demos) >= enough
        assert all(demo.success[-1] for demo in demos)
        seeds = [demo.seed for demo in demos]
        assert len(set(seeds)) == len(seeds), "no start twice"
    session = open_session()
    assert session.status().episode == len(demos)
    assert session.status().seed > max(seeds)
    assert (
        json.loads((tmp_path / "demos" / "demos.json").read_text())["demonstrator"] == "teleoperate"
    )
