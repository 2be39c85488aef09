"""Rotations: axioms and round trips over the whole group, against scipy as the naive reference."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from surgicai_vision.scene import rotations

angles = st.floats(-math.pi, math.pi)
components = st.floats(-1.0, 1.0)
rotvecs = st.tuples(components, components, components).map(
    lambda v: np.array(v) * math.pi / math.sqrt(3)
)
matrices = rotvecs.map(rotations.rotvec_to_matrix)


def same(a, b, tolerance=1e-12):
    return np.allclose(a, b, rtol=0, atol=tolerance)


@given(matrices, matrices)
def test_matrices_form_a_group(a, b):
    assert same(a @ a.T, np.eye(3))
    assert math.isclose(np.linalg.det(a), 1.0, abs_tol=1e-12)
    product = rotations.multiply_flat(rotations.flatten(a), rotations.flatten(b))
    assert same(np.reshape(product, (3, 3)), a @ b)


@given(rotvecs)
def test_exponential_equals_scipy(rotvec):
    assert same(rotations.rotvec_to_matrix(rotvec), Rotation.from_rotvec(rotvec).as_matrix())


@given(matrices)
def test_logarithm_inverts_exponential(matrix):
    rotvec = rotations.matrix_to_rotvec(matrix)
    assert np.linalg.norm(rotvec) <= math.pi + 1e-12
    assert same(rotations.rotvec_to_matrix(rotvec), matrix)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-8, 1e-4, math.pi - 1e-9, math.pi])
def test_logarithm_at_the_ends(angle):
    axis = np.array([2.0, -3.0, 6.0]) / 7.0
    matrix = rotations.rotvec_to_matrix(axis * angle)
    assert math.isclose(
        np.linalg.norm(rotations.matrix_to_rotvec(matrix)), angle, rel_tol=1e-12, abs_tol=1e-12
    )
    assert math.isclose(
        rotations.geodesic_angle(np.eye(3), matrix), angle, rel_tol=1e-12, abs_tol=1e-12
    )


@given(matrices)
def test_quaternions_are_unit_and_round_trip(matrix):
    quaternion = rotations.matrix_to_quaternion(matrix)
    assert math.isclose(np.linalg.norm(quaternion), 1.0, rel_tol=1e-14)
    assert quaternion[0] >= 0
    assert same(rotations.quaternion_to_matrix(quaternion), matrix)
    assert same(rotations.quaternion_to_matrix(-3.0 * quaternion), matrix)


@given(angles, st.floats(-math.pi / 2, math.pi / 2), angles)
def test_roll_pitch_yaw_round_trips(roll, pitch, yaw):
    matrix = rotations.rpy_to_matrix(roll, pitch, yaw)
    assert same(matrix, Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix())
    found = rotations.matrix_to_rpy(matrix)
    assert -2 * math.pi < found[0] <= 0
    assert same(
        rotations.rpy_to_matrix(*found), matrix, 3e-9
    )  # within 1e-9 the pitch counts as gimbal lock


def test_roll_keeps_the_released_range():
    assert same(
        rotations.matrix_to_rpy(rotations.rpy_to_matrix(-3.598, -0.05, 1.27)), (-3.598, -0.05, 1.27)
    )
    assert rotations.matrix_to_rpy(np.eye(3))[0] == 0


@given(matrices, matrices, matrices)
def test_geodesic_angle_is_a_metric_that_moves_with_the_world(a, b, world):
    angle = rotations.geodesic_angle(a, b)
    assert 0 <= angle <= math.pi
    assert rotations.geodesic_angle(a, a) < 1e-12
    assert math.isclose(angle, rotations.geodesic_angle(b, a), abs_tol=1e-12)
    assert math.isclose(angle, rotations.geodesic_angle(world @ a, world @ b), abs_tol=1e-9)
    assert math.isclose(angle, np.linalg.norm(rotations.matrix_to_rotvec(a @ b.T)), abs_tol=1e-9)
