"""Success: what must not count does not, and a physics error never does.

Each wrong way is tested next to the right one.
"""

import dataclasses
import math

import numpy as np
import pytest
from episodes import make, play
from needle_polyline import crosses

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import SuccessRule, TaskConfig
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs import hole_crossing, poses
from surgicai_vision.envs.force_plate import ForcePlate
from surgicai_vision.envs.geometry import HANDOFF_ANGLE, grasp_in_needle
from surgicai_vision.scene import compose, holes, needle
from surgicai_vision.scene.arm import GRASP_DEPTH, PAD_OFFSET
from surgicai_vision.scene.rotations import rotvec_to_matrix

ASIDE = np.array([0.0, 0.003, 0.0])
"""Shift along the wound, past an opening of ±1.9 mm."""


def put(env, pose):
    """Teleport the needle to T_world_needle (4, 4), at rest."""
    env.simulation.pose_needle(poses.flat(pose))
    env.data.qvel[:] = 0.0
    env.simulation.refresh()


def drag(env, path):
    """Move the needle along `path` without physics and return the measurement.

    Every step is checked for crossings, as in an episode.
    """
    for pose in path:
        put(env, pose)
        hole_crossing.update(env.simulation, env.simulation.task_state, env.stitch.pair)
    return env.measure()


def shifted(pose, shift):
    moved = pose.copy()
    moved[:3, 3] += shift
    return moved


def turning(stitch, first, last, shift=(0.0, 0.0, 0.0)):
    """Needle poses on the circle from angle `first` to `last` in the entry [deg], 3° apart."""
    count = int(abs(last - first) / 3) + 2
    return [
        shifted(stitch.on_arc(math.radians(angle)), shift)
        for angle in np.linspace(first, last, count)
    ]


def sliding(pose, shift):
    """Poses from `pose` to `pose` + `shift` [m], at most 1 mm apart."""
    count = int(np.linalg.norm(shift) / 0.001) + 2
    return [shifted(pose, share * np.asarray(shift)) for share in np.linspace(0.0, 1.0, count)]


def inserted_angle(env):
    """The needle's angle in the entry at the goal of the insertion [deg]."""
    return math.degrees(env.stitch.angle_at_entry(math.radians(100.0), 0.002))


def near(env, info):
    """Return whether the pose alone is within tolerance: else a refusal proves nothing."""
    tolerance = env.subtask.tolerances["paper"]
    return info["d_trans"] <= tolerance.distance and info["d_angle"] <= tolerance.angle


def start(task, **fields):
    env = make(task, **fields)
    env.reset(seed=2)
    return env


# -- insert ----------------------------------------------------------------------------------------


def test_the_circle_through_both_holes_is_an_insertion():
    env = start("insert")
    before = drag(env, turning(env.stitch, 130.0, 90.0))
    assert before["holes_passed"] == 1 and not before["is_success"]
    info = drag(env, turning(env.stitch, 90.0, inserted_angle(env)))
    assert near(env, info) and info["holes_passed"] == 2 and info["is_success"]
    back = drag(env, turning(env.stitch, inserted_angle(env), 130.0))
    assert back["holes_passed"] == 0


def test_a_teleported_insertion_does_not_count():
    env = start("insert")
    put(env, env.stitch.inserted())
    assert hole_crossing.in_both(env.simulation, env.stitch.pair)
    _, _, terminated, _, info = env.step(np.zeros(7, np.float32))
    assert near(env, info) and not info["is_success"] and not terminated


def test_a_teleport_between_the_holes_does_not_count():
    env = start("insert")
    assert drag(env, turning(env.stitch, 130.0, 110.0))["holes_passed"] == 1
    info = drag(env, turning(env.stitch, 80.0, inserted_angle(env)))
    assert near(env, info) and not info["is_success"]


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_tunnelling_beside_the_holes_does_not_count(side):
    """Through the tissue 3 mm beside both holes, then sideways to the goal."""
    env = start("insert")
    angle = inserted_angle(env)
    beside = drag(env, turning(env.stitch, 130.0, angle, side * ASIDE))
    assert beside["d_trans"] < 0.005 and beside["holes_passed"] == 0 and not beside["is_success"]
    info = drag(
        env, sliding(shifted(env.stitch.on_arc(math.radians(angle)), side * ASIDE), -side * ASIDE)
    )
    assert (
        near(env, info)
        and hole_crossing.in_both(env.simulation, env.stitch.pair)
        and not info["is_success"]
    )


@pytest.mark.parametrize("depth", [-0.0005, 0.0005])
def test_dragging_along_the_entrys_plane_does_not_count(depth):
    """Beside the opening, the tip is moved just above or below the plane and dragged across."""
    env = start("insert")
    outward = env.stitch.pair.entry.rotation[:, 2]
    beside = shifted(env.stitch.place(), ASIDE + 0.002 * outward)
    path = sliding(beside, (depth - 0.002) * outward)
    info = drag(env, [*path, *sliding(path[-1], -2 * ASIDE)])
    assert info["holes_passed"] == 0


def test_the_wrong_way_round_does_not_count():
    env = start("insert")
    info = drag(
        env, turning(env.stitch, -2 * math.degrees(env.stitch.half) - 5.0, inserted_angle(env))
    )
    assert (
        near(env, info)
        and hole_crossing.in_both(env.simulation, env.stitch.pair)
        and not info["is_success"]
    )


def test_a_needle_torn_out_of_the_entry_alone_does_not_count():
    """Through both holes, then turned by 8° about the exit through the tissue at the entry."""
    env = start("insert")
    inserted = turning(env.stitch, 130.0, inserted_angle(env))
    path = [*inserted, *sliding(inserted[-1], (0.0, 0.0015, 0.0))]
    assert drag(env, path)["is_success"]
    exit_point, turned = np.asarray(env.stitch.pair.exit.centre), []
    for angle in np.radians(np.linspace(0.0, -8.0, 9)):
        rotation = rotvec_to_matrix([0.0, 0.0, angle])
        pose = path[-1].copy()
        pose[:3, :3] = rotation @ pose[:3, :3]
        pose[:3, 3] = exit_point + rotation @ (pose[:3, 3] - exit_point)
        turned.append(pose)
    info = drag(env, turned)
    assert near(env, info) and info["holes_passed"] == 2 and not info["is_success"]


def test_another_pair_does_not_count():
    env = start("insert")
    other = start("insert", scene=dataclasses.replace(env.config.scene, hole_pair=2)).stitch
    assert drag(env, turning(other, 130.0, inserted_angle(env)))["holes_passed"] == 0


# -- pull-out --------------------------------------------------------------------------------------


def to_the_end(env, pose):
    """Poses from outside the tissue to the goal of the pull-out."""
    goal, steps = env.stitch.pulled(), np.linspace(0.0, 1.0, 60)
    turn = goal[:3, :3] @ pose[:3, :3].T
    angle = math.acos((np.trace(turn) - 1) / 2)
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / (
        2 * math.sin(angle)
    )
    path = []
    for share in steps:
        between = np.eye(4)
        between[:3, :3] = rotvec_to_matrix(share * angle * axis) @ pose[:3, :3]
        between[:3, 3] = (1 - share) * pose[:3, 3] + share * goal[:3, 3]
        path.append(between)
    return path


def test_out_along_the_circle_and_to_the_end_is_a_pull_out():
    env = start("pullout")
    out = turning(env.stitch, inserted_angle(env), -2 * math.degrees(env.stitch.half) - 10.0)
    info = drag(env, out)
    assert info["holes_passed"] == 2 and not info["is_success"]
    info = drag(env, to_the_end(env, out[-1]))
    assert near(env, info) and info["is_success"]


def test_a_teleported_pull_out_does_not_count():
    env = start("pullout")
    put(env, env.stitch.pulled())
    _, _, terminated, _, info = env.step(np.zeros(7, np.float32))
    assert near(env, info) and hole_crossing.is_out(env.simulation, env.stitch.pair)
    assert not info["is_success"] and not terminated


@pytest.mark.parametrize("way", [(0.0, 0.012, 0.0), (0.0, 0.0, 0.020), (0.010, 0.0, 0.020)])
def test_a_needle_torn_through_the_tissue_does_not_count(way):
    env = start("pullout")
    torn = sliding(env.stitch.inserted(), way)
    info = drag(env, [*torn, *sliding(torn[-1], (0.0, 0.0, 0.020))])
    info = drag(env, to_the_end(env, shifted(torn[-1], (0.0, 0.0, 0.020))))
    assert (
        near(env, info)
        and hole_crossing.is_out(env.simulation, env.stitch.pair)
        and not info["is_success"]
    )


def test_a_needle_drawn_back_does_not_count():
    env = start("pullout")
    back = turning(env.stitch, inserted_angle(env), 130.0)
    info = drag(env, [*back, *to_the_end(env, back[-1])])
    assert near(env, info) and not info["is_success"]


def test_the_closed_form_is_the_naive_test():
    """The closed form equals the crossing of a fine polyline, anywhere near the holes."""
    env = start("pullout")
    simulation, pair = env.simulation, env.stitch.pair
    rng, found = np.random.default_rng(0), np.zeros((3, 2), int)
    for _ in range(600):
        pose = env.stitch.on_arc(rng.uniform(-1.0, 2.2))
        pose[:3, :3] = rotvec_to_matrix(rng.normal(scale=0.3, size=3)) @ pose[:3, :3]
        pose[:3, 3] += rng.normal(scale=0.0015, size=3)
        env.simulation.pose_needle(poses.flat(pose))
        env.simulation.refresh()
        line = pose[:3, 3] + needle.polyline(2001) @ pose[:3, :3].T
        beyond = ((line - pair.exit.centre) @ pair.exit.rotation)[:, 2]
        enters = crosses(line, pair.entry, inward=True)
        leaves = crosses(line, pair.exit, inward=False)
        out = bool((beyond > 0).all())
        assert hole_crossing.enters(simulation, pair.entry) == enters
        assert hole_crossing.leaves(simulation, pair.exit) == leaves
        assert hole_crossing.in_both(simulation, pair) == (enters and leaves)
        assert hole_crossing.is_out(simulation, pair) == out
        for row, happened in zip(found, (enters, leaves, out), strict=True):
            row[int(happened)] += 1
    assert found.min() > 50


# -- grasps ----------------------------------------------------------------------------------------

GRASPS = {"grasp": (names.PSM2, None), "handoff": (names.PSM1, HANDOFF_ANGLE)}


def jaws_at_the_grasp(task, jaw, measured, needle_shift=(0.0, 0.0, 0.0)):
    """Measure with jaws at the grasp's pose, the needle moved by `needle_shift` in its frame."""
    env = start(task)
    simulation, (arm, angle) = env.simulation, GRASPS[task]
    pose = env.stitch.inserted() if task == "handoff" else poses.square(simulation.needle())
    angle = simulation.task_state.grasp_angle if angle is None else angle
    tip = simulation.to_base(arm, poses.flat(pose @ grasp_in_needle(arm, angle)))
    simulation.pose_arm(arm, tip, jaw, measured)
    put(env, shifted(pose, pose[:3, :3] @ needle_shift))
    return env, env.measure()


@pytest.mark.parametrize("task", GRASPS)
def test_jaws_closed_on_the_needle_are_a_grasp(task):
    thickness = {"grasp": needle.BODY_RADIUS, "handoff": needle.thickness(HANDOFF_ANGLE)}[task]
    env, info = jaws_at_the_grasp(task, 0.0, (thickness - PAD_OFFSET) / GRASP_DEPTH - 0.003)
    assert near(env, info) and info["contact"] and info["is_success"]


@pytest.mark.parametrize("task", GRASPS)
def test_open_jaws_around_the_needle_are_no_grasp(task):
    env, info = jaws_at_the_grasp(task, 0.3, 0.3)
    assert near(env, info) and not info["contact"] and not info["is_success"]


@pytest.mark.parametrize("task", GRASPS)
@pytest.mark.parametrize("away", [0.0007, -0.0007, 0.03])
def test_jaws_closed_on_nothing_are_no_grasp(task, away):
    """The needle is beside the closed jaws, within the tolerated distance or far away."""
    angle = {"grasp": 12.5, "handoff": 105.0}[task]
    env, info = jaws_at_the_grasp(task, 0.0, 0.0, away * needle.radial(math.radians(angle)))
    if abs(away) < 0.001:
        assert near(env, info)
    assert not info["is_success"]


# -- laws ------------------------------------------------------------------------------------------


@pytest.fixture
def moved_world(monkeypatch):
    """Shift the holes of layout `simple`; scenes built meanwhile are discarded afterwards."""

    def move(shift):
        def moved(hole):
            return holes.Hole(tuple(np.add(hole.centre, shift)), hole.tilt, hole.turn)

        pairs = tuple(
            holes.HolePair(moved(pair.entry), moved(pair.exit)) for pair in holes.PAIRS["simple"]
        )
        monkeypatch.setitem(holes.PAIRS, "simple", pairs)
        compose._build_scene.cache_clear()

    yield move
    monkeypatch.undo()
    compose._build_scene.cache_clear()


def carry_over(source, target, shift):
    """Give `target` the poses and the task state of `source`, moved by `shift` [m, world]."""
    one, other = source.simulation, target.simulation
    for arm in names.ARMS:
        tip = poses.square(one.tip(arm))
        tip[:3, 3] += shift
        other.pose_arm(
            arm, other.to_base(arm, poses.flat(tip)), one.commands[arm].jaw, one.jaw(arm)
        )
    put(target, shifted(poses.square(one.needle()), shift))
    other.task_state = dataclasses.replace(one.task_state)


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_success_does_not_change_when_the_world_is_moved(task, moved_world):
    """With all shifted by 3 mm and -6 mm, every measure of the first and last state is equal."""
    shift = np.array([0.003, -0.006, 0.0])
    here = make(task)
    here.reset(seed=1)
    states = [here.get_state()]
    expert = Expert(here)
    for _ in range(200):
        if here.step(expert.action())[4]["is_success"]:
            break
    states.append(here.get_state())
    measured = []
    for state in states:
        here.set_state_vector(state)
        carry_over(
            here, here, np.zeros(3)
        )  # as in the moved world: the same joints from the inverse kinematics
        measured.append(here.measure())
    assert [info["is_success"] for info in measured] == [False, True]
    moved_world(shift)
    there = make(task)
    there.reset(seed=1)
    assert np.allclose(
        there.stitch.pair.entry.centre - np.array(here.stitch.pair.entry.centre), shift
    )
    for state, expected in zip(states, measured, strict=True):
        here.set_state_vector(state)
        carry_over(here, there, shift)
        info = there.measure()
        for key in ("is_success", "contact", "holes_passed", "phase"):
            assert info[key] == expected[key], key
        assert info["d_trans"] == pytest.approx(expected["d_trans"], abs=1e-9)
        assert info["d_angle"] == pytest.approx(expected["d_angle"], abs=1e-6)


def huge(data, body):
    data.qvel[:] = 1e12


def not_a_number(data, body):
    data.qpos[3] = np.nan


def blown_away(data, body):
    data.xfrc_applied[body, :3] = 1e15


def torn(data, body):
    data.qfrc_applied[:] = np.nan


def told_nonsense(data, body):
    data.ctrl[0] = np.nan


def told_to_go_far(data, body):
    data.ctrl[-1] = -np.inf


@pytest.mark.parametrize("after", [0, 5])
@pytest.mark.parametrize("task", ["grasp", "handoff", "suture"])
@pytest.mark.parametrize(
    "attack", [huge, not_a_number, blown_away, torn, told_nonsense, told_to_go_far]
)
def test_divergence_is_an_error_and_never_a_success(task, attack, after, monkeypatch, tmp_path):
    """MuJoCo resets itself silently, even in the first step of an episode."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into the working folder
    env = make(task)
    env.reset(seed=0)
    play(env, after)
    attack(env.data, env.model.body("needle").id)
    seen, reward, terminated, _, info = env.step(np.zeros(7, np.float32))
    assert info["physics_error"] and terminated and not info["is_success"] and reward == -1.0
    assert np.isfinite(seen).all() and env.observation_space.contains(seen)
    assert all(np.isfinite(value).all() for value in info.values())
    assert np.isfinite(env.get_state()).all()
    again, fresh = make(task), env.reset(seed=7)
    assert np.array_equal(fresh[0], again.reset(seed=7)[0]) and not fresh[1]["physics_error"]


def test_no_arm_is_pushed_out_of_the_tissue_at_the_start_of_a_pullout():
    """Starts with PSM2 in the tissue are redrawn: pushed out, it would strike on return."""
    env = envs.make(TaskConfig("pullout"))
    plate = ForcePlate(env.model)
    for seed in (500_013, 500_018):  # the first draws of these are pushed
        env.reset(seed=seed)
        forces = []
        for _ in range(10):
            env.step(np.zeros(7, np.float32))
            forces.append(plate.force(env.data))
        assert max(forces) < 0.1


@pytest.mark.parametrize("obs_type", ["state", "goal"])
@pytest.mark.parametrize("keeps", [False, True])
def test_a_needle_torn_out_of_a_hole_counts_as_handed_over_unless_holes_are_kept(keeps, obs_type):
    env = make("handoff", obs_type=obs_type)
    env.success_rule = SuccessRule(keeps_holes=keeps)
    env.reset(seed=0)
    expert, ended = Expert(env), False
    while not ended:
        env.simulation.task_state.holes_passed = 0
        seen, reward, terminated, truncated, info = env.step(expert.action())
        ended = terminated or truncated
    assert info["paper_success"]
    assert info["is_success"] == terminated == (not keeps) and truncated == keeps
    assert reward == (-1.0 if keeps else 0.0)
    if obs_type == "goal":
        assert env.compute_reward(seen["achieved_goal"], seen["desired_goal"]) == reward
    env.close()


@pytest.mark.parametrize("obs_type", ["state", "goal"])
def test_a_share_of_the_tolerance_asks_for_so_much_of_it(obs_type):
    env = make("insert", obs_type=obs_type)
    whole = env.tolerance()
    env.success_rule = SuccessRule(tolerance_share=0.5)
    half = env.tolerance()
    assert (half.distance, half.angle) == (whole.distance / 2, whole.angle / 2)
    env.reset(seed=0)
    expert, met, ended = Expert(env), 0, False
    while not ended:
        _, reward, terminated, truncated, info = env.step(expert.action())
        near = info["d_trans"] <= half.distance and info["d_angle"] <= half.angle
        assert info["is_success"] == (info["paper_success"] and near)
        assert reward == (0.0 if info["is_success"] else -1.0)
        met += info["paper_success"] and not near
        ended = terminated or truncated
    assert met  # within the tolerance, but not yet within half of it
    env.close()
