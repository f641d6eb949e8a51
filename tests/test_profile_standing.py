"""What stands above a rack: which points, and where their lines of sight cross a level."""

import numpy as np
import pytest
import scenes

from tubepose.labware import load_rack
from tubepose.profile.standing import OUTSIDE_M, Standing, gather_standing
from tubepose.transforms import invert_transform, transform_points

RACK = load_rack("chen2023-soft-5x10")
T_CAMERA_RACK = scenes.camera_from_rack(RACK, 0.3, 0.15)
LOW_M, HIGH_M = RACK.height_m + 2e-3, 0.13
RNG = np.random.default_rng(0)
POINTS = RNG.uniform([-0.13, -0.09, 0.0], [0.13, 0.09, 0.16], (20_000, 3))


def test_a_line_of_sight_by_hand():
    standing = Standing(np.array([[0.0, 0.0, 0.1], [0.1, 0.2, 0.0], [0.3, 0.1, 0.5]]), np.array([0.0, 0.0, 1.0]))
    # From one metre up, a point on the ground stays in place on the ground, and comes half way in half way up.
    assert standing.on_level(0.0)[1] == pytest.approx([0.1, 0.2])
    assert standing.on_level(0.5)[1] == pytest.approx([0.05, 0.1])
    assert standing.on_level(0.5)[2] == pytest.approx([0.3, 0.1])
    assert standing.on_level(0.0)[2] == pytest.approx([0.6, 0.2])
    levels = standing.on_level(np.array([0.0, 0.5, 0.0]))
    assert levels == pytest.approx(np.array([[0.0, 0.0], [0.05, 0.1], [0.6, 0.2]]))
    assert standing.on_level(0.5, np.array([[0.2, 0.0, 0.0]])) == pytest.approx(np.array([[0.1, 0.0]]))


def test_light_from_below_the_surface_is_put_where_it_was_seen():
    camera = invert_transform(T_CAMERA_RACK)[:3, 3]
    top = np.array([0.03, -0.02, 0.12])
    deeper = top + (top - camera) / np.linalg.norm(top - camera) * np.array([[1e-3], [3e-3]])
    assert Standing(deeper, camera).on_level(0.12) == pytest.approx(np.tile(top[:2], (2, 1)))


def inside(points_m):
    half = RACK.outline_m / 2 + OUTSIDE_M
    return points_m[
        np.all(np.abs(points_m[:, :2]) < half, axis=1) & (points_m[:, 2] > LOW_M) & (points_m[:, 2] < HIGH_M)
    ]


def ordered(points_m):
    return points_m[np.lexsort(np.round(points_m, 9).T)]


def test_points_above_the_top_and_over_the_outline_are_taken():
    frame = scenes.unorganised(transform_points(T_CAMERA_RACK, POINTS))
    found = gather_standing(frame, None, T_CAMERA_RACK, RACK, LOW_M, HIGH_M)
    assert np.allclose(ordered(found.points_m), ordered(inside(POINTS)))
    assert found.camera_m == pytest.approx(invert_transform(T_CAMERA_RACK)[:3, 3])


def test_only_a_part_of_an_image_is_read_and_nothing_is_lost():
    frame = scenes.organised(transform_points(T_CAMERA_RACK, POINTS))
    whole = gather_standing(frame, None, T_CAMERA_RACK, RACK, LOW_M, HIGH_M)
    part = gather_standing(frame, scenes.CAMERA, T_CAMERA_RACK, RACK, LOW_M, HIGH_M)
    assert len(whole.points_m) > 3000
    assert np.allclose(ordered(part.points_m), ordered(whole.points_m))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_without_a_value_are_left_out(value):
    cloud = transform_points(T_CAMERA_RACK, POINTS)
    cloud[::2] = value
    found = gather_standing(scenes.unorganised(cloud), None, T_CAMERA_RACK, RACK, LOW_M, HIGH_M)
    assert np.allclose(ordered(found.points_m), ordered(inside(POINTS[1::2])))


def test_a_rack_beside_the_image_has_nothing_standing_on_it():
    frame = scenes.organised(transform_points(T_CAMERA_RACK, POINTS))
    T_beside = T_CAMERA_RACK.copy()
    T_beside[0, 3] += 5.0
    found = gather_standing(frame, scenes.CAMERA, T_beside, RACK, LOW_M, HIGH_M)
    assert found.points_m.shape == (0, 3)
