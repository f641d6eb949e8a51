"""Distortion: what a distorting camera records comes out as what one without a lens records."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import STAMP_NS, image_message, info_message, mcap, read_all

from tubepose.capture import CameraIntrinsics
from tubepose.capture.lens import PixelCamera, coefficients_of
from tubepose.capture.message_types import CAMERA_INFO, IMAGE

CAMERA = CameraIntrinsics(width=160, height=120, fx=150.0, fy=152.0, cx=81.5, cy=57.25)
LENSES = {
    "plumb_bob": (-0.28, 0.09, 0.001, -0.0015, -0.01),
    "rational_polynomial": (0.4, -0.2, 0.0005, 0.001, 0.02, 0.7, -0.15, 0.03),
    "equidistant": (0.03, -0.01, 0.004, -0.001),
}
MODELS = {"plumb_bob": "polynomial", "rational_polynomial": "polynomial", "equidistant": "fisheye"}


def lens(name: str) -> PixelCamera:
    return PixelCamera(CAMERA, MODELS[name], LENSES[name])


def pixels() -> np.ndarray:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.stack([u, v], axis=-1).astype(float)


def seen_by(camera: PixelCamera) -> tuple[np.ndarray, np.ndarray]:
    """Depth and picture of a tilted plane with a smooth pattern, by OpenCV's own lines of sight."""
    K = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    flat, d = pixels().reshape(-1, 1, 2), np.array(camera.coefficients)
    undistort = cv2.fisheye.undistortPoints if camera.model == "fisheye" else cv2.undistortPoints
    ideal = undistort(flat, K, d) if camera.model else cv2.undistortPoints(flat, K, None)
    # OpenCV's default iterations leave some hundredths of a pixel; Newton's steps by differences take them away.
    rays = np.concatenate([ideal.reshape(CAMERA.height, CAMERA.width, 2), np.ones((*pixels().shape[:2], 1))], axis=-1)
    for _ in range(20):
        rays[..., :2] += (pixels() - camera.project(rays)) / (CAMERA.fx, CAMERA.fy)
    depth = 0.7 / (1 + 0.2 * rays[..., 0] - 0.1 * rays[..., 1])
    x, y = depth * rays[..., 0], depth * rays[..., 1]
    picture = np.rint(120 + 60 * np.sin(40 * x) + 50 * np.cos(35 * y)).astype(np.uint8)
    return depth.astype(np.float32), picture


@pytest.mark.parametrize("name", LENSES)
def test_lines_of_sight_project_back_onto_their_pixels(name):
    camera = lens(name)
    assert np.isfinite(camera.rays()).all()
    np.testing.assert_allclose(camera.project(camera.rays() * 0.7), pixels(), atol=1e-5)
    # OpenCV's projection is the reference.
    points = camera.rays().reshape(-1, 1, 3)
    K = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    expected = project(points, np.zeros(3), np.zeros(3), K, np.array(camera.coefficients))[0]
    np.testing.assert_allclose(expected.reshape(pixels().shape), pixels(), atol=1e-5)


def recorded(name: str, topic: str = "/camera/aligned_depth_to_color/image_raw") -> list:
    depth, picture = seen_by(lens(name))
    info = info_message(CAMERA, changes={"d": list(LENSES[name]), "distortion_model": name})
    return [
        ("/camera/color/camera_info", CAMERA_INFO, info),
        ("/camera/color/image_raw", IMAGE, image_message(picture, "mono8")),
        (topic, IMAGE, image_message(depth, "32FC1")),
    ]


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("topic", ["/camera/aligned_depth_to_color/image_raw", "/depth/image_rect_raw"])
def test_depth_and_picture_come_out_as_without_the_lens(tmp_path, name, topic):
    (frame,) = read_all(mcap(tmp_path / "a.mcap", recorded(name, topic)))
    assert frame.intrinsics == CAMERA
    assert frame.timestamp_ns == STAMP_NS
    assert [note.split()[0] for note in frame.notes] == ([topic] if "rect" in topic else [])
    depth, picture = seen_by(PixelCamera(CAMERA))
    points = frame.measured_m
    assert frame.valid.mean() > 0.8
    # Every point lies on the plane as it was measured, and in the pixel that sees it.
    off_plane = points[:, 2] + 0.2 * points[:, 0] - 0.1 * points[:, 1] - 0.7
    assert np.abs(off_plane).max() < 1e-6
    v, u = np.nonzero(frame.valid.reshape(depth.shape))
    off = frame.intrinsics.project(frame.cloud_m[v, u]) - np.stack([u, v], axis=1)
    assert np.abs(off).max() < 0.75
    assert np.abs(off.mean(axis=0)).max() < 0.02
    np.testing.assert_allclose(frame.cloud_m[v, u, 2], depth[v, u], atol=2e-3)
    inside = frame.image > 0
    assert inside.mean() > 0.8
    assert np.abs(frame.image.astype(int) - picture)[inside].mean() < 1.5


def test_a_cloud_beside_a_distorted_picture_comes_into_the_same_pixels(tmp_path):
    from recordings import POINT_CLOUD, cloud_message

    camera = lens("plumb_bob")
    cloud = camera.backproject(seen_by(camera)[0])
    messages = [*recorded("plumb_bob")[:2], ("/points", POINT_CLOUD, cloud_message(cloud))]
    (frame,) = read_all(mcap(tmp_path / "a.mcap", messages))
    (of_depth,) = read_all(mcap(tmp_path / "b.mcap", recorded("plumb_bob")))
    np.testing.assert_allclose(frame.cloud_m, of_depth.cloud_m, atol=1e-6)
    np.testing.assert_array_equal(frame.image, of_depth.image)


@settings(max_examples=30)
@given(st.lists(st.floats(-30, 30), min_size=4, max_size=8))
def test_no_coefficients_give_a_pixel_what_another_one_sees(values):
    """Wild polynomials turn back off the axis; what cannot be undone is left out."""
    coefficients = coefficients_of("polynomial", np.array(values))
    assert coefficients is not None
    camera = PixelCamera(CAMERA, "polynomial", coefficients)
    cloud = camera.rectify_cloud(camera.backproject(np.full((120, 160), 0.7)))
    v, u = np.nonzero(np.isfinite(cloud[..., 2]))
    off = CAMERA.project(cloud[v, u]) - np.stack([u, v], axis=1)
    assert np.abs(off).max(initial=0) < 5.1
    assert camera.rectify_picture(np.full((120, 160), 7, np.uint8)).shape == (120, 160)


def test_coefficients_are_filled_up_and_too_many_are_refused():
    assert coefficients_of("polynomial", np.array([1.0, 2, 3])) == (1, 2, 3, 0)
    assert coefficients_of("polynomial", np.array([1.0, 2, 3, 4, 5, 6])) == (1, 2, 3, 4, 5, 6, 0, 0)
    assert coefficients_of("fisheye", np.array([1.0, 2, 3, 4, 0])) == (1, 2, 3, 4)
    assert coefficients_of("fisheye", np.array([1.0, 2, 3, 4, 5])) is None
