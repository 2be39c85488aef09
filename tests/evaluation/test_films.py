"""Filming: which episodes become videos, what they show, and that evaluations do not change."""

import json

import av
import numpy as np
import pytest

from surgicai_vision.commands.main import main
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, OutputExists
from surgicai_vision.core.video import read_video
from surgicai_vision.envs import contact_sheet
from surgicai_vision.evaluation.agents import ExpertAgent, ZeroAgent
from surgicai_vision.evaluation.films import LAST_S, Filming, Look
from surgicai_vision.evaluation.overlay import BAND, GOOD
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.evaluation.slot import Slot

SMALL = Look(("front", "wrist_psm1"), size=96)
SHORT = TaskConfig("handoff", max_steps=6)


def names_in(folder):
    return sorted(path.name for path in folder.glob("*.mp4"))


@pytest.mark.parametrize(
    ("of", "seeds"), [("all", [900, 901, 902]), ("failures", [900, 901, 902]), ("2", [902, 900])]
)
def test_the_wanted_episodes_become_videos(tmp_path, of, seeds):
    filming = Filming(tmp_path / "videos", of, SMALL)
    evaluate(ZeroAgent, SHORT, [902, 900, 901], workers=1, filming=filming)
    filmed = [int(name.split("-")[1]) for name in names_in(tmp_path / "videos")]
    assert filmed == sorted(seeds)
    listed = json.loads((tmp_path / "videos" / "videos.json").read_text())
    assert [row["file"] for row in listed["videos"]] == filming.videos()
    assert sorted(filming.videos()) == names_in(tmp_path / "videos")
    assert [row["seed"] for row in listed["videos"]] == [s for s in (902, 900, 901) if s in seeds]


def test_a_video_shows_every_second_state_and_the_outcome_at_the_end(tmp_path):
    config = TaskConfig("handoff")
    slot = Slot(0, agent := ExpertAgent(), config)
    slot.begin(900_000)
    while not slot.ended:
        slot.step(agent.act([0], [slot.env], [slot.observation])[0])
    states = list(slot.states)
    evaluate(
        ExpertAgent, config, [900_000], workers=1, filming=Filming(tmp_path, "successes", SMALL)
    )
    (name,) = names_in(tmp_path)
    video = read_video(tmp_path / name)
    assert video.shape[1:] == (96 + BAND, 640, 3)
    shown = [*range(0, len(states) - 1, 2), len(states) - 1]
    held = round(LAST_S * 25)
    assert len(video) == len(shown) - 1 + held
    left = (640 - 2 * 96) // 2
    with contact_sheet.state_renderer(config, 96, "fast") as draw:
        for place, index in list(enumerate(shown))[:: len(shown) // 4]:
            for column, view in enumerate(SMALL.views):
                corner = left + 96 * column
                found = video[place, 40:94, corner : corner + 96].astype(int)
                assert np.abs(found - draw(states[index], view)[40:94]).mean() < 8, (index, view)
    assert np.abs(video[-1].astype(int) - video[-held]).mean() < 2
    line = video[-1, 96, 20:620].astype(int)
    assert np.abs(line - GOOD).max() < 40, "a success ends under a green line"
    assert np.abs(video[0, 96, 20:620].astype(int) - GOOD).min(axis=0).max() > 20


def test_a_held_action_changes_no_time(tmp_path):
    config = TaskConfig("handoff", max_steps=20, action_repeat=5)
    filming = Filming(tmp_path, look=SMALL)
    (episode,) = evaluate(ZeroAgent, config, [900], workers=1, filming=filming)
    assert episode.row.steps == 20
    assert episode.film.steps.tolist() == [0, 5, 10, 15, 20]
    (name,) = names_in(tmp_path)
    with av.open(str(tmp_path / name)) as video:
        assert video.streams.video[0].average_rate == 5, "an image every 10 of 50 control steps"
        shown = video.streams.video[0].frames
    assert shown == 2 + round(5 * LAST_S)


def test_a_video_that_another_policy_left_is_not_listed(tmp_path):
    config = TaskConfig("handoff", max_steps=2)
    evaluate(ZeroAgent, config, [900], workers=1, filming=Filming(tmp_path, look=SMALL))
    (left,) = names_in(tmp_path)
    (tmp_path / "videos.json").write_text('{"videos": []}')  # it was killed before its list
    filming = Filming(tmp_path, "successes", SMALL)
    evaluate(ZeroAgent, config, [900], workers=1, filming=filming)
    assert names_in(tmp_path) == [left] and filming.videos() == []


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ('{"videos": [', "is not valid JSON"),
        ("[]", "it must be a table of keys"),
        ("{}", "videos is None; it must be a list"),
        ('{"videos": [{"file": 3, "seed": 1}]}', "a video's file is 3; it must be text"),
        ('{"videos": [{"file": "a.mp4", "seed": "1"}]}', "a.mp4 is .1.; it must be a whole number"),
    ],
)
def test_a_damaged_list_of_videos_is_refused_before_any_episode(content, told, tmp_path):
    (tmp_path / "videos.json").write_text(content)
    with pytest.raises(BadFile, match=told):
        evaluate(ZeroAgent, SHORT, [1], workers=1, filming=Filming(tmp_path, look=SMALL))
    assert [path.name for path in tmp_path.iterdir()] == ["videos.json"]


def test_rows_and_videos_depend_on_neither_filming_nor_workers(tmp_path):
    seeds = [3, 4, 5]
    plain = evaluate(ExpertAgent, SHORT, seeds, workers=1)
    for workers in (1, 2):
        filming = Filming(tmp_path / str(workers), look=SMALL)
        filmed = evaluate(ExpertAgent, SHORT, seeds, workers=workers, filming=filming)
        assert [str(episode.row) for episode in filmed] == [str(episode.row) for episode in plain]
    assert names_in(tmp_path / "1") == names_in(tmp_path / "2")
    for name in names_in(tmp_path / "1"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


def test_filming_again_replaces_what_was_filmed_and_touches_nothing_else(tmp_path):
    evaluate(ZeroAgent, SHORT, [1], workers=1, filming=Filming(tmp_path, look=SMALL))
    (tmp_path / "mine.txt").write_text("kept")
    (tmp_path / "handoff-2-success.mp4").write_text("of a run that was killed")
    evaluate(ZeroAgent, SHORT, [2], workers=1, filming=Filming(tmp_path, look=SMALL))
    (name,) = names_in(tmp_path)
    assert name.startswith("handoff-2-")
    assert name != "handoff-2-success.mp4"
    assert (tmp_path / "mine.txt").read_text() == "kept"
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "a.mp4").write_text("somebody's")
    with pytest.raises(OutputExists, match="--video"):
        evaluate(ZeroAgent, SHORT, [2], workers=1, filming=Filming(tmp_path / "other", look=SMALL))


@pytest.mark.parametrize(
    "wrong",
    [
        lambda folder: Filming(folder, "some"),
        lambda folder: Filming(folder, "0"),
        lambda folder: Look(()),
        lambda folder: Look(("front", "front")),
        lambda folder: Look(("nowhere",)),
        lambda folder: Look(size=97),
        lambda folder: Look(every=0),
        lambda folder: Look(speed=0.0),
    ],
)
def test_what_cannot_be_filmed_is_refused(tmp_path, wrong):
    with pytest.raises(InputError):
        wrong(tmp_path)


def test_the_command_films(tmp_path, capsys):
    arguments = ["evaluate", "zero", "--task", "handoff", "--episodes", "2", "--workers", "1"]
    config = tmp_path / "short.yaml"
    config.write_text("env:\n  max_steps: 4\n")
    arguments += ["--config", str(config), "--out", str(tmp_path / "out"), "--json"]
    film = ["--video", str(tmp_path / "films"), "--video-of", "1", "--video-view", "back"]
    assert main([*arguments, *film, "--video-size", "64"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    (video,) = result["videos"]
    assert read_video(tmp_path / "films" / video.rpartition("/")[2]).shape[1:] == (
        64 + BAND,
        640,
        3,
    )
    assert main([*arguments, "--video", str(tmp_path / "out2"), "--video-of", "none"]) == 2
    assert "Videos of 'none'" in capsys.readouterr().err
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a").write_text("")
    assert main([*arguments, "--video", str(tmp_path / "full")]) == 2
    assert "--video" in capsys.readouterr().err
