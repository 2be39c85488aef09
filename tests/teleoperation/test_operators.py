"""Teleoperation of the real env by scripted operators: the kept recordings are what happened."""

import itertools

import numpy as np
import pytest
from teleoperators import VIEWS, GamepadOperator, KeyboardOperator, event

from surgicai_vision import envs
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.dataset import check_dataset, open_dataset, render_demos
from surgicai_vision.demos.store import list_demos, read_demo
from surgicai_vision.teleoperation.input_map import InputMapping
from surgicai_vision.teleoperation.inputs import DISCARD, KEEP, START
from surgicai_vision.teleoperation.recordings import open_recordings
from surgicai_vision.teleoperation.session import DRIVING, JUDGED, Rules, Session

LONG = TaskConfig("grasp", max_steps=1500)


def play(folder, who, config=LONG, frame="camera", speed=0.5, episodes=1, answers=()):
    """Run a session of the real env with a scripted person until it stops; return it."""
    env = envs.make(config)
    answers = iter(answers or itertools.repeat(KEEP))
    with open_recordings(folder, config, env.scene.hash) as recordings:
        mapping = InputMapping(env, frame, speed)
        session = Session(env, mapping, recordings, VIEWS, Rules(episodes=episodes))
        operator = who(session, mapping)
        while not session.over:
            state = session.status().state
            session.tick(
                event(next(answers))
                if state == JUDGED
                else operator.poll()
                if state == DRIVING
                else event(START)
            )
    env.close()
    return session


@pytest.mark.parametrize(
    ("who", "frame", "speed"), [(KeyboardOperator, "camera", 0.5), (GamepadOperator, "tool", 1.0)]
)
def test_an_operator_grasps_and_the_recording_is_what_happened(tmp_path, who, frame, speed):
    session = play(tmp_path / "demos", who, frame=frame, speed=speed, answers=[DISCARD, KEEP])
    assert (session.kept, session.discarded) == (1, 1)
    demo = read_demo(list_demos(tmp_path / "demos")[0])
    assert demo.success[-1] and demo.contact[-1]
    assert np.abs(demo.action[:, :6]).max() <= speed + 1e-6
    env = envs.make(LONG)
    env.reset(seed=demo.seed)
    np.testing.assert_array_equal(env.get_state(), demo.state[0])
    for action, state in zip(demo.action, demo.state[1:], strict=True):
        env.step(action)
        np.testing.assert_array_equal(env.get_state(), state)


def test_the_same_operator_gives_the_same_files(tmp_path):
    for name in ("one", "two"):
        play(tmp_path / name, GamepadOperator, speed=1.0, episodes=2)
    for path in list_demos(tmp_path / "one"):
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


def test_kept_episodes_go_through_render_demos_as_they_are(tmp_path):
    play(tmp_path / "demos", GamepadOperator, speed=1.0, episodes=2)
    summary = render_demos(tmp_path / "demos", tmp_path / "dataset", views=("back",), size=32)
    lengths = [len(read_demo(path)) for path in list_demos(tmp_path / "demos")]
    assert (summary.episodes, summary.frames) == (2, sum(lengths))
    assert not check_dataset(tmp_path / "dataset").problems
    actions = np.concatenate([read_demo(path).action for path in list_demos(tmp_path / "demos")])
    np.testing.assert_array_equal(open_dataset(tmp_path / "dataset").columns()["action"], actions)


def test_a_whole_suture_is_driven_with_one_gamepad_and_changes_arms(tmp_path):
    assert (
        play(
            tmp_path / "demos", GamepadOperator, TaskConfig("suture", max_steps=2000), speed=1.0
        ).kept
        == 1
    )
    demo = read_demo(list_demos(tmp_path / "demos")[0])
    assert np.unique(demo.phase).tolist() == [0, 1, 2, 3, 4]
    assert demo.success[-1]


def test_randomised_and_delayed_envs_are_driven_too(tmp_path):
    config = TaskConfig(
        "grasp", max_steps=600, randomisation=RandomisationConfig(needle_thickness=0.1, latency=2)
    )
    assert play(tmp_path / "demos", GamepadOperator, config, speed=1.0).kept == 1
