"""Demonstrations: store and record, on the stand-in environment (two noise tests: the real one)."""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from fake_env import FakeEnv, FakeExpert
from shown import showing

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import (
    BadFile,
    InputError,
    OutputExists,
    PhysicsError,
    SurgicaiError,
)
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.files import write_json
from surgicai_vision.demos import record as recording
from surgicai_vision.demos import store
from surgicai_vision.demos.disturbance import AIM_STEPS, Disturbance
from surgicai_vision.demos.expert import Expert, WorldState
from surgicai_vision.demos.record import record
from surgicai_vision.demos.rollout import rollout
from surgicai_vision.demos.search_expert import SearchExpert
from surgicai_vision.demos.store import (
    Demo,
    list_demos,
    read_demo,
    read_marker,
    write_demo,
    write_marker,
)
from surgicai_vision.envs.geometry import grasp_in_needle
from surgicai_vision.scene import needle

CONFIG = TaskConfig(max_steps=12)


@pytest.fixture
def fake(monkeypatch):
    """Record from the stand-in environment, in this process."""
    monkeypatch.setattr(recording, "_env", lambda config: FakeEnv(config))
    monkeypatch.setattr(recording, "make_demonstrator", lambda name, env, *_: FakeExpert(env))


@pytest.fixture
def demo():
    env = FakeEnv(CONFIG)
    return rollout(env, FakeExpert(env), 3).demo


def test_write_read_returns_the_same_demo(tmp_path, demo):
    again = read_demo(write_demo(tmp_path, 7, demo))
    for field in dataclasses.fields(Demo):
        one, two = getattr(demo, field.name), getattr(again, field.name)
        if isinstance(one, np.ndarray):
            assert one.dtype == two.dtype
            np.testing.assert_array_equal(one, two)
        else:
            assert one == two
    assert [path.name for path in tmp_path.iterdir()] == ["episode_000007.safetensors"]


def test_noise_is_executed_and_the_label_is_the_experts(tmp_path):
    env = FakeEnv(CONFIG)
    noisy = rollout(env, FakeExpert(env), 3, disturbance=Disturbance(noise=0.2)).demo
    again = read_demo(write_demo(tmp_path, 0, noisy))
    np.testing.assert_array_equal(again.executed, noisy.executed)
    difference = noisy.executed - noisy.action
    assert (difference[:, 1:6].std(axis=0) > 0).all()
    assert (difference[:, 6] == 0).all(), "the jaw is done as meant"
    assert np.abs(noisy.executed).max() <= 1.0
    env.reset(seed=3)
    for state, label, executed in zip(noisy.state, noisy.action, noisy.executed, strict=False):
        np.testing.assert_array_equal(env.get_state(), state)
        np.testing.assert_array_equal(FakeExpert(env).action(), label)
        env.step(executed)
    np.testing.assert_array_equal(
        rollout(env, FakeExpert(env), 3, disturbance=Disturbance(0.2)).demo.state, noisy.state
    )


def test_each_episode_draws_its_own_noise_within_the_range():
    env = FakeEnv(CONFIG)
    spread = Disturbance(0.6, noise_from=0.1)
    demos = [rollout(env, FakeExpert(env), seed, disturbance=spread).demo for seed in range(12)]
    off = [np.abs(demo.executed - demo.action)[:, 1:6].mean() for demo in demos]
    assert max(off) > 1.5 * min(off) > 0, "episodes differ in their noise"
    even = [
        rollout(env, FakeExpert(env), seed, disturbance=Disturbance(0.6)).demo for seed in range(12)
    ]
    assert np.mean(off) < np.mean(
        [np.abs(demo.executed - demo.action)[:, 1:6].mean() for demo in even]
    )


def test_the_range_of_noise_reaches_the_recording(tmp_path):
    """Regression: the jobs got only the largest noise."""
    config = TaskConfig("grasp", max_steps=100)
    calm = record(
        config, episodes=2, out=tmp_path / "a", disturbance=Disturbance(0.6, noise_from=0.0)
    )
    loud = record(config, episodes=2, out=tmp_path / "b", disturbance=Disturbance(0.6))
    for one, other in zip(calm, loud, strict=True):
        one, other = read_demo(one), read_demo(other)
        assert one.seed == other.seed and not np.array_equal(one.executed, other.executed)


def test_open_jaws_have_noise_of_their_own_and_closing_ones_none(tmp_path):
    """A random walk of closed jaws would drop the needle."""
    config = TaskConfig("handoff")
    given = {"seed": 3, "out": tmp_path, "context": RunContext(0)}
    demos = {}
    for name, disturbance in (("calm", Disturbance(0.3)), ("loud", Disturbance(0.3, jaw_noise=1))):
        request = {**given, "out": tmp_path / name, "disturbance": disturbance}
        demos[name] = read_demo(record(config, episodes=1, **request)[0])
    calm, loud = ((demo.action[:, 6], demo.executed[:, 6]) for demo in demos.values())
    np.testing.assert_array_equal(*calm)
    labels, executed = loud
    closing = labels == -1.0
    assert closing.any() and not closing.all()
    np.testing.assert_array_equal(executed[closing], labels[closing])
    assert 0.5 < (executed - labels)[~closing].std() <= 1.0, "clipped to the range of an action"
    # The label corrects the noise of the step before: that is its purpose.
    both = ~closing[1:] & ~closing[:-1]
    did, answered = (executed - labels)[:-1][both], labels[1:][both]
    assert np.corrcoef(did, answered)[0, 1] < -0.5
    stored = [read_marker(tmp_path / name)["request"] for name in ("calm", "loud")]
    assert "jaw_noise" not in stored[0] and stored[1]["jaw_noise"] == 1


def past_the_aims(demo: Demo) -> np.ndarray:
    """Return how far the tool is past an attempt's aim at the end of each period [m]."""
    env = envs.make(demo.config)
    env.reset(seed=demo.seed)
    past = []
    for attempt, step in enumerate(range(99, len(demo), AIM_STEPS)):
        env.set_state_vector(demo.state[step])
        world = WorldState(env)
        aim = math.radians(SearchExpert.ATTEMPTS[attempt])
        goal = world.needle @ grasp_in_needle(world.arm, aim)
        past.append((world.tip - goal)[:3, 3] @ world.needle[:3, :3] @ needle.tangent(aim))
    return np.array(past)


def test_a_tool_that_aims_past_the_grasp_is_shown_the_way_back():
    """Noise of single steps leaves a tool near its aim; a missed aim does not, in some periods."""
    env = envs.make(TaskConfig("grasp"))
    disturbances = (Disturbance(0.3), Disturbance(0.3, aim_noise=2.0))
    calm, missing = (
        rollout(env, SearchExpert(env), 7, "search", disturbance).demo
        for disturbance in disturbances
    )
    assert np.abs(past_the_aims(calm)).max() < 0.0007
    off = np.abs(past_the_aims(missing))
    assert off.max() > 0.0015 > 0.0007 > off.min()


@pytest.mark.parametrize(("task", "demonstrator"), [("grasp", SearchExpert), ("handoff", Expert)])
def test_labels_and_jaws_stay_right_where_the_tool_misses(task, demonstrator):
    env = envs.make(TaskConfig(task))
    demo = rollout(env, demonstrator(env), 7, disturbance=Disturbance(aim_noise=2.0)).demo
    missed = np.abs(demo.executed[:, :6] - demo.action[:, :6]).max(axis=1) > 0.01
    assert AIM_STEPS / 2 <= missed.sum() < len(demo) - AIM_STEPS / 2
    np.testing.assert_array_equal(demo.executed[:, 6], demo.action[:, 6])
    for step in range(0, len(demo), 7):
        env.set_state_vector(demo.state[step])
        np.testing.assert_array_equal(demonstrator(env).action(), demo.action[step])


def test_a_needle_that_is_pressed_beside_the_entry_is_lifted_off_and_lined_up_again():
    """Without it no demonstration shows the tip on the tissue beside the opening, 1.9 mm wide."""
    with envs.make(TaskConfig("insert"), obs_type="state") as env:
        calm, missing = (
            [rollout(env, Expert(env), seed, disturbance=disturbance) for seed in range(8)]
            for disturbance in (Disturbance(0.3), Disturbance(0.3, aim_noise=2.0))
        )
        assert all(one.success for one in calm)
        assert all(_beside_the_entry(env, one.demo) < 1.9e-3 for one in calm)
        recovered = [one for one in missing if one.success]
        assert sum(_beside_the_entry(env, one.demo) > 1.9e-3 for one in recovered) >= 3


def _beside_the_entry(env: envs.SuturingEnv, demo: Demo) -> float:
    """Return how far beside the entry the tip is at most where it touches the tissue [m]."""
    most = 0.0
    for state in demo.state:
        env.set_state_vector(state)
        world = WorldState(env)
        tip = (world.needle @ np.append(needle.point(world.stitch.tip_angle), 1.0))[:3]
        entry = world.stitch.pair.entry
        x, y, z = entry.rotation.T @ (tip - np.asarray(entry.centre))
        if z < 0.25e-3 and not world.task_state.holes_passed:
            most = max(most, math.hypot(x, y))
    return most


def test_where_nothing_can_be_missed_no_tool_misses(tmp_path):
    for task, demonstrator, told in (
        ("place", "expert", "no goal to miss"),
        ("suture", "recover", "'recover' cannot aim beside"),
    ):
        with pytest.raises(InputError, match=told):
            record(
                TaskConfig(task),
                episodes=1,
                out=tmp_path / task,
                demonstrator=demonstrator,
                disturbance=Disturbance(aim_noise=1.0),
            )
        assert not (tmp_path / task).exists()


def test_an_episode_goes_on_after_its_success():
    env = FakeEnv(CONFIG)
    plain = rollout(env, FakeExpert(env), 3).demo
    longer = rollout(env, FakeExpert(env), 3, post_success_steps=4).demo
    assert len(longer.action) == len(plain.action) + 4
    np.testing.assert_array_equal(longer.state[: len(plain.state)], plain.state)
    assert (
        not longer.success[: len(plain.action) - 1].any() and longer.success[len(plain.action) - 1]
    )
    short = FakeEnv(dataclasses.replace(CONFIG, max_steps=len(plain.action) + 1))
    assert (
        len(rollout(short, FakeExpert(short), 3, post_success_steps=4).demo.action)
        == len(plain.action) + 1
    ), "up to the limit"


class Patient(FakeEnv):
    """An env that reports no success while a push lasts, and counts its steps over all resets."""

    taken = 0

    def step(self, action):
        self.taken += 1
        seen, reward, success, truncated, info = super().step(action)
        success &= self.state[2] > 25
        return seen, reward, success, truncated, {**info, "is_success": success}


def test_a_recovery_starts_elsewhere_and_its_push_is_not_recorded():
    env = Patient(dataclasses.replace(CONFIG, max_steps=60))
    disturbance = Disturbance(perturb_start_fraction=0.5)
    pushes = []
    for seed in range(20):
        env.taken = 0
        demo = rollout(env, FakeExpert(env), seed, disturbance=disturbance).demo
        pushes.append(env.taken - len(demo))
        assert (demo.state[0, 1] != 0.0) == (pushes[-1] > 0)
        assert demo.state[0, 2] == 0, "steps count from the first state that is recorded"
    assert 4 <= sum(push > 0 for push in pushes) <= 16
    assert {push for push in pushes if push} <= set(range(8, 26))
    # A push that ends the episode is undone: the start stays as it was.
    short = FakeEnv(CONFIG)
    for seed in range(20):
        start = rollout(
            short, FakeExpert(short), seed, disturbance=Disturbance(perturb_start_fraction=1.0)
        ).demo.state[0, 2]
        assert start < CONFIG.max_steps


@pytest.mark.parametrize(
    "wrong",
    [
        {"noise": -0.1},
        {"noise": float("nan")},
        {"perturb_start_fraction": 1.1},
        {"jaw_noise": 1.1},
        {"jaw_noise": float("nan")},
        {"aim_noise": 5.1},
        {"aim_noise": float("nan")},
        {"noise_from": 0.1},
    ],
)
def test_a_senseless_disturbance_is_refused(wrong):
    with pytest.raises(InputError, match="within 0 and"):
        Disturbance(**wrong)


def test_disturbed_recordings_are_another_request(tmp_path, fake):
    calm = record(CONFIG, episodes=2, out=tmp_path / "calm", seed=1, context=RunContext(0))
    disturbed = Disturbance(noise=0.1)
    noisy = record(
        CONFIG,
        episodes=2,
        out=tmp_path / "noisy",
        seed=1,
        context=RunContext(0),
        disturbance=disturbed,
    )
    assert read_demo(calm[0]).executed is None
    assert read_demo(noisy[0]).executed is not None
    assert "noise" not in read_marker(tmp_path / "calm")["request"]
    assert read_marker(tmp_path / "noisy")["request"]["noise"] == 0.1
    with pytest.raises(OutputExists):
        record(CONFIG, episodes=2, out=tmp_path / "noisy", seed=1, context=RunContext(0))


def test_demo_refuses_bad_lengths_quoting_both(demo):
    with pytest.raises(InputError, match=f"{len(demo)} states and {len(demo)} actions"):
        dataclasses.replace(demo, state=demo.state[:-1])
    with pytest.raises(InputError, match=f"2 of reward and {len(demo)} actions"):
        dataclasses.replace(demo, reward=demo.reward[:2])
    with pytest.raises(InputError, match="it must be float32"):
        dataclasses.replace(demo, action=demo.action.astype(np.float64))
    with pytest.raises(InputError, match=r"it must be .* float32"):
        dataclasses.replace(demo, executed=demo.action[:-1])
    with pytest.raises(InputError, match="not finite"):
        dataclasses.replace(demo, state=np.full_like(demo.state, np.nan))


@pytest.mark.parametrize("spoil", ["empty", "half", "text", "flipped", "unrelated"])
def test_damaged_episode_is_a_bad_file(tmp_path, demo, spoil):
    path = write_demo(tmp_path, 0, demo)
    content = path.read_bytes()
    header = json.dumps({"x": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}).encode()
    path.write_bytes(
        {
            "empty": b"",
            "half": content[: len(content) // 2],
            "text": b"hello",
            "flipped": content.replace(b"surgicai-vision-demos", b"surgicai-vision-demoz"),
            "unrelated": len(header).to_bytes(8, "little") + header + bytes(4),
        }[spoil]
    )
    with pytest.raises(BadFile) as caught:
        read_demo(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_demonstrations_of_release_0_1_are_refused_in_one_line(tmp_path, demo, monkeypatch):
    write_json(
        tmp_path / "demos.json",
        {"format": "surgicai-vision-demos", "version": 1, "task": "grasp", "source": "expert"},
    )
    monkeypatch.setattr(store, "VERSION", 1)
    path = write_demo(tmp_path, 0, demo)
    monkeypatch.undo()
    for read, file in ((read_marker, tmp_path), (list_demos, tmp_path), (read_demo, path)):
        with pytest.raises(BadFile, match=r"was written by release 0\.1; .* again\.$") as caught:
            read(file)
        assert "\n" not in str(caught.value)


def test_folder_without_marker_or_with_a_gap_is_refused(tmp_path, demo):
    with pytest.raises(BadFile, match="not a folder of demonstrations"):
        list_demos(tmp_path)
    write_marker(tmp_path, "grasp", "expert")
    with pytest.raises(BadFile, match="no episodes"):
        list_demos(tmp_path)
    write_demo(tmp_path, 1, demo)
    with pytest.raises(BadFile, match="episode 0 is missing"):
        list_demos(tmp_path)


def test_record_skips_failed_seeds_and_writes_them_down(tmp_path, fake):
    seen = []
    paths = record(
        CONFIG,
        episodes=6,
        seed=0,
        out=tmp_path / "demos",
        context=RunContext(0, stage=showing(lambda *row: seen.append(row))),
    )
    demos = [read_demo(path) for path in paths]
    skipped = [row["seed"] for row in read_marker(tmp_path / "demos")["skipped"]]
    assert len(demos) == 6
    assert all(demo.success[-1] and not demo.success[:-1].any() for demo in demos)
    assert skipped, "the stand-in expert fails at some of these starts"
    assert sorted([demo.seed for demo in demos] + skipped) == list(range(6 + len(skipped)))
    assert seen[-1] == (6, 6, "episodes")
    assert [path.name for path in tmp_path.iterdir()] == ["demos"]


def test_a_start_that_cannot_be_made_is_skipped(tmp_path, fake, monkeypatch):
    reset = FakeEnv.reset

    def sometimes(self, *, seed=None, options=None):
        if seed == 1:
            raise PhysicsError("No start of 'grasp' was physical in 20 draws.")
        return reset(self, seed=seed)

    monkeypatch.setattr(FakeEnv, "reset", sometimes)
    paths = record(CONFIG, episodes=3, seed=0, out=tmp_path / "demos", context=RunContext(0))
    assert 1 not in [read_demo(path).seed for path in paths]
    skipped = {row["seed"]: row["reason"] for row in read_marker(tmp_path / "demos")["skipped"]}
    assert skipped[1] == "No start of 'grasp' was physical in 20 draws."


@pytest.mark.parametrize(
    "goes_on", [{"post_success_steps": 10}, {"demonstrator": "search"}], ids=str
)
def test_demonstrations_that_go_on_hold_no_actions(goes_on, tmp_path):
    """An env holds no action beyond a success: their timestamps would be wrong."""
    held = TaskConfig("grasp", action_repeat=2)
    with pytest.raises(InputError, match="go on after their success"):
        record(held, episodes=1, out=tmp_path / "out", context=RunContext(0), **goes_on)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("demonstrator", ["expert", "search", "recover"])
def test_a_procedure_that_waits_to_be_told_is_refused(demonstrator, tmp_path):
    """Its env would stay in the grasp until every episode has reached its limit."""
    told = TaskConfig(names.SUTURE, advance="told")
    with pytest.raises(InputError, match=r"[Ll]eave env\.advance out"):
        record(
            told,
            episodes=1,
            out=tmp_path / "out",
            demonstrator=demonstrator,
            context=RunContext(0),
        )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("held", "moves"), [(1, 8), (2, 4), (3, 3)])
def test_a_perturbed_start_is_as_far_off_however_long_an_action_is_held(held, moves):
    taken = []

    class Env:
        config = TaskConfig("grasp", action_repeat=held)
        simulation = SimpleNamespace(task_state=SimpleNamespace(steps=3, tip_path=1.0))

        def step(self, action):
            taken.append(action)
            return None, 0.0, False, False, {}

    class Least:
        def random(self):
            return 0.0

        def uniform(self, low, high, size):
            return np.full(size, high)

        def integers(self, low, high, endpoint):
            return low

    assert Disturbance(perturb_start_fraction=1.0).perturb_start(Env(), Least())
    assert len(taken) == moves and Env.simulation.task_state.steps == 0


def test_record_again_does_nothing_and_another_request_is_refused(tmp_path, fake, monkeypatch):
    out = tmp_path / "demos"
    first = record(CONFIG, episodes=2, out=out, context=RunContext(0))
    before = [path.stat().st_mtime_ns for path in first]
    monkeypatch.setattr(recording, "_env", None)
    assert record(CONFIG, episodes=2, out=out, context=RunContext(0)) == first
    assert [path.stat().st_mtime_ns for path in first] == before
    with pytest.raises(OutputExists, match="another command"):
        record(CONFIG, episodes=3, out=out, context=RunContext(0))


def test_a_folder_from_before_the_config_gained_a_field_is_the_same(tmp_path, fake):
    out = tmp_path / "demos"
    first = record(CONFIG, episodes=2, out=out, context=RunContext(0))
    marker = read_marker(out)
    del marker["request"]["task"]["scene"]["ink"]
    write_json(out / "demos.json", marker)
    assert record(CONFIG, episodes=2, out=out, context=RunContext(0)) == first
    marker["request"]["task"]["scene"]["ink"] = "due"
    write_json(out / "demos.json", marker)
    with pytest.raises(OutputExists, match="another command"):
        record(CONFIG, episodes=2, out=out, context=RunContext(0))
    marker["request"]["task"]["scene"]["unknown"] = 1
    write_json(out / "demos.json", marker)
    with pytest.raises(OutputExists, match="another command"):
        record(CONFIG, episodes=2, out=out, context=RunContext(0))


def test_record_continues_where_it_was_stopped(tmp_path, fake, monkeypatch):
    record(CONFIG, episodes=4, out=tmp_path / "whole", context=RunContext(0))
    calls = []

    def stop(done, total, unit):
        calls.append(done)
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(
            CONFIG, episodes=4, out=tmp_path / "demos", context=RunContext(0, stage=showing(stop))
        )
    assert not (tmp_path / "demos").exists()
    paths = record(CONFIG, episodes=4, out=tmp_path / "demos", context=RunContext(0))
    for one, two in zip(list_demos(tmp_path / "whole"), paths, strict=True):
        assert one.read_bytes() == two.read_bytes()


def test_record_gives_up_on_an_expert_that_fails(tmp_path, fake, monkeypatch):
    monkeypatch.setattr(FakeExpert, "action", lambda self: np.zeros(7, np.float32))
    with pytest.raises(
        SurgicaiError, match=r"succeeded at 0 of \d+ starts of grasp; 2 were requested \(seed 0: no"
    ):
        record(CONFIG, episodes=2, out=tmp_path / "demos", context=RunContext(0))


@pytest.mark.parametrize(("episodes", "seed"), [(0, 0), (-3, 0), (1, -1)])
def test_record_refuses_senseless_numbers(tmp_path, episodes, seed):
    with pytest.raises(
        InputError, match=f"episodes is {episodes}, seed {seed}, post_success_steps 0"
    ):
        record(CONFIG, episodes=episodes, seed=seed, out=tmp_path / "demos")


def test_record_keeps_away_from_starts_that_are_counted_on(tmp_path, fake, monkeypatch):
    out = tmp_path / "demos"
    for seed in (names.VALIDATION_SEED, names.TEST_SEED + 7):
        with pytest.raises(InputError, match=f"seed {seed} on.*give a smaller --seed"):
            record(CONFIG, episodes=1, seed=seed, out=out)
    assert not list(tmp_path.iterdir())
    last = names.VALIDATION_SEED - 1
    (path,) = record(CONFIG, episodes=1, seed=last, out=out, context=RunContext(0))
    assert read_demo(path).seed == last
    monkeypatch.setattr(FakeExpert, "action", lambda self: np.zeros(7, np.float32))
    with pytest.raises(SurgicaiError, match=f"starts end at {last}, and 0 of 1"):
        record(CONFIG, episodes=1, seed=last, out=tmp_path / "failed", context=RunContext(0))
