"""What is on a rack besides the tubes that are looked for, and what is nothing."""

import numpy as np
import pytest

from tubepose.labware import load_rack, load_tube
from tubepose.profile.leftovers import find_leftovers
from tubepose.profile.standing import Standing

RACK = load_rack("chen2023-soft-5x10")
TUBES = [load_tube("chen2023-tube-2"), load_tube("chen2023-tube-3")]
SLOT = RACK.slot("C5")
AT = [slot.name for slot in RACK.all_slots].index("C5")


def disc(center_m, radius_m, z_m, spacing_m=0.4e-3):
    axis = np.arange(-radius_m, radius_m, spacing_m)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    xy = xy[np.hypot(*xy.T) < radius_m]
    return np.column_stack([xy + center_m, np.full(len(xy), z_m)])


def bar(length_m, width_m, z_m, center_m=(0.0, 0.0), turn_rad=0.0, spacing_m=0.4e-3):
    x, y = np.meshgrid(
        np.arange(-length_m / 2, length_m / 2, spacing_m), np.arange(-width_m / 2, width_m / 2, spacing_m)
    )
    xy = np.column_stack([x.ravel(), y.ravel()])
    R = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    return np.column_stack([xy @ R.T + center_m, np.full(len(xy), z_m)])


def find(points, label=-1, taken=(), tubes=TUBES):
    points = np.asarray(points)
    return find_leftovers(
        Standing(points, np.array([0.0, 0.0, 0.7])), np.full(len(points), label), list(taken), RACK, tubes
    )


@pytest.mark.parametrize("turn_rad", [0.0, 0.6, np.pi / 2])
def test_a_tube_that_lies_across_the_rack(turn_rad):
    points = bar(0.08, 0.015, 0.07, turn_rad=turn_rad)
    (found,) = find(points)
    assert found.slot is None
    assert found.code == "lies_across"
    length, width = (float(word) for word in found.reason.split(": ")[1].split(" mm")[0].split(" x "))
    assert length == pytest.approx(80, abs=2)
    assert width == pytest.approx(15, abs=2)
    assert len(found.rows) > 0.97 * len(points)


def test_a_top_of_a_height_that_no_type_has():
    points = disc(SLOT.center_m + np.array([1e-3, 0]), 7e-3, RACK.floor_m + 0.0852)
    (found,) = find(points)
    assert found.slot == AT
    assert found.code == "unknown_type"
    assert "85.2 mm high, expected (mm): chen2023-tube-2 100, chen2023-tube-3 105.5;" in found.reason


def test_a_type_is_not_called_unknown_at_its_own_height():
    (found,) = find(disc(SLOT.center_m, 7e-3, RACK.floor_m + 0.1003))
    assert found.code == "part_of_top"
    assert found.reason.startswith("100.3 mm high as chen2023-tube-2 is")


def test_a_second_top_in_a_slot_that_is_taken():
    points = disc(SLOT.center_m, 8e-3, RACK.floor_m + 0.11)
    (found,) = find(points, taken=[AT])
    assert found.slot == AT
    assert found.code == "second_top"
    assert "slot C5, 110.0 mm high" in found.reason


def test_points_of_tubes_are_not_looked_at():
    assert find(disc(SLOT.center_m, 8e-3, 0.1), label=0) == ()


def test_nothing_stands_on_an_empty_rack():
    assert find(np.empty((0, 3))) == ()


@pytest.mark.parametrize("width_mm", [1.0, 2.0, 3.0])
def test_thin_ghosts_are_nothing(width_mm):
    ghosts = [bar(0.08, width_mm * 1e-3, 0.09)]
    ring = disc(SLOT.center_m, 9e-3, 0.1)
    inner = 9e-3 - width_mm * 1e-3
    ghosts.append(ring[np.hypot(*(ring[:, :2] - SLOT.center_m).T) > inner])
    assert find(np.vstack(ghosts[:1])) == ()
    assert find(ghosts[1]) == ()


def test_single_points_are_nothing():
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.09, -0.04, 0.07], [0.09, 0.04, 0.11], (1500, 3))
    assert find(points) == ()


def test_slivers_beside_a_taken_slot_are_nothing():
    assert find(disc(SLOT.center_m, 4.5e-3, 0.1), taken=[AT]) == ()
    assert find(disc(SLOT.center_m, 3e-3, 0.1)) == ()


def test_what_stands_between_slots_is_in_neither():
    between = (RACK.slot("C5").center_m + RACK.slot("D6").center_m) / 2
    assert find(disc(between, 5e-3, 0.1)) == ()


def test_two_groups_are_two_entries_with_their_own_rows():
    one, other = disc(SLOT.center_m, 7e-3, 0.08), disc(RACK.slot("A1").center_m, 7e-3, 0.09)
    found = find(np.vstack([one, other]))
    assert {entry.slot for entry in found} == {AT, 0}
    first = next(entry for entry in found if entry.slot == AT)
    assert set(first.rows) <= set(range(len(one)))
    assert len(first.rows) > 0.9 * len(one)
