"""Points before any pose: thinning, outliers, noise and unit."""

import numpy as np
import pytest
import scenes
from hypothesis import given
from hypothesis import strategies as st

from tubepose.config import PreprocessConfig, RackTopConfig
from tubepose.labware import load_rack
from tubepose.preprocessing import (
    fullest_level,
    level_noise_m,
    plausible_unit_factors,
    point_spacing_m,
    remove_outliers,
    thin,
    voxel_downsample,
)

CONFIG = RackTopConfig()
RACK = load_rack("chen2023-soft-5x10")


def plane(noise_m=0.0, count=8000, seed=0):
    """A table of 0.4 x 0.4 m that faces the camera at 0.6 m."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.2, -0.2, 0.6], [0.2, 0.2, 0.6], (count, 3))
    return points + np.column_stack([np.zeros((count, 2)), rng.normal(0, noise_m, count)])


def test_outliers_go_and_the_rest_stays():
    points = scenes.rack_top(RACK)
    stray = np.array([[0.3, 0.3, 0.3], [-0.2, 0.1, 0.4], [0.0, 0.0, 0.2]])
    kept = remove_outliers(np.vstack([points, stray]), PreprocessConfig())
    assert len(kept) > 0.95 * len(points)
    assert np.abs(kept[:, 2] - RACK.height_m).max() < 0.01


def test_too_few_points_to_judge_are_returned_as_they_are():
    points = np.vstack([np.zeros((19, 3)), [[1.0, 1.0, 1.0]]])
    assert remove_outliers(points, PreprocessConfig()) is points


def test_voxels_hold_the_mean_of_their_points():
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.3, 0.3], [5.1, 0.1, 0.1]])
    found = voxel_downsample(points, 1.0)
    assert np.allclose(found[np.argsort(found[:, 0])], [[0.2, 0.2, 0.2], [5.1, 0.1, 0.1]])


@given(st.integers(0, 300), st.integers(1, 100))
def test_thinning_keeps_order_ends_and_the_count(total, count):
    points = np.arange(total, dtype=float)[:, None] * np.ones(3)
    kept = thin(points, count)
    assert len(kept) == min(total, count)
    assert np.all(np.diff(kept[:, 0]) > 0)
    if count > 1 and total:
        assert (kept[0, 0], kept[-1, 0]) == (0, total - 1)


def test_spacing_of_a_grid():
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20), [0]), axis=-1).reshape(-1, 3) * 0.7e-3
    assert point_spacing_m(grid) == pytest.approx(0.7e-3)
    assert np.isnan(point_spacing_m(grid[:1]))
    assert np.isnan(point_spacing_m(grid[:0]))


def test_noise_of_a_level_plane_is_its_scatter():
    assert level_noise_m(plane(1.5e-3), CONFIG) == pytest.approx(1.5e-3, rel=0.1)
    assert level_noise_m(plane(0.1e-3), CONFIG) == pytest.approx(0.1e-3, rel=0.1)


def test_smooth_waves_count_as_noise_and_a_tilted_plane_does_not():
    points = plane()
    slanted = points + np.outer(0.3 * points[:, 0], [0, 0, 1])
    assert level_noise_m(slanted, CONFIG) < 1e-6
    wavy = points + np.outer(2e-3 * np.sin(points[:, 0] * 2 * np.pi / 0.04), [0, 0, 1])
    assert level_noise_m(wavy, CONFIG) == pytest.approx(2e-3 / np.sqrt(2), rel=0.15)


def test_noise_without_a_plane_is_unknown():
    assert np.isnan(level_noise_m(np.zeros((10, 3)), CONFIG))


@pytest.mark.parametrize(
    ("scale", "factors"), [(1.0, set()), (1000.0, {1000.0}), (0.001, {0.001}), (10.0, {10.0}), (0.1, {0.1})]
)
def test_units_under_suspicion_are_those_that_make_the_cloud_a_racks_size(scale, factors):
    assert factors <= set(plausible_unit_factors(scenes.rack_top(RACK) * scale, RACK))


def test_a_cloud_in_metres_is_not_taken_for_millimetres():
    assert 1000.0 not in plausible_unit_factors(scenes.rack_top(RACK), RACK)
    assert 10.0 not in plausible_unit_factors(scenes.rack_top(RACK), RACK)


def test_the_fullest_level_of_every_group_is_counted():
    of = np.array([0, 0, 0, 0, 2, 2, 2])
    heights = np.array([1.1, 1.9, 2.2, 5.0, 7.0, 8.6, 11.0]) * 1e-3
    found = fullest_level(of, heights, 4, 2e-3, 0.0)
    assert found.tolist() == [3, 0, 2, 0]
    assert fullest_level(of[:0], heights[:0], 2, 2e-3, 0.0).tolist() == [0, 0]
