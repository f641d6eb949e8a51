"""Depth noise that is added to frames: its law is the one that is asked for."""

import dataclasses

import numpy as np
import pytest

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.errors import ConfigError
from tubepose.simulation.depth_noise import DepthNoise

CAMERA = CameraIntrinsics(400, 300, 1000.0, 1000.0, 199.5, 149.5)


def plane(depth_m: float = 0.5) -> RgbdFrame:
    cloud = CAMERA.backproject(np.full((300, 400), depth_m))
    return RgbdFrame(cloud, np.zeros((300, 400), np.uint8), CAMERA, None, "plane")


def step() -> RgbdFrame:
    depth = np.full((300, 400), 0.5)
    depth[:, 200:] = 0.6
    return dataclasses.replace(plane(), cloud_m=CAMERA.backproject(depth))


def error_of(noise: DepthNoise, seed: int = 0) -> np.ndarray:
    return noise.applied(plane(), np.random.default_rng(seed)).cloud_m[..., 2] - 0.5


def test_no_noise_changes_nothing() -> None:
    frame = step()
    np.testing.assert_array_equal(DepthNoise().applied(frame, np.random.default_rng(0)).cloud_m, frame.cloud_m)


def test_points_move_along_their_line_of_sight_and_the_image_stays() -> None:
    frame = plane()
    noisy = DepthNoise(1e-3, 1e-3).applied(frame, np.random.default_rng(0))
    assert noisy.image is frame.image
    u, v = np.meshgrid(np.arange(400), np.arange(300))
    np.testing.assert_allclose(CAMERA.project(noisy.cloud_m), np.stack([u, v], axis=-1), atol=1e-9)
    np.testing.assert_array_equal(frame.cloud_m, plane().cloud_m)


@pytest.mark.parametrize("length_m", [1e-3, 3e-3, 6e-3])
def test_shared_error_has_its_std_and_its_correlation(length_m: float) -> None:
    fields = np.array([error_of(DepthNoise(shared_m=1e-3, correlation_m=length_m), seed) for seed in range(4)])
    assert np.std(fields) == pytest.approx(1e-3, rel=0.05)
    lag = round(length_m * 1000 / 0.5)
    product = fields[:, :, lag:] * fields[:, :, :-lag]
    assert np.mean(product) / np.var(fields) == pytest.approx(np.exp(-1), abs=0.05)


def test_independent_error_is_not_shared() -> None:
    error = error_of(DepthNoise(independent_m=1e-3))
    assert np.std(error) == pytest.approx(1e-3, rel=0.02)
    assert abs(np.mean(error[:, 1:] * error[:, :-1])) < 0.02e-6


@pytest.mark.parametrize(("blur_px", "between"), [(0, 0), (2, 2), (6, 6)])
def test_blur_makes_a_ramp_of_its_width(blur_px: float, between: int) -> None:
    row = DepthNoise(blur_px=blur_px).applied(step(), np.random.default_rng(0)).cloud_m[150, :, 2]
    assert np.sum((row > 0.5 + 1e-6) & (row < 0.6 - 1e-6)) == between


def test_steps_and_missing_pixels() -> None:
    noisy = DepthNoise(independent_m=1e-3, missing=0.3, step_m=5e-4).applied(plane(), np.random.default_rng(0))
    depth = noisy.cloud_m[..., 2]
    assert np.mean(np.isnan(depth)) == pytest.approx(0.3, abs=0.01)
    counts = depth[np.isfinite(depth)] / 5e-4
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)


def test_invalid_pixels_stay_invalid_and_harm_no_neighbour() -> None:
    frame = plane()
    cloud = frame.cloud_m.copy()
    cloud[100:110, 100:110] = np.nan
    noisy = DepthNoise(1e-3, 1e-3, blur_px=3).applied(
        dataclasses.replace(frame, cloud_m=cloud), np.random.default_rng(0)
    )
    np.testing.assert_array_equal(np.isnan(noisy.cloud_m), np.isnan(cloud))


def test_same_state_same_frame() -> None:
    noise = DepthNoise(1e-3, 1e-3, missing=0.1)
    np.testing.assert_array_equal(error_of(noise, 3), error_of(noise, 3))
    assert not np.array_equal(error_of(noise, 3), error_of(noise, 4), equal_nan=True)


def test_refuses_clouds_without_pixels_and_numbers_that_mean_nothing() -> None:
    flat = dataclasses.replace(plane(), cloud_m=plane().cloud_m.reshape(1, -1, 3), organised=False)
    with pytest.raises(ConfigError, match="needs a pixel grid"):
        DepthNoise().applied(flat, np.random.default_rng(0))
    for wrong in ({"independent_m": -1e-3}, {"missing": 1.5}, {"correlation_m": 0.0}, {"step_m": float("nan")}):
        with pytest.raises(ConfigError, match="depth noise: expected"):
            DepthNoise(**wrong)
