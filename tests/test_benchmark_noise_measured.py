"""The benchmark of measured noise: its true values are those of the law, and the measured ones agree."""

import numpy as np
import pytest

from benchmarks.noise_measured import HEAD, RADIUS_M, clean, measured, row, true_stds
from tubepose.simulation.depth_noise import DepthNoise


@pytest.fixture(scope="module")
def scene():
    return clean("round-10ml-3x4", "blood-16x100", 500, 0)


def test_true_values_of_independent_noise_are_those_of_least_squares(scene):
    noise = DepthNoise(independent_m=2e-4)
    slope, height, depth_m = true_stds(scene, noise, np.random.default_rng(0))
    n = np.pi * (RADIUS_M * scene.camera.fx / depth_m) ** 2
    # The camera looks at the plane at up to 20 deg: pixels are fewer, and the depth's error is not along the normal.
    assert slope == pytest.approx(2e-4 / np.sqrt(n) / (RADIUS_M / 2), rel=0.15)
    assert height == pytest.approx(2e-4 / np.sqrt(n), rel=0.15)


def test_measured_values_agree_with_the_true_ones_on_a_ray_cast_frame(scene):
    noise = DepthNoise(1e-4, 2e-4, depth_power=1.0)
    slope, height, depth_m = true_stds(scene, noise, np.random.default_rng(0))
    found, _ = measured(scene, noise, np.random.default_rng(1))
    assert found.source == "table"
    assert found.slope_std(RADIUS_M, depth_m) == pytest.approx(slope, rel=0.2)
    assert found.height_std_m(RADIUS_M, depth_m) == pytest.approx(height, rel=0.3)


def test_a_row_has_the_columns_of_the_head(scene):
    text = row(scene, "none", DepthNoise(), 0)
    assert text.count("|") == HEAD.count("|")
    assert "| - |" in text
