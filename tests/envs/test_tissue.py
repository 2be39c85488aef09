"""Soft tissue in motion: it is pierced anywhere, drags, yields, tears; its state is complete."""

import dataclasses
import math

import numpy as np
import pytest
from helpers.driven_needle import TURN, Circle, carry, drive, driven, move, put, whole_way

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, SceneConfig, TaskConfig
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs import randomisation
from surgicai_vision.envs.hole_crossing import OUT
from surgicai_vision.envs.tissue import INSIDE, OUTSIDE, THROUGH, TRAILING
from surgicai_vision.scene.holes import PAIRS, HolePair
from surgicai_vision.scene.tissue import FORCES

SOFT = SceneConfig(tissue="soft")
PHANTOM = FORCES["phantom"]


def points(pair, along=0.0, up=0.0):
    """Return two points (3,) on the flanks, along the wound and up from a pair's marks [m]."""
    shift = along * np.array(pair.entry.axes[1])
    return [
        np.array(hole.centre) + shift - math.copysign(up, hole.tilt) * np.array(hole.axes[0])
        for hole in (pair.entry, pair.exit)
    ]


def at_start(simulation, circle):
    """Put the needle in front of the tissue; return its angles before and after the whole way."""
    first, last = whole_way(simulation, circle)
    simulation.reset()
    put(simulation, circle.pose(first))
    assert simulation.tissue.stage == OUTSIDE
    return first, last


def driven_to(stage, scene=SOFT, pair=1):
    """Return a simulation driven to a stage, its circle and its angle [rad]."""
    simulation = driven(scene)
    circle = Circle(*points(PAIRS[scene.layout][pair - 1]), simulation.radius)
    angle, last = at_start(simulation, circle)
    for _ in range(int((angle - last) / TURN)):
        angle -= TURN
        drive(simulation, circle, angle + TURN, angle)
        if simulation.tissue.stage == stage:
            break
    assert simulation.tissue.stage == stage
    drive(simulation, circle, angle, angle - 2 * TURN)
    return simulation, circle, angle - 2 * TURN


def force(simulation):
    return float(np.linalg.norm(simulation.tissue.force_on_needle()))


def settled_force(simulation, steps=25):
    """Return the force [N] after half a second with the hand at rest."""
    for _ in range(steps):
        simulation.advance(names.PSM1, [0.0] * 7, envs.base.StepSize.of("paper"))
    return force(simulation)


def assert_passes(simulation, pair, ends, error=2e-4):
    """Drive the needle all the way from one of `ends` to the other; check the bite it makes."""
    tissue = simulation.tissue
    circle = Circle(*ends, simulation.radius)
    first, last = at_start(simulation, circle)
    stages, passed, before, after = [], [], [], []

    def note():
        for value, values in ((tissue.stage, stages), (tissue.passed(pair), passed)):
            if not values or values[-1] != value:
                values.append(value)
        (before if tissue.stage == OUTSIDE and not tissue.bites else after).append(
            force(simulation)
        )

    drive(simulation, circle, first, last, note)
    assert stages == [OUTSIDE, INSIDE, THROUGH, TRAILING, OUTSIDE]
    assert passed == [0, 1, 2, OUT]
    (bite,) = tissue.bites
    assert bite.is_done and bite.tears == tissue.tears == 0
    assert np.linalg.norm(np.array(bite.entry) - ends[0]) < error
    assert np.linalg.norm(np.array(bite.exit) - ends[1]) < error
    chord = np.linalg.norm(ends[1] - ends[0])
    assert chord < bite.length < 1.3 * chord
    # The skin gives way up to about its puncture force, less where the tip goes through between
    # two control steps; nothing later takes more than the exit and friction.
    assert 0.7 * PHANTOM.puncture_in < max(before) < 1.4 * PHANTOM.puncture_in
    rub = PHANTOM.puncture_out + PHANTOM.cutting + PHANTOM.friction * bite.length
    assert max(after) < 1.5 * rub
    assert after[-1] == 0.0


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("layout", PAIRS)
def test_every_pair_can_be_sewn_both_ways_on_and_off_its_marks(layout, index):
    simulation = driven(SceneConfig(layout=layout, tissue="soft"))
    pair = PAIRS[layout][index]
    back = HolePair(pair.exit, pair.entry)
    for along, up in ((0.0, 0.0), (0.003, 0.001), (-0.004, -0.001)):
        ends = points(pair, along, up)
        assert_passes(simulation, pair, ends)
        assert_passes(simulation, back, ends[::-1])


@pytest.mark.parametrize("seed", range(8))
def test_it_can_be_pierced_wherever_it_lies_with_every_needle(seed):
    """Phantom shifted and turned, needles of other radii, arcs and thicknesses."""
    axes = RandomisationConfig(
        phantom_shift=10.0, phantom_turn=15.0, needle_size=0.2, needle_arc="any", pair="any"
    )
    draws = randomisation.draw(axes, np.random.default_rng(seed))
    simulation = driven(SOFT, draws)
    ends = points(simulation.pair)
    assert_passes(simulation, simulation.pair, ends)
    assert_passes(simulation, HolePair(simulation.pair.exit, simulation.pair.entry), ends[::-1])


def test_a_bite_of_another_direction_does_not_count():
    simulation = driven(SOFT)
    pair = PAIRS["simple"][0]
    circle = Circle(*points(pair)[::-1], simulation.radius)
    first, last = at_start(simulation, circle)
    drive(simulation, circle, first, last, lambda: _is_zero(simulation.tissue.passed(pair)))
    assert simulation.tissue.bites[0].entry_side == "exit"


def _is_zero(value):
    assert value == 0


def test_several_stitches_in_one_phantom():
    simulation = driven(SOFT)
    tissue = simulation.tissue
    for index in (0, 1, 2, 3, 0):
        circle = Circle(*points(PAIRS["simple"][index], up=5e-4 * index), simulation.radius)
        first, last = whole_way(simulation, circle)
        carry(simulation, circle.pose(first))
        drive(simulation, circle, first, last)
    assert [bite.entry_piece for bite in tissue.bites] == [1, 2, 3, 4, 1]
    assert all(bite.is_done and bite.exit is not None for bite in tissue.bites)


# -- what it resists -------------------------------------------------------------------------------


def test_the_skin_gives_way_before_it_is_pierced():
    """A tip that rests in a dent is pushed back in proportion to its depth."""
    simulation = driven(SOFT)
    pair = PAIRS["simple"][0]
    circle = Circle(*points(pair), simulation.radius)
    first, _ = at_start(simulation, circle)
    drive(simulation, circle, first, simulation.tip_angle)
    dents, forces = [], []
    for turn in (0.02, 0.04, 0.06, 0.08):
        drive(simulation, circle, simulation.tip_angle, simulation.tip_angle - turn)
        forces.append(settled_force(simulation))
        dents.append(-pair.entry.height(simulation.needle_point(simulation.tip_angle)))
    assert simulation.tissue.stage == OUTSIDE
    slope = np.polyfit(dents, forces, 1)[0]
    assert slope == pytest.approx(PHANTOM.skin_stiffness, rel=0.15)


def test_a_tip_that_is_flat_on_the_skin_does_not_go_through():
    simulation = driven(SOFT)
    pair = PAIRS["simple"][0]
    circle = Circle(*points(pair), simulation.radius)
    first, _ = at_start(simulation, circle)
    drive(simulation, circle, first, simulation.tip_angle)
    pose = circle.pose(simulation.tip_angle)
    pivot = np.array(pair.entry.centre)
    # 65° off the inward normal: the circle's pose turned about the wound.
    turn = math.radians(-90.0)
    about = np.array(
        [
            [math.cos(turn), 0, math.sin(turn)],
            [0, 1, 0],
            [-math.sin(turn), 0, math.cos(turn)],
        ]
    )
    pose[:3, :3] = about @ pose[:3, :3]
    pose[:3, 3] = pivot + about @ (pose[:3, 3] - pivot)
    lifted = pose.copy()
    lifted[:3, 3] += 0.003 * np.array(pair.entry.normal)
    put(simulation, lifted)
    for depth in np.arange(0.003, -0.0016, -0.0003):
        pushed = pose.copy()
        pushed[:3, 3] += depth * np.array(pair.entry.normal)
        move(simulation, pushed)
        drive_still(simulation)
    assert simulation.tissue.stage == OUTSIDE
    assert force(simulation) > PHANTOM.puncture_in


def drive_still(simulation, steps=1):
    for _ in range(steps):
        assert simulation.advance(names.PSM1, [0.0] * 7, envs.base.StepSize.of("paper"))


def test_friction_grows_with_the_embedded_length():
    """Between the two punctures the shaft's force is cutting force plus friction per length."""
    simulation, circle, angle = driven_to(INSIDE)
    lengths, forces = [], []

    def note():
        if simulation.tissue.stage == INSIDE:
            lengths.append(simulation.tissue.bites[-1].length)
            forces.append(force(simulation))

    drive(simulation, circle, angle, angle - math.radians(14.0), note)
    expected = PHANTOM.cutting + PHANTOM.friction * np.array(lengths)
    np.testing.assert_allclose(forces, expected, rtol=0.25)


def test_a_needle_that_rests_is_held_by_friction():
    """Stiction: when the hand lets go, the needle stays where it is."""
    simulation, _, _ = driven_to(THROUGH)
    simulation.data.eq_active[simulation.model.equality("hand").id] = 0
    before = np.array(simulation.needle())
    drive_still(simulation, 50)
    assert np.linalg.norm(np.array(simulation.needle())[:3] - before[:3]) < 0.0015


def pushed(simulation, pose, shift):
    """Push the hand across the shaft in steps of 0.2 mm; return the largest force [N]."""
    largest = 0.0
    size = float(np.linalg.norm(shift))
    for share in np.linspace(0.0, 1.0, max(2, int(size / 2e-4))):
        moved = pose.copy()
        moved[:3, 3] += share * shift
        move(simulation, moved)
        drive_still(simulation)
        largest = max(largest, force_across(simulation))
    return largest


def force_across(simulation, steps=0):
    """Return the force across the plane of the stitch [N], after `steps` at rest."""
    drive_still(simulation, steps)
    return abs(float(simulation.tissue.force_on_needle()[1]))


def test_across_the_shaft_it_is_elastic_up_to_the_yield_force():
    simulation, circle, angle = driven_to(THROUGH)
    pose = circle.pose(angle)
    shift = np.array([0.0, 0.001, 0.0])
    # Two places hold the shaft.
    assert pushed(simulation, pose, shift) == pytest.approx(
        2 * PHANTOM.lateral_stiffness * 0.001, rel=0.15
    )
    pushed(simulation, pose + _at(shift), -shift)
    assert force_across(simulation, 25) < 0.02
    assert simulation.tissue.tears == 0


def _at(shift):
    moved = np.zeros((4, 4))
    moved[:3, 3] = shift
    return moved


def test_beyond_the_yield_force_a_part_stays_and_the_needle_is_pulled_back():
    simulation, circle, angle = driven_to(THROUGH)
    pose = circle.pose(angle)
    shift = np.array([0.0, 0.003, 0.0])
    largest = pushed(simulation, pose, shift)
    drive_still(simulation, 5)
    # The needle tilts a little in the hand: measure how far its point in the skin moved.
    way = simulation.needle_point(angle)[1] - simulation.tissue.bite.entry[1]
    stayed = (way - PHANTOM.yield_force / PHANTOM.lateral_stiffness) / 2
    hardened = PHANTOM.yield_force + PHANTOM.hardening * stayed
    assert largest == pytest.approx(2 * hardened, rel=0.1)
    pushed(simulation, pose + _at(shift), -shift)
    left = 2 * PHANTOM.lateral_stiffness * stayed
    assert force_across(simulation, 25) == pytest.approx(left, rel=0.15)
    assert simulation.tissue.tears == 0


def test_at_the_tear_force_it_tears_and_the_force_drops():
    simulation, circle, angle = driven_to(THROUGH)
    pose = circle.pose(angle)
    largest = pushed(simulation, pose, np.array([0.0, 0.006, 0.0]))
    tissue = simulation.tissue
    assert tissue.tears >= 2 and tissue.bite.tears == tissue.tears
    assert largest < 2.3 * PHANTOM.tear_force
    assert force_across(simulation, 25) < 0.8 * largest


# -- back and forth --------------------------------------------------------------------------------


def test_a_needle_that_is_drawn_back_leaves_as_it_came():
    simulation, circle, angle = driven_to(TRAILING)
    tissue = simulation.tissue
    first, _ = whole_way(simulation, circle)
    stages = [tissue.stage]

    def note():
        if stages[-1] != tissue.stage:
            stages.append(tissue.stage)

    drive(simulation, circle, angle, first, note)
    assert stages == [TRAILING, THROUGH, INSIDE, OUTSIDE]
    (bite,) = tissue.bites
    assert bite.is_done and bite.exit is None and bite.exit_side == ""
    assert tissue.passed(PAIRS["simple"][0]) == 0
    assert force(simulation) == 0.0
    drive(simulation, circle, first, whole_way(simulation, circle)[1])
    assert [bite.exit is None for bite in tissue.bites] == [True, False]


@pytest.mark.parametrize(("task", "stage"), [("handoff", THROUGH), ("pullout", THROUGH)])
def test_starts_with_an_inserted_needle_are_embedded_and_pull_at_little(task, stage):
    env = envs.make(TaskConfig(task, SOFT))
    for seed in range(names.VALIDATION_SEED, names.VALIDATION_SEED + 5):
        env.reset(seed=seed)
        tissue = env.simulation.tissue
        assert tissue.stage == stage
        assert tissue.passed(env.stitch.pair) == 2 == env.simulation.task_state.holes_passed
        assert force(env.simulation) < 0.6
        assert math.dist(tissue.bite.entry, env.stitch.pair.entry.centre) < 0.001


def test_starts_of_insert_are_outside():
    env = envs.make(TaskConfig("insert", SOFT))
    for seed in range(names.VALIDATION_SEED, names.VALIDATION_SEED + 10):
        env.reset(seed=seed)
        assert env.simulation.tissue.stage == OUTSIDE
        assert force(env.simulation) == 0.0


# -- the whole state -------------------------------------------------------------------------------


@pytest.mark.parametrize("thread", [0, 10])
def test_a_state_in_the_middle_of_a_stitch_goes_on_bit_for_bit_anywhere(thread):
    axes = RandomisationConfig(phantom_shift=5.0, phantom_turn=5.0, friction=0.2)
    config = TaskConfig("suture", dataclasses.replace(SOFT, thread=thread), randomisation=axes)
    env, other = envs.make(config), envs.make(config)
    env.reset(seed=names.VALIDATION_SEED)
    other.reset(seed=names.VALIDATION_SEED + 1)
    expert = Expert(env)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 7)).astype(np.float32)
    seen = set()
    for _ in range(env.config.max_steps):
        stage = (env.simulation.tissue.stage, env.simulation.tissue.thread_drawn > 0.012)
        if stage not in seen:
            seen.add(stage)
            state = env.get_state()
            futures = []
            for one in (env, other, env):
                one.set_state_vector(state)
                np.testing.assert_array_equal(one.get_state(), state)
                for action in actions:
                    one.step(action)
                futures.append(one.get_state())
            np.testing.assert_array_equal(futures[0], futures[1])
            np.testing.assert_array_equal(futures[0], futures[2])
            env.set_state_vector(state)
        *_, terminated, truncated, info = env.step(expert.action())
        if terminated or truncated:
            break
    assert info["is_success"]
    assert {stage for stage, _ in seen} == {OUTSIDE, INSIDE, THROUGH, TRAILING}
    assert any(drawn for _, drawn in seen) == bool(thread)


def test_a_slider_that_holds_nothing_is_restored_where_it_was():
    """Some creep by the last bits while the needle moves."""
    config = TaskConfig("pullout", dataclasses.replace(SOFT, thread=10))
    env, other = envs.make(config), envs.make(config)
    env.reset(seed=names.VALIDATION_SEED)
    other.reset(seed=names.VALIDATION_SEED + 1)
    slider = env.model.joint("thread_slider_0")
    env.data.qpos[slider.qposadr[0]] = 9e-22
    env.data.qvel[slider.dofadr[0]] = 5e-20
    state = env.get_state()
    other.set_state_vector(state)
    np.testing.assert_array_equal(other.get_state(), state)


def test_reading_forces_changes_nothing():
    plain, read = (envs.make(TaskConfig("insert", SOFT)) for _ in range(2))
    for env in (plain, read):
        env.reset(seed=names.VALIDATION_SEED)
    for _ in range(60):
        action = Expert(plain).action()
        plain.step(action)
        read.simulation.tissue.force_on_needle()
        assert isinstance(read.simulation.tissue.bites, tuple)
        read.step(action)
    np.testing.assert_array_equal(plain.get_state(), read.get_state())
    assert plain.simulation.tissue.bites


# -- the expert ------------------------------------------------------------------------------------


@pytest.mark.parametrize("forces", FORCES)
def test_the_expert_sews_every_tissue(forces):
    env = envs.make(TaskConfig("insert", SceneConfig(tissue="soft", tissue_forces=forces)))
    expert = Expert(env)
    for seed in range(names.VALIDATION_SEED, names.VALIDATION_SEED + 3):
        env.reset(seed=seed)
        largest = 0.0
        info = {"is_success": False}
        for _ in range(env.config.max_steps):
            *_, terminated, truncated, info = env.step(expert.action())
            largest = max(largest, force(env.simulation))
            if terminated or truncated:
                break
        assert info["is_success"]
        assert 0.5 * FORCES[forces].puncture_in < largest < 3.0
        (bite,) = env.simulation.tissue.bites
        assert math.dist(bite.entry, env.stitch.pair.entry.centre) < 0.002
        assert bite.tears == 0


# -- the thread ------------------------------------------------------------------------------------


def test_the_thread_follows_through_the_needles_path_and_is_held_there():
    env = envs.make(TaskConfig("pullout", dataclasses.replace(SOFT, thread=10)))
    env.reset(seed=names.VALIDATION_SEED)
    tissue = env.simulation.tissue
    expert = Expert(env)
    drawn, fastest = [], 0.0
    first = env.model.joint("thread_0").dofadr[0]
    for step in range(env.config.max_steps):
        action = expert.action()
        env.step(action)
        if tissue.stage == OUTSIDE:
            drawn.append(tissue.thread_drawn)
            fastest = max(fastest, float(np.abs(env.data.qvel[first : first + 30]).max()))
        if len(drawn) > 40 or step > 150:
            break
    assert np.all(np.diff(drawn) > -3e-4) and drawn[-1] > 0.010, "more and more is drawn out"
    assert fastest < 60.0, "nothing kicks it"
    bite = tissue.bites[-1]
    starts = np.array([env.data.body(f"thread_{index}").xpos for index in range(10)])
    for point in (bite.entry, bite.exit):
        assert distance_to_polyline(np.array(point), starts) < 0.0015
    base = env.simulation.needle_point(0.0)
    assert tissue.thread_drawn == pytest.approx(math.dist(base, bite.exit), abs=0.004)


def test_the_thread_runs_through_two_stitches_in_their_order():
    """From the needle: the second bite's exit and entry, then the first's, each a bite apart."""
    simulation = driven(dataclasses.replace(SOFT, thread=20))
    circles = [Circle(*points(pair), simulation.radius) for pair in PAIRS["simple"][:2]]
    first, last = at_start(simulation, circles[0])
    drive(simulation, circles[0], first, last)
    around(simulation, *circles, last, first)
    drive(simulation, circles[1], first, last)
    bites = simulation.tissue.bites
    assert len(bites) == 2 and all(bite.is_done for bite in bites)
    # Lift it clear of the ridge, so that the thread is drawn taut.
    for lift in np.arange(0.0, 0.015, 5e-4):
        pose = circles[1].pose(last)
        pose[2, 3] += lift
        move(simulation, pose)
        drive_still(simulation)
    starts = np.array([simulation.data.body(f"thread_{index}").xpos for index in range(20)])
    ways = [
        place_on_polyline(np.array(point), starts)
        for bite in bites[::-1]
        for point in (bite.exit, bite.entry)
    ]
    assert ways == sorted(ways)
    for exit_way, entry_way, bite in ((ways[0], ways[1], bites[1]), (ways[2], ways[3], bites[0])):
        assert entry_way - exit_way == pytest.approx(bite.length, abs=0.003)


def around(simulation, before, after, last, first):
    """Bring the needle from the end of one circle to the start of another, high over the ridge."""
    steps = 120
    high = np.concatenate([np.linspace(0, 1, 30), np.ones(steps - 60), np.linspace(1, 0, 30)])
    for share, lift in zip(np.linspace(0.0, 1.0, steps), high, strict=True):
        pose = after.pose(last + share * (first - last))
        pose[:3, 3] = (1.0 - share) * before.centre + share * after.centre
        pose[2, 3] += 0.02 * lift
        move(simulation, pose)
        drive_still(simulation)


def place_on_polyline(point, line):
    """Return the distance [m] along a polyline (N, 3) to the place nearest to a point."""
    ways = np.diff(line, axis=0)
    lengths = np.linalg.norm(ways, axis=1)
    share = np.clip(((point - line[:-1]) * ways).sum(1) / lengths**2, 0.0, 1.0)
    apart = np.linalg.norm(line[:-1] + share[:, None] * ways - point, axis=1)
    nearest = int(apart.argmin())
    assert apart[nearest] < 0.004
    return float(lengths[:nearest].sum() + share[nearest] * lengths[nearest])


def distance_to_polyline(point, line):
    """Return the distance [m] of a point from a polyline (N, 3)."""
    ways = np.diff(line, axis=0)
    share = np.clip(((point - line[:-1]) * ways).sum(1) / (ways**2).sum(1), 0.0, 1.0)
    return float(np.linalg.norm(line[:-1] + share[:, None] * ways - point, axis=1).min())
