"""Cutting whole procedures: a subtask's visits, as demonstrations of the subtask."""

import dataclasses
import functools
import json
import multiprocessing
import os

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import DWELL, TaskConfig
from surgicai_vision.core.errors import InputError, OutputExists, UnknownName
from surgicai_vision.dataset import open_dataset, render_demos
from surgicai_vision.demos import cut
from surgicai_vision.demos.cut import SHORTEST, cut_demos, visits
from surgicai_vision.demos.expert import Expert
from surgicai_vision.demos.record import record
from surgicai_vision.demos.rollout import rollout
from surgicai_vision.demos.store import list_demos, read_demo, read_marker, write_demo, write_marker

GRASP, PLACE, INSERT = range(3)
LENGTHS = ((GRASP, 9), (PLACE, 12), (GRASP, 8), (PLACE, 7), (INSERT, 3), (GRASP, 6))
"""Visits of a procedure that returns to the grasp twice: (phase, control steps)."""


@pytest.fixture(scope="module")
def procedures(tmp_path_factory):
    """Two whole procedures by the expert."""
    out = tmp_path_factory.mktemp("procedures") / "demos"
    record(TaskConfig(names.SUTURE), episodes=2, out=out)
    return out


@pytest.fixture
def broken(procedures):
    """A procedure with the visits in `LENGTHS`; its jaws hold nothing from step 15 to step 20."""
    demo = read_demo(list_demos(procedures)[0])
    phase = np.concatenate([np.full(length, phase, np.int8) for phase, length in LENGTHS])
    steps = len(phase)
    contact = np.ones(steps, bool)
    contact[15:21] = False
    return dataclasses.replace(
        demo,
        state=demo.state[: steps + 1],
        action=demo.action[:steps],
        phase=phase,
        reward=demo.reward[:steps],
        success=demo.success[:steps],
        contact=contact,
        executed=demo.action[:steps] * 0.5,
    )


def test_every_visit_is_a_slice_of_the_procedure(broken):
    first, second, third = visits(broken, "grasp")
    for visit, at, length in ((first, 0, 9), (second, 21, 8), (third, 39, 6)):
        rows = slice(at, at + length)
        assert visit.config == dataclasses.replace(broken.config, task="grasp", max_steps=200)
        np.testing.assert_array_equal(visit.state, broken.state[at : at + length + 1])
        np.testing.assert_array_equal(visit.action, broken.action[rows])
        np.testing.assert_array_equal(visit.executed, broken.executed[rows])
        np.testing.assert_array_equal(visit.contact, broken.contact[rows])


def test_what_came_after_an_unnoticed_loss_is_left_out(broken):
    first, second = visits(broken, "place")
    assert len(first) == 15 - 9, "it went on for six steps without the needle"
    assert len(second) == 7, "it was finished"
    np.testing.assert_array_equal(first.action, broken.action[9:15])
    lost = dataclasses.replace(broken, contact=np.zeros_like(broken.contact))
    assert [len(visit) for visit in visits(lost, "place")] == [7]
    assert SHORTEST > 3 and not visits(broken, "insert"), "too short to be seen"


def test_the_visits_of_all_subtasks_make_up_a_procedure(procedures):
    whole = read_demo(list_demos(procedures)[0])
    parts = [visit for subtask in names.SUBTASKS for visit in visits(whole, subtask)]
    np.testing.assert_array_equal(np.concatenate([part.action for part in parts]), whole.action)


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_reward_and_success_are_the_subtasks_own(reward):
    """A subtask goes on for `DWELL` steps after its success; the last one ends the procedure."""
    env = envs.make(TaskConfig(names.SUTURE, reward=reward))
    whole = rollout(env, Expert(env), 1).demo
    for subtask in names.SUBTASKS[:-1]:
        (visit,) = visits(whole, subtask)
        assert np.flatnonzero(visit.success).tolist() == list(range(len(visit)))[-DWELL:]
        recorded = whole.reward[whole.phase == names.SUBTASKS.index(subtask)]
        expected = visit.success - 1.0 if reward == "sparse" else recorded
        np.testing.assert_array_equal(visit.reward, expected.astype(np.float32))
    (last,) = visits(whole, names.SUBTASKS[-1])
    np.testing.assert_array_equal(last.success, whole.success[-len(last) :])
    np.testing.assert_array_equal(last.reward, whole.reward[-len(last) :])
    with pytest.raises(InputError, match="recorded in another scene"):
        visits(dataclasses.replace(whole, scene_hash="0" * 64), "grasp")


def test_cut_demonstrations_are_rendered_beside_a_subtasks_own(procedures, tmp_path, capsys):
    own = tmp_path / "own"
    record(TaskConfig("place"), episodes=1, out=own)
    out = tmp_path / "visits"
    command = ("cut-demos", "--demos", str(procedures), "--subtask", "place", "--out", str(out))
    assert main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["visits"] == 2
    marker = read_marker(out)
    assert (marker["task"], marker["demonstrator"], marker["episodes"]) == ("place", "expert", 2)
    render_demos([own, out], tmp_path / "dataset", views=("back",), size=32, frame_stride=10)
    dataset = open_dataset(tmp_path / "dataset")
    assert dataset.task == "place" and len(dataset.bounds()) == 3
    begin, _ = dataset.bounds()[1]
    env = envs.make(
        TaskConfig("place"), obs_type="pixels_agent_pos", cameras=("back",), image_size=32
    )
    env.set_state_vector(read_demo(list_demos(out)[0]).state[0])
    shown = dataset.columns()[names.STATE][begin]
    np.testing.assert_allclose(shown, env.observe()["agent_pos"], atol=1e-6)


def test_a_finished_folder_is_left_as_it_is_and_another_request_refused(procedures, tmp_path):
    out = tmp_path / "visits"
    paths = cut_demos(procedures, "insert", out=out)
    before = {path: path.stat().st_mtime_ns for path in paths}
    assert cut_demos(procedures, "insert", out=out) == paths
    assert {path: path.stat().st_mtime_ns for path in paths} == before
    with pytest.raises(OutputExists, match="another command"):
        cut_demos(procedures, "place", out=out)


def test_what_a_killed_cut_left_is_removed(broken, tmp_path, monkeypatch):
    whole = tmp_path / "whole"
    whole.mkdir()
    write_demo(whole, 0, broken)
    write_marker(whole, names.SUTURE, "expert")
    call = functools.partial(cut_demos, whole, "grasp", out=tmp_path / "visits")
    with monkeypatch.context() as killed:
        killed.setattr(cut, "write_marker", lambda *arguments, **details: os._exit(9))
        process = multiprocessing.get_context("fork").Process(target=call)
        process.start()
        process.join()
    assert process.exitcode == 9 and not (tmp_path / "visits").exists()

    assert len(call()) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["visits", "whole"]


def test_what_has_no_visits_is_refused(procedures, broken, tmp_path):
    with pytest.raises(UnknownName, match="'grasp'"):
        cut_demos(procedures, "grsp", out=tmp_path / "out")
    alone = tmp_path / "alone"
    record(TaskConfig("handoff"), episodes=1, out=alone)
    with pytest.raises(InputError, match="shows 'handoff'"):
        cut_demos(alone, "handoff", out=tmp_path / "out")
    short = tmp_path / "short"
    short.mkdir()
    write_demo(short, 0, broken)
    write_marker(short, names.SUTURE, "expert")
    with pytest.raises(InputError, match="no visit of 'insert'"):
        cut_demos(short, "insert", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
