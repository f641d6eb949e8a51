"""Registration of the rack by the paper's way, OBB and ICP: the rival of the edges."""

import numpy as np
import pytest
import scenes
from scipy.spatial.transform import Rotation

from tubepose.config import Config, RackConfig
from tubepose.labware import load_rack
from tubepose.rack import RackStatus, obb, register_rack
from tubepose.rack.obb import rack_template_m
from tubepose.transforms import HALF_TURN, make_transform, transform_points

SOFT = load_rack("chen2023-soft-5x10")
HARD = load_rack("chen2023-hard-5x10")
MIXED = load_rack("mixed-6x15ml-4x50ml")
T_CAMERA_SOFT = scenes.camera_from_rack(SOFT, yaw_rad=0.3, tilt_rad=0.2)


def config_with(**changes):
    return Config(rack=RackConfig(method="obb-icp", **changes))


CONFIG = config_with()


@pytest.fixture(scope="module")
def soft_scan():
    return transform_points(T_CAMERA_SOFT, scenes.rack_top(SOFT))


def assert_same_pose(T_found, T_true, angle_deg=0.1, distance_m=1.5e-4):
    """Within 0.1 degrees and 0.15 mm, but for half a turn."""
    T_found = min((T_found, T_found @ HALF_TURN), key=lambda T: scenes.angle_deg(T[:3, :3], T_true[:3, :3]))
    assert scenes.angle_deg(T_found[:3, :3], T_true[:3, :3]) < angle_deg
    assert np.linalg.norm((T_found - T_true)[:3, 3]) < distance_m


@pytest.mark.parametrize("name", ["chen2023-soft-5x10", "round-10ml-3x4", "quincunx-17mm-8"])
def test_a_tilted_rack_is_recovered(name):
    rack = load_rack(name)
    T_true = scenes.camera_from_rack(rack, 2.0, np.deg2rad(25))
    pose = register_rack(transform_points(T_true, scenes.rack_top(rack)), rack, CONFIG)
    assert pose.status is RackStatus.OK
    assert_same_pose(pose.T_camera_rack, T_true)
    assert (pose.ambiguous, pose.resolved_by) == (True, "rule")
    assert pose.fitness > 0.99
    assert pose.in_slot_share < 0.01
    assert pose.covariance is None


@pytest.mark.parametrize(("true", "asked"), [(SOFT, HARD), (HARD, SOFT)], ids=["soft-as-hard", "hard-as-soft"])
def test_a_rack_of_another_pitch_is_refused_though_its_fitness_is_high(true, asked):
    T_true = scenes.camera_from_rack(true, 0.3, 0.2)
    pose = register_rack(transform_points(T_true, scenes.rack_top(true)), asked, CONFIG)
    assert pose.status is RackStatus.REFUSED
    assert pose.T_camera_rack is None
    assert pose.fitness > CONFIG.rack.min_fitness
    assert f"lie inside the openings of {asked.name}" in pose.reason


def test_half_a_rack_is_not_found_and_the_reason_tells_its_size():
    top = scenes.rack_top(SOFT)
    pose = register_rack(transform_points(T_CAMERA_SOFT, top[top[:, 0] > 0]), SOFT, CONFIG)
    assert pose.status is RackStatus.NOT_FOUND
    assert "closest: a band of 96." in pose.reason


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"min_coverage": 0.999}, "of the top seen, at least 100% expected"),
        ({"min_fitness": 1.01}, "fitness 1.000, at least 1.01 expected"),
        ({"max_inlier_rmse_m": 1.5e-4}, "inlier rmse 0.2"),
    ],
    ids=["coverage", "fitness", "rmse"],
)
def test_every_threshold_can_refuse_in_words(soft_scan, change, words):
    pose = register_rack(soft_scan, SOFT, config_with(**change))
    assert pose.status is RackStatus.REFUSED
    assert words in pose.reason
    assert pose.T_camera_rack is None


@pytest.mark.parametrize("distances_m", [(1e-9,), (6e-3, 1e-9)], ids=["first-round", "last-round"])
def test_points_that_correspond_to_nothing_give_no_pose(soft_scan, distances_m):
    pose = register_rack(soft_scan, SOFT, config_with(icp_distances_m=distances_m, judge_distance_m=max(distances_m)))
    assert pose.status is RackStatus.REFUSED
    assert "fitness 0.000" in pose.reason
    assert pose.T_camera_rack is None


def test_the_template_lies_on_the_solid_top_and_nowhere_else():
    template = rack_template_m(MIXED, 1e-3)
    assert np.all(template[:, 2] == MIXED.height_m)
    solid = np.prod(MIXED.outline_mm) - sum(np.pi * (s.size_mm[0] / 2) ** 2 for s in MIXED.all_slots)
    assert len(template) == pytest.approx(solid, rel=0.01)  # one point per square millimetre
    assert not np.any(np.hypot(*(template[:, :2] - MIXED.slot("B4").center_m).T) < 15e-3)


def test_a_bounding_box_that_stands_askew_does_not_lose_the_rack(soft_scan, monkeypatch):
    hypotheses = obb._hypotheses
    askew = make_transform(Rotation.from_euler("x", 25, degrees=True).as_matrix(), np.zeros(3))
    starts = []

    def turned(*arguments):
        starts.extend(T @ askew for T in hypotheses(*arguments))
        return starts

    monkeypatch.setattr(obb, "_hypotheses", turned)
    pose = register_rack(soft_scan, SOFT, CONFIG)
    assert len(starts) > 0
    assert pose.status is RackStatus.OK
    assert pose.fitness > 0.95
    assert_same_pose(pose.T_camera_rack, T_CAMERA_SOFT)
