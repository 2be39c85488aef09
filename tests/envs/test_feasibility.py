"""Feasibility: what geometry forbids is refused with the reason, before anything runs."""

import math

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core.config import (
    NEEDLE_ARCS,
    RANDOMISATION_LIMITS,
    RandomisationConfig,
    SceneConfig,
    TaskConfig,
)
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.names import PSM1, PSM2
from surgicai_vision.envs import feasibility, reach
from surgicai_vision.envs.geometry import Stitch, grasp_in_needle
from surgicai_vision.envs.randomisation import TIP_ANGLES
from surgicai_vision.envs.starts import GRASP_ANGLES
from surgicai_vision.scene import needle
from surgicai_vision.scene.holes import PAIRS

FURTHEST = RandomisationConfig(phantom_shift=10.0, phantom_turn=15.0, pair="any")


def refused(task="insert", scene=SceneConfig(), **axes):
    """Return why an env with these axes is refused, "" if it is made."""
    try:
        envs.make(TaskConfig(task, scene, randomisation=RandomisationConfig(**axes)))
    except InputError as error:
        return str(error)
    return ""


def test_the_largest_needle_size_of_a_pair_is_named_and_works():
    message = refused(pair="any", needle_size=0.2)
    assert "pair 2" in message and "8.4 mm" in message and "needle_size here is" in message
    allowed = float(message.rsplit(" ", 1)[1].rstrip("."))
    assert 0.15 < allowed < 0.2
    assert refused(pair="any", needle_size=allowed) == ""
    assert refused(pair="any", needle_size=round(allowed + 0.002, 3)) != ""
    assert refused(pair="any", needle_size=0.2, needle_arc="any") != ""


def test_longer_needles_and_the_first_pair_leave_room_for_the_whole_range():
    assert refused(needle_size=0.2) == ""
    for arc in ("3/8", "1/2"):
        assert refused(pair="any", needle_size=0.2, needle_arc=arc) == ""


def test_what_does_not_go_through_the_tissue_may_have_any_needle():
    for task in ("grasp", "place"):
        assert refused(task, pair="any", needle_size=0.2, needle_arc="any") == ""


@pytest.mark.parametrize("size", [0.0, 0.1, 0.2])
def test_the_derived_limit_is_that_of_the_room_for_the_jaws(size):
    for pair in (pair for pairs in PAIRS.values() for pair in pairs):
        allowed = feasibility.largest_size(pair, needle.TIP_ANGLE)
        has_room = feasibility.has_room(pair, needle.RADIUS * (1 - size))
        assert has_room == (size <= allowed + 5e-4)


def test_the_wide_layouts_narrowest_pair_needs_a_longer_arc():
    """3dmed is made for a needle of 133° (the surgical robotics challenge's)."""
    scene = SceneConfig(layout="3dmed", hole_pair=4)
    assert "Allowed there: grasp, place" in refused(scene=scene)
    assert refused(scene=scene, needle_arc="3/8") == ""


@pytest.mark.parametrize("layout", ["3dmed", "3dmed_straight"])
def test_a_half_circle_comes_round_to_a_steep_flank(layout):
    message = refused("pullout", SceneConfig(layout=layout), needle_arc="1/2")
    assert "reached the flank" in message and "1/2" in message


@pytest.mark.parametrize("pair", PAIRS["simple"])
def test_a_needle_that_comes_out_lies_beyond_the_exits_plane(pair):
    """The rule matches the points: with the base in the exit all others are beyond its plane."""
    for radius, tip_angle in ((0.0086, math.pi), (0.0122, math.pi), (0.0102, 2.9), (0.0086, 3.6)):
        stitch = Stitch.of(pair, radius, tip_angle)
        pose = stitch.on_arc(-2 * stitch.half)
        points = needle.polyline(60, radius, tip_angle)[1:] @ pose[:3, :3].T + pose[:3, 3]
        clear = min(pair.exit.height(tuple(point)) for point in points) > 0.0
        assert clear or not stitch.comes_out


def test_a_phantom_that_leaves_the_endoscopes_image_is_refused():
    assert "outside the image of camera 'front'" in refused(
        scene=SceneConfig(hole_pair=4), phantom_shift=1.0
    )
    assert refused(scene=SceneConfig(hole_pair=2), phantom_shift=10.0, phantom_turn=15.0) == ""


@pytest.mark.parametrize("where", list(feasibility.corners(SceneConfig(), FURTHEST)))
def test_in_every_corner_both_holes_are_in_view(where):
    pair = where.placed_pair(PAIRS["simple"][where.pair])
    for view in (*feasibility.VIEWS, "back"):
        for hole in (pair.entry, pair.exit):
            assert feasibility.in_view(SceneConfig(), view, hole.centre)


@pytest.mark.parametrize("where", list(feasibility.corners(SceneConfig(), FURTHEST)))
def test_in_every_corner_both_arms_follow_every_needle(where):
    """The limits of the axes leave each joint at least 2° or 2 mm with nominal grasps."""
    own = PAIRS["simple"][where.pair]
    limit = RANDOMISATION_LIMITS["needle_size"]
    for arc in NEEDLE_ARCS:
        smallest = max(-limit, -feasibility.largest_size(own, TIP_ANGLES[arc]))
        for size in (smallest, limit):
            stitch = Stitch.of(where.placed_pair(own), needle.RADIUS * (1 + size), TIP_ANGLES[arc])
            for angle in stitch.grasps(*GRASP_ANGLES):
                grasp = grasp_in_needle(PSM2, angle, radius=stitch.radius)
                reach.joints_along(PSM2, reach.insertion(stitch, grasp), "400006")
            grasp = grasp_in_needle(PSM1, stitch.handoff_angle, radius=stitch.radius)
            joints = reach.joints_along(PSM1, reach.extraction(stitch, grasp), "400006")
            assert np.abs(joints)[:, 3].max() < math.radians(175.0)


def test_a_pose_past_a_limit_is_not_followed():
    stitch = Stitch.of(PAIRS["simple"][0], tip_angle=math.pi)
    base_end = grasp_in_needle(PSM2, math.radians(6.5), radius=stitch.radius)
    assert not reach.is_followed(PSM2, reach.insertion(stitch, base_end), "400006")
