"""The level band of the rack's top: found among other levels, and told from what has its outline."""

import numpy as np
import pytest
import scenes

from tubepose.config import RackTopConfig
from tubepose.labware import load_rack
from tubepose.rack_band import find_rack_top
from tubepose.transforms import invert_transform, transform_points

CONFIG = RackTopConfig()
RACK = load_rack("chen2023-soft-5x10")
T_CAMERA_RACK = scenes.camera_from_rack(RACK, 0.7, 0.3)
WALL = np.random.default_rng(0).uniform([-0.2, -0.2, 0.6], [0.2, 0.2, 0.6], (8000, 3))


def test_the_top_is_found_among_table_and_slot_floors():
    top = scenes.rack_top(RACK)
    table = np.random.default_rng(0).uniform([-0.2, -0.2, 0], [0.2, 0.2, 0], (12000, 3))
    points = transform_points(T_CAMERA_RACK, np.vstack([table, scenes.slot_floors(RACK), top]))
    found = find_rack_top(points, RACK, CONFIG)
    assert found.fits(CONFIG)
    assert found.size_m == pytest.approx(RACK.outline_m, abs=1.5e-3)
    assert found.in_slot_share < 0.02
    assert np.array_equal(np.sort(found.band_rows), np.arange(len(points) - len(top), len(points)))
    up, origin = found.T_camera_top[:3, 2], found.T_camera_top[:3, 3]
    assert up @ T_CAMERA_RACK[:3, 2] > np.cos(np.deg2rad(0.1))
    assert np.allclose(origin, transform_points(T_CAMERA_RACK, np.array([0, 0, RACK.height_m])), atol=1e-3)
    assert abs(found.T_camera_top[:3, 0] @ T_CAMERA_RACK[:3, 0]) > np.cos(np.deg2rad(0.5))


def test_the_floors_of_the_slots_are_not_taken_for_the_top():
    points = transform_points(T_CAMERA_RACK, scenes.slot_floors(RACK, spacing_m=1e-3))
    found = find_rack_top(points, RACK, CONFIG)
    assert found.in_slot_share > 2 * CONFIG.max_in_slot_share
    assert not found.fits(CONFIG)


def test_a_plate_of_the_racks_size_is_not_its_top():
    half = RACK.outline_m / 2
    plate = np.random.default_rng(0).uniform([*-half, RACK.height_m], [*half, RACK.height_m], (12000, 3))
    found = find_rack_top(transform_points(T_CAMERA_RACK, plate), RACK, CONFIG)
    assert found.outline_error_m < CONFIG.outline_tolerance_m
    assert not found.fits(CONFIG)


def test_a_perfectly_flat_wall_is_no_top():
    found = find_rack_top(WALL, RACK, CONFIG)
    assert found is None or not found.fits(CONFIG)


def test_a_thinned_search_still_measures_with_every_point():
    top = scenes.rack_top(RACK, spacing_m=0.6e-3)
    points = transform_points(T_CAMERA_RACK, top)
    found = find_rack_top(points, RACK, RackTopConfig(search_points=4000))
    assert found.fits(CONFIG)
    assert len(found.band_rows) == len(points)


@pytest.mark.parametrize("yaw_rad", [0.9, 2.5, 4.0, 5.6])
def test_the_half_turn_of_an_irregular_rack_is_told_by_its_openings(yaw_rad):
    rack = load_rack("mixed-6x15ml-4x50ml")
    T = scenes.camera_from_rack(rack, yaw_rad)
    found = find_rack_top(transform_points(T, scenes.rack_top(rack)), rack, CONFIG)
    T_top_rack = invert_transform(found.T_camera_top) @ T
    assert T_top_rack[0, 0] > 0.99


def test_nothing_stands_out_of_too_few_points():
    assert find_rack_top(WALL[:60], RACK, CONFIG) is None
