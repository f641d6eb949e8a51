"""Registration by edges where little of the rack is seen: covers, cuts, neighbours, full racks; and its covariance."""

from dataclasses import replace

import numpy as np
import pytest
import scenes

from tubepose.checks import Check
from tubepose.config import Config
from tubepose.labware import RackModel, load_rack, load_tube
from tubepose.rack import RackStatus, agreement, edges, fit, looks, register_rack, settling
from tubepose.rack.field import top_field
from tubepose.rack.fit import filled, refine
from tubepose.rack.insufficient import too_coarse
from tubepose.transforms import HALF_TURN, QUARTER_TURN, invert_transform, transform_points, translation

CONFIG = Config()
SQUARE = RackModel.model_validate(
    {
        "kind": "rack", "name": "square", "outline_mm": [110, 110], "height_mm": 60, "floor_mm": 4,
        "grid": {"rows": 5, "columns": 5, "pitch_mm": [20, 20], "slot": {"shape": "square", "size_mm": [16, 16]}},
    }
)  # fmt: skip
SOFT = load_rack("chen2023-soft-5x10")
STEEL = load_rack("steel-round-13mm-5x10")
MIXED = load_rack("mixed-6x15ml-4x50ml")
CAPPED = load_tube("chen2023-tube-3")
T_TRUE = scenes.camera_from_rack(SOFT, yaw_rad=0.4, tilt_rad=0.15)
TOP = scenes.rack_top(SOFT, spacing_m=0.6e-3)


def register(points_in_rack, rack=SOFT, T=T_TRUE):
    return register_rack(transform_points(T, points_in_rack), rack, CONFIG)


def error(pose, T=T_TRUE, rack=SOFT):
    """Rotation (degrees) and shift of the top's centre (mm), but for half a turn."""
    top = np.array([0.0, 0.0, rack.height_m])
    T_found = min((pose.T_camera_rack, pose.T_camera_rack @ HALF_TURN), key=lambda F: -F[:3, 0] @ T[:3, 0])
    return scenes.angle_deg(T_found[:3, :3], T[:3, :3]), 1e3 * float(
        np.linalg.norm(transform_points(T_found, top) - transform_points(T, top))
    )


def capped(slots):
    view = scenes.towards_camera(T_TRUE)
    return [scenes.tube_surface(CAPPED, scenes.tube_pose(SOFT, s.name), SOFT.height_m, seen_from=view) for s in slots]


def hidden_by(top, slots, reach_m):
    """The top less what is under caps in those slots."""
    return scenes.hidden_by(top, [slot.center_m for slot in slots], reach_m)


@pytest.mark.parametrize("rack", [SOFT, MIXED], ids=lambda rack: rack.name)
def test_the_field_is_the_racks_signed_distance(rack):
    rng = np.random.default_rng(0)
    xy = rng.uniform(-0.5, 0.5, (4000, 2)) * (rack.outline_m + 5e-3)
    found, _, known = top_field(rack).look_up(xy)
    true = rack.top_signed_distance_m(xy)
    near = known & (np.abs(true) < 0.3e-3)
    assert known.all()
    assert np.abs(found - true)[near].max() < 1e-4
    assert np.abs(found - true)[near].mean() < 1e-5


def test_which_tops_are_the_same_after_half_a_turn_or_a_quarter():
    assert top_field(SQUARE).alike == 4
    assert top_field(SQUARE.model_copy(update={"outline_mm": (110.0, 112.0)})).alike == 2
    assert top_field(SOFT).alike == 2
    assert top_field(STEEL).alike == 2
    assert top_field(MIXED).alike == 1


def test_a_rack_full_of_capped_tubes_is_registered_by_slivers_of_its_ribs():
    top = hidden_by(TOP, SOFT.all_slots, 9.5e-3)
    assert len(top) < 0.75 * len(TOP)
    pose = register(np.vstack([top, *capped(SOFT.all_slots)]))
    assert pose.status is RackStatus.OK, pose.reason
    turn_deg, shift_mm = error(pose)
    assert turn_deg < 0.2
    assert shift_mm < 0.2


def test_a_rack_cut_by_the_image_edge_is_registered_by_what_is_left():
    pose = register(TOP[TOP[:, 0] < 0.045])
    assert pose.status is RackStatus.OK, pose.reason
    assert error(pose)[1] < 0.15


def test_a_plate_above_a_third_of_the_rack_does_not_move_it():
    plate = np.random.default_rng(0).uniform([0.03, -0.05, 0.15], [0.1, 0.05, 0.15], (20_000, 3))
    pose = register(np.vstack([TOP[TOP[:, 0] < 0.03], plate]))
    assert pose.status is RackStatus.OK, pose.reason
    assert error(pose)[1] < 0.15


def test_a_second_rack_beside_it_does_not_move_it():
    beside = TOP + np.array([0.0, SOFT.outline_m[1] + 6e-3, 0.0])
    pose = register(np.vstack([TOP, beside]))
    assert pose.status is RackStatus.OK, pose.reason
    both = [T_TRUE, T_TRUE.copy()]
    both[1][:3, 3] += T_TRUE[:3, 1] * (SOFT.outline_m[1] + 6e-3)
    assert min(error(pose, T)[1] for T in both) < 0.1


def test_light_that_sinks_half_of_the_points_does_not_sink_the_rack():
    rng = np.random.default_rng(0)
    sunk = TOP.copy()
    stray = rng.uniform(size=len(sunk)) < 0.4
    sunk[stray, 2] -= rng.exponential(0.8e-3, stray.sum())
    pose = register(sunk)
    T_found = pose.T_camera_rack
    assert abs((invert_transform(T_TRUE) @ T_found)[2, 3]) < 5e-5  # the mean sinks by 0.3 mm


def test_nothing_of_the_rack_but_one_row_is_not_believed():
    pose = register(TOP[TOP[:, 1] > 0.027])
    assert pose.status is not RackStatus.OK
    assert pose.covariance is None


def test_openings_that_are_wider_than_the_racks_are_another_rack():
    pose = register(TOP, STEEL)
    assert pose.status is not RackStatus.OK
    assert "another rack" in pose.reason


@pytest.mark.parametrize("share", [0.1, 0.2])
def test_light_that_lifts_and_sinks_points_makes_the_plane_less_sure(share):
    rng = np.random.default_rng(5)
    noisy = TOP + rng.normal(0, 1e-4, TOP.shape) * [0, 0, 1]
    astray = noisy + (rng.random(len(TOP)) < share)[:, None] * rng.choice([-2e-3, 2e-3], (len(TOP), 1)) * [0, 0, 1]
    clean, lit = register(noisy), register(astray)
    assert lit.status is RackStatus.OK, lit.reason
    clean_std, lit_std = (np.sqrt(np.diag(pose.covariance)) for pose in (clean, lit))
    expected = np.sqrt(1 + (share / fit.LIFTED_SHARE) ** 2)
    # What the tubes' slots say of yaw and shift is as sure as before.
    assert lit_std[[0, 1, 5]] / clean_std[[0, 1, 5]] == pytest.approx(expected, rel=0.25)
    assert lit_std[[2, 3, 4]] / clean_std[[2, 3, 4]] == pytest.approx(1, rel=0.25)


def test_evidence_is_compared_at_one_spacing():
    seen = agreement.Agreement(evidence=100.0, spacing_m=0.5e-3)
    assert seen.evidence_at(0.5e-3) == pytest.approx(100)
    assert seen.evidence_at(1.0e-3) == pytest.approx(400)
    assert seen.evidence_at(9e-3) == seen.evidence_at(1.5e-3) == pytest.approx(900)
    assert agreement.Agreement().evidence_at(0.5e-3) == 0


def test_the_covariance_holds_what_repeated_scans_do():
    for seed in range(6):
        pose = register(scenes.rack_top(SOFT, seed, spacing_m=0.8e-3))
        assert pose.covariance.shape == (6, 6)
        assert np.all(np.linalg.eigvalsh(pose.covariance) > 0)
        turn_deg, shift_mm = error(pose)
        assert turn_deg < 3 * np.rad2deg(np.sqrt(np.trace(pose.covariance[:3, :3])))
        assert shift_mm < 3e3 * np.sqrt(np.trace(pose.covariance[3:, 3:]))


@pytest.mark.parametrize("slots_off", [(0, 0), (2, 0), (-1, 1)])
def test_a_start_some_slots_off_is_moved_before_it_is_refined(monkeypatch, slots_off):
    fits = []
    refine = settling.refine
    monkeypatch.setattr(settling, "refine", lambda *args: fits.append(1) or refine(*args))
    assert SOFT.grid is not None
    off = translation([*(np.multiply(slots_off, SOFT.grid.pitch_mm) * 1e-3), 0.0])
    points = transform_points(T_TRUE, hidden_by(TOP, SOFT.all_slots[5:30], 9e-3))
    found = settling.register_at(points, T_TRUE @ off, SOFT, CONFIG.rack)
    degrees, millimetres = error(found.fit)
    assert degrees < 0.05
    assert millimetres < 0.05
    assert found.reason == ""
    assert len(fits) == 1


@pytest.mark.parametrize("every", [1, 3])
def test_a_place_with_much_less_evidence_than_an_accepted_one_is_not_refined(every):
    points = transform_points(T_TRUE, hidden_by(TOP, SOFT.all_slots[5:30], 9e-3))
    best = settling.register_at(points, T_TRUE, SOFT, CONFIG.rack)
    assert best.reason == ""

    def no_rival(shift_m, found):
        T = T_TRUE @ translation([shift_m, 0.0, 0.0])
        return edges._no_rival(*looks.look_at(points[::every], T, SOFT), every, found, SOFT, CONFIG.rack)

    refused = replace(best, checks=(Check("row_more", 90.0, 60.0, False),))
    half_a_rack = 5 * SOFT.grid.pitch_mm[0] * 1e-3
    assert no_rival(half_a_rack, [best])
    assert not no_rival(0.0, [best])
    assert not no_rival(half_a_rack, [refused])  # nothing is accepted yet
    assert not no_rival(half_a_rack, [])


def test_a_quarter_turn_is_the_same_place_for_a_rack_that_it_leaves_as_it_is():
    for rack, same in ((SQUARE, True), (SOFT, False)):
        assert edges._same(T_TRUE, T_TRUE @ HALF_TURN, rack)
        assert edges._same(T_TRUE, T_TRUE @ QUARTER_TURN, rack) == same
        assert not edges._same(T_TRUE, T_TRUE @ translation([5e-3, 0.0, 0.0]), rack)


def test_a_rough_look_at_some_of_the_points_goes_on_with_all_of_them():
    points = transform_points(T_TRUE, TOP)
    T = T_TRUE @ translation([1e-3, -1e-3, 0.0])
    few, all_of_them = (looks.look_at(points[::every], T, SOFT)[1] for every in (5, 1))
    gone_on = filled(few, points, SOFT)
    assert len(few.kept_m) < 0.3 * len(all_of_them.kept_m)
    assert len(gone_on.kept_m) == pytest.approx(len(all_of_them.kept_m), rel=0.01)
    assert len(gone_on.rough_m) == len(all_of_them.rough_m)
    assert np.array_equal(gone_on.T_camera_top, few.T_camera_top)
    for rough in (gone_on, all_of_them):
        degrees, millimetres = error(refine(rough, SOFT))
        assert degrees < 0.05
        assert millimetres < 0.05


def test_a_scan_of_less_than_a_rack_is_refused():
    part = TOP[np.abs(TOP[:, :2]).max(axis=1) < 0.02]
    assert len(part) > 500
    assert register_rack(transform_points(T_TRUE, part), SOFT, CONFIG).status is not RackStatus.OK


def test_a_spacing_that_is_not_known_is_not_called_coarse():
    assert too_coarse(float("nan"), SOFT, CONFIG.rack) == ""
    assert "2.00 mm apart" in too_coarse(2e-3, SOFT, CONFIG.rack)
