"""The visible soft tissue: dents, lifts, wounds and marks, as a function of the state alone."""

import itertools
import math

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, SceneConfig, TaskConfig
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs.camera_rig import Images
from surgicai_vision.envs.skin import PLACE, WAY, Skin
from surgicai_vision.envs.tissue import INSIDE, OUTSIDE, THROUGH
from surgicai_vision.scene.holes import PAIRS, SURFACE
from surgicai_vision.scene.rotations import quaternion_to_matrix
from surgicai_vision.scene.visual.skin_state import Pull, SkinState, Wound, displaced
from surgicai_vision.scene.visual.soft_skin import MATERIALS, SoftSkin

SOFT = SceneConfig(tissue="soft")
SIZE = 96


def make(task="insert", **options):
    return envs.make(
        TaskConfig(task, options.pop("scene", SOFT), **options),
        obs_type="pixels",
        cameras=("endo_left",),
        image_size=SIZE,
        depth=True,
    )


def skin_of(env):
    return Skin(env.simulation, env.simulation.tissue)


@pytest.fixture(scope="module")
def insertion():
    """An env and the states of the expert's insertion, each with the tissue's stage."""
    env = make()
    env.reset(seed=names.VALIDATION_SEED)
    expert = Expert(env)
    states = [(env.simulation.tissue.stage, env.get_state())]
    for _ in range(env.config.max_steps):
        ended = env.step(expert.action())[2]
        states.append((env.simulation.tissue.stage, env.get_state()))
        if ended:
            break
    return env, states


def last(states, stage):
    return [state for found, state in states if found == stage][-1]


def world_points(env, name):
    """Return the points of a mesh in the phantom's frame."""
    model = env.model
    mesh = model.mesh(name).id
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    turn = quaternion_to_matrix(model.mesh_quat[mesh])
    return model.mesh_vert[first : first + count] @ turn.T + model.mesh_pos[mesh]


def test_whole_skin_has_neither_dents_nor_wounds(insertion):
    env, states = insertion
    env.set_state_vector(states[0][1])
    assert skin_of(env).state() == SkinState(0)


def test_a_pressing_tip_takes_the_skin_along(insertion):
    env, states = insertion
    env.set_state_vector(last(states, OUTSIDE))
    skin = skin_of(env)
    skin.follow()
    deepest = skin.state().pulls[0]
    hole = env.stitch.pair.entry
    tip = env.simulation.needle_point(env.simulation.tip_angle)
    depth = math.hypot(*deepest.way)
    assert depth == pytest.approx(-hole.height(tip), abs=3e-4) and depth > 4e-4
    inwards = depth * np.negative(hole.normal)
    np.testing.assert_allclose(deepest.way, inwards, atol=WAY)  # up to their rounding
    points = world_points(env, "skin")
    # The drawn skin is no further from the tip than its mesh lines are apart.
    assert np.linalg.norm(points - tip, axis=1).min() < 6e-4


def test_a_tip_from_inside_lifts_the_skin(insertion):
    env, states = insertion
    env.set_state_vector(last(states, INSIDE))
    leave = env.stitch.pair.exit
    lifted = [
        pull
        for pull in skin_of(env).state().pulls
        if math.dist(pull.place, leave.centre) < 1e-3 and np.dot(pull.way, leave.normal) > 2e-4
    ]
    assert len(lifted) == 1


def test_wounds_stay(insertion):
    env, states = insertion
    pair = env.stitch.pair
    for stage, marks in ((INSIDE, [pair.entry]), (THROUGH, [pair.entry, pair.exit])):
        env.set_state_vector(last(states, stage))
        wounds = skin_of(env).state().wounds
        assert len(wounds) == len(marks)
        for wound, mark in zip(wounds, marks, strict=True):
            assert wound.start == wound.end and math.dist(wound.start, mark.centre) < 1e-3


def test_a_tear_is_long(insertion):
    env, states = insertion
    env.set_state_vector(last(states, THROUGH))
    passage = env.simulation.tissue.passages[-1]
    passage.tears = 1
    x, y, z = passage.entry
    passage.entry_now = (x, y + 2e-3, z)
    wound = skin_of(env).state().wounds[0]
    assert math.dist(wound.start, wound.end) == pytest.approx(2e-3)


def test_restored_states_look_the_same(insertion):
    env, states = insertion
    other = make()
    other.reset(seed=3)
    seen = []
    for stage in (OUTSIDE, INSIDE, THROUGH):
        state = last(states, stage)
        env.set_state_vector(state)
        first = env.observe()
        env.set_state_vector(states[0][1])
        env.observe()
        env.set_state_vector(state)
        other.set_state_vector(state)
        for again in (env.observe(), other.observe()):
            for key, frame in first.items():
                np.testing.assert_array_equal(frame, again[key])
        seen.append(first)
    key = names.frame_key("endo_left", names.RGB)
    assert all((a[key] != b[key]).any() for a, b in itertools.pairwise(seen))
    env.close()
    other.close()


def test_two_renderers_of_one_size_show_the_same_skin(insertion):
    """They share the GPU's meshes: each counted versions for itself, and could miss a change."""
    env, states = insertion
    whole, before, after = states[0][1], last(states, OUTSIDE), last(states, INSIDE)
    one, other = (Images(env.simulation, env.calibration) for _ in range(2))
    for rig, state in ((one, whole), (other, whole), (one, before), (other, after)):
        env.set_state_vector(state)
        seen = rig.frames("endo_left", (SIZE, SIZE), (names.RGB,))[names.RGB]
    for each in (env, one, other):
        each.close()
    np.testing.assert_array_equal(seen, env.observe()["endo_left"])


def test_a_dent_has_depth(insertion):
    env, states = insertion
    env.set_state_vector(states[0][1])
    key = names.frame_key("endo_left", names.DEPTH)
    whole = env.observe()[key]
    model_skin = env.simulation.tissue.drawn_skin._drawn
    state = SkinState(0, (Pull((0.0, 0.05, SURFACE), (0.0, 0.0, -3e-3), 4e-3),))
    follow = env.simulation.tissue.drawn_skin.follow

    def dented():
        model_skin.shape(state)
        return model_skin.versions

    env.simulation.tissue.drawn_skin.follow = dented
    try:
        deeper = env.observe()[key] - whole
    finally:
        env.simulation.tissue.drawn_skin.follow = follow
    assert deeper.max() > 1e-3
    env.close()


def test_jaws_dent_the_flat_tissue():
    env = make("grasp")
    env.reset(seed=names.VALIDATION_SEED)
    expert = Expert(env)
    deepest = 0.0
    skin = skin_of(env)
    for _ in range(env.config.max_steps):
        ended = env.step(expert.action())[2]
        deepest = max([deepest, *(-pull.way[2] for pull in skin.state().pulls)])
        if ended:
            break
    assert 5e-4 < deepest < 5e-3
    env.close()


@pytest.mark.parametrize("pair", [1, 2, 3, 4])
def test_the_marks_of_the_pair_to_sew_are_the_dark_ones(pair):
    env = make(scene=SceneConfig(tissue="soft", hole_pair=pair))
    env.reset(seed=0)
    skin_of(env).follow()
    chosen = PAIRS["simple"][pair - 1]
    middles = [np.array(chosen.entry.centre), np.array(chosen.exit.centre)]
    for name, near in (("mark", True), ("marks", False)):
        points = world_points(env, name)
        distance = np.min([np.linalg.norm(points - middle, axis=1) for middle in middles], axis=0)
        assert (distance < 2.5e-3).all() == near
    materials = [env.model.material(MATERIALS[name]).id for name in ("mark", "marks")]
    assert env.model.mat_rgba[materials[0], 3] > env.model.mat_rgba[materials[1], 3]


def test_marks_follow_a_drawn_pair():
    env = make(randomisation=RandomisationConfig(pair="any"))
    pairs = set()
    for seed in range(6):
        env.reset(seed=seed)
        pairs.add(skin_of(env).state().pair)
        assert skin_of(env).state().pair == env.simulation.pair_index
    assert len(pairs) > 1


def test_shaping_is_exact_and_can_be_undone():
    env = make()
    env.reset(seed=0)
    skin = SoftSkin(env.model, "simple")
    hole = PAIRS["simple"][0].entry
    way = tuple(-1e-3 * part for part in hole.normal)
    dented = SkinState(0, (Pull(hole.centre, way, 1.2e-3),), (Wound(hole.centre, hole.centre),))
    skin.shape(SkinState())
    whole = {name: world_points(env, name) for name in MATERIALS}
    skin.shape(dented)
    points = world_points(env, "skin")
    # Points at the dent have left the whole skin.
    low = (np.array([hole.height(point) for point in points]) < -5e-4) & (
        np.linalg.norm(points - hole.centre, axis=1) < 2e-3
    )
    assert low.any()
    versions = skin.versions
    skin.shape(dented)
    assert skin.versions == versions
    skin.shape(SkinState())
    assert all(now > then for now, then in zip(skin.versions[:1], versions[:1], strict=True))
    for name, before in whole.items():
        np.testing.assert_array_equal(world_points(env, name), before)


def test_pulls_take_their_own_place_all_the_way():
    near, far = (0.0, 0.0, 0.0), (0.05, 0.0, 0.0)
    pulls = (Pull(near, (0.0, 0.0, -1e-3), 1e-3), Pull(near, (0.0, 0.0, -1e-3), 1e-3))
    for some in (pulls[:1], pulls):
        moved = displaced(np.array([near, far, (1e-3, 0.0, 0.0)]), some)
        np.testing.assert_allclose(moved[0], (0.0, 0.0, -1e-3), atol=1e-9)
        np.testing.assert_allclose(moved[1], far, atol=1e-12)
        assert moved[2, 2] == pytest.approx(-1e-3 / math.e, rel=1e-6)


def test_what_cannot_be_seen_changes_no_mesh(insertion):
    env, states = insertion
    env.set_state_vector(last(states, INSIDE))
    before = skin_of(env).state()
    for pull in before.pulls:
        for value in pull.place:
            assert value == pytest.approx(round(value / PLACE) * PLACE, abs=1e-12)
        for value in pull.way:
            assert value == pytest.approx(round(value / WAY) * WAY, abs=1e-12)
