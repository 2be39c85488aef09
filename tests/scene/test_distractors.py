"""Distractors: seen clear of the needle's path, and without any other effect."""

import copy
import itertools
import math

import mujoco
import numpy as np
import pytest

from surgicai_vision.core.config import SceneConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.names import PARTS
from surgicai_vision.scene import build_scene, holes
from surgicai_vision.scene.rendering import FrameRenderer
from surgicai_vision.scene.visual import distractors
from surgicai_vision.scene.visual.distractors import BAND, KINDS, MOST, Litter, draw


@pytest.fixture(scope="module")
def source():
    return build_scene(SceneConfig()).model


def views(model, modality="rgb"):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with FrameRenderer(model, 224, 224) as renderer:
        return renderer.render(data, "front", modality)


@pytest.mark.parametrize("name", KINDS)
def test_a_mesh_lies_on_the_ground_within_its_reach(name):
    points = np.array(KINDS[name].mesh().points)
    assert np.hypot(points[:, 0], points[:, 1]).max() <= KINDS[name].reach
    assert points[:, 2].min() >= -1e-9
    assert 0.0002 < points[:, 2].max() < 0.003


def test_things_lie_apart_from_each_other_the_stitches_and_where_needles_start():
    left, right, near, _ = distractors.START
    for seed in range(200):
        things = draw(Litter(MOST, seed))
        assert len(things) == MOST
        for one, other in itertools.combinations(things, 2):
            apart = math.dist(one.place[:2], other.place[:2])
            assert apart > KINDS[one.kind].reach + KINDS[other.kind].reach
        for kind, (x, y, z), _ in things:
            reach = KINDS[kind].reach
            assert abs(x) >= BAND + reach
            for pairs in holes.PAIRS.values():
                for hole in (hole for pair in pairs for hole in (pair.entry, pair.exit)):
                    assert math.dist(hole.centre[:2], (x, y)) > reach + holes.OPENING
            if z > distractors.TABLE + 0.01:
                assert x + reach <= left or x - reach >= right or y + reach <= near


def test_all_kinds_are_drawn():
    kinds = {thing.kind for seed in range(40) for thing in draw(Litter(MOST, seed))}
    assert kinds == set(KINDS)


def test_fewer_are_the_first_of_more():
    for seed in range(10):
        assert draw(Litter(2, seed)) == draw(Litter(MOST, seed))[:2]


def test_they_are_seen_as_background(source):
    """No pixel becomes another part; those that a distractor hides become background."""
    model = copy.copy(source)
    plain, parts = views(model), views(model, "segmentation")
    distractors.scatter(source, model, Litter(MOST, 3))
    assert distractors.seen(model) == MOST
    image, found = views(model), views(model, "segmentation")
    changed = (image != plain).any(axis=2)
    assert changed.sum() > 200
    assert (found[parts != found] == 0).all()
    assert (found == PARTS.index("needle")).sum() == (parts == PARTS.index("needle")).sum()
    distractors.scatter(source, model, Litter())
    assert distractors.seen(model) == 0
    assert np.array_equal(views(model), plain)


def test_they_neither_collide_nor_weigh(source):
    body = source.body(distractors.BODY).id
    of = source.geom_bodyid == body
    assert of.sum() == MOST
    assert not source.geom_contype[of].any()
    assert not source.geom_conaffinity[of].any()
    assert source.body_mass[body] == 0.0


def test_more_than_there_is_room_for_are_refused():
    with pytest.raises(InputError, match="0 to 5"):
        Litter(MOST + 1)
