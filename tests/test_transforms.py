"""Rigid transforms and the rotation of Eq. 1."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tubepose.transforms import (
    axis_rotation,
    axis_rotations,
    invert_transform,
    make_transform,
    quaternion_wxyz,
    tilt_rad,
    tilt_rotation,
    transform_points,
)

ANGLE = st.floats(-1.4, 1.4)


@given(ANGLE, ANGLE)
def test_eq_1_is_ry_times_rx(alpha, beta):
    by_hand = Rotation.from_euler("y", beta).as_matrix() @ Rotation.from_euler("x", alpha).as_matrix()
    assert np.allclose(tilt_rotation(alpha, beta), by_hand, atol=1e-12)


@given(ANGLE, ANGLE)
def test_third_column_of_eq_1_is_the_axis(alpha, beta):
    axis = [np.sin(beta) * np.cos(alpha), -np.sin(alpha), np.cos(beta) * np.cos(alpha)]
    assert np.allclose(tilt_rotation(alpha, beta)[:, 2], axis, atol=1e-12)


def test_alpha_leans_along_minus_y_and_beta_along_x():
    assert np.allclose(tilt_rotation(0.1, 0.0)[:, 2], [0, -np.sin(0.1), np.cos(0.1)])
    assert np.allclose(tilt_rotation(0.0, 0.1)[:, 2], [np.sin(0.1), 0, np.cos(0.1)])


@given(ANGLE, ANGLE)
def test_axis_rotation_gives_back_the_rotation_of_eq_1(alpha, beta):
    R = tilt_rotation(alpha, beta)
    assert np.allclose(axis_rotation(3.0 * R[:, 2]), R, atol=1e-9)


def test_many_axes_at_once_are_turned_as_each_alone():
    axes = np.vstack([np.random.default_rng(2).normal(size=(50, 3)), np.eye(3)])
    assert np.allclose(axis_rotations(axes), [axis_rotation(axis) for axis in axes], atol=1e-12)


def test_axis_rotation_of_a_tube_upside_down_is_a_rotation_with_that_axis():
    R = axis_rotation(np.array([0.1, 0.2, -1.0]))
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert R[2, 2] < -0.9


def test_transforms_chain_and_invert():
    rng = np.random.default_rng(0)
    T_a_b = make_transform(Rotation.random(random_state=1).as_matrix(), np.array([1.0, 2.0, 3.0]))
    T_b_c = make_transform(Rotation.random(random_state=2).as_matrix(), np.array([-0.3, 0.1, 0.7]))
    points = rng.normal(size=(4, 5, 3))
    chained = transform_points(T_a_b, transform_points(T_b_c, points))
    assert np.allclose(transform_points(T_a_b @ T_b_c, points), chained)
    assert np.allclose(transform_points(invert_transform(T_a_b), transform_points(T_a_b, points)), points)
    assert np.allclose(invert_transform(T_a_b), np.linalg.inv(T_a_b))


def test_a_quarter_turn_and_a_shift_by_hand():
    T = make_transform(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, 0, 0]))
    assert np.allclose(transform_points(T, np.array([1.0, 2.0, 3.0])), [8, 1, 3])
    assert quaternion_wxyz(T) == pytest.approx((np.sqrt(0.5), 0, 0, np.sqrt(0.5)))


def test_invalid_points_stay_invalid():
    points = np.array([[np.nan, np.nan, np.nan], [0.0, 0.0, 1.0]])
    moved = transform_points(make_transform(np.eye(3), np.ones(3)), points)
    assert np.isnan(moved[0]).all()
    assert np.allclose(moved[1], [1, 1, 2])


@given(st.integers(0, 1000))
def test_quaternion_has_no_negative_w_and_is_the_same_rotation(seed):
    R = Rotation.random(random_state=seed).as_matrix()
    w, x, y, z = quaternion_wxyz(make_transform(R, np.zeros(3)))
    assert w >= 0
    assert np.allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), R, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.02, np.pi / 2, np.pi - 1e-9, np.pi])
def test_tilt_is_accurate_near_0_and_near_pi(angle):
    up = np.array([0.0, 0.0, 2.0])
    axis = 5.0 * np.array([np.sin(angle), 0.0, np.cos(angle)])
    assert tilt_rad(axis, up) == pytest.approx(angle, abs=1e-14, rel=1e-6)
