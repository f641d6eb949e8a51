"""The method `profile` as a whole: recovery, types, invariance, what it refuses and in which words."""

import dataclasses

import numpy as np
import profile_scenes as ps
import pytest
import scenes

from tubepose.capture.frame import RgbdFrame
from tubepose.labware import load_rack, load_tube
from tubepose.profile import fit_profiles
from tubepose.transforms import make_transform, transform_points
from tubepose.tube import TubeStatus

RACK = load_rack("chen2023-soft-5x10")
TUBES = tuple(load_tube(f"chen2023-tube-{i}") for i in (1, 2, 3))
OPEN, LOW, HIGH = TUBES
VIEW = scenes.camera_from_rack(RACK, 0.3, 0.1, 0.65)
PLACED = {
    "A1": (OPEN, scenes.tube_pose(RACK, "A1", 0.006, -0.005)),
    "C5": (LOW, scenes.tube_pose(RACK, "C5", -0.012, 0.015)),
    "C6": (HIGH, scenes.tube_pose(RACK, "C6", 0.006, 0.004)),
    "E10": (HIGH, scenes.tube_pose(RACK, "E10", -0.006, 0.006)),
    "B8": (OPEN, scenes.tube_pose(RACK, "B8", -0.003, 0.008)),
    "D3": (LOW, scenes.tube_pose(RACK, "D3", 0.02, 0.004)),
}
CLOSED = {slot: PLACED[slot] for slot in ("C5", "C6", "E10", "D3")}
OTHERS = {
    "steel-round-13mm-5x10": ({"A1": (0.004, 0.002), "C5": (-0.005, 0.0), "C6": (0.0, 0.004)}, "blood-13x75"),
    "round-5ml-3x4": ({"A1": (0.01, 0.0), "B3": (-0.004, 0.012)}, "centrifuge-5ml"),
}


@pytest.fixture(scope="module")
def frame():
    return ps.rendered(RACK, PLACED, VIEW)


@pytest.fixture(scope="module")
def found(frame):
    return ps.fit(frame, VIEW, RACK, TUBES)


def clouded(frame, cloud_m):
    return dataclasses.replace(frame, cloud_m=cloud_m)


# Recovery


def test_every_tube_of_three_types_is_found_with_its_type_and_none_more(found):
    assert {entry.slot: entry.tube for entry in found} == {slot: tube for slot, (tube, _) in PLACED.items()}
    assert {(entry.pose.status, entry.pose.reason) for entry in found} == {(TubeStatus.OK, "")}


def test_poses_are_recovered_and_the_stated_errors_are_honest(found):
    errors, squares = ps.errors_of(found, PLACED)
    assert errors.tilt_deg.max() < 0.35
    assert errors.tilt_deg.mean() < 0.2
    assert errors.lateral_mm.max() < 0.6
    assert errors.axial_mm.max() < 0.1
    assert squares.max() < 20.5  # chi-square with 5 degrees of freedom, 0.1 %
    assert squares.mean() < 9


def test_what_is_told_of_a_tube(found):
    for entry in found:
        pose = entry.pose
        assert 0.1 < entry.support <= 1
        assert 0.9 < pose.confidence <= 1
        assert pose.checks
        assert all(check.passed for check in pose.checks)
        assert pose.n_points == len(entry.points_m) > 50
        assert np.hypot(*(entry.points_m[:, :2] - RACK.slot(entry.slot).center_m).T).max() < 16e-3
        assert np.linalg.eigvalsh(pose.covariance).min() > 0
        assert pose.covariance == pytest.approx(pose.covariance.T)
        R = pose.T_rack_tube[:3, :3]
        assert pytest.approx(np.eye(3)) == R @ R.T
        assert entry.tube.is_open is bool(np.isnan(pose.top_rms_m))
        assert 0.4 <= pose.top_seen_share <= 1


@pytest.mark.parametrize("rack_name", sorted(OTHERS))
def test_round_slots_and_other_types(rack_name):
    rack = load_rack(rack_name)
    leans, tube_name = OTHERS[rack_name]
    tube = load_tube(tube_name)
    placed = {slot: (tube, scenes.tube_pose(rack, slot, *lean)) for slot, lean in leans.items()}
    view = scenes.camera_from_rack(rack, -0.4, -0.1, 0.65)
    found = ps.fit(ps.rendered(rack, placed, view), view, rack, (tube, load_tube("chen2023-tube-3")))
    assert {entry.slot: entry.tube for entry in found} == dict.fromkeys(placed, tube)
    assert {(entry.pose.status, entry.pose.reason) for entry in found} == {(TubeStatus.OK, "")}
    errors, squares = ps.errors_of(found, placed)
    assert errors.tilt_deg.max() < 0.35
    assert squares.max() < 20.5


def test_a_coarse_scan_still_gives_poses():
    frame = ps.rendered(RACK, CLOSED, VIEW, resolution=420)
    found = ps.fit(frame, VIEW, RACK, TUBES)
    assert {entry.slot: entry.tube for entry in found} == {slot: tube for slot, (tube, _) in CLOSED.items()}
    assert {(entry.pose.status, entry.pose.reason) for entry in found} == {(TubeStatus.OK, "")}
    errors, squares = ps.errors_of(found, CLOSED)
    assert errors.tilt_deg.max() < 0.5
    assert squares.max() < 20.5


def test_one_more_type_of_the_same_scene_changes_no_other_tube(frame, found):
    alone = ps.by_slot(ps.fit(frame, VIEW, RACK, (LOW, HIGH)))
    for slot in CLOSED:
        assert alone[slot].tube == PLACED[slot][0]
        assert alone[slot].pose.T_rack_tube == pytest.approx(ps.by_slot(found)[slot].pose.T_rack_tube, abs=1e-4)


# Types


def test_the_order_of_the_types_does_not_matter(frame, found):
    again = ps.by_slot(ps.fit(frame, VIEW, RACK, (HIGH, OPEN, LOW)))
    for entry in found:
        assert again[entry.slot].tube == entry.tube
        assert again[entry.slot].pose.T_rack_tube == pytest.approx(entry.pose.T_rack_tube, abs=1e-12)


def test_a_detectors_word_restricts_the_types(frame):
    allowed = np.ones((3, len(RACK.all_slots)), bool)
    slot = [known.name for known in RACK.all_slots].index("C5")
    allowed[:, slot] = [False, False, True]
    entry = ps.by_slot(ps.fit(frame, VIEW, RACK, TUBES, allowed=allowed)).get("C5")
    assert entry is None or entry.tube is not LOW
    assert entry is None or entry.pose.status is TubeStatus.REJECTED
    others = {e.slot for e in ps.fit(frame, VIEW, RACK, TUBES, allowed=allowed) if e.slot != "C5"}
    assert others == set(PLACED) - {"C5"}


def test_types_that_are_none_of_those_given_are_said_to_be_unknown(frame):
    short = load_tube("blood-13x75")
    found = ps.fit(frame, VIEW, RACK, (short,))
    assert {entry.tube for entry in found} == {None}
    assert {entry.pose.status for entry in found} == {TubeStatus.REJECTED}
    # The caps in C5 and C6 nearly touch, and look like one thing.
    closed = ps.by_slot([entry for entry in found if entry.slot in ("D3", "E10")])
    assert set(closed) == {"D3", "E10"}
    for slot, entry in closed.items():
        height = PLACED[slot][0].height_mm
        assert entry.pose.T_rack_tube is None
        words = entry.pose.reason.split(" mm high, expected (mm): ")
        assert float(words[0].removeprefix("unknown type: ")) == pytest.approx(height, abs=0.7)
        assert words[1] == "blood-13x75 76; or it stands on something"


# Invariance


def test_moving_the_camera_changes_nothing_beyond_noise(found):
    view = scenes.camera_from_rack(RACK, -0.5, -0.12, 0.62)
    again = ps.fit(ps.rendered(RACK, PLACED, view, seed=3), view, RACK, TUBES)
    assert {entry.slot: entry.tube for entry in again} == {slot: tube for slot, (tube, _) in PLACED.items()}
    before = ps.by_slot(found)
    for entry in again:
        other = before[entry.slot].pose
        angle = np.rad2deg(np.arccos(min(1.0, entry.pose.T_rack_tube[:3, 2] @ other.T_rack_tube[:3, 2])))
        sigma = np.sqrt(np.trace(entry.pose.covariance[:2, :2]) + np.trace(other.covariance[:2, :2]))
        assert angle < np.rad2deg(3.2 * sigma)


def test_another_frame_of_reference_changes_nothing_at_all():
    frame = ps.sampled(RACK, CLOSED, VIEW)
    T_moved = make_transform(
        np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ scenes.camera_from_rack(RACK, 0.2, 0.3)[:3, :3],
        np.full(3, 0.1),
    )
    moved = clouded(frame, transform_points(T_moved, frame.cloud_m))
    # The camera stays where it was seen from: the lines of sight go through the frame's origin, so it must move too.
    before, after = ps.fit(frame, VIEW, RACK, TUBES), ps.fit(moved, T_moved @ VIEW, RACK, TUBES)
    assert [entry.slot for entry in after] == [entry.slot for entry in before]
    for a, b in zip(after, before, strict=True):
        assert np.rad2deg(np.arccos(min(1.0, a.pose.T_rack_tube[:3, 2] @ b.pose.T_rack_tube[:3, 2]))) < 0.15


def test_a_rack_named_from_the_other_end_has_the_same_tubes(frame, found):
    T_half = make_transform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    turned = ps.by_slot(ps.fit(frame, VIEW @ T_half, RACK, TUBES))
    places = {slot.name: slot.center_m for slot in RACK.all_slots}
    for entry in found:
        other = next(name for name, xy in places.items() if np.allclose(xy, -places[entry.slot], atol=1e-6))
        axis, turned_axis = entry.pose.T_rack_tube[:3, 2], turned[other].pose.T_rack_tube[:3, 2]
        assert np.rad2deg(np.arccos(min(1.0, axis @ (T_half[:3, :3] @ turned_axis)))) < 0.12
    assert len(turned) == len(found)


def test_the_same_frame_gives_the_same_numbers(frame, found):
    again = ps.fit(frame, VIEW, RACK, TUBES)
    for a, b in zip(again, found, strict=True):
        # Where the rack is uncertain a top's own height counts for a little more.
        assert a.pose.T_rack_tube == pytest.approx(b.pose.T_rack_tube, abs=5e-6)
        assert np.array_equal(a.pose.covariance, b.pose.covariance)


def test_an_uncertain_rack_makes_uncertain_tubes(frame, found):
    rack_covariance = np.diag(np.square([2e-3, 2e-3, 1e-3, 1e-4, 1e-4, 2e-4]))
    loose = ps.fit(frame, VIEW, RACK, TUBES, rack_covariance=rack_covariance)
    for a, b in zip(loose, found, strict=True):
        # Where the rack is uncertain a top's own height counts for a little more.
        assert a.pose.T_rack_tube == pytest.approx(b.pose.T_rack_tube, abs=5e-6)
        assert np.linalg.eigvalsh(a.pose.covariance - b.pose.covariance).min() > -1e-12
        assert a.pose.covariance[4, 4] > b.pose.covariance[4, 4] + (2e-4) ** 2
        # Two samples: what the others do not tell apart.
        assert a.pose.confidence <= b.pose.confidence + 1e-3


# Frames without pixels


def test_without_pixels_closed_tops_work():
    found = ps.fit(ps.sampled(RACK, CLOSED, VIEW), VIEW, RACK, TUBES)
    assert {entry.slot: entry.tube for entry in found} == {slot: tube for slot, (tube, _) in CLOSED.items()}
    assert {entry.pose.status for entry in found} == {TubeStatus.OK}
    errors, _ = ps.errors_of(found, CLOSED)
    assert errors.tilt_deg.max() < 0.3


def test_without_pixels_open_tops_are_reported_with_a_reason():
    found = ps.by_slot(ps.fit(ps.sampled(RACK, PLACED, VIEW), VIEW, RACK, TUBES))
    assert set(found) == set(PLACED)
    for slot, (tube, _) in PLACED.items():
        assert found[slot].tube == tube
        if tube.is_open:
            assert found[slot].pose.status is TubeStatus.REJECTED
            assert found[slot].pose.reason_code == "not_looked_at"


def test_without_an_image_the_rims_are_looked_for_in_the_depth(frame):
    bare = dataclasses.replace(frame, image=None)
    found = ps.by_slot(ps.fit(bare, VIEW, RACK, TUBES))
    assert set(found) >= set(CLOSED)
    for slot in ("A1", "B8"):
        assert slot in found
        assert found[slot].pose.reason or found[slot].pose.status is TubeStatus.OK


def test_rims_that_the_image_does_not_show_are_told_of_and_refused(frame):
    dark = dataclasses.replace(frame, image=np.zeros_like(frame.image))
    found = ps.by_slot(ps.fit(dark, VIEW, RACK, TUBES))
    assert set(found) == set(PLACED)
    for slot, (tube, _) in PLACED.items():
        assert found[slot].tube == tube
        assert found[slot].pose.reason_code == ("circle_little_seen" if tube.is_open else "")


# What is refused


def test_an_empty_rack_has_no_tubes(frame):
    empty = ps.rendered(RACK, {}, VIEW, resolution=500)
    assert ps.fit(empty, VIEW, RACK, TUBES) == ()


def test_without_types_what_stands_there_is_told_of_without_a_pose(frame, found):
    alone = ps.fit(frame, VIEW, RACK, ())
    assert alone
    for entry in alone:
        assert (entry.tube, entry.pose.status, entry.pose.T_rack_tube) == (None, TubeStatus.REJECTED, None)
        assert entry.slot is None or entry.pose.reason.endswith("no tube model given (--tubes)")
    assert {entry.slot for entry in alone} - {None} <= {entry.slot for entry in found}


@pytest.mark.parametrize("organised", [True, False])
def test_nothing_but_missing_values(frame, organised):
    nothing = np.full_like(frame.cloud_m, np.nan)
    if organised:
        blind = dataclasses.replace(clouded(frame, nothing), image=None)
        assert ps.fit(blind, VIEW, RACK, TUBES) == ()
    else:
        assert ps.fit(scenes.unorganised(nothing.reshape(-1, 3)), VIEW, RACK, TUBES) == ()


@pytest.mark.parametrize("up_mm", [5.0, 1.4])
def test_a_tube_that_stands_on_something_is_refused(up_mm):
    T = scenes.tube_pose(RACK, "C5")
    T[2, 3] += up_mm * 1e-3
    (entry,) = ps.fit(ps.sampled(RACK, {"C5": (LOW, T)}, VIEW), VIEW, RACK, (LOW,))
    assert entry.pose.status is TubeStatus.REJECTED
    assert entry.pose.reason_code == "unknown_type"
    assert entry.pose.top.height_m == pytest.approx(0.1 + up_mm * 1e-3, abs=3e-4)
    height = float(entry.pose.reason.removeprefix("unknown type: ").split(" mm")[0])
    assert height == pytest.approx(100 + up_mm, abs=0.3)
    assert entry.tube is None


def test_a_tube_that_leans_as_its_slot_does_not_let_it_is_refused():
    T = scenes.tube_pose(RACK, "C5", 0.0, np.deg2rad(4.0))
    found = ps.fit(ps.sampled(RACK, {"C5": (HIGH, T)}, VIEW), VIEW, RACK, (HIGH,))
    assert found
    assert {entry.pose.status for entry in found} == {TubeStatus.REJECTED}


def test_two_tubes_in_one_slot_are_refused():
    rack, tube = load_rack("round-5ml-3x4"), load_tube("centrifuge-5ml")
    reach = tube.max_radius_m + 2.5e-3
    xy = np.random.default_rng(0).uniform([reach, -18e-3], [reach + 5.5e-3, 18e-3], (6000, 2))
    second = np.column_stack([xy + rack.slot("B2").center_m, np.full(len(xy), rack.floor_m + 0.055)])
    view = scenes.camera_from_rack(rack, 0.3, 0.1, 0.65)
    placed = {"B2": (tube, scenes.tube_pose(rack, "B2"))}
    alone = ps.fit(ps.sampled(rack, placed, view), view, rack, (tube,))
    assert [entry.pose.status for entry in alone] == [TubeStatus.OK]
    first, other = ps.fit(ps.sampled(rack, placed, view, second), view, rack, (tube,))
    assert first.pose.status is TubeStatus.REJECTED
    assert first.pose.reason_code == "two_in_slot"
    assert first.pose.T_rack_tube is not None
    assert (other.slot, other.tube, other.pose.reason_code) == ("B2", None, "second_top")


def test_a_tube_lying_across_is_told_and_the_others_stay():
    lying = np.random.default_rng(0).uniform([-45, -8, 68], [45, 8, 72], (20_000, 3)) * 1e-3
    placed = {slot: CLOSED[slot] for slot in ("E10",)}
    found = ps.fit(ps.sampled(RACK, placed, VIEW, lying), VIEW, RACK, TUBES)
    assert found[0].slot == "E10"
    assert found[0].pose.status is TubeStatus.OK
    (across,) = found[1:]
    assert (across.slot, across.tube) == (None, None)
    assert across.pose.reason_code == "lies_across"
    assert across.pose.T_rack_tube is None


def cut(frame, left, top, right, bottom):
    """The same frame as taken by a sensor that sees less."""
    k = frame.intrinsics
    smaller = dataclasses.replace(
        k, width=right - left, height=bottom - top, cx=k.cx - left, cy=k.cy - top
    )  # fmt: skip
    image = frame.image[top:bottom, left:right]
    return RgbdFrame(frame.cloud_m[top:bottom, left:right], image, smaller, None, "cut")


def test_a_rack_cut_by_the_images_edge_keeps_the_tubes_that_are_seen(frame, found):
    height = len(frame.cloud_m)
    tops = {s: transform_points(VIEW @ T, np.array([0, 0, t.height_m])) for s, (t, T) in PLACED.items()}
    u = {slot: frame.intrinsics.project(top)[0] for slot, top in tops.items()}
    edge = int(np.sort(list(u.values()))[3]) + 25
    part = cut(frame, 0, 0, edge, height)
    seen = ps.by_slot(ps.fit(part, VIEW, RACK, TUBES))
    for slot, at in u.items():
        if at < edge - 20:
            assert seen[slot].pose.status is TubeStatus.OK
            assert seen[slot].pose.T_rack_tube == pytest.approx(ps.by_slot(found)[slot].pose.T_rack_tube, abs=2e-3)
        elif at > edge + 20:
            assert slot not in seen


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (40, 40)])
def test_tiny_images_of_a_part_of_the_rack_do_not_fail(frame, size):
    height, width = size
    part = cut(frame, 330, 330, 330 + width, 330 + height)
    for entry in fit_profiles(part, part.intrinsics, VIEW, RACK, TUBES, ps.CONFIG):
        assert entry.pose.status in (TubeStatus.OK, TubeStatus.REJECTED)


def test_a_rack_that_is_not_in_the_image_has_no_tubes(frame):
    T_beside = VIEW.copy()
    T_beside[0, 3] += 3.0
    assert ps.fit(frame, T_beside, RACK, TUBES) == ()


# A floor that is not known


@pytest.mark.parametrize("off_mm", [-7.0, 0.0, 11.0])
def test_a_floor_that_is_not_known_is_found_from_the_tops(frame, found, off_mm):
    unsure = RACK.model_copy(update={"floor_mm": RACK.floor_mm + off_mm, "floor_tolerance_mm": 50.0})
    tubes, known = ps.by_slot(ps.fit(frame, VIEW, unsure, TUBES)), ps.by_slot(found)
    assert {slot: entry.tube for slot, entry in tubes.items()} == {slot: entry.tube for slot, entry in known.items()}
    for slot, (tube, _) in CLOSED.items():
        moved = tubes[slot].pose.T_rack_tube - known[slot].pose.T_rack_tube
        assert np.abs(moved[:3, 3]).max() < 0.6e-3, (slot, tube.name)


def test_a_floor_that_is_known_is_not_moved(frame):
    off = RACK.model_copy(update={"floor_mm": RACK.floor_mm + 7.0})
    assert all(entry.pose.status is TubeStatus.REJECTED for entry in ps.fit(frame, VIEW, off, TUBES))


def test_types_with_the_same_top_are_not_told_apart(frame):
    twin = HIGH.model_copy(update={"name": "twin"})
    tubes = ps.by_slot(ps.fit(frame, VIEW, RACK, (*TUBES, twin)))
    alike = {slot for slot, (tube, _) in PLACED.items() if tube is HIGH}
    assert {slot for slot, entry in tubes.items() if entry.pose.status is not TubeStatus.OK} == alike
    for slot in alike:
        assert tubes[slot].pose.reason_code == "type_not_told"
        assert "fit alike" in tubes[slot].pose.reason
