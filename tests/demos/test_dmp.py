"""Movement primitives: reproduction, other starts and goals, and execution in the env."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgicai_vision import envs
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.executor import RunContext
from surgicai_vision.demos.dmp import fit
from surgicai_vision.demos.dmp.controller import DmpController
from surgicai_vision.demos.dmp.primitive import (
    PAUSE_SPEED,
    PAUSE_TURN_RATE,
    Execution,
    Motion,
    conjugate,
    exp_quaternion,
    fit_primitive,
    log_quaternion,
    multiply,
    without_pauses,
)
from surgicai_vision.demos.expert import Expert
from surgicai_vision.demos.imports.surgicai import import_demos
from surgicai_vision.demos.record import record
from surgicai_vision.demos.rollout import rollout
from surgicai_vision.demos.stitch_path import CLEARANCE, deviation_from_path, project
from surgicai_vision.demos.store import list_demos, read_demo, read_marker, write_demo
from surgicai_vision.envs import poses

AXIS = np.array([1.0, 2.0, 3.0]) / math.sqrt(14.0)


def motion(samples=60, dt=0.02, turn=2.5):
    """Return a curve of 50 mm and 2.5 rad, at rest at both ends; y ends where it began."""
    s = np.linspace(0.0, 1.0, samples)
    m = 10 * s**3 - 15 * s**4 + 6 * s**5
    bow = np.sin(np.pi * m)
    position = np.stack([0.05 * m, 0.01 * np.sin(2 * np.pi * m), 0.01 * bow - 0.02 * m], axis=1)
    turns = turn * m[:, None] * AXIS + np.stack([0.3 * bow, 0 * m, 0 * m], axis=1)
    return Motion(position, exp_quaternion(turns), dt)


def play(execution: Execution, dt: float, steps: int) -> Motion:
    positions, rotations = [execution.position.copy()], [execution.rotation.copy()]
    for _ in range(steps):
        execution.advance(dt)
        positions.append(execution.position.copy())
        rotations.append(execution.rotation.copy())
    return Motion(np.array(positions), np.array(rotations), dt)


def ends(demo):
    return demo.position[0], demo.rotation[0], demo.position[-1], demo.rotation[-1]


def apart(a, b):
    """Largest distance [m] and angle [rad] between two motions, sample by sample."""
    turns = log_quaternion(multiply(a.rotation, conjugate(b.rotation)))
    return np.linalg.norm(a.position - b.position, axis=1).max(), np.linalg.norm(
        turns, axis=1
    ).max()


@pytest.mark.parametrize(
    ("samples", "cut"),
    [(8, False), (20, False), (60, False), (200, False), (20, True), (60, True), (200, True)],
)
def test_reproduces_its_own_demonstration(samples, cut):
    whole = motion(samples)
    kept = slice(samples // 4, 3 * samples // 4) if cut else slice(None)
    demo = Motion(whole.position[kept], whole.rotation[kept], whole.dt)
    distance, angle = apart(
        play(fit_primitive([demo]).start(*ends(demo)), demo.dt, len(demo) - 1), demo
    )
    assert distance < 0.0003
    assert angle < math.radians(0.5)


def test_standard_scaling_loses_an_axis_without_amplitude():
    demo = motion()
    assert demo.position[0, 1] == pytest.approx(demo.position[-1, 1], abs=1e-12)
    played = play(fit_primitive([demo], scaled=True).start(*ends(demo)), demo.dt, len(demo) - 1)
    assert np.abs(played.position[:, 1]).max() < 1e-5 < 0.009 < np.abs(demo.position[:, 1]).max()
    assert np.abs(played.position[:, [0, 2]] - demo.position[:, [0, 2]]).max() < 0.0003
    double = fit_primitive([demo], scaled=True).start(
        demo.position[0], demo.rotation[0], 2 * demo.position[-1], demo.rotation[-1]
    )
    wide = play(double, demo.dt, len(demo) - 1)
    np.testing.assert_allclose(wide.position[:, [0, 2]], 2 * played.position[:, [0, 2]], atol=1e-4)


def test_another_start_and_goal_are_met_and_the_quaternion_stays_one():
    demo = motion()
    start, goal = np.array([0.01, -0.02, 0.005]), np.array([-0.03, 0.04, 0.02])
    turned = exp_quaternion(np.array([0.4, -0.9, 0.2]))
    execution = fit_primitive([demo]).start(
        start, exp_quaternion(np.array([0.2, 0.0, -0.3])), goal, turned
    )
    played = play(execution, demo.dt, len(demo) + 20)
    assert execution.done
    np.testing.assert_allclose(np.linalg.norm(played.rotation, axis=1), 1.0, atol=1e-12)
    assert np.linalg.norm(execution.position - goal) < 1e-4
    assert np.linalg.norm(
        log_quaternion(multiply(execution.rotation, conjugate(turned)))
    ) < math.radians(0.2)


def test_goal_may_move_on_the_way():
    demo = motion()
    execution = fit_primitive([demo]).start(*ends(demo))
    play(execution, demo.dt, 30)
    execution.set_goal(np.array([0.1, 0.0, 0.0]), demo.rotation[0])
    play(execution, demo.dt, 90)
    np.testing.assert_allclose(execution.position, [0.1, 0.0, 0.0], atol=1e-5)


def test_orientation_takes_the_short_way():
    demo = motion(turn=0.5)
    straight = dataclasses.replace(
        fit_primitive([demo]), weights=np.zeros((80, 6)), drift=np.zeros(6)
    )
    near = exp_quaternion(np.array([0.0, 0.0, 1.0]))
    for goal in (near, -near):  # the same rotation, with its quaternion of either sign
        played = play(
            straight.start(np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3), goal), demo.dt, 80
        )
        steps = log_quaternion(multiply(played.rotation[1:], conjugate(played.rotation[:-1])))
        assert np.linalg.norm(steps, axis=1).sum() == pytest.approx(1.0, abs=0.01)


def test_time_scales_and_the_path_stays():
    demo = motion()
    primitive = fit_primitive([demo])
    once = play(primitive.start(*ends(demo)), demo.dt, len(demo) - 1)
    slow = primitive.start(*ends(demo), duration=3 * primitive.duration)
    thrice = play(slow, 3 * demo.dt, len(demo) - 1)
    assert slow.done
    distance, angle = apart(once, thrice)
    assert distance < 1e-9
    assert angle < 1e-9
    with pytest.raises(InputError, match="duration is 0"):
        primitive.start(*ends(demo), duration=0)


def test_filter_drops_slow_samples_only():
    demo = motion()
    stopped = Motion(
        np.repeat(demo.position, 3, axis=0), np.repeat(demo.rotation, 3, axis=0), demo.dt
    )
    np.testing.assert_array_equal(without_pauses(stopped).position, without_pauses(demo).position)
    for speed, turn, kept in ((0.9, 0.9, 1), (1.1, 0.9, 10), (0.9, 1.1, 10)):
        time = 0.02 * np.arange(10)[:, None]
        position = time * speed * PAUSE_SPEED * np.array([[0.6, 0.8, 0.0]])
        rotation = exp_quaternion(time * turn * PAUSE_TURN_RATE * AXIS)
        assert len(without_pauses(Motion(position, rotation, 0.02))) == kept


def test_several_demonstrations_teach_their_mean():
    demo = motion()
    wide = Motion(demo.position * [1.0, 3.0, 1.0], demo.rotation, demo.dt)
    played = play(fit_primitive([demo, wide]).start(*ends(demo)), demo.dt, len(demo) - 1)
    assert np.abs(played.position - demo.position * [1.0, 2.0, 1.0]).max() < 0.0005


def test_refuses_what_is_no_motion():
    demo = motion()
    with pytest.raises(InputError, match=r"\(60, 3\) and rotations \(59, 4\)"):
        Motion(demo.position, demo.rotation[:-1], demo.dt)
    with pytest.raises(InputError, match="unit quaternions"):
        Motion(demo.position, 2 * demo.rotation, demo.dt)
    with pytest.raises(InputError, match="got 0 and 80"):
        fit_primitive([])


vectors = st.tuples(*[st.floats(-0.05, 0.05)] * 3).map(np.array)
turns = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


@settings(max_examples=15, deadline=None)
@given(shift=vectors, turn=turns, vector=turns)
def test_a_moved_demonstration_gives_the_moved_path(shift, turn, vector):
    """Fitting commutes with a change of frame; log is the inverse of exp."""
    np.testing.assert_allclose(log_quaternion(exp_quaternion(vector)), vector, atol=1e-12)
    demo, frame = motion(20), exp_quaternion(turn)
    matrix = np.stack(
        [
            log_quaternion(multiply(multiply(frame, exp_quaternion(axis)), conjugate(frame)))
            for axis in np.eye(3)
        ]
    )
    moved = Motion(
        demo.position @ matrix + shift,
        multiply(np.broadcast_to(frame, (20, 4)), demo.rotation),
        demo.dt,
    )
    here = play(fit_primitive([demo]).start(*ends(demo)), demo.dt, 19)
    there = play(fit_primitive([moved]).start(*ends(moved)), demo.dt, 19)
    np.testing.assert_allclose(there.position, here.position @ matrix + shift, atol=1e-9)
    back = log_quaternion(
        multiply(
            there.rotation, conjugate(multiply(np.broadcast_to(frame, (20, 4)), here.rotation))
        )
    )
    assert np.abs(back).max() < 1e-9


# -- in the env ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory):
    """One of the expert's demonstrations per subtask: {task: path}."""
    folder = tmp_path_factory.mktemp("demonstrated")
    paths = {}
    for task in envs.SUBTASKS:
        env = envs.make(TaskConfig(task))
        rollouts = (rollout(env, Expert(env), seed) for seed in range(10))
        (folder / task).mkdir()
        paths[task] = write_demo(
            folder / task, 0, next(one.demo for one in rollouts if one.success)
        )
    return paths


def test_jaws_that_stay_closed_after_the_success_change_nothing():
    """Regression: they counted as jaws that open, and closed jaws were learned."""
    env = envs.make(TaskConfig("grasp"))
    plain, longer = (
        fit.fit_subtask("grasp", [rollout(env, Expert(env), 3, post_success_steps=steps).demo])
        for steps in (0, 20)
    )
    assert longer.jaw_opening == plain.jaw_opening > 0.2
    assert longer.grasp_angle == plain.grasp_angle
    assert fit.closing(np.array([0.5, 0.5, 0.4, 0.2, 0.0, 0.0, 0.0])) == 1
    assert fit.closing(np.zeros(4)) == 3, "jaws that never move"


@pytest.mark.parametrize("task", list(envs.SUBTASKS))
def test_one_demonstration_teaches_other_starts(demonstrated, task):
    env = envs.make(TaskConfig(task))
    successes = [
        rollout(env, DmpController(env, [demonstrated[task]]), seed).success
        for seed in range(500, 505)
    ]
    assert sum(successes) >= 4, successes


def test_a_half_circle_is_grasped_at_the_same_share_of_its_arc(demonstrated):
    """The demonstrated needle is a third of a circle."""
    half_circles = RandomisationConfig(needle_arc="1/2", needle_size=0.2)
    env = envs.make(TaskConfig("handoff", randomisation=half_circles))
    demos = [demonstrated["handoff"]]
    successes = [rollout(env, DmpController(env, demos), seed).success for seed in range(500, 502)]
    assert all(successes), successes


def test_an_insertion_is_cut_at_the_entry_and_a_pull_out_at_the_exit(demonstrated):
    for task, holes in (("insert", 1.0), ("pullout", 3.0)):
        demo = read_demo(demonstrated[task])
        measured, env = fit.demo_poses(demo), envs.make(demo.config)
        cut = fit.CARRY_PHASES[task][0].end(measured)
        env.set_state_vector(demo.state[min(cut + 6, len(demo))])
        assert env.simulation.task_state.holes_passed == holes
        env.set_state_vector(demo.state[max(cut - 4, 0)])
        assert env.simulation.task_state.holes_passed < holes


def test_reset_begins_anew_and_the_same_start_gives_the_same_actions(demonstrated):
    env = envs.make(TaskConfig("insert"))
    controller = DmpController(env, [demonstrated["insert"]])
    runs = []
    for _ in range(2):
        env.reset(seed=77)
        controller.reset()
        actions = []
        for _ in range(15):
            actions.append(controller.action())
            env.step(actions[-1])
        runs.append(np.array(actions))
    np.testing.assert_array_equal(*runs)
    assert runs[0].dtype == np.float32
    assert np.abs(runs[0]).max() <= 1.0


def test_a_file_that_was_replaced_is_learned_anew(demonstrated, tmp_path):
    env = envs.make(TaskConfig("insert"))
    demo = read_demo(demonstrated["insert"])
    path = write_demo(tmp_path, 0, demo)
    first = DmpController(env, [path]).fit
    assert DmpController(env, [path]).fit is first
    path.write_bytes(write_demo(tmp_path, 1, dataclasses.replace(demo, seed=77)).read_bytes())
    assert DmpController(env, [path]).fit is not first


def test_refuses_demonstrations_that_do_not_fit(demonstrated, tmp_path):
    insert, whole = envs.make(TaskConfig("insert")), envs.make(TaskConfig("suture"))
    with pytest.raises(InputError, match="A demonstration of place cannot teach insert"):
        DmpController(insert, [demonstrated["place"]])
    with pytest.raises(InputError, match="at least one"):
        DmpController(insert, [])
    with pytest.raises(InputError, match="whole procedure has none"):
        DmpController(whole, [demonstrated["insert"]])
    demo = dataclasses.replace(read_demo(demonstrated["insert"]), scene_hash="0" * 64)
    with pytest.raises(InputError, match="recorded in another scene"):
        DmpController(insert, [write_demo(tmp_path, 0, demo)])


def test_records_what_it_generates(demonstrated, tmp_path):
    seed = read_demo(demonstrated["insert"]).seed
    out, given = (
        tmp_path / "demos",
        {"demonstrator": "dmp", "demos": [demonstrated["insert"]], "context": RunContext(0)},
    )
    paths = record(TaskConfig("insert"), episodes=3, seed=seed, out=out, **given)
    demos = [read_demo(path) for path in paths]
    assert [demo.demonstrator for demo in demos] == ["dmp"] * 3
    assert all(demo.success[-1] and demo.seed > seed for demo in demos), (
        "the demonstration's own start is left out"
    )
    assert len(read_marker(out)["request"]["demos"]) == 1
    with pytest.raises(InputError, match="learns from demonstrations"):
        record(TaskConfig("insert"), episodes=1, out=tmp_path / "none", demonstrator="dmp")
    with pytest.raises(InputError, match="does not learn from demonstrations"):
        record(
            TaskConfig("insert"), episodes=1, out=tmp_path / "none", demos=[demonstrated["insert"]]
        )


@pytest.mark.parametrize(("task", "name"), [("insert", "insert_v2"), ("pullout", "pullout_v2")])
def test_recordings_of_surgicai_teach_in_tissue(shared, tmp_path, task, name):
    import_demos(shared / "surgicai" / f"surgicai_{name}.npz", task=task, out=tmp_path / "demos")
    env, first = envs.make(TaskConfig(task)), list_demos(tmp_path / "demos")[0]
    controller = DmpController(env, [first])
    assert controller.fit.projected == 1, "its needle moves beside the holes"
    successes = [
        rollout(env, DmpController(env, [first]), seed).success for seed in range(500, 504)
    ]
    assert sum(successes) >= 3, successes


def test_a_projected_path_keeps_its_turns_and_lies_in_the_holes(demonstrated):
    measured = fit.demo_poses(read_demo(demonstrated["insert"]))
    cut = fit.CARRY_PHASES["insert"][0].end(measured)
    path = measured.needle[cut:]
    assert deviation_from_path(measured.stitch, path) < CLEARANCE
    away = path.copy()
    away[:, :3, 3] += [0.003, 0.002, -0.004]
    assert deviation_from_path(measured.stitch, away) > CLEARANCE
    for projected, pose in zip(project(measured.stitch, away), path, strict=True):
        assert poses.angle(poses.flat(projected), poses.flat(pose)) < math.radians(0.5)
        assert poses.distance(poses.flat(projected), poses.flat(pose)) < 0.0003
