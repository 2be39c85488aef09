"""Kinematics: the closed forms against the DH table, the published numbers, the limits."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from surgicai_vision.core.errors import InputError, UnknownName, UnreachablePose
from surgicai_vision.scene import kinematics
from surgicai_vision.scene.kinematics import DVRK_JOINTS, INSTRUMENTS, forward, inverse, limits
from surgicai_vision.scene.rotations import geodesic_angle, matrix_to_rpy

instruments = st.sampled_from(sorted(INSTRUMENTS))
fractions = st.tuples(*[st.floats(0.0, 1.0)] * 6).map(np.array)


def joints_of(fraction, instrument):
    low, high = limits(instrument).T
    return low + fraction * (high - low)


def naive_forward(q, instrument):
    """Multiply out the modified DH table as it is published."""
    length, right, pose = INSTRUMENTS[instrument], math.pi / 2, np.eye(4)
    table = (
        (right, 0, q[0] + right, 0),
        (-right, 0, q[1] - right, 0),
        (right, 0, 0, q[2] - length.rcc),
        (0, 0, q[3], length.tool),
        (-right, 0, q[4] - right, 0),
        (-right, length.pitch_to_yaw, q[5] - right, 0),
        (-right, 0, right, 0),
    )
    for alpha, a, theta, d in table:
        ca, sa, ct, st_ = math.cos(alpha), math.sin(alpha), math.cos(theta), math.sin(theta)
        pose = pose @ [
            [ct, -st_, 0, a],
            [st_ * ca, ct * ca, -sa, -d * sa],
            [st_ * sa, ct * sa, ca, d * ca],
            [0, 0, 0, 1],
        ]
    return pose


@given(fractions, instruments)
def test_forward_equals_the_dh_table(fraction, instrument):
    q = joints_of(fraction, instrument)
    assert np.allclose(forward(q, instrument), naive_forward(q, instrument), rtol=0, atol=1e-14)


def test_tip_at_zero_joints():
    assert np.allclose(forward(np.zeros(6))[:3, 3], [0, 0, 0.0139], atol=1e-12)
    assert np.allclose(forward(np.zeros(6))[:3, :3], [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-12)


def test_insertion_moves_along_minus_z():
    moved = forward([0, 0, 0.1, 0, 0, 0])[:3, 3] - forward(np.zeros(6))[:3, 3]
    assert np.allclose(moved, [0, 0, -0.1], atol=1e-12)


@pytest.mark.parametrize(
    ("arm", "expected"), [("psm1", (31.0, 76.3, 108.1)), ("psm2", (-40.9, 73.7, 107.0))]
)
def test_start_tips_in_world(arm, expected):
    start = kinematics.start_in_base(arm)
    tip_in_world = (kinematics.base_in_world(arm) @ start)[:3, 3] * 1000
    assert np.allclose(tip_in_world, expected, atol=0.06)
    assert np.allclose(matrix_to_rpy(start[:3, :3]), kinematics.STARTS[arm][3:6], atol=1e-12)
    assert np.allclose(forward(inverse(start)), start, atol=1e-12)


@given(fractions, instruments)
def test_round_trip_over_the_whole_joint_range(fraction, instrument):
    q = joints_of(fraction, instrument)
    length = INSTRUMENTS[instrument]
    # With the wrist in the remote centre the first two joints are free; near it they are
    # ill-conditioned.
    assume(abs(q[2] + length.tool - length.rcc) > 1e-5)
    pose = forward(q, instrument)
    found = inverse(pose, instrument, near=q)
    assert np.allclose(forward(found, instrument), pose, rtol=0, atol=1e-9)
    low, high = limits(instrument).T
    assert (found >= low - 1e-9).all()
    assert (found <= high + 1e-9).all()
    anywhere = inverse(pose, instrument)
    assert np.allclose(forward(anywhere, instrument), pose, rtol=0, atol=1e-9)


@given(fractions)
def test_inverse_finds_the_joints_it_came_from(fraction):
    q = joints_of(0.05 + 0.9 * fraction, "420006")
    assert np.allclose(inverse(forward(q, "420006"), "420006", near=q), q, rtol=0, atol=1e-9)


@pytest.mark.parametrize("insertion", [0.0, 0.010, 0.030])
def test_near_chooses_the_side_of_the_remote_centre(insertion):
    """400006 at less than 23 mm of insertion has its wrist behind the remote centre."""
    q = np.array([0.2, -0.3, insertion, 0.4, 0.5, -0.6])
    assert np.allclose(inverse(forward(q), near=q), q, atol=1e-12)


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("instrument", sorted(INSTRUMENTS))
def test_beyond_each_limit_is_refused_and_named(joint, side, instrument):
    q = np.array([0.1, 0.1, 0.12, 0.1, 0.1, 0.1])
    bound = limits(instrument)[joint, side]
    q[joint] = bound
    assert np.allclose(inverse(forward(q, instrument), instrument, near=q), q, atol=1e-9)
    q[joint] = bound + (2 * side - 1) * (0.001 if joint == kinematics.INSERTION else 0.01)
    with pytest.raises(UnreachablePose, match=DVRK_JOINTS[joint]) as refusal:
        inverse(forward(q, instrument), instrument, near=q)
    unit = 1000.0 if joint == kinematics.INSERTION else math.degrees(1)
    assert f"{q[joint] * unit:.2f}" in str(refusal.value)
    assert f"{bound * unit:.2f}" in str(refusal.value)


def test_roll_is_unwrapped_towards_near():
    q = np.array([0.0, 0.0, 0.1, math.radians(-174), 0.1, 0.1])
    pose = forward(q)
    assert np.allclose(inverse(pose), q, atol=1e-12)
    across = np.array([0.0, 0.0, 0.1, math.radians(174), 0.1, 0.1])
    with pytest.raises(UnreachablePose, match="outer_roll would be 186"):
        inverse(pose, near=across)


def test_rotation_about_the_tip_keeps_the_position():
    pose = kinematics.start_in_base("psm2")
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    reached = forward(inverse(turned))
    assert np.allclose(reached[:3, 3], pose[:3, 3], atol=1e-12)
    assert math.isclose(geodesic_angle(reached[:3, :3], pose[:3, :3]), math.pi / 2, abs_tol=1e-12)


def test_flat_functions_are_the_same_functions():
    pose = kinematics.start_in_base("psm1")
    flat = (*pose[:3, 3].tolist(), *pose[:3, :3].ravel().tolist())
    q = kinematics.inverse_flat(flat)
    assert isinstance(q, tuple)
    assert q == tuple(inverse(pose))
    assert kinematics.forward_flat(q)[:3] == tuple(forward(q)[:3, 3])


def test_wrong_arguments_are_refused():
    with pytest.raises(UnknownName, match="400006"):
        forward(np.zeros(6), "400007")
    with pytest.raises(UnknownName, match="psm2"):
        kinematics.base_in_world("psm3")
    with pytest.raises(InputError, match=r"\(3, 3\)"):
        inverse(np.eye(3))
    with pytest.raises(InputError, match="finite"):
        inverse(np.full((4, 4), np.nan))
    start = kinematics.start_in_base("psm1")
    for wrong in (np.zeros(5), np.full(6, np.nan), np.zeros((1, 6))):
        with pytest.raises(InputError, match="q6 must be six finite numbers"):
            forward(wrong)
        with pytest.raises(InputError, match="near must be six finite numbers"):
            inverse(start, near=wrong)
