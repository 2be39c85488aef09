"""The episode monitor: it measures known cases correctly and changes nothing."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, SceneConfig, TaskConfig
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs.bite import Bite
from surgicai_vision.envs.bite_measures import SoftWatch, angle_to, depth_under
from surgicai_vision.envs.episode_monitor import EpisodeMonitor, drawn_length
from surgicai_vision.envs.force_plate import ForcePlate
from surgicai_vision.envs.hole_crossing import crossing
from surgicai_vision.scene import needle
from surgicai_vision.scene.holes import OPENING, PAIRS

NO_ACTION = np.zeros(7, np.float32)
INFO = {"needle_slip": (0.0, 0.0), "paper_success": False}


def started(task="grasp", seed=names.TEST_SEED, **options):
    env = envs.make(TaskConfig(task, **options))
    env.reset(seed=seed)
    monitor = EpisodeMonitor(env)
    monitor.reset()
    return env, monitor


@pytest.mark.parametrize("scene", [SceneConfig(), SceneConfig(tissue="soft", thread=10)])
def test_nothing_is_measured_before_an_episode_begins(scene):
    _, monitor = started(scene=scene)
    is_soft = scene.tissue == "soft"

    def measured():
        soft_alone = (monitor.tears, monitor.thread_drawn)
        return (
            monitor.slip,
            monitor.turn,
            monitor.tissue_force,
            monitor.tissue_impulse,
        ), soft_alone

    assert measured()[0] == (0.0,) * 4
    assert measured()[1] == (0.0, 0.0) if is_soft else np.isnan(measured()[1]).all()
    monitor.clear()
    assert np.isnan(measured()[0]).all() and np.isnan(measured()[1]).all()


def test_a_lying_needle_weighs_what_it_weighs():
    env, _ = started()
    for _ in range(60):
        env.step(NO_ACTION)
    weight = env.model.body("needle").mass[0] * 9.81
    assert ForcePlate(env.model).force(env.data) == pytest.approx(weight, rel=0.02)


def test_a_needle_in_the_air_presses_nothing():
    env, _ = started("place")
    env.step(np.array([0, 0, 1, 0, 0, 0, 0], np.float32))
    pose = np.array(env.simulation.needle())
    pose[2] += 0.05
    env.simulation.pose_needle(tuple(pose))
    env.simulation.refresh()
    assert ForcePlate(env.model).force(env.data) == 0.0


def test_an_instrument_that_is_driven_into_the_tissue_presses_it():
    env, monitor = started()
    down = env.simulation.bases[names.PSM2]
    # World's -z in the arm's base: the third row of R_world_base, negated.
    action = np.array([*(-np.array(down[9:12])), 0, 0, 0, 0], np.float32)
    for _ in range(env.config.max_steps):
        monitor.update(env.step(action)[4])
    assert monitor.tissue_force > 1.0
    assert 0 < monitor.tissue_impulse < monitor.tissue_force * env.config.max_steps * env.dt


def test_the_impulse_is_summed_over_all_control_steps_of_a_held_action():
    env, monitor = started(action_repeat=4)
    down = env.simulation.bases[names.PSM2]
    action = np.array([*(-np.array(down[9:12])), 0, 0, 0, 0], np.float32)
    impulse = 0.0
    for _ in range(env.config.max_steps // 4):
        monitor.update(env.step(action)[4])
        impulse += monitor.force * 4 * env.dt
    assert monitor.tissue_impulse == pytest.approx(impulse) and impulse > 1.0


def test_monitoring_changes_nothing():
    (plain, _), (watched, monitor) = started("insert"), started("insert")
    ones = np.ones(7, np.float32)
    for _ in range(60):
        plain.step(ones)
        monitor.update(watched.step(ones)[4])
    assert monitor.tissue_force > 0.001
    np.testing.assert_array_equal(watched.get_state(), plain.get_state())


def test_the_expert_goes_through_the_middle_of_both_holes():
    env, monitor = started("insert")
    expert = Expert(env)
    for _ in range(env.config.max_steps):
        *_, ended, _, info = env.step(expert.action())
        monitor.update(info)
        if ended:
            break
    assert info["is_success"]
    assert 0 < monitor.bite.entry_error < 1e-3 and 0 < monitor.bite.exit_error < 1e-3
    assert 0 < monitor.slip < 1e-3 and monitor.turn > 0
    assert not monitor.bite.wrong_hole
    # The needle starts square to the skin; its circle leaves at 21° to the hole's axis
    # (`envs.geometry`).
    assert 0 < math.degrees(monitor.bite.entry_angle) < 10
    assert math.degrees(monitor.bite.exit_angle) == pytest.approx(21, abs=4)
    assert monitor.bite.length == pytest.approx(env.stitch.pair.gap, abs=1e-3)
    sagitta = needle.RADIUS - math.sqrt(needle.RADIUS**2 - (monitor.bite.length / 2) ** 2)
    assert monitor.bite.depth == pytest.approx(sagitta, abs=4e-4)
    assert monitor.paper_success
    assert math.isnan(monitor.tears) and math.isnan(monitor.thread_drawn)
    monitor.reset()
    assert math.isnan(monitor.bite.entry_error) and monitor.slip == 0.0


def lead_tip(monitor, *points):
    """Move the needle's tip along world points [m], a millimetre per step."""
    env = monitor._env
    simulation = env.simulation
    pose = np.array(simulation.needle())
    here = np.array(simulation.needle_point(needle.TIP_ANGLE))
    for point in points:
        steps = max(2, round(float(np.linalg.norm(np.array(point) - here)) / 1e-3) + 1)
        for goal in np.linspace(here, point, steps)[1:]:
            tip = np.array(simulation.needle_point(needle.TIP_ANGLE))
            pose[:3] += goal - tip
            simulation.pose_needle(tuple(pose))
            simulation.refresh()
            monitor.update(INFO)
        here = np.array(point)


def through(hole, inward, off=(0.0, 0.0)):
    """Return points outside and inside a hole, offset by `off` from its centre [m]."""
    centre = np.array(hole.centre) + hole.rotation[:, 0] * off[0] + hole.rotation[:, 1] * off[1]
    ends = centre + np.outer((2e-3, -2e-3), hole.rotation[:, 2])
    return ends if inward else ends[::-1]


def test_crossings_are_measured_from_the_holes_centre():
    _, monitor = started()
    pair = PAIRS["simple"][0]
    lead_tip(monitor, *through(pair.entry, True, (3e-4, 4e-4)))
    assert monitor.bite.entry_error == pytest.approx(5e-4, abs=1e-6)
    assert math.isnan(monitor.bite.exit_error)
    lead_tip(monitor, *through(pair.exit, False, (-1e-3, 0.0)))
    assert monitor.bite.exit_error == pytest.approx(1e-3, abs=1e-6)
    assert not monitor.bite.wrong_hole


def test_another_stitchs_hole_is_the_wrong_one_until_the_right_exit():
    _, monitor = started()
    pairs = PAIRS["simple"]
    lead_tip(monitor, *through(pairs[2].entry, True))
    assert monitor.bite.wrong_hole and math.isnan(monitor.bite.entry_error)
    lead_tip(
        monitor,
        *through(pairs[2].entry, False),
        *through(pairs[0].entry, True),
        *through(pairs[0].exit, False),
    )
    assert not monitor.bite.wrong_hole


def test_the_exit_from_outside_is_the_wrong_hole():
    _, monitor = started()
    lead_tip(monitor, *through(PAIRS["simple"][0].exit, True))
    assert monitor.bite.wrong_hole


def test_the_holes_of_the_chosen_pair_are_the_right_ones():
    _, monitor = started(scene=SceneConfig(hole_pair=3))
    lead_tip(monitor, *through(PAIRS["simple"][2].entry, True))
    assert monitor.bite.entry_error == pytest.approx(0.0, abs=1e-6)
    assert not monitor.bite.wrong_hole


def test_holes_move_with_a_shifted_phantom():
    env, monitor = started(randomisation=RandomisationConfig(phantom_shift=5.0))
    lead_tip(monitor, *through(env.stitch.pair.entry, True))
    assert monitor.bite.entry_error == pytest.approx(0.0, abs=1e-6)


def test_a_jump_is_no_crossing():
    _, monitor = started()
    simulation = monitor._env.simulation
    for point in through(PAIRS["simple"][0].entry, True) * 1.0 + np.array(
        [[0, 0, 2e-3], [0, 0, -2e-3]]
    ):
        pose = np.array(simulation.needle())
        pose[:3] += point - np.array(simulation.needle_point(needle.TIP_ANGLE))
        simulation.pose_needle(tuple(pose))
        simulation.refresh()
        monitor.update(INFO)
    assert math.isnan(monitor.bite.entry_error)


def test_crossing_has_a_direction_and_an_opening():
    hole = PAIRS["simple"][0].entry
    out, into = through(hole, True)
    assert crossing(tuple(out), tuple(into), hole, inward=True) == pytest.approx(
        (0.0, 0.0), abs=1e-9
    )
    assert crossing(tuple(out), tuple(into), hole, inward=False) is None
    assert crossing(tuple(into), tuple(out), hole, inward=True) is None
    beside = through(hole, True, (0.0, 0.51 * OPENING))
    assert crossing(*map(tuple, beside), hole, inward=True) is None


def test_the_thread_does_not_press():
    bare, threaded = (
        ForcePlate(envs.make(TaskConfig(scene=SceneConfig(thread=count))).model)
        for count in (0, 10)
    )
    assert threaded._model.ngeom > bare._model.ngeom
    assert threaded._presses.sum() == bare._presses.sum()


def test_the_needle_is_held_by_either_arm():
    held = {task: started(task)[1].is_held() for task in ("grasp", "place", "handoff", "pullout")}
    assert held == {"grasp": False, "place": True, "handoff": True, "pullout": True}


def test_depth_counts_only_what_lies_between_entry_and_exit():
    path = [(-1e-3, 0, -5e-3), (2e-3, 1e-3, -1e-3), (5e-3, 0, -2e-3), (9e-3, 0, -5e-3)]
    assert depth_under((0, 0, 0), (8e-3, 0, 0), path) == pytest.approx(2e-3)
    # Over (5, 0, -2), a line that rises by 2 mm over 8 mm is at 0.5588 of its length.
    risen = depth_under((0, 0, -1e-3), (8e-3, 0, 1e-3), path[2:3])
    assert risen == pytest.approx(2e-3 - 1e-3 + 2e-3 * (5 * 8 - 1 * 2) / 68, rel=1e-6)


def test_a_bite_is_measured_from_entry_to_exit():
    _, monitor = started()
    pair = PAIRS["simple"][0]
    lead_tip(monitor, *through(pair.entry, True))
    assert math.isnan(monitor.bite.length)
    lead_tip(monitor, (0.0, pair.entry.centre[1], 0.0705), *through(pair.exit, False))
    assert monitor.bite.length == pytest.approx(pair.gap, abs=1e-5)
    assert monitor.bite.depth == pytest.approx(0.0749 - 0.0705, abs=2e-4)


def test_angles_lie_between_unit_vectors():
    assert angle_to((0.0, 0.0, 1.0), (0.0, 0.0, 1.0)) == 0.0
    assert angle_to((0.0, 0.0, 1.0), (0.6, 0.0, 0.8)) == pytest.approx(math.acos(0.8))


def test_thread_is_drawn_as_far_as_it_is_out_of_the_exit():
    leave = PAIRS["simple"][0].exit
    centre = np.array(leave.centre)
    normal = np.array(leave.normal)
    points = [tuple(centre + height * normal) for height in (5e-3, 2e-3, -2e-3, 4e-3)]
    assert drawn_length(points, leave) == pytest.approx(5e-3)
    assert drawn_length(points[2:], leave) == 0.0
    assert drawn_length(points[:2], leave) == pytest.approx(3e-3)


def test_a_pullout_draws_the_thread():
    env, monitor = started("pullout", scene=SceneConfig(thread=10))
    assert monitor.thread_drawn == 0.0
    expert = Expert(env)
    for _ in range(env.config.max_steps):
        *_, ended, _, info = env.step(expert.action())
        monitor.update(info)
        if ended:
            break
    assert info["is_success"]
    assert 0.0 < monitor.thread_drawn < 0.095


def soft(task="insert"):
    return started(task, scene=SceneConfig(tissue="soft"))


def drive(env, monitor, steps=None):
    """Let the expert act and return the infos."""
    expert = Expert(env)
    infos = []
    for _ in range(steps or env.config.max_steps):
        *_, ended, _, info = env.step(expert.action())
        monitor.update(info)
        infos.append(info)
        if ended:
            break
    return infos


def test_the_expert_stitches_soft_tissue_at_its_marks():
    env, monitor = soft()
    info = drive(env, monitor)[-1]
    assert info["is_success"] and info["paper_success"] and monitor.paper_success
    bite = monitor.bite
    assert 0 < bite.entry_error < 1e-3 and 0 < bite.exit_error < 1e-3
    assert not bite.wrong_hole and monitor.tears == 0.0
    assert bite.length == pytest.approx(env.stitch.pair.gap, abs=1e-3)
    assert 0 < bite.depth < 2e-3
    # Entering takes the puncture force.
    assert monitor.tissue_force > env.simulation.tissue.forces.puncture_in * 0.8
    assert monitor.tissue_impulse > 0


def test_what_soft_tissue_does_to_the_needle_is_what_the_plate_shows():
    env, _ = soft()
    plate = ForcePlate(env.model, env.simulation.tissue)
    expert = Expert(env)
    forces = []
    for _ in range(env.config.max_steps):
        ended = env.step(expert.action())[2]
        shown = plate.force(env.data)
        forces.append(shown)
        assert shown == pytest.approx(
            np.linalg.norm(env.simulation.tissue.force_on_needle()), abs=1e-9
        )
        if ended:
            break
    assert max(forces) > 1.0


def test_a_bite_of_the_start_is_not_the_episodes():
    env, monitor = soft("pullout")
    assert env.simulation.tissue.bites
    drive(env, monitor)
    assert math.isnan(monitor.bite.entry_error) and math.isnan(monitor.bite.exit_error)


def test_a_bite_drawn_back_from_the_wrong_mark_may_end_at_the_right_one():
    env, _ = soft()
    pair, other = PAIRS["simple"][:2]
    tissue = SimpleNamespace(bites=())
    watch = SoftWatch(env.simulation, tissue, pair, [other])
    inside = Bite(pair.entry.centre, None, "entry", "", 1, 0, 1e-3, 4e-3, 0, False)
    wrong, right = (
        replace(inside, exit=one.exit.centre, exit_side="exit", exit_piece=piece)
        for one, piece in ((other, 2), (pair, 1))
    )
    seen = []
    for bite in (inside, wrong, inside, right):
        tissue.bites = (bite,)
        watch.update()
        seen.append(watch.measures.wrong_hole)
    assert seen == [False, True, False, False]


@pytest.mark.parametrize(("shift", "success"), [(0.0019, True), (0.0021, False)])
def test_soft_tissue_asks_for_the_marks(shift, success):
    env, _ = soft("handoff")
    tissue = env.simulation.tissue
    passage = tissue._passages[-1]
    passage.entry = env.stitch.pair.entry.centre
    x, y, z = env.stitch.pair.exit.centre
    passage.exit = (x, y + shift, z)
    expert = Expert(env)
    infos = [env.step(expert.action())[4] for _ in range(120)]
    assert any(info["paper_success"] for info in infos)
    assert any(info["is_success"] for info in infos) is success


def test_torn_tissue_is_no_success():
    env, monitor = soft()
    env.simulation.tissue.tears = 1
    infos = drive(env, monitor)
    assert monitor.tears == 1.0 and monitor.paper_success
    assert not any(info["is_success"] for info in infos)


def test_monitoring_soft_tissue_changes_nothing():
    (plain, _), (watched, monitor) = soft(), soft()
    experts = Expert(plain), Expert(watched)
    for _ in range(60):
        plain.step(experts[0].action())
        monitor.update(watched.step(experts[1].action())[4])
    assert monitor.tissue_force > 0.5
    np.testing.assert_array_equal(watched.get_state(), plain.get_state())
