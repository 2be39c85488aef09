"""A varying world: phantom, pair, needle and robot start, and all that depends on them."""

import dataclasses
import itertools
import math

import mujoco
import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import (
    NEEDLE_ARCS,
    RANDOMISATION_LIMITS,
    WORLD,
    RandomisationConfig,
    SceneConfig,
    TaskConfig,
)
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.names import ARMS, PSM1, PSM2
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs import geometry, poses, randomisation
from surgicai_vision.envs.episode_monitor import EpisodeMonitor
from surgicai_vision.envs.placement import PIVOT, SLIDE, Placement
from surgicai_vision.envs.simulation import BESIDE
from surgicai_vision.scene import build_scene, needle
from surgicai_vision.scene.holes import PAIRS, SURFACE
from surgicai_vision.scene.kinematics import base_in_world, start_in_base
from surgicai_vision.scene.needle import NeedleShape
from surgicai_vision.scene.phantom import ORIGIN, SIZE
from surgicai_vision.scene.reshape import reshape_needle
from surgicai_vision.scene.visual.shapes import VISIBLE

AXES = WORLD.on


def made(task="grasp", scene=SceneConfig(), **axes):
    """An env with the given axes, or with all of `WORLD`."""
    chosen = RandomisationConfig(**axes) if axes else WORLD
    return envs.make(TaskConfig(task, scene, randomisation=chosen))


def played(env, steps=200):
    """The last info of the expert's episode; the env has been reset."""
    expert = Expert(env)
    for _ in range(steps):
        _, _, terminated, truncated, info = env.step(expert.action())
        if terminated or truncated:
            break
    return info


# -- draws -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", AXES)
def test_an_axis_draws_the_same_alone_and_among_all(axis):
    alone = randomisation.draw(
        RandomisationConfig(**{axis: getattr(WORLD, axis)}), np.random.default_rng(3)
    )
    among = randomisation.draw(WORLD, np.random.default_rng(3))
    place = randomisation.report(WORLD, among)[axis]
    np.testing.assert_array_equal(
        randomisation.report(RandomisationConfig(**{axis: getattr(WORLD, axis)}), alone)[axis],
        place,
    )
    assert np.any(place != 0) or axis == "needle_arc"


def test_every_pair_and_every_arc_is_drawn():
    rng = np.random.default_rng(0)
    drawn = [randomisation.report(WORLD, randomisation.draw(WORLD, rng)) for _ in range(200)]
    pairs = [int(numbers["pair"][0]) for numbers in drawn]
    arcs = [round(math.degrees(numbers["needle_arc"][0])) for numbers in drawn]
    assert sorted(set(pairs)) == [1, 2, 3, 4]
    assert min(pairs.count(pair) for pair in (1, 2, 3, 4)) > 30
    assert sorted(set(arcs)) == [0, 15, 60]


def test_arcs_are_held_out_between_those_to_train_on():
    rng = np.random.default_rng(0)
    drawn = {choice: [] for choice in (names.TRAIN, names.HELDOUT)}
    for choice, arcs in drawn.items():
        axes = RandomisationConfig(needle_arc=choice)
        for _ in range(200):
            numbers = randomisation.report(axes, randomisation.draw(axes, rng))
            arcs.append(round(math.degrees(numbers["needle_arc"][0])))
    assert set(drawn[names.TRAIN]) == {0, 60} and set(drawn[names.HELDOUT]) == {15}
    assert drawn[names.TRAIN].count(60) > 40


@pytest.mark.parametrize("arc", NEEDLE_ARCS)
def test_an_arc_may_be_chosen(arc):
    env = made(needle_arc=arc)
    env.reset(seed=0)
    assert env.simulation.tip_angle == pytest.approx(2 * math.pi * eval(arc))  # "3/8"
    assert env.simulation.radius == needle.RADIUS


@pytest.mark.parametrize("tissue", names.TISSUES)
def test_a_state_is_restored_elsewhere_with_its_world(tissue):
    """In the middle of an insertion."""
    one, other = (made("insert", SceneConfig(tissue=tissue)) for _ in range(2))
    one.reset(seed=2)
    other.reset(seed=9)
    expert = Expert(one)
    while not one.simulation.task_state.holes_passed:
        one.step(expert.action())
    other.set_state_vector(one.get_state())
    assert other.simulation.pair_index == one.simulation.pair_index
    assert other.stitch.pair == one.stitch.pair
    assert other.simulation.shape == one.simulation.shape
    for _ in range(20):
        action = expert.action()
        seen = one.step(action)[0]
        np.testing.assert_array_equal(seen, other.step(action)[0])
    np.testing.assert_array_equal(one.get_state(), other.get_state())


# -- the needle ------------------------------------------------------------------------------------


def test_a_reshaped_needle_is_the_one_that_is_compiled():
    """Reshaping to another shape and back changes no number of the model."""
    scene = build_scene(SceneConfig(thread=10))
    model = mujoco.MjModel.__copy__(scene.model)
    reshape_needle(scene.model, model, NeedleShape(0.012, math.pi, 0.0005))
    assert not np.array_equal(model.geom_pos, scene.model.geom_pos)
    reshape_needle(scene.model, model, needle.OWN_SHAPE)
    for name in ("geom_pos", "geom_quat", "geom_size", "body_inertia", "mesh_vert", "bvh_aabb"):
        np.testing.assert_array_equal(getattr(model, name), getattr(scene.model, name))


@pytest.mark.parametrize("arc", NEEDLE_ARCS)
def test_everything_of_a_needle_lies_on_its_arc(arc):
    env = made(needle_arc=arc, needle_size=0.16, scene=SceneConfig(thread=10))
    env.reset(seed=1)
    model, data, simulation = env.model, env.data, env.simulation
    pose = poses.square(simulation.needle())
    index = env.scene.needle_geoms
    ends = []
    for geom in index:
        way = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
        ends += [
            pose[:3, :3].T @ (data.geom_xpos[geom] + side - pose[:3, 3]) for side in (way, -way)
        ]
    assert np.allclose(np.linalg.norm(ends, axis=1), simulation.radius, atol=1e-9)
    angles = [(math.atan2(y, -x) + 0.1) % (2 * math.pi) - 0.1 for x, y, _ in ends]
    assert max(angles) == pytest.approx(simulation.tip_angle, abs=1e-6)
    tip = simulation.needle_point(simulation.tip_angle)
    np.testing.assert_allclose(data.site("needle_tip").xpos, tip, atol=1e-9)
    base = simulation.needle_point(0.0)
    np.testing.assert_allclose(data.body("thread_0").xpos, base, atol=1e-9)
    mesh = model.mesh("needle")
    drawn = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
    shown = next(
        geom for geom in range(model.ngeom) if model.geom_dataid[geom] == model.mesh("needle").id
    )
    points = data.geom_xmat[shown].reshape(3, 3) @ drawn.T + data.geom_xpos[shown][:, None]
    local = pose[:3, :3].T @ (points - pose[:3, 3:4])
    assert np.allclose(np.hypot(*local[:2]), simulation.radius, atol=7e-4)
    assert model.body("needle").mass[0] == pytest.approx(simulation.shape.mass, rel=1e-9)


def test_goals_of_the_own_needle_are_the_released_codes():
    stitch = geometry.Stitch.of(PAIRS["simple"][0])
    assert stitch.insert_angle == math.radians(100.0)
    assert stitch.handoff_angle == math.radians(105.0)
    assert stitch.grasps(0.1, 0.3) == (0.1, 0.3)
    assert stitch.ahead == 0.0


@pytest.mark.parametrize("degrees", [135, 180])
def test_as_large_a_part_of_another_needle_is_out_of_the_exit(degrees):
    stitch = geometry.Stitch.of(PAIRS["simple"][0], tip_angle=math.radians(degrees))
    assert stitch.insert_angle / stitch.tip_angle == pytest.approx(100 / 120)
    assert stitch.handoff_angle / stitch.tip_angle == pytest.approx(105 / 120)


def test_goals_are_derived_from_the_phantoms_place():
    """A stitch that is moved as a whole has goals that are moved as a whole."""
    where = Placement(0, 0.0, (0.004, -0.003), 0.2)
    own = geometry.Stitch.of(PAIRS["simple"][0], 0.0105, math.radians(135))
    moved = geometry.Stitch.of(where.placed_pair(own.pair), 0.0105, math.radians(135))
    for goal in ("place_tip", "insert_point", "pullout_point"):
        expected = where.T_world_phantom @ poses.square(getattr(own, goal))
        np.testing.assert_allclose(poses.square(getattr(moved, goal)), expected, atol=1e-12)


# -- the phantom -----------------------------------------------------------------------------------


def test_the_phantom_its_holes_and_its_tray_move_as_one():
    env = made("insert")
    for seed in range(4):
        env.reset(seed=seed)
        simulation = env.simulation
        pose = simulation.placement.T_world_phantom
        for body in ("phantom", "tray"):
            np.testing.assert_allclose(env.data.body(body).xpos, pose[:3, 3], atol=1e-12)
            turned = env.data.body(body).xmat.reshape(3, 3)
            np.testing.assert_allclose(turned, pose[:3, :3], atol=1e-12)
        own = PAIRS["simple"][simulation.pair_index]
        for before, after in ((own.entry, env.stitch.pair.entry), (own.exit, env.stitch.pair.exit)):
            np.testing.assert_allclose(after.centre, (pose @ [*before.centre, 1.0])[:3], atol=1e-12)
            np.testing.assert_allclose(after.rotation, pose[:3, :3] @ before.rotation, atol=1e-12)


def test_the_phantom_turns_about_its_place():
    where = Placement(0, 0.0, (0.0, 0.0), math.radians(15))
    np.testing.assert_allclose(where.point(PIVOT), PIVOT, atol=1e-15)
    assert PIVOT[:2] == ORIGIN


def test_a_drawn_pair_slides_part_of_its_way_towards_the_first():
    env = made(pair="any")
    rows = [pair.entry.centre[1] for pair in PAIRS["simple"]]
    seen = set()
    for seed in range(30):
        env.reset(seed=seed)
        index = env.simulation.pair_index
        seen.add(index)
        assert env.stitch.pair.entry.centre[1] == pytest.approx(
            rows[index] + SLIDE * (rows[0] - rows[index])
        )
    assert seen == {0, 1, 2, 3}


def test_a_chosen_pair_lies_where_the_scene_has_it():
    env = made(scene=SceneConfig(hole_pair=2), needle_size=0.1)
    env.reset(seed=0)
    assert env.stitch.pair == PAIRS["simple"][1]
    assert env.simulation.pair_index == 1


def test_the_monitor_sees_the_drawn_pairs_holes():
    env = made("insert")
    for seed in (0, 1, 2):
        env.reset(seed=seed)
        monitor = EpisodeMonitor(env)
        monitor.reset()
        expert = Expert(env)
        done = False
        while not done:
            _, _, terminated, truncated, info = env.step(expert.action())
            monitor.update(info)
            done = terminated or truncated
        assert info["is_success"]
        assert not monitor.bite.wrong_hole
        assert math.isfinite(monitor.bite.entry_error)


# -- starts ----------------------------------------------------------------------------------------


def test_a_lying_needle_lies_on_the_pad_beside_the_ridge():
    env = made("grasp")
    half = np.array(SIZE[:2]) / 2
    for seed in range(60):
        env.reset(seed=seed)
        simulation = env.simulation
        line = needle.polyline(61, simulation.radius, simulation.tip_angle)
        pose = poses.square(simulation.needle())
        points = line @ pose[:3, :3].T + pose[:3, 3]
        bed = np.linalg.inv(simulation.placement.T_world_bed)
        lying = points @ bed[:3, :3].T + bed[:3, 3]
        assert np.all(np.abs(lying[:, 0] - ORIGIN[0]) < half[0] - simulation.shape.body_radius)
        slid = lying[:, 1] - simulation.placement.slide
        assert np.all(np.abs(slid - ORIGIN[1]) < half[1] - simulation.shape.body_radius)
        foot = -0.0080
        assert lying[:, 0].max() + simulation.shape.body_radius < foot
        height = points[:, 2] - SURFACE - simulation.shape.body_radius
        assert np.all(np.abs(height) < 2e-4)


def test_the_arms_start_within_the_axis_of_their_homes():
    env = made(robot_start=15.0)
    spread = []
    for seed in range(8):
        _, info = env.reset(seed=seed)
        drawn = info["randomisation"]["robot_start"].reshape(2, 3)
        for arm, shift in zip(ARMS, drawn, strict=True):
            home = (base_in_world(arm) @ start_in_base(arm))[:3, 3]
            tip = np.array(env.simulation.tip(arm)[:3])
            spread.append(tip - home)
            if arm == PSM2:
                np.testing.assert_allclose(tip - home, shift, atol=5e-4)
    assert np.abs(spread).max() <= 0.0155
    assert np.std(spread, axis=0).min() > 0.004


def test_psm1_starts_beside_the_exit():
    env = made("insert")
    for seed in range(40):
        env.reset(seed=seed)
        leave = env.stitch.pair.exit
        tip = np.array(env.simulation.tip(PSM1)[:3])
        beside = (tip - leave.centre) @ [math.cos(leave.turn), math.sin(leave.turn), 0.0]
        assert beside > BESIDE - 5e-4


# -- the expert ------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_the_expert_solves_everything_at_once(task):
    env = made(task)
    solved = 0
    for seed in range(500000, 500008):
        env.reset(seed=seed)
        solved += played(env)["is_success"]
    assert solved >= 7


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("arc", NEEDLE_ARCS)
def test_the_expert_sews_in_the_corners(arc, sign):
    """Insertion and pull-out with the phantom at its furthest, for each arc."""
    corner = {
        "phantom_turn": [sign * math.radians(15.0)],
        "phantom_shift": [sign * 0.010, 0.010],
    }
    axes = RandomisationConfig(phantom_turn=15.0, needle_arc=arc, phantom_shift=10.0)
    for task in ("insert", "pullout"):
        env = envs.make(TaskConfig(task, randomisation=axes))
        env.reset(seed=4, options={"randomisation": corner})
        assert env.simulation.placement.turn == corner["phantom_turn"][0]
        assert played(env)["is_success"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"randomization": {}}, "Did you mean 'randomisation'"),
        ({"randomisation": [1.0]}, "must be a dict"),
        (
            {"randomisation": {"phantom_shift": [0.001]}},
            "phantom_shift takes 2 numbers; 1 are given",
        ),
        ({"randomisation": {"phantom_shift": 0.001}}, "phantom_shift is 0.001; give a list of 2"),
        ({"randomisation": {"phantom_turn": ["left"]}}, "phantom_turn is .* finite numbers"),
        ({"randomisation": {"phantom_turn": [math.nan]}}, "phantom_turn is .* finite numbers"),
        ({"randomisation": {"phantom_turn": [-0.3]}}, "phantom_turn has -0.3; allowed: -0.26"),
        ({"randomisation": {"phantom_tun": [0.1]}}, "Did you mean 'phantom_turn'"),
        ({"randomisation": {"pair": [5.0]}}, "pair has 5; allowed: 0 to 4"),
        ({"randomisation": {"pair": [1.5]}}, "pair is .* whole numbers"),
        ({"randomisation": {"appearance": [99.0, 0.0]}}, "appearance has 99; allowed: 0 to"),
    ],
)
def test_options_that_no_reset_can_have_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        made().reset(seed=0, options=options)


def test_numbers_for_an_env_without_randomisation_are_refused():
    with pytest.raises(InputError, match=r"this env has no randomisation; .*phantom_turn"):
        envs.make(TaskConfig()).reset(options={"randomisation": {"phantom_turn": [0.1]}})


def test_what_was_reported_may_be_given_again():
    env = made(latency=2)
    _, info = env.reset(seed=3)
    _, again = env.reset(seed=4, options={"randomisation": info["randomisation"]})
    for axis, numbers in info["randomisation"].items():
        np.testing.assert_array_equal(again["randomisation"][axis], numbers)


def test_a_needle_that_is_given_is_the_one_that_is_drawn():
    """Whether or not the env draws needles itself, and back to its own."""
    shape = {"needle_arc": [math.pi / 3], "needle_size": [0.2], "needle_thickness": [0.3]}
    env = envs.make(TaskConfig(randomisation=RandomisationConfig(light=0.1)))
    size = (96, 96)
    env.reset(seed=0)
    own = env.image("front", size)
    for given in (shape, {axis: [0.0] for axis in shape}):
        env.reset(seed=0, options={"randomisation": given})
        fresh = envs.make(TaskConfig(randomisation=RandomisationConfig(light=0.1)))
        fresh.reset(seed=0, options={"randomisation": given})
        np.testing.assert_array_equal(env.image("front", size), fresh.image("front", size))
        assert np.array_equal(env.image("front", size), own) == (given is not shape)


def test_the_limits_of_the_axes_are_those_of_the_world():
    for axis, value in dataclasses.asdict(WORLD).items():
        if axis in RANDOMISATION_LIMITS and axis in AXES and axis != "needle_size":
            assert value == RANDOMISATION_LIMITS[axis]


@pytest.mark.parametrize("signs", list(itertools.product((-1.0, 1.0), repeat=3)))
def test_every_corner_of_the_arms_starts_is_reached(signs):
    env = made(robot_start=15.0)
    limit = RANDOMISATION_LIMITS["robot_start"] / 1e3
    given = {"robot_start": [limit * sign for sign in signs] * len(ARMS)}
    env.reset(seed=0, options={"randomisation": given})
    for arm in ARMS:
        home = (base_in_world(arm) @ start_in_base(arm))[:3, 3]
        shift = np.array(env.simulation.tip(arm)[:3]) - home
        np.testing.assert_allclose(shift, limit * np.array(signs), atol=5e-4)
    assert not env.simulation.touches_phantom(needle=False)


def test_ink_rings_the_pair_that_is_due_alone():
    config = TaskConfig(
        "place",
        scene=SceneConfig(ink="due", hole_pair=2),
        randomisation=RandomisationConfig(pair="any", phantom_shift=10),
    )
    env = envs.make(config)
    geoms = env.scene.ink_geoms
    assert len(geoms) == 4

    def ringed(model):
        return [index for index, geom in enumerate(geoms) if model.geom_group[geom] == VISIBLE]

    assert ringed(env.scene.model) == [1]
    drawn = set()
    for seed in range(24):
        env.reset(seed=seed)
        assert ringed(env.model) == [env.simulation.pair_index]
        drawn.add(env.simulation.pair_index)
    assert drawn == {0, 1, 2, 3}
    assert ringed(env.scene.model) == [1]
    env.close()
    assert build_scene(SceneConfig()).ink_geoms == ()
    with pytest.raises(InputError, match="marks the pair"):
        SceneConfig(ink="due", tissue="soft")
