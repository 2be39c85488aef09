"""Randomisation: each axis changes what it should, from the seed alone, and is restored."""

import dataclasses
import json
import math

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import cameras, names
from surgicai_vision.core.config import (
    RANDOMISATION_LIMITS,
    RandomisationConfig,
    SceneConfig,
    TaskConfig,
    from_mapping,
    to_mapping,
)
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs import observation, poses, randomisation, simulation
from surgicai_vision.scene import build_scene, compose, kinematics, needle
from surgicai_vision.scene.cameras import CameraPose

EVERYTHING = RandomisationConfig(
    light=0.4,
    colour=0.3,
    camera_shift=3.0,
    camera_turn=2.0,
    camera_fovy=2.0,
    needle_thickness=0.15,
    friction=0.2,
    phantom_shift=1.5,
    kinematic_error=0.3,
    needle_size=0.05,
    latency=2,
)


def made(task="grasp", obs_type="state", **axes):
    """An env with the given axes."""
    config = TaskConfig(task=task, randomisation=RandomisationConfig(**axes))
    return envs.make(config, obs_type=obs_type, cameras=("front", "wrist_psm2"), image_size=64)


def played(env, seed, steps=10):
    """The observations of some random actions."""
    rng = np.random.default_rng(seed)
    seen = [env.reset(seed=seed)[0]]
    return np.array(
        seen + [env.step(rng.uniform(-1, 1, 7).astype(np.float32))[0] for _ in range(steps)]
    )


def image(env):
    """What the front camera sees."""
    return env.observe()["front"]


@pytest.mark.parametrize("axis", RANDOMISATION_LIMITS)
def test_limits_are_refused_and_named(axis):
    with pytest.raises(InputError, match=axis):
        RandomisationConfig(**{axis: RANDOMISATION_LIMITS[axis] + 1})
    with pytest.raises(InputError, match=axis):
        RandomisationConfig(**{axis: -1})


def test_configuration_goes_through_plain_data():
    config = TaskConfig(randomisation=EVERYTHING)
    assert from_mapping(TaskConfig, to_mapping(config)) == config
    assert (
        envs.make_task("grasp", randomisation=to_mapping(EVERYTHING)).config.randomisation
        == EVERYTHING
    )


def test_off_shares_the_model_and_draws_nothing():
    env = made()
    _, info = env.reset(seed=3)
    assert env.model is build_scene(env.config.scene).model
    assert "randomisation" not in info


def test_an_axis_owns_its_model_and_leaves_the_shared_one_alone():
    env = envs.make(TaskConfig(randomisation=EVERYTHING))
    shared = build_scene(env.config.scene).model
    before = {
        name: np.copy(getattr(shared, name))
        for name in ("cam_pos", "geom_size", "mat_rgba", "mesh_vert")
    }
    env.reset(seed=0)
    assert env.model is not shared
    for name, values in before.items():
        np.testing.assert_array_equal(getattr(shared, name), values)
        assert not np.array_equal(getattr(env.model, name), values)


def test_draws_come_from_the_seed_and_are_reported():
    one, other = (envs.make(TaskConfig(randomisation=EVERYTHING)) for _ in range(2))
    first, again = one.reset(seed=5)[1]["randomisation"], other.reset(seed=5)[1]["randomisation"]
    assert tuple(first) == EVERYTHING.on
    for axis in EVERYTHING.on:
        np.testing.assert_array_equal(first[axis], again[axis])
    assert not np.array_equal(first["light"], one.reset(seed=6)[1]["randomisation"]["light"])


def test_one_more_axis_leaves_the_draws_of_the_others():
    rng = np.random.default_rng
    alone = randomisation.draw(RandomisationConfig(friction=0.2), rng(0))
    both = randomisation.draw(RandomisationConfig(friction=0.2, light=0.2), rng(0))
    assert len(alone) == len(both) == randomisation.SIZE
    assert sum(a != b for a, b in zip(alone, both, strict=True)) == len(
        randomisation.UNITS["light"]
    )


@pytest.mark.parametrize(
    "axis",
    [
        "light",
        "colour",
        "camera_shift",
        "camera_turn",
        "camera_fovy",
        "needle_thickness",
        "needle_size",
    ],
)
def test_an_axis_of_sight_changes_images(axis):
    plain, changed = (
        made(obs_type="pixels"),
        made(obs_type="pixels", **{axis: RANDOMISATION_LIMITS[axis] / 4}),
    )
    changed.reset(seed=1)
    plain.reset(seed=1)
    plain.set_state(changed.data.qpos, changed.data.qvel)
    assert not np.array_equal(image(plain), image(changed))


def test_restored_elsewhere_it_looks_and_moves_the_same():
    config = TaskConfig(task="insert", randomisation=EVERYTHING)
    one, other = (envs.make(config, obs_type="pixels_agent_pos", image_size=64) for _ in range(2))
    one.reset(seed=2)
    other.reset(seed=9)
    other.observe()
    rng = np.random.default_rng(0)
    for _ in range(5):
        one.step(rng.uniform(-1, 1, 7).astype(np.float32))
    other.set_state_vector(one.get_state())
    for _ in range(4):
        for view in ("front", "back"):
            np.testing.assert_array_equal(one.observe()[view], other.observe()[view])
        np.testing.assert_array_equal(one.get_state(), other.get_state())
        assert one.measure()["d_trans"] == other.measure()["d_trans"]
        action = rng.uniform(-1, 1, 7).astype(np.float32)
        one.step(action)
        other.step(action)


def test_a_randomised_state_is_refused_by_an_env_without():
    changed, plain = made(friction=0.2), made()
    changed.reset(seed=0)
    plain.reset(seed=1)
    before = plain.get_state()
    with pytest.raises(InputError, match="randomisation"):
        plain.set_state_vector(changed.get_state())
    np.testing.assert_array_equal(plain.get_state(), before)


@pytest.mark.parametrize(
    ("axis", "numbers"),
    [("appearance", [99.0, 1.0]), ("pair", [7.0]), ("needle_size", [-1.0]), ("friction", [-2.0])],
)
def test_a_state_with_numbers_that_no_episode_has_is_refused(axis, numbers):
    env = made(friction=0.2)
    env.reset(seed=1)
    state = env.get_state()
    drawn = randomisation._PLACES["friction"].start
    first = state.tolist().index(env.simulation.draws[drawn]) - drawn
    spoilt = state.copy()
    spoilt[first : first + randomisation.SIZE][randomisation._PLACES[axis]] = numbers
    with pytest.raises(InputError, match=f"randomisation: {axis} has"):
        env.set_state_vector(spoilt)
    env.set_state_vector(state)
    np.testing.assert_array_equal(env.get_state(), state)


def test_replacing_numbers_of_a_state_leaves_the_env_where_it_is():
    env = made(light=0.3)
    env.reset(seed=1)
    start = env.get_state()
    env.step(np.ones(7, np.float32))
    before = env.get_state()
    redrawn = env.simulation.redrawn(start, {"light": [0.1, 0.0, -0.1]})
    np.testing.assert_array_equal(env.get_state(), before)
    assert (redrawn != start).sum() == 3
    env.set_state_vector(redrawn)
    assert env.simulation.draws[randomisation._PLACES["light"]] == (0.1, 0.0, -0.1)


def test_a_snapshot_continues_with_the_same_episodes():
    """In the same env, and in one that has drawn others; the snapshot may be stored as JSON."""
    env = made(phantom_shift=3.0)
    env.reset(seed=7)
    state, generator = env.snapshot
    stored = json.loads(json.dumps(generator))
    following = [env.reset()[1]["randomisation"]["phantom_shift"] for _ in range(3)]
    other = made(phantom_shift=3.0)
    other.reset(seed=8)
    other.reset()
    for each in (env, other):
        each.snapshot = (state, stored)
        again = [each.reset()[1]["randomisation"]["phantom_shift"] for _ in range(3)]
        np.testing.assert_array_equal(again, following)


def test_the_same_seed_gives_the_same_trajectory_again():
    env = envs.make(TaskConfig(task="place", randomisation=EVERYTHING))
    first = played(env, 4)
    played(env, 5)
    np.testing.assert_array_equal(first, played(env, 4))


@pytest.mark.parametrize("task", ["grasp", "suture"])
def test_what_is_drawn_for_a_seed_is_known_without_an_env(task):
    everything = dataclasses.replace(EVERYTHING, appearance="heldout", distractors=3, latency=0)
    env = envs.make(TaskConfig(task, randomisation=everything))
    for seed in (3, names.TEST_SEED):
        _, info = env.reset(seed=seed)
        drawn = randomisation.drawn(everything, seed)
        assert drawn.keys() == info["randomisation"].keys()
        for axis, numbers in info["randomisation"].items():
            np.testing.assert_array_equal(drawn[axis], numbers, err_msg=axis)


@pytest.mark.parametrize(("choice", "allowed"), [("train", ("1/3", "1/2")), ("heldout", ("3/8",))])
def test_an_arc_is_named_by_its_number(choice, allowed):
    config = RandomisationConfig(needle_arc=choice)
    drawn = {
        randomisation.arc_name(float(randomisation.drawn(config, seed)["needle_arc"][0]))
        for seed in range(20)
    }
    assert drawn == set(allowed)


def test_an_error_that_is_drawn_anew_moves_nothing():
    """Where the arms are and are told to be stays; what they report is off by the difference."""
    error = RandomisationConfig(kinematic_error=0.5)
    env = made("place", kinematic_error=0.5)
    simulation = env.simulation
    env.reset(seed=3)
    for _ in range(5):
        env.step(np.array([0.5, -0.5, 0.5, 0.2, 0.1, -0.3, -1], np.float32))
    state = simulation.get_state()

    def seen():
        where = [
            (simulation.tip(arm), simulation.true_pose(arm, simulation.commands[arm]))
            for arm in names.ARMS
        ]
        return np.array(where), {arm: simulation.reported_joints(arm) for arm in names.ARMS}

    (where, reported), offsets = seen(), simulation.offsets
    others = {
        axis: numbers.tolist() for axis, numbers in randomisation.drawn(error, seed=8).items()
    }
    env.set_state_vector(simulation.redrawn(state, others))
    (moved, now), after = seen(), simulation.offsets
    np.testing.assert_allclose(moved, where, atol=1e-9)
    for arm in names.ARMS:
        change = np.subtract(offsets[arm], after[arm])
        assert np.abs(change[:3]).min() > 1e-4
        np.testing.assert_allclose(np.subtract(now[arm], reported[arm]), change, atol=1e-12)
    back = {"kinematic_error": [*offsets["psm1"][:3], *offsets["psm2"][:3]]}
    env.set_state_vector(simulation.redrawn(simulation.get_state(), back))
    np.testing.assert_allclose(simulation.get_state(), state, atol=1e-9)


def test_the_phantom_moves_with_its_goals():
    plain, moved = made("place"), made("place", phantom_shift=2.0)
    _, info = moved.reset(seed=1)
    plain.reset(seed=1)
    shift = [*info["randomisation"]["phantom_shift"], 0.0]
    assert np.linalg.norm(shift) > 1e-4
    body = moved.named("body", "phantom")
    np.testing.assert_allclose(moved.data.xpos[body] - plain.data.xpos[body], shift, atol=1e-12)
    np.testing.assert_allclose(
        np.subtract(moved.stitch.place_tip[:3], plain.stitch.place_tip[:3]), shift, atol=1e-12
    )


def test_the_endoscope_moves_as_one():
    env = made(camera_turn=3.0, camera_shift=3.0)
    env.reset(seed=0)
    left, right = (env.model.camera(name).pos for name in ("front", "front_right"))
    assert math.isclose(np.linalg.norm(left - right), 0.004, rel_tol=1e-6)


def test_a_thicker_needle_lies_higher():
    env, plain = made(needle_thickness=0.3), made()
    for seed in range(4):
        _, info = env.reset(seed=seed)
        plain.reset(seed=seed)
        grown = float(info["randomisation"]["needle_thickness"][0])
        rise = env.needle_pose()[2] - plain.needle_pose()[2]
        assert abs(rise - grown * needle.BODY_RADIUS) < 4e-5


def test_a_needles_size_is_that_of_its_arc_its_mass_and_its_stitch():
    """What collides, what is drawn, the watched tip and the goals all lie on the drawn arc."""
    axes = {"randomisation": RandomisationConfig(needle_size=0.1), "scene": SceneConfig(thread=10)}
    env, plain = envs.make(TaskConfig("insert", **axes)), build_scene(SceneConfig(thread=10)).model
    radii = set()
    for seed in range(4):
        _, info = env.reset(seed=seed)
        size = 1.0 + float(info["randomisation"]["needle_size"][0])
        radius, model, data = size * needle.RADIUS, env.model, env.data
        radii.add(radius)
        pose = poses.square(env.simulation.needle())
        for index in env.scene.needle_geoms:
            way = data.geom_xmat[index].reshape(3, 3)[:, 2] * model.geom_size[index, 1]
            for end in (data.geom_xpos[index] + way, data.geom_xpos[index] - way):
                assert np.linalg.norm(pose[:3, :3].T @ (end - pose[:3, 3])) == pytest.approx(
                    radius, abs=1e-9
                )
        tip = env.simulation.needle_point(needle.TIP_ANGLE)
        np.testing.assert_allclose(data.site("needle_tip").xpos, tip, atol=1e-9)
        np.testing.assert_allclose(
            data.body("thread_0").xpos, env.simulation.needle_point(0.0), atol=1e-9
        )
        entry, leave = (
            np.array(hole.centre) for hole in (env.stitch.pair.entry, env.stitch.pair.exit)
        )
        for hole in (entry, leave):
            assert np.linalg.norm(hole - env.stitch.centre) == pytest.approx(radius, abs=1e-9)
        mesh = slice(
            model.mesh("needle").vertadr[0],
            model.mesh("needle").vertadr[0] + model.mesh("needle").vertnum[0],
        )
        longer = (
            np.ptp(model.mesh_vert[mesh], axis=0).max()
            - np.ptp(plain.mesh_vert[mesh], axis=0).max()
        )
        chord = 2 * needle.RADIUS * math.sin(needle.TIP_ANGLE / 2)
        assert longer == pytest.approx((size - 1.0) * chord, abs=5e-5)
        body = model.body("needle").id
        assert model.body_mass[body] == pytest.approx(size * plain.body_mass[body])
        assert model.body_invweight0[body, 0] != plain.body_invweight0[body, 0]
        assert model.stat.extent == plain.stat.extent
    assert len(radii) == 4
    randomisation.apply(env.scene, env.model, randomisation.NOTHING)
    for name in ("geom_pos", "geom_size", "body_mass", "body_inertia", *randomisation.DERIVED):
        np.testing.assert_array_equal(getattr(env.model, name), getattr(plain, name))


@pytest.mark.parametrize(
    ("task", "seed"), [(task, seed) for task in ("insert", "handoff", "pullout") for seed in (1, 2)]
)
def test_the_expert_threads_needles_of_any_size(task, seed):
    env = made(task, needle_size=0.1)
    env.reset(seed=seed)
    expert, ended = Expert(env), False
    while not ended:
        _, _, terminated, truncated, info = env.step(expert.action())
        ended = terminated or truncated
    assert info["is_success"]


def test_a_size_that_leaves_no_room_for_the_stitch_is_refused():
    scene = SceneConfig(layout="3dmed_straight", hole_pair=4)
    with pytest.raises(InputError, match="needle_size"):
        envs.make(
            TaskConfig("insert", scene=scene, randomisation=RandomisationConfig(needle_size=0.1))
        )
    envs.make(TaskConfig("grasp", scene=scene, randomisation=RandomisationConfig(needle_size=0.1)))


def test_an_arm_does_not_know_its_joint_error():
    env, plain = made(kinematic_error=1.0), made()
    _, info = env.reset(seed=7)
    plain.reset(seed=7)
    offsets = info["randomisation"]["kinematic_error"]
    assert np.all(np.abs(offsets) <= np.tile(randomisation.JOINT_ERROR, 2))
    ids = env.scene.arms["psm2"]
    told = env.data.qpos[ids.qpos] - [*offsets[3:], 0, 0, 0]
    expected = kinematics.forward(told, "400006")
    np.testing.assert_allclose(env.agent_pos()[:3], expected[:3, 3], atol=1e-6)
    assert np.linalg.norm(env.agent_pos()[:3] - plain.agent_pos()[:3]) > 1e-3
    # Success uses the true pose: the arm really is at its start.
    np.testing.assert_allclose(env.simulation.tip("psm2"), plain.simulation.tip("psm2"), atol=5e-4)


def test_an_action_takes_effect_after_the_latency():
    env = made(latency=3)
    env.reset(seed=0)
    action = np.array([1, 0, 0, 0, 0, 0, 0], dtype=np.float32)
    start = env.simulation.commands["psm2"].pose[0]
    moved = []
    for _ in range(5):
        env.step(action)
        moved.append(env.simulation.commands["psm2"].pose[0] - start)
    np.testing.assert_allclose(moved, [0, 0, 0, 0.0005, 0.001], atol=1e-12)


def test_the_whole_state_holds_everything():
    assert simulation.USED <= compose.USER_DATA


def test_the_fast_state_vector_equals_the_plain_one():
    rng = np.random.default_rng(0)
    for task in ("grasp", "insert", "pullout"):
        env = envs.make(TaskConfig(task=task))
        env.reset(seed=1)
        for _ in range(10):
            fast = env.step(rng.uniform(-1, 1, 7).astype(np.float32))[0]
            arm, tip = env.subtask.arm, env.simulation.tip(env.subtask.arm)
            achieved, desired = env.subtask.target(env.simulation, env.stitch)
            goal = env.simulation.to_base(
                arm, poses.compose(desired, poses.relative(achieved, tip))
            )
            plain = observation.state_vector(
                arm, env.simulation.to_base(arm, tip), goal, env.simulation.jaw(arm)
            )
            np.testing.assert_allclose(fast, plain, atol=2e-5)


@pytest.mark.parametrize("task", ["grasp", "place", "insert", "handoff", "pullout"])
def test_the_expert_copes_with_everything(task):
    env = envs.make(TaskConfig(task=task, randomisation=dataclasses.replace(EVERYTHING, latency=1)))
    expert = Expert(env)
    solved = 0
    for seed in range(3):
        env.reset(seed=seed)
        done = False
        while not done:
            _, _, terminated, truncated, info = env.step(expert.action())
            done = terminated or truncated
        solved += info["is_success"]
    assert solved >= 2


def test_a_camera_of_another_distribution_moves_as_front_does() -> None:
    axes = {"camera_shift": 3.0, "camera_turn": 2.0, "camera_fovy": 2.0}
    without = envs.make(TaskConfig(randomisation=RandomisationConfig(**axes)))
    without.reset(seed=3)
    pose = CameraPose((0.12, 0.03, 0.10), (-0.9, 0.0, -0.5), (0.0, 0.0, 1.0), 0.7)
    cameras.register_camera("side", pose)
    try:
        env = envs.make(TaskConfig(randomisation=RandomisationConfig(**axes)))
        env.reset(seed=3)
        moved = env.model.camera("front").pos - build_scene().model.camera("front").pos
        np.testing.assert_allclose(env.model.camera("side").pos, pose.position + moved, atol=1e-12)
        assert env.model.camera("side").fovy != build_scene().model.camera("side").fovy
        for name in (name for name in names.CAMERAS if name not in names.CROPS):
            for key in ("pos", "quat", "fovy"):
                ours, before = (getattr(each.model.camera(name), key) for each in (env, without))
                np.testing.assert_array_equal(ours, before)
        without.reset(seed=4)  # an env that was made before goes on without it
    finally:
        cameras.CAMERAS.unregister("side")
