"""The baselines of Open3D: what they recover on clean clouds, and that they fail aloud."""

import numpy as np
import pytest
import scenes

from tubepose.config import Config, IcpConfig
from tubepose.labware import load_rack, load_tube
from tubepose.methods.global_icp import fit_global_icp
from tubepose.methods.slot_icp import fit_slot_icp
from tubepose.methods.upright import fit_upright
from tubepose.transforms import axis_rotation, tilt_rad
from tubepose.tube import TubeStatus

CONFIG = Config()
RACK = load_rack("chen2023-soft-5x10")
SLOT = RACK.slot("C4")
TUBES = [load_tube(f"chen2023-tube-{i}") for i in (1, 2, 3)]
ASIDE = np.array([np.sin(0.3), 0.0, np.cos(0.3)])
ABOVE_M = RACK.height_m + CONFIG.slots.clearance_m


def leaning(tube, alpha_deg=0.8, beta_deg=-0.6, off_m=(0.6e-3, -0.4e-3)):
    T_rack_tube = scenes.tube_pose(RACK, SLOT.name, np.deg2rad(alpha_deg), np.deg2rad(beta_deg), off_m)
    return scenes.tube_surface(tube, T_rack_tube, ABOVE_M, seen_from=ASIDE), T_rack_tube


def errors(T_found, T_true):
    """Tilt in degrees, bottom in millimetres."""
    return (
        np.rad2deg(tilt_rad(T_found[:3, 2], T_true[:3, 2])),
        1e3 * np.linalg.norm((T_found - T_true)[:3, 3]),
    )


@pytest.mark.parametrize("tube", TUBES, ids=lambda tube: tube.name)
def test_slot_icp_recovers_a_clean_tube_with_its_bottom_off_the_centre(tube):
    points, T_true = leaning(tube)
    pose = fit_slot_icp(points, SLOT, tube, RACK, CONFIG)
    assert (pose.status, pose.reason) == (TubeStatus.OK, "")
    tilt_deg, bottom_mm = errors(pose.T_rack_tube, T_true)
    assert tilt_deg < 0.1
    assert bottom_mm < 0.25
    assert pose.fitness > 0.95
    assert pose.n_points == len(points)


def test_point_to_point_is_slower_to_arrive_than_point_to_plane():
    points, T_true = leaning(TUBES[1])
    config = CONFIG.model_copy(update={"icp": IcpConfig(estimation="point_to_point")})
    plane = errors(fit_slot_icp(points, SLOT, TUBES[1], RACK, CONFIG).T_rack_tube, T_true)
    point = errors(fit_slot_icp(points, SLOT, TUBES[1], RACK, config).T_rack_tube, T_true)
    assert 1.5 * plane[0] < point[0] < 0.95  # and yet nearer than the start, 1 degree off


def test_global_icp_recovers_a_clean_capped_tube_anywhere():
    tube = TUBES[2]
    points, T_true = leaning(tube)
    found = [fit_global_icp(points, SLOT, tube, RACK, CONFIG, seed) for seed in range(3)]
    good = [
        pose.T_rack_tube is not None
        and errors(pose.T_rack_tube, T_true)[0] < 0.1
        and errors(pose.T_rack_tube, T_true)[1] < 0.3
        for pose in found
    ]
    assert sum(good) >= 2  # it is a matter of chance, and that is what its row of the tables says


def test_global_icp_has_no_prior_from_the_slot():
    points, _ = leaning(TUBES[2])
    here = fit_global_icp(points, SLOT, TUBES[2], RACK, CONFIG, 0)
    there = fit_global_icp(points, RACK.slot("A1"), TUBES[2], RACK, CONFIG, 0)
    assert np.allclose(here.T_rack_tube, there.T_rack_tube, atol=1e-4)


def test_upright_is_the_slots_floor_and_the_racks_normal():
    pose = fit_upright(np.empty((0, 3)), SLOT, TUBES[0], RACK, CONFIG)
    assert pose.status is TubeStatus.OK
    assert np.array_equal(pose.T_rack_tube[:3, :3], np.eye(3))
    assert np.array_equal(pose.T_rack_tube[:3, 3], [*SLOT.center_m, RACK.floor_m])


@pytest.mark.parametrize("method", [fit_slot_icp, fit_global_icp])
def test_the_spin_is_fixed_by_the_rule_of_eq_1(method):
    points, _ = leaning(TUBES[1])
    T = method(points, SLOT, TUBES[1], RACK, CONFIG, 0).T_rack_tube
    assert np.allclose(T[:3, :3], axis_rotation(T[:3, 2]), atol=1e-9)


def test_slot_icp_without_a_correspondence_fails_and_is_no_identity():
    points, _ = leaning(TUBES[1])
    pose = fit_slot_icp(points + np.array([0.5, 0.0, 0.0]), SLOT, TUBES[1], RACK, CONFIG)
    assert pose.status is TubeStatus.FAILED
    assert pose.T_rack_tube is None
    assert pose.reason == "ICP found no correspondence within 4.0 mm"
    assert np.isnan(pose.inlier_rmse_m)


def test_global_icp_without_a_correspondence_fails_and_is_no_identity():
    line = np.linspace([0, 0, 0.06], [1.0, 0, 0.06], 60)
    pose = fit_global_icp(line, SLOT, TUBES[1], RACK, CONFIG, 0)
    assert pose.status is TubeStatus.FAILED
    assert pose.T_rack_tube is None
    assert pose.reason == "global registration found no correspondence"


@pytest.mark.parametrize(
    ("method", "count", "words"),
    [
        (fit_slot_icp, 0, "fewer than 3 points"),
        (fit_slot_icp, 2, "fewer than 3 points"),
        (fit_global_icp, 0, "0 points after down-sampling"),
        (fit_global_icp, 5, "at least 10 expected"),
    ],
)
def test_too_few_points_fail_without_a_pose(method, count, words):
    points, _ = leaning(TUBES[1])
    pose = method(points[:count], SLOT, TUBES[1], RACK, CONFIG, 0)
    assert pose.status is TubeStatus.FAILED
    assert pose.T_rack_tube is None
    assert words in pose.reason
    assert pose.n_points == count
