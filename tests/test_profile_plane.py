"""Planes of caps' tops: height and slope of noisy, tilted discs, whatever lies beside them."""

import numpy as np
import pytest

from tubepose.config import ProfileConfig
from tubepose.profile.plane import fit_top_planes, top_spacing_m

CONFIG = ProfileConfig()
RADIUS_M = 9e-3
HEIGHT_M = 0.12


def disc(slope=(0.0, 0.0), height_m=HEIGHT_M, count=2000, noise_m=0.0, radius_m=RADIUS_M, seed=0):
    """Offsets (N, 2) and heights (N,) of points on a tilted disc."""
    rng = np.random.default_rng(seed)
    xy = rng.normal(size=(count, 2))
    xy *= radius_m * np.sqrt(rng.uniform(size=(count, 1))) / np.linalg.norm(xy, axis=1, keepdims=True)
    return xy, height_m + xy @ np.array(slope) + rng.normal(0, noise_m, count)


def fit(*discs, expected_m=HEIGHT_M, config=CONFIG):
    label = np.repeat(np.arange(len(discs)), [len(z) for _, z in discs])
    xy, z = (np.concatenate([d[k] for d in discs]) for k in (0, 1))
    count = len(discs)
    return fit_top_planes(label, xy, z, np.full(count, expected_m), np.full(count, RADIUS_M), config)


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.03, 0.0), (-0.02, 0.04)])
def test_a_clean_tilted_disc_is_exact(slope):
    found = fit(disc(slope))
    assert found.slope[0] == pytest.approx(slope, abs=1e-9)
    assert found.height_m[0] == pytest.approx(HEIGHT_M, abs=1e-12)


def test_the_spacing_of_a_top_is_that_of_its_points():
    # A disc of 2000 points, and one of 125, four times as far apart; what is no plane has none.
    found = fit(disc(), disc(count=125), disc(height_m=0.3))
    spacing = top_spacing_m(found, np.full(3, RADIUS_M))
    assert spacing[:2] == pytest.approx(np.sqrt(np.pi * RADIUS_M**2 / np.array([2000, 125])), rel=0.05)
    assert np.isnan(spacing[2])


def test_each_top_has_its_own_plane():
    slopes = np.array([(0.02, 0.0), (0.0, -0.03), (0.01, 0.01)])
    found = fit(*(disc(slope, HEIGHT_M + 1e-4 * i, seed=i) for i, slope in enumerate(slopes)))
    assert np.allclose(found.slope, slopes, atol=1e-9)
    assert found.height_m == pytest.approx(HEIGHT_M + 1e-4 * np.arange(3), abs=1e-12)


def test_errors_of_noise_are_within_the_stated_variance():
    discs = [disc((0.01, -0.02), noise_m=1e-4, seed=seed) for seed in range(40)]
    found = fit(*discs)
    errors = (found.slope - [0.01, -0.02]) / np.sqrt(found.slope_var)[:, None]
    # The rms is weighted: points far off count less in it than in a plain one. So are the errors: the part of single
    # points is stated too small.
    assert found.rms_m == pytest.approx(0.82e-4, rel=0.1)
    assert 0.8 < np.mean(errors**2) < 2.0
    heights = (found.height_m - HEIGHT_M) / np.sqrt(found.height_var_m2)
    assert 0.5 < np.mean(heights**2) < 2.5


def test_many_points_average_out():
    few, many = fit(disc(noise_m=1e-4, count=500)), fit(disc(noise_m=1e-4, count=50_000))
    assert few.slope_var[0] == pytest.approx(100 * many.slope_var[0], rel=0.3)
    assert few.height_var_m2[0] == pytest.approx(100 * many.height_var_m2[0], rel=0.3)


def test_points_of_something_else_change_nothing():
    xy, z = disc((0.02, -0.01), noise_m=3e-5)
    rng = np.random.default_rng(1)
    clutter = rng.uniform(-5e-3, 5e-3, (300, 2))
    beside = HEIGHT_M - rng.uniform(0.6e-3, 1.5e-3, len(clutter))
    mixed = fit((np.vstack([xy, clutter]), np.concatenate([z, beside])))
    assert mixed.slope[0] == pytest.approx((0.02, -0.01), abs=5e-4)
    assert mixed.height_m[0] == pytest.approx(HEIGHT_M, abs=2e-5)
    assert mixed.n_points[0] < len(z) * 1.1


def test_the_blurred_edge_is_left_out():
    xy, z = disc((0.01, 0.0))
    far = np.hypot(*xy.T) > RADIUS_M - 1e-3
    assert far.sum() > 200
    bent = z - np.where(far, 0.4e-3, 0.0)
    assert fit((xy, bent)).slope[0] == pytest.approx((0.01, 0.0), abs=1e-9)


@pytest.mark.parametrize("count", [0, 5, CONFIG.min_top_points - 1])
def test_too_few_points_make_no_plane(count):
    xy, z = disc(radius_m=5e-3)
    found = fit((xy[:count], z[:count]), disc())
    assert np.isnan(found.height_m[0])
    assert np.isnan(found.slope[0]).all()
    assert np.isfinite(found.slope[1]).all()


def test_points_far_from_the_expected_height_are_of_no_top():
    found = fit(disc(height_m=HEIGHT_M + 2 * CONFIG.top_band_m))
    assert np.isnan(found.height_m[0])
