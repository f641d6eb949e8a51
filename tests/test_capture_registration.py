from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tubepose.capture import CameraIntrinsics, estimate_intrinsics, project_cloud
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.registration import (
    clean_cloud,
    foreign_center_m,
    is_mirrored,
    refuse_foreign_frame,
    refuse_mirrored,
)
from tubepose.errors import CaptureError
from tubepose.transforms import axis_rotation, make_transform, transform_points

CAMERA = CameraIntrinsics(width=20, height=10, fx=30.0, fy=31.0, cx=9.5, cy=4.5)


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_nearest_point_wins(order):
    ray = CAMERA.rays()[3, 7]
    points = np.array([ray * 1.0, ray * 0.5, ray * 2.0])[list(order)]
    organised = project_cloud(points, np.eye(4), CAMERA)
    np.testing.assert_array_equal(organised[3, 7], ray * 0.5)
    assert np.isfinite(organised).all(axis=-1).sum() == 1


def test_points_outside_behind_and_invalid_are_left_out():
    points = np.array([[5.0, 0, 1], [0, 5, 1], [0, 0, -1], [0, 0, 0], [np.nan, 0, 1]])
    assert np.isnan(project_cloud(points, np.eye(4), CAMERA)).all()


@settings(max_examples=30)
@given(seed=st.integers(0, 1000), x=st.floats(-0.3, 0.3), y=st.floats(-0.3, 0.3))
def test_projection_undoes_the_place_of_the_sensor(seed, x, y):
    rng = np.random.default_rng(seed)
    cloud = CAMERA.backproject(rng.uniform(0.5, 1.5, (10, 20)))
    T_cloud_image = make_transform(axis_rotation(np.array([x, y, 1.0])), rng.uniform(-1, 1, 3))
    moved = rng.permutation(transform_points(T_cloud_image, cloud.reshape(-1, 3)))
    organised = project_cloud(moved, np.linalg.inv(T_cloud_image), CAMERA)
    np.testing.assert_allclose(organised, cloud, atol=1e-9)


@settings(max_examples=30)
@given(
    fx=st.floats(100, 3000),
    fy=st.floats(100, 3000),
    cx=st.floats(-50, 100),
    cy=st.floats(-50, 100),
    seed=st.integers(0, 99),
)
def test_intrinsics_are_recovered_from_an_organised_cloud(fx, fy, cx, cy, seed):
    camera = CameraIntrinsics(40, 30, fx, fy, cx, cy)
    depth = np.random.default_rng(seed).uniform(0.4, 1.0, (30, 40))
    depth[::3] = np.nan
    found = estimate_intrinsics(camera.backproject(depth))
    assert found is not None
    assert (found.width, found.height) == (40, 30)
    np.testing.assert_allclose([found.fx, found.fy, found.cx, found.cy], [fx, fy, cx, cy], rtol=1e-6, atol=1e-6)


def test_cloud_that_is_no_pinhole_image_has_no_intrinsics():
    rng = np.random.default_rng(0)
    cloud = CAMERA.backproject(rng.uniform(0.5, 1.5, (10, 20)))
    assert estimate_intrinsics(cloud) is not None
    assert estimate_intrinsics(rng.permutation(cloud.reshape(-1, 3)).reshape(10, 20, 3)) is None
    assert estimate_intrinsics(np.full((10, 20, 3), np.nan)) is None
    assert estimate_intrinsics(np.tile([0.0, 0.0, 1.0], (10, 20, 1))) is None


@pytest.mark.parametrize("signs", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_a_cloud_in_a_mirror_is_told_from_one_that_is_turned(signs):
    camera = CameraIntrinsics(200, 160, 300.0, 310.0, 101.0, 83.0)
    cloud = camera.backproject(np.random.default_rng(2).uniform(0.5, 1.5, (160, 200)))
    cloud[::3, ::5] = np.nan
    assert is_mirrored(cloud * [*signs, 1]) == (signs[0] * signs[1] < 0)
    assert not is_mirrored(np.random.default_rng(3).permutation(cloud.reshape(-1, 3)).reshape(cloud.shape))
    assert not is_mirrored(np.full((160, 200, 3), np.nan))


def test_a_mirrored_frame_is_refused_and_others_are_not():
    cloud = CameraIntrinsics(200, 160, 300.0, 310.0, 101.0, 83.0).backproject(np.full((160, 200), 0.8))
    frame = RgbdFrame(cloud, None, None, None, "scan", index=3)
    refuse_mirrored(frame)
    refuse_mirrored(replace(frame, cloud_m=(cloud * [-1, 1, 1]).reshape(1, -1, 3), organised=False))
    with pytest.raises(
        CaptureError, match=r"^frame 3: the cloud is mirrored against its pixels; expected x to the right"
    ):
        refuse_mirrored(replace(frame, cloud_m=cloud * [-1, 1, 1]))


@pytest.mark.parametrize("mark", [3.4e38, -1e30, 1e7])
def test_a_number_that_is_no_distance_marks_a_missing_point(mark):
    cleaned = clean_cloud(np.array([[1.0, 2, 3], [mark, 0, 1], [mark, mark, mark]], np.float32), 1.0)
    assert np.isfinite(cleaned).all(axis=1).tolist() == [True, False, False]


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_clean_cloud_scales_a_copy(scale):
    xyz = np.array([[1.0, 2, 3], [0, 0, 0], [np.inf, 0, 1], [0, 0, 1]])
    kept = xyz.copy()
    cleaned = clean_cloud(xyz, scale)
    np.testing.assert_array_equal(xyz, kept)
    np.testing.assert_allclose(cleaned[[0, 3]], kept[[0, 3]] * scale)
    assert np.isnan(cleaned[1:3]).all()


VIEW = CameraIntrinsics(200, 160, 300.0, 310.0, 101.0, 83.0)


def relief(seed=2):
    """A cloud with relief of 0.2 m, every fifth pixel missing."""
    depth = np.random.default_rng(seed).uniform(0.6, 0.8, (160, 200))
    depth[::5] = np.nan
    return VIEW.backproject(depth)


def moved(cloud, T):
    return transform_points(T, cloud.reshape(-1, 3)).reshape(cloud.shape)


@pytest.mark.parametrize("center_m", [(0.4, -0.2, 0.7), (0.08, 0.0, 0.0), (0.0, 0.0, -0.3)])
def test_where_the_lines_of_sight_of_a_moved_cloud_meet(center_m):
    T = make_transform(axis_rotation(np.array([0.3, -2.0, 0.4])), np.array(center_m))
    np.testing.assert_allclose(foreign_center_m(moved(relief(), T)), center_m, atol=1e-3)


def test_a_cloud_in_a_robots_frame_is_refused():
    frame = RgbdFrame(relief(), None, None, None, "scan", index=3)
    refuse_foreign_frame(frame)
    T = make_transform(axis_rotation(np.array([0.0, 1.0, 0.0])), np.array([0.5, 0.25, 0.75]))
    robot = replace(frame, cloud_m=moved(frame.cloud_m, T))
    with pytest.raises(
        CaptureError, match=r"^frame 3: the cloud is not in .* meet at \(0\.50, 0\.25, 0\.75\) m; expected"
    ):
        refuse_foreign_frame(robot)
    refuse_foreign_frame(replace(robot, cloud_m=robot.cloud_m.reshape(1, -1, 3), organised=False))


def test_clouds_that_do_not_tell_where_their_camera_is_are_not_refused():
    turned = moved(relief(), make_transform(axis_rotation(np.array([0.0, 1.0, 0.0])), np.zeros(3)))
    assert foreign_center_m(turned) is None  # the camera is at the origin, whatever the axes
    plane = VIEW.backproject(np.full((160, 200), 0.7))
    assert foreign_center_m(moved(plane, make_transform(np.eye(3), np.array([0.3, 0.0, 0.2])))) is None
    shuffled = np.random.default_rng(3).permutation(relief().reshape(-1, 3)).reshape(160, 200, 3)
    assert foreign_center_m(shuffled) is None
    assert foreign_center_m(np.full((160, 200, 3), np.nan)) is None


def test_a_distorted_lens_is_no_foreign_frame():
    rays = VIEW.rays()
    radius = np.hypot(rays[..., 0], rays[..., 1])[..., None]
    bent = np.concatenate([rays[..., :2] * (1 - 0.5 * radius**2), rays[..., 2:]], axis=-1)
    cloud = bent * np.random.default_rng(5).uniform(0.6, 0.8, (160, 200, 1))
    assert estimate_intrinsics(cloud) is None
    assert foreign_center_m(cloud) is None
