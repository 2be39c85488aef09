"""Recovery: the expert returns to the subtask that was undone; what it records."""

import dataclasses
import itertools
import json

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos import rollout as rollout_module
from surgicai_vision.demos.demonstrator import make_demonstrator
from surgicai_vision.demos.disturbance import Disturbance
from surgicai_vision.demos.expert import Expert
from surgicai_vision.demos.record import record
from surgicai_vision.demos.recovery_expert import LOST, RecoveryExpert
from surgicai_vision.demos.rollout import Rollout, rollout
from surgicai_vision.demos.store import read_demo, read_marker
from surgicai_vision.envs.upset import UpsetPlan
from surgicai_vision.training.visits import find_visits, subtasks_due

SUTURE = TaskConfig(names.SUTURE)


def visits(phases: np.ndarray) -> list[int]:
    return [phase for phase, _ in itertools.groupby(phases.tolist())]


def upset_rollout(monkeypatch: pytest.MonkeyPatch, plan: UpsetPlan, seed: int) -> Rollout:
    monkeypatch.setattr(rollout_module, "plan_upset", lambda *_: plan)
    env = envs.make(SUTURE)
    return rollout(env, RecoveryExpert(env), seed, "recover", Disturbance(upset_fraction=1.0))


@pytest.mark.parametrize(
    ("plan", "expected"),
    [
        (UpsetPlan("push", 30, 1.0), [0, 1, 2, 3, 4]),
        (UpsetPlan("drop", 20, 0.0), [0, 1, 0, 1, 2, 3, 4]),
        (UpsetPlan("drop", 70, 0.0), [0, 1, 0, 1, 2, 3, 4]),
        (UpsetPlan("insertion", 43, 0.0), [0, 1, 2, 0, 1, 2, 3, 4]),
        (UpsetPlan("handoff", 8, 0.0), [0, 1, 2, 3, 4]),
    ],
    ids=lambda value: f"{value.kind}-{value.wait}" if isinstance(value, UpsetPlan) else "",
)
def test_it_goes_back_to_what_was_lost_and_ends_the_procedure(monkeypatch, plan, expected):
    result = upset_rollout(monkeypatch, plan, 2)
    assert result.success, result.reason
    assert result.upset == plan.kind
    assert visits(result.demo.phase) == expected
    # The stored states are those the labels belong to, also where a subtask is entered.
    size = result.demo.state.shape[1]
    env = envs.make(SUTURE)
    env.reset(seed=2)
    assert env.get_state().shape == (size,)
    changes = np.flatnonzero(np.diff(result.demo.phase)) + 1
    for step in (0, *changes):
        env.set_state_vector(result.demo.state[step])
        assert env.phase == result.demo.phase[step]
    opened = (result.demo.executed != result.demo.action).any(axis=1)
    assert opened.sum() == (0 if plan.kind == "push" else 6)


def test_undisturbed_it_is_the_expert_but_for_the_goal_of_the_grasp():
    env = envs.make(SUTURE)
    env.reset(seed=1)
    expert = Expert(env)
    recover = make_demonstrator("recover", env)
    labels = []
    ended = False
    info: dict[str, object] = {}
    while not ended:
        labels.append(recover.action())
        if env.phase != 0:
            np.testing.assert_array_equal(labels[-1], expert.label())
        _, _, terminated, truncated, info = env.step(labels[-1])
        ended = terminated or truncated
    assert info["is_success"] and recover.gives_up == ""
    # The grasp does not use its goal.
    for goal in (5.0, 20.0):
        env.reset(seed=1)
        env.simulation.task_state.grasp_angle = np.radians(goal)
        recover = make_demonstrator("recover", env)
        for label in labels[:120]:
            np.testing.assert_array_equal(recover.action(), label)
            env.step(label)
        assert env.phase == 1


def test_it_gives_up_where_no_way_leads_on(monkeypatch):
    """It does not look for a needle off the phantom until the episode's limit."""
    env = envs.make(SUTURE)
    env.reset(seed=1)
    recover = RecoveryExpert(env)
    env.simulation.pose_needle((0.0, 0.3, 0.1, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    env.simulation.refresh()
    steps = 0
    while not recover.gives_up:
        env.step(recover.action())
        steps += 1
    assert steps < SUTURE.max_steps / 2 and "grasp" in recover.gives_up


def test_it_needs_the_whole_procedure(tmp_path):
    with pytest.raises(InputError, match="Give task suture"):
        make_demonstrator("recover", envs.make(TaskConfig("grasp")))
    for config, wanted in (
        (TaskConfig("grasp"), "Give task suture"),
        (TaskConfig("suture", advance="told"), "Leave env.advance out"),
    ):
        with pytest.raises(InputError, match=wanted):
            record(config, episodes=1, out=tmp_path / "demos", demonstrator="recover")
        assert not list(tmp_path.iterdir())  # refused before any work


def test_recordings_say_what_went_wrong_and_repeat_themselves(tmp_path):
    config = dataclasses.replace(SUTURE)
    wrong = Disturbance(noise=0.2, upset_fraction=0.5)
    request = {"episodes": 3, "demonstrator": "recover", "disturbance": wrong, "seed": 40}
    paths = record(config, out=tmp_path / "a", **request)
    again = record(config, out=tmp_path / "b", **request)
    assert [path.read_bytes() for path in paths] == [path.read_bytes() for path in again]
    marker = read_marker(tmp_path / "a")
    assert marker["request"]["upset_fraction"] == 0.5
    upset = sum(count["episodes"] for count in marker["upsets"].values())
    assert 0 < upset <= 3 + len(marker["skipped"])
    assert read_demo(paths[0]).executed is not None
    assert json.dumps(marker["upsets"])


def test_late_it_goes_on_with_nothing_in_its_jaws_and_the_label_says_to_go_back(tmp_path):
    """Frames between the loss and the return are labelled with what is due, not what is done."""
    late = {}
    for steps in (0, 40):
        wrong = Disturbance(noise=0.2, upset_fraction=1.0, late=steps)
        request = {"episodes": 3, "demonstrator": "recover", "disturbance": wrong, "seed": 60}
        found = []
        for path in record(SUTURE, out=tmp_path / str(steps), **request):
            demo = read_demo(path)
            found.append(frames_without_needle(demo))
        late[steps] = found
        assert read_marker(tmp_path / str(steps))["request"].get("late", 0) == steps
    lengths = {steps: [len(due) for due in found] for steps, found in late.items()}
    assert max(lengths[0]) <= LOST < max(lengths[40]) <= LOST + 40
    for due in late[40]:
        assert set(due) <= {0}, "not every frame without the needle asks for a grasp"


def frames_without_needle(demo):
    """Return the subtasks due in the frames after the loss in a broken-off place or insert."""
    phase = demo.phase.astype(int)
    episode = np.zeros(len(phase), int)
    due = subtasks_due(phase, np.arange(len(phase)), episode, contact=demo.contact)
    found = find_visits(phase, episode)
    rows = []
    for visit in np.flatnonzero(~found.is_finished):
        if phase[found.first[visit]] in (1, 2):
            whole = np.arange(found.first[visit], found.last[visit] + 1)
            rows.extend(whole[np.flatnonzero(demo.contact[whole])[-1] + 1 :])
    return due[rows]


def test_who_goes_back_to_nothing_is_never_late(tmp_path):
    with pytest.raises(InputError, match="late is 9, but demonstrator 'expert'"):
        record(SUTURE, episodes=1, out=tmp_path / "a", disturbance=Disturbance(late=9))
    with pytest.raises(InputError, match="late is -1"):
        Disturbance(late=-1)
    assert not (tmp_path / "a").exists()


def test_upsets_are_refused_before_any_work(tmp_path):
    with pytest.raises(InputError, match="upset_fraction is 2"):
        Disturbance(upset_fraction=2.0)
