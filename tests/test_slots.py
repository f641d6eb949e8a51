"""Which slot holds which tube: shares, conflicts, crop, and the kind of tube."""

import numpy as np
import pytest
import scenes

from tubepose.config import SlotConfig
from tubepose.labware import load_rack, load_tube
from tubepose.slots import (
    assign_slots,
    crop_to_slot,
    identify_tube,
    lean_reach_m,
    points_above,
    slot_shares,
)

RACK = load_rack("chen2023-soft-5x10")
ROUND = load_rack("round-10ml-3x4")
CONFIG = SlotConfig()
NAMES = [slot.name for slot in RACK.all_slots]
OPENING_MM2 = 16.5**2 - (4 - np.pi) * 2.0**2  # rounded corners of 2 mm
TUBE_1, TUBE_2, TUBE_3 = (load_tube(f"chen2023-tube-{i}") for i in (1, 2, 3))


def disc(center_mm, radius_mm, count=360, z_mm=100.0):
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    xy = np.array(center_mm) + radius_mm * np.column_stack([np.cos(turn), np.sin(turn)])
    return np.column_stack([xy, np.full(count, z_mm)]) * 1e-3


def center_mm(name, rack=RACK, off=(0.0, 0.0)):
    return np.array(rack.slot(name).center_mm) + np.array(off)


@pytest.mark.parametrize(
    ("offset_mm", "radius_mm", "share"),
    [
        ((0, 0), 5.0, 1.0),
        ((8.25, 0), 1.8, 0.5),  # on the opening's straight edge, short of the next one
        ((0, 0), 30.0, OPENING_MM2 / (np.pi * 30**2)),  # covers it and its neighbours
    ],
    ids=["inside", "on-an-edge", "around"],
)
def test_share_of_a_disc_over_a_square_slot(offset_mm, radius_mm, share):
    shares = slot_shares(disc(center_mm("C5", off=offset_mm), radius_mm), RACK)
    assert shares[NAMES.index("C5")] == pytest.approx(share, rel=2e-3)
    if radius_mm < 10:
        assert np.count_nonzero(shares) == 1


def test_a_wide_disc_covers_all_openings_under_it_alike():
    shares = slot_shares(disc(center_mm("C5"), 30.0), RACK)
    for name in ("B5", "D5", "C4", "C6"):
        assert shares[NAMES.index(name)] == pytest.approx(OPENING_MM2 / (np.pi * 900), rel=2e-3)
    assert shares[NAMES.index("C8")] == 0


def test_share_of_a_disc_over_a_round_slot():
    names = [slot.name for slot in ROUND.all_slots]
    shares = slot_shares(disc(center_mm("B2", ROUND), 14.0), ROUND)
    assert shares[names.index("B2")] == pytest.approx((10.5 / 14.0) ** 2, rel=5e-3)


def test_points_inside_the_hull_and_their_height_change_no_share():
    outline = disc(center_mm("B2", off=(6, 3)), 7.0)
    filled = np.vstack([disc(center_mm("B2", off=(6, 3)), 3.0, z_mm=70.0), outline + np.array([0, 0, 0.02])])
    assert np.allclose(slot_shares(filled, RACK), slot_shares(outline, RACK), atol=1e-9)


@pytest.mark.parametrize(
    "points",
    [np.empty((0, 3)), np.zeros((2, 3)), np.zeros((9, 3)), np.linspace([0, 0, 0], [0.05, 0.02, 0], 9)],
    ids=["none", "two", "one-place", "a-line"],
)
def test_points_without_an_area_have_no_share(points):
    assert not slot_shares(points, RACK).any()


def test_only_points_well_above_the_top_count():
    z = RACK.height_m + np.array([-0.01, 0.0, 0.0039, 0.0041, 0.05])
    kept = points_above(np.column_stack([np.zeros((5, 2)), z]), RACK, CONFIG)
    assert np.allclose(kept[:, 2], z[3:])


def test_every_tube_gets_its_own_slot_and_the_others_stay_empty():
    held = ["A1", "C5", "C6", "E10"]
    tubes = [scenes.tube_surface(TUBE_3, scenes.tube_pose(RACK, name), 0.0, seed=i) for i, name in enumerate(held)]
    assigned = assign_slots(tubes, RACK, CONFIG)
    assert [entry.slot for entry in assigned] == held
    assert [entry.detection for entry in assigned] == [0, 1, 2, 3]
    assert all(entry.why is None and entry.hull_share > 0.8 for entry in assigned)
    assert all(np.all(entry.points_m[:, 2] > RACK.height_m + CONFIG.clearance_m) for entry in assigned)


def test_no_tubes_no_slots():
    assert assign_slots([], RACK, CONFIG) == ()


def test_two_tubes_on_one_slot_the_larger_share_keeps_it():
    shifted, centred = disc(center_mm("B3", off=(1.5, 0)), 8.0), disc(center_mm("B3"), 8.0)
    loser, winner = assign_slots([shifted, centred], RACK, CONFIG)
    assert (winner.slot, winner.why) == ("B3", None)
    assert loser.slot is None
    assert (loser.why.code, loser.why.detail) == ("slot_taken", "B3")
    assert 0.5 < loser.hull_share < winner.hull_share


def test_the_one_that_must_go_takes_its_next_best_free_slot():
    centred, between = disc(center_mm("B3"), 8.0), disc(center_mm("B3", off=(8.0, 0)), 8.0)
    winner, other = assign_slots([centred, between], RACK, CONFIG)
    assert winner.slot == "B3"
    assert (other.slot, other.why) == ("B4", None)
    assert other.hull_share == pytest.approx(slot_shares(between, RACK)[NAMES.index("B4")])


def test_the_slots_do_not_depend_on_the_order_of_the_tubes():
    tubes = [disc(center_mm("B3", off=(k, 0)), 8.0) for k in (0, 1.5, 8.0)]
    forth = [entry.slot for entry in assign_slots(tubes, RACK, CONFIG)]
    back = [entry.slot for entry in assign_slots(tubes[::-1], RACK, CONFIG)]
    assert forth == back[::-1] == ["B3", None, "B4"]


def test_a_tube_that_lies_across_the_rack_has_no_slot():
    lying = np.random.default_rng(0).uniform([-50, -8, 60], [50, 8, 70], (500, 3)) * 1e-3
    (entry,) = assign_slots([lying], RACK, CONFIG)
    assert entry.slot is None
    assert entry.why.code == "in_no_slot"
    assert entry.why.value == pytest.approx(100 * entry.hull_share)
    assert 0 < entry.hull_share < CONFIG.min_share


def test_a_box_without_points_above_the_top_says_so():
    (entry,) = assign_slots([scenes.rack_top(RACK)], RACK, CONFIG)
    assert (entry.slot, entry.why.code, len(entry.points_m)) == (None, "no_points_above", 0)


def test_reach_of_the_axis_by_hand():
    # Tube 2: body 6.525 in a half opening of 8.25 leaves 1.725 to each side; over the diagonal sqrt(2) times that.
    slot = RACK.slot("A1")
    at_floor, at_top = lean_reach_m(np.array([RACK.floor_m, RACK.height_m]), slot, TUBE_2, RACK)
    assert at_floor == pytest.approx(1.0e-3)  # the rack's floor play
    assert at_top == pytest.approx((1.0 + 1.725 * np.sqrt(2) + 1.0) * 1e-3)


def test_crop_keeps_the_tube_at_its_largest_lean_and_drops_the_neighbour():
    slot = RACK.slot("C5")
    lean = np.arctan(1.7e-3 / RACK.depth_m)
    own = scenes.tube_surface(TUBE_2, scenes.tube_pose(RACK, "C5", lean, lean), RACK.height_m)
    neighbour = scenes.tube_surface(TUBE_2, scenes.tube_pose(RACK, "C7"), RACK.height_m)
    high = np.array([[*slot.center_m, RACK.floor_m + TUBE_2.height_m + 0.02]])
    kept = crop_to_slot(np.vstack([own, neighbour, high]), slot, TUBE_2, RACK, CONFIG)
    assert len(kept) == len(own)
    assert np.array_equal(kept, own)


@pytest.mark.parametrize("tube", [TUBE_1, TUBE_2, TUBE_3], ids=lambda tube: tube.name)
def test_the_height_tells_the_kind(tube):
    above = np.array([0.0, 0.2, np.sqrt(0.96)])
    points = scenes.tube_surface(tube, scenes.tube_pose(RACK, "B2"), RACK.height_m, seen_from=above)
    assert identify_tube("tube", points, (TUBE_3, TUBE_2, TUBE_1), RACK, CONFIG) == (tube, None)


def test_a_class_name_outweighs_the_height():
    points = scenes.tube_surface(TUBE_3, scenes.tube_pose(RACK, "B2"), RACK.height_m)
    candidates = (TUBE_1, TUBE_2, TUBE_3)
    assert identify_tube("purple-cap", points, candidates, RACK, CONFIG) == (TUBE_2, None)
    assert identify_tube(TUBE_1.name, points, candidates, RACK, CONFIG) == (TUBE_1, None)


def test_an_unknown_class_names_the_known_ones():
    tube, why = identify_tube("vial", np.zeros((30, 3)), (TUBE_2, TUBE_3), RACK, CONFIG)
    assert tube is None
    assert why.code == "unknown_class"
    assert "'vial' belongs to none" in why.detail
    assert "chen2023-tube-2, chen2023-tube-3, purple-cap, tube-2, tube-3, white-cap" in why.detail


def test_an_unknown_height_is_told_with_the_expected_ones():
    points = disc(center_mm("A1"), 8.0, z_mm=RACK.floor_mm + 90.0)
    tube, why = identify_tube("tube", points, (TUBE_2, TUBE_3), RACK, CONFIG)
    assert tube is None
    assert why.code == "unknown_type"
    assert why.detail.endswith("90.0 mm high, expected (mm): chen2023-tube-2 100, chen2023-tube-3 105.5")


def test_an_open_rim_may_seem_lower_than_it_is_and_a_cap_may_not():
    def seen(tube, off_mm):
        points = disc(center_mm("A1"), 8.0, z_mm=RACK.floor_mm + tube.height_mm + off_mm)
        return identify_tube("tube", points, (tube,), RACK, CONFIG)[0]

    assert seen(TUBE_1, -3.2) == TUBE_1
    assert seen(TUBE_2, -3.2) is None
    assert seen(TUBE_1, 3.2) is None


def test_heights_that_are_alike_are_not_guessed():
    points = disc(center_mm("A1"), 8.0, z_mm=RACK.floor_mm + 106.5)  # 1.0 from one, 1.25 from the other
    tube, why = identify_tube("tube", points, (TUBE_1, TUBE_2, TUBE_3), RACK, CONFIG)
    assert tube is None
    assert (why.code, why.detail) == ("types_alike", "chen2023-tube-3 and chen2023-tube-1")
    assert why.value == pytest.approx(106.5)
