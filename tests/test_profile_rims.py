"""Middles of rims: bright rings in drawn images, between pixels, among clutter, and in the picture of depth."""

import numpy as np
import pytest
import scenes

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.config import ProfileConfig
from tubepose.labware import load_rack
from tubepose.profile.outline import SECTORS
from tubepose.profile.rims import brightness, fit_rims, rim_view

CONFIG = ProfileConfig()
BIAS_M = CONFIG.rim_bias_m
RACK = load_rack("chen2023-soft-5x10")
CAMERA = CameraIntrinsics(640, 480, 1600.0, 1600.0, 319.5, 239.5)
LEVEL_M = 0.12
INNER_M, OUTER_M = 7.75e-3, 9.0e-3
NONE_BLOCKED = np.zeros((1, SECTORS), bool)
SUB = 3


def level_points(T_camera_rack, level_m=LEVEL_M):
    """Where the rays of a grid of `SUB` x `SUB` points per pixel meet a level, rack frame, shape (H SUB, W SUB, 2)."""
    u = (np.arange(CAMERA.width * SUB) + 0.5) / SUB - 0.5
    v = (np.arange(CAMERA.height * SUB) + 0.5) / SUB - 0.5
    rays = np.stack(
        [*np.meshgrid((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy), np.ones((len(v), len(u)))], axis=-1
    )
    R, t = T_camera_rack[:3, :3], T_camera_rack[:3, 3]
    directions, origin = rays @ R, -R.T @ t
    along = (level_m - origin[2]) / directions[..., 2]
    return (origin + along[..., None] * directions)[..., :2]


def drawn(T_camera_rack, *centers_m, clutter=0.0, seed=0):
    """An image of bright rings on a dark ground, averaged over each pixel."""
    xy = level_points(T_camera_rack)
    bright = np.full(xy.shape[:2], 60.0)
    for center in centers_m:
        rho = np.hypot(*np.moveaxis(xy - np.asarray(center), -1, 0))
        bright[(rho > INNER_M) & (rho < OUTER_M)] = 160.0
    image = bright.reshape(CAMERA.height, SUB, CAMERA.width, SUB).mean(axis=(1, 3))
    rng = np.random.default_rng(seed)
    image += rng.normal(0, 2 + clutter, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


def frame_of(image, cloud_m=None):
    cloud = np.zeros((CAMERA.height, CAMERA.width, 3)) if cloud_m is None else cloud_m
    return RgbdFrame(cloud, image, CAMERA, None, "test")


def fit(frame, T, start_m, blocked=NONE_BLOCKED, level_m=LEVEL_M):
    start = np.atleast_2d(start_m)
    count = len(start)
    radii = np.tile([INNER_M, OUTER_M], (count, 1))
    return (
        start
        + fit_rims(rim_view(frame, CAMERA, T), start, np.full(count, level_m), radii, blocked, CONFIG, BIAS_M).offset_m
    )


VIEW = scenes.camera_from_rack(RACK, 0.4, 0.12, 0.6)


def seen(image):
    return rim_view(frame_of(image), CAMERA, VIEW)


@pytest.mark.parametrize("off_mm", [(0.0, 0.0), (1.1, -0.9), (-0.2, 1.4)])
def test_a_ring_is_found_between_pixels(off_mm):
    # A pixel is 0.34 mm wide there.
    center = np.array([0.013, -0.021])
    found = fit(frame_of(drawn(VIEW, center)), VIEW, center + np.array(off_mm) * 1e-3)
    assert found[0] == pytest.approx(center, abs=5e-5)


def test_colour_images_are_read_too():
    image = np.random.default_rng(0).integers(0, 255, (CAMERA.height, CAMERA.width)).astype(np.uint8)
    colour = np.stack([image] * 3, axis=-1)
    assert np.allclose(brightness(frame_of(colour)), brightness(frame_of(image)))


def test_rings_side_by_side_are_told_apart():
    centers = np.array([[0.0, 0.0], [0.0185, 0.0]])
    image = drawn(VIEW, *centers)
    found = fit(frame_of(image), VIEW, centers + np.array([[5e-4, -4e-4], [-5e-4, 3e-4]]), np.zeros((2, SECTORS), bool))
    assert found == pytest.approx(centers, abs=1e-4)


def test_clutter_adds_noise_and_no_more():
    center = np.array([0.01, 0.01])
    image = drawn(VIEW, center, clutter=25.0)
    image[:, :] = np.where(np.random.default_rng(1).uniform(size=image.shape) < 0.05, 250, image)
    found = fit(frame_of(image), VIEW, center + np.array([6e-4, -5e-4]))
    assert found[0] == pytest.approx(center, abs=1.5e-4)


def test_half_a_ring_is_enough_and_blocked_sectors_do_not_count():
    center = np.array([0.0, 0.0])
    image = drawn(VIEW, center)
    blocked = NONE_BLOCKED.copy()
    blocked[0, :8] = True
    radii = np.array([[INNER_M, OUTER_M]])
    found = fit_rims(seen(image), center[None] + 5e-4, np.array([LEVEL_M]), radii, blocked, CONFIG, BIAS_M)
    assert found.sectors[0] == pytest.approx(16 / 24, abs=0.05)
    assert center + 5e-4 + found.offset_m[0] == pytest.approx(center, abs=8e-5)


def test_an_image_without_a_ring_has_no_sectors():
    radii = np.array([[INNER_M, OUTER_M]])
    flat = np.full((CAMERA.height, CAMERA.width), 90, np.uint8)
    found = fit_rims(seen(flat), np.zeros((1, 2)), np.array([LEVEL_M]), radii, NONE_BLOCKED, CONFIG, BIAS_M)
    assert found.sectors[0] == 0
    assert np.isnan(found.offset_m).all()


def test_noise_alone_is_no_whole_ring():
    radii = np.array([[INNER_M, OUTER_M]])
    shares = []
    for seed in range(6):
        noise = np.random.default_rng(seed).integers(0, 255, (CAMERA.height, CAMERA.width)).astype(np.uint8)
        found = fit_rims(seen(noise), np.zeros((1, 2)), np.array([LEVEL_M]), radii, NONE_BLOCKED, CONFIG, BIAS_M)
        shares.append(found.sectors[0])
    # Contrast is relative: sectors of noise pass one by one, but never all, and the ring is asked for points too.
    assert max(shares) < 0.95
    assert np.mean(shares) < 0.8


def test_without_an_image_the_picture_of_depth_stands_for_it_with_less_trust():
    center = np.array([0.0, 0.0])
    xy = level_points(VIEW)[SUB // 2 :: SUB, SUB // 2 :: SUB]
    rho = np.hypot(*np.moveaxis(xy - center, -1, 0))
    cloud = np.where(((rho > INNER_M) & (rho < OUTER_M))[..., None], 1.0, np.nan) * np.ones(3)
    bare = frame_of(None, cloud)
    assert set(np.unique(brightness(bare))) == {0.0, 1.0}
    radii = np.array([[INNER_M, OUTER_M]])
    start, level = center[None] + [[5e-4, 3e-4]], np.array([LEVEL_M])
    found = fit_rims(rim_view(bare, CAMERA, VIEW), start, level, radii, NONE_BLOCKED, CONFIG, BIAS_M)
    assert start[0] + found.offset_m[0] == pytest.approx(center, abs=8e-5)
    sure = fit_rims(seen(drawn(VIEW, center)), start, level, radii, NONE_BLOCKED, CONFIG, BIAS_M)
    assert np.trace(found.covariance_m2[0]) > np.trace(sure.covariance_m2[0])


def test_a_rim_at_the_images_edge_does_not_fail():
    corner = level_points(VIEW)[0, 0]
    found = fit_rims(
        seen(drawn(VIEW, corner)), corner[None], np.array([LEVEL_M]),
        np.array([[INNER_M, OUTER_M]]), NONE_BLOCKED, CONFIG, BIAS_M,
    )  # fmt: skip
    assert found.sectors[0] < 0.75


def test_a_wrong_level_moves_the_middle_along_the_line_of_sight():
    T = scenes.camera_from_rack(RACK, 0.0, 0.25, 0.6)
    found = fit(frame_of(drawn(T, (0.0, 0.0))), T, (0.0, 0.0), level_m=LEVEL_M - 2e-3)[0]
    # Seen 0.25 rad off the vertical plus the place in the image: deeper is farther from the camera.
    camera = -T[:3, :3].T @ T[:3, 3]
    expected = camera[:2] + (0 - camera[:2]) * (LEVEL_M - 2e-3 - camera[2]) / (LEVEL_M - camera[2])
    assert np.linalg.norm(expected) > 4e-4
    assert found == pytest.approx(expected, abs=6e-5)
