"""Walls: a clean one moves the axis to the truth, scattered light says nothing."""

import numpy as np
import pytest
import scenes

from tubepose.config import ProfileConfig
from tubepose.labware import load_rack, load_tube
from tubepose.profile.posterior import evidence
from tubepose.profile.standing import Standing
from tubepose.profile.wall import wall_evidence

CONFIG = ProfileConfig()
RACK = load_rack("chen2023-soft-5x10")
TUBE = load_tube("chen2023-tube-2")
SLOT = RACK.slot("C5")
CAMERA_M = np.array([0.15, 0.05, 0.7])
LOW_M = RACK.height_m + 2e-3
SKIRT_M = TUBE.height_m - TUBE.cap.height_mm * 1e-3


def cylinder(truth, count=1500, noise_m=3e-5, tube=TUBE, all_around=False, seed=0):
    """Points on the side of a leaning wall that faces the camera, shape (N, 3), rack frame."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(LOW_M, RACK.floor_m + SKIRT_M - 2e-3, count)
    u, v, a, b = truth
    above = z - RACK.floor_m - tube.pivot_height_m
    middle = SLOT.center_m + np.column_stack([u + a * above, v + b * above])
    angle = rng.uniform(0, 2 * np.pi, count)
    normal = np.column_stack([np.cos(angle), np.sin(angle)])
    r = tube.body_radius_m(z - RACK.floor_m) + rng.normal(0, noise_m, count)
    points = np.column_stack([middle + r[:, None] * normal, z])
    seen = all_around | (np.einsum("ij,ij->i", normal, CAMERA_M[:2] - points[:, :2]) > 0)
    return points[seen]


def told(points, pose=(0.0, 0.0, 0.0, 0.0), tube=TUBE, config=CONFIG):
    standing = Standing(np.asarray(points), CAMERA_M)
    label = np.zeros(len(points), np.intp)
    return wall_evidence(standing, label, np.array([pose]), SLOT.center_m[None], [tube], RACK, config)


def combined(walls, at=(0.0, 0.0, 0.0, 0.0), std=(1e-3, 1e-3, 0.02, 0.02)):
    """Mean under a weak Gaussian about a start."""
    prior = evidence(np.eye(4)[None], np.array([at]), np.diag(np.square(std))[None])
    both = walls + prior
    return np.linalg.solve(both.matrix, both.vector[..., None])[0, :, 0]


@pytest.mark.parametrize("truth", [(1e-4, 0.0, 1.5e-3, -1e-3), (-1e-4, 1e-4, 0.0, 2e-3), (0.0, 0.0, 0.0, 0.0)])
@pytest.mark.parametrize("all_around", [True, False])
def test_a_clean_wall_moves_the_axis_to_the_truth(truth, all_around):
    points = cylinder(truth, all_around=all_around)
    pose = np.zeros(4)
    for _ in range(3):
        pose = combined(told(points, pose))
    heights = np.array([LOW_M, RACK.floor_m + SKIRT_M]) - RACK.floor_m - TUBE.pivot_height_m
    off = [pose[:2] - truth[:2] + h * (pose[2:] - truth[2:]) for h in heights]
    # From one side a wider wall and a nearer axis look the same, so half the truth's radius prior stays.
    assert np.abs(off).max() < 8e-5


def test_the_information_points_at_the_camera():
    matrix = told(cylinder((0, 0, 0, 0))).matrix[0]
    towards = CAMERA_M[:2] - SLOT.center_m
    towards /= np.linalg.norm(towards)
    across = np.array([-towards[1], towards[0]])
    assert across @ matrix[:2, :2] @ across > 0
    assert np.linalg.eigvalsh(matrix).min() > -1e-6 * np.linalg.eigvalsh(matrix).max()
    # The wall's own radius is unknown: towards the camera it is worth no more than that prior.
    assert towards @ matrix[:2, :2] @ towards < 40 / CONFIG.wall_radius_m**2


def test_uniform_clutter_says_almost_nothing():
    rng = np.random.default_rng(0)
    clean = cylinder((0, 0, 0, 0), count=4000, noise_m=0.0, all_around=True)
    spread = (clean[:, :2] - SLOT.center_m) * rng.uniform(0.85, 1.15, (len(clean), 1)) + SLOT.center_m
    clutter = np.column_stack([spread, clean[:, 2]])
    of_wall, of_clutter = (np.trace(told(points).matrix[0][:2, :2]) for points in (clean, clutter))
    assert of_clutter < 0.02 * of_wall


def test_points_on_the_far_side_are_seen_through_the_tube_and_do_not_count():
    points = cylinder((0, 0, 0, 0), all_around=True)
    towards = CAMERA_M[:2] - points[:, :2]
    far = points[np.einsum("ij,ij->i", points[:, :2] - SLOT.center_m, towards) < 0]
    assert len(far) > 300
    assert not told(far).matrix.any()


def test_the_cap_and_the_skirt_below_it_do_not_count():
    points = cylinder((0, 0, 0, 0))
    points[:, 2] = RACK.floor_m + SKIRT_M + 0.5e-3
    assert not told(points).matrix.any()


def test_few_points_say_nothing():
    points = cylinder((0, 0, 0, 0), noise_m=1e-5)
    assert not told(points[: CONFIG.min_wall_points - 1]).matrix.any()
    assert told(points[: CONFIG.min_wall_points]).matrix.any()


def test_twice_the_points_are_twice_the_information_and_neighbours_count_once():
    points = cylinder((0, 0, 0, 0), noise_m=1e-5)
    loose = CONFIG.model_copy(update={"wall_radius_m": 1e3})
    once, twice = told(points, config=loose), told(np.vstack([points, points]), config=loose)
    assert np.allclose(twice.matrix, 2 * once.matrix, rtol=1e-6)
    alone = loose.model_copy(update={"wall_redundancy": 1.0})
    assert np.allclose(told(points, config=alone).matrix, loose.wall_redundancy * once.matrix, rtol=1e-6)


def test_tubes_and_points_of_no_tube_are_told_apart():
    points = cylinder((0, 0, 0, 0))
    label = np.full(len(points), -1)
    standing = Standing(points, CAMERA_M)
    nothing = wall_evidence(standing, label, np.zeros((1, 4)), SLOT.center_m[None], [TUBE], RACK, CONFIG)
    assert not nothing.matrix.any()
    centers = np.array([RACK.slot("A1").center_m, SLOT.center_m])
    both = wall_evidence(standing, np.ones(len(points), np.intp), np.zeros((2, 4)), centers, [TUBE, TUBE], RACK, CONFIG)
    assert not both.matrix[0].any()
    assert np.allclose(both.matrix[1], told(points).matrix[0])


def test_no_tubes_have_no_evidence():
    found = wall_evidence(
        Standing(np.empty((0, 3)), CAMERA_M), np.empty(0, np.intp), np.empty((0, 4)), np.empty((0, 2)), [], RACK, CONFIG
    )
    assert found.matrix.shape == (0, 4, 4)


def test_the_surface_of_the_scenes_module_is_believed_too():
    T = scenes.tube_pose(RACK, "C5", 0.004, -0.003)
    points = scenes.tube_surface(TUBE, T, LOW_M, noise_m=3e-5)
    pose = np.zeros(4)
    for _ in range(3):
        pose = combined(told(points, pose))
    axis = T[:3, 2] / T[2, 2]
    top = RACK.height_m + 10e-3 - RACK.floor_m
    expected = T[:2, 3] - SLOT.center_m + axis[:2] * top
    assert pose[:2] + pose[2:] * (top - TUBE.pivot_height_m) == pytest.approx(expected, abs=1e-4)
