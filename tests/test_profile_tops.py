"""Where tubes stand and of which type: discs and rings over slots, and the points that belong to each."""

import numpy as np
import pytest

from tubepose.config import ProfileConfig
from tubepose.labware import load_rack, load_tube
from tubepose.profile.closed_tops import NEAR_TOP_M, label_points
from tubepose.profile.standing import Standing
from tubepose.profile.tops import (
    _scores_in,
    _top_score,
    _windows,
    find_tops,
    mouth_radius_m,
    top_depth_m,
    top_level_m,
    top_radius_m,
    top_reach_m,
)

CONFIG = ProfileConfig()
RACK = load_rack("chen2023-soft-5x10")
TUBES = tuple(load_tube(f"chen2023-tube-{i}") for i in (1, 2, 3))
OPEN, LOW, HIGH = TUBES
CAMERA_M = np.array([0.02, -0.03, 0.75])
NAMES = [slot.name for slot in RACK.all_slots]


def top(tube, slot, off_m=(0.0, 0.0), up_m=0.0, spacing_m=0.4e-3, seed=0):
    """Points on the top of an upright tube, shape (N, 3)."""
    rng = np.random.default_rng(seed)
    axis = np.arange(-12e-3, 12e-3, spacing_m)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + rng.uniform(-0.1e-3, 0.1e-3, (len(axis) ** 2, 2))
    rho = np.hypot(*xy.T)
    xy = xy[(rho < top_radius_m(tube)) & (rho > mouth_radius_m(tube))]
    return np.column_stack([xy + RACK.slot(slot).center_m + off_m, np.full(len(xy), top_level_m(tube, RACK) + up_m)])


def find(*points, tubes=TUBES, allowed=None):
    return find_tops(Standing(np.vstack(points), CAMERA_M), RACK, tubes, CONFIG, allowed)


def named(found, tubes=TUBES):
    """Slots and types; rims with little support are left to the image, and not here."""
    found = found.take(found.support > CONFIG.min_support)
    return {NAMES[slot]: tubes[k].name for slot, k in zip(found.slot, found.tube, strict=True)}


def test_the_measures_of_tops_by_hand():
    assert top_radius_m(LOW) == pytest.approx(17.45e-3 / 2)
    assert mouth_radius_m(LOW) == 0.0
    assert top_radius_m(OPEN) == pytest.approx(18.05e-3 / 2)
    assert mouth_radius_m(OPEN) == pytest.approx(17.5e-3 / 2 - 1e-3)
    assert top_level_m(HIGH, RACK) == pytest.approx(RACK.floor_m + 0.1055)
    bare = OPEN.model_copy(update={"cap": None})
    assert top_radius_m(bare) == pytest.approx(17.5e-3 / 2)


def test_points_below_a_rim_can_be_of_it_and_those_below_a_cap_cannot():
    assert top_depth_m(LOW, CONFIG) == CONFIG.top_band_m
    assert top_depth_m(OPEN, CONFIG) == CONFIG.rim_depth_m > CONFIG.top_band_m


@pytest.mark.parametrize("off_mm", [(0.0, 0.0), (1.2, -0.8), (-1.5, 1.0)])
def test_three_types_in_three_slots(off_mm):
    off = np.array(off_mm) * 1e-3
    placed = {"A1": OPEN, "C5": LOW, "E10": HIGH}
    found = find(*(top(tube, slot, off) for slot, tube in placed.items()))
    assert named(found) == {slot: tube.name for slot, tube in placed.items()}
    found = found.take(found.support > CONFIG.min_support)
    for slot, center, support in zip(found.slot, found.center_m, found.support, strict=True):
        assert center == pytest.approx(RACK.slot(NAMES[slot]).center_m + off, abs=0.6e-3)
        assert support > 0.7
    assert np.all(found.support > found.runner_up)


def test_a_full_row_of_wide_caps_is_told_apart():
    row = [name for name in NAMES if name.startswith("C")]
    found = find(*(top(HIGH, slot, seed=i) for i, slot in enumerate(row)))
    assert named(found) == dict.fromkeys(row, HIGH.name)


def test_types_of_nearly_the_same_top_are_told_by_height():
    taller = LOW.model_copy(
        update={"name": "taller", "body": LOW.body.model_copy(update={"height_mm": LOW.body.height_mm + 1.5})}
    )
    for true in (LOW, taller):
        found = find(top(true, "C5"), tubes=(LOW, taller))
        assert named(found, (LOW, taller)) == {"C5": true.name}


def test_what_is_not_allowed_is_not_found():
    allowed = np.ones((3, len(NAMES)), bool)
    allowed[1, NAMES.index("C5")] = False
    assert named(find(top(LOW, "C5"), top(LOW, "E10"), allowed=allowed)) == {"E10": LOW.name}


def test_a_cap_of_a_leaning_tube_is_found_as_far_as_the_slot_lets_it_and_no_farther():
    reach = top_reach_m(RACK.slot("C5"), LOW, RACK)
    assert 2e-3 < reach < 8e-3
    near = find(top(LOW, "C5", (0.7 * reach, 0.0)))
    assert named(near) == {"C5": LOW.name}
    assert near.support.max() > 0.7
    # Part of a disc beside it can be in reach, but not its middle.
    beside = find(top(LOW, "A1", (-reach - CONFIG.reach_m - 3e-3, 0.0)))
    assert beside.support.max() < 0.65
    assert np.hypot(*(beside.center_m - RACK.slot("A1").center_m).T).max() < np.sqrt(2) * (
        reach + CONFIG.reach_m + 1e-3
    )
    assert named(find(top(LOW, "A1", (-reach - CONFIG.reach_m - 9e-3, 0.0)))) == {}


def test_a_disc_is_no_ring_and_a_ring_no_disc():
    as_open = np.column_stack([top(LOW, "C5")[:, :2], np.full(len(top(LOW, "C5")), top_level_m(OPEN, RACK))])
    ring = find(as_open, tubes=(OPEN,))
    assert len(ring.support) == 0
    hollow = top(OPEN, "C5")
    hollow[:, 2] = top_level_m(HIGH, RACK)
    disc = find(hollow, tubes=(HIGH,))
    assert disc.support.max(initial=0) < 0.55


@pytest.mark.parametrize("up_mm", [0.7, 1.2])
def test_a_cap_that_stands_too_high_is_not_taken_for_a_higher_rim(up_mm):
    # The rim is 2.25 mm above it, and light comes out of rims from that far below.
    found = find(top(HIGH, "C5", up_m=up_mm * 1e-3), tubes=(OPEN, HIGH))
    assert OPEN.name not in named(found, (OPEN, HIGH)).values()


@pytest.mark.parametrize("up_mm", [-1.4, 1.4])
def test_a_disc_at_a_height_of_no_type_is_nothing(up_mm):
    assert len(find(top(LOW, "C5", up_m=up_mm * 1e-3), tubes=(LOW,)).slot) == 0


def test_no_points_and_stray_points_give_no_tops():
    rng = np.random.default_rng(0)
    stray = rng.uniform([-0.09, -0.045, RACK.height_m], [0.09, 0.045, 0.13], (3000, 3))
    assert len(find(np.empty((0, 3))).slot) == 0
    assert named(find(stray)) == {}


def test_entries_are_taken_together():
    found = find(top(LOW, "C5"), top(HIGH, "E10"))
    one = found.take(np.array([False, True]))
    assert named(one) == {"E10": HIGH.name}
    assert len(one.center_m) == len(one.support) == len(one.runner_up) == 1


# Points


def test_points_belong_to_the_nearest_top_from_above():
    centers, radii = np.array([[0.0, 0.0], [0.02, 0.0]]), np.array([8e-3, 9e-3])
    rng = np.random.default_rng(0)
    xy = rng.uniform(-0.03, 0.05, (20_000, 2))
    points = np.column_stack([xy, rng.uniform(0.0, 0.1, len(xy))])
    label = label_points(Standing(points, CAMERA_M), centers, radii)
    distance = np.linalg.norm(xy[:, None] - centers[None], axis=2)
    nearest = distance.argmin(axis=1)
    expected = np.where(distance.min(axis=1) < radii[nearest] + NEAR_TOP_M, nearest, -1)
    cell = 0.4e-3  # half a cell's diagonal
    doubtful = np.abs(distance.min(axis=1) - radii[nearest] - NEAR_TOP_M) < cell
    doubtful |= np.abs(distance[:, 0] - distance[:, 1]) < 2 * cell
    doubtful |= (np.abs(distance - radii - NEAR_TOP_M) < cell).any(axis=1)
    assert doubtful.mean() < 0.1
    assert np.array_equal(label[~doubtful], expected[~doubtful])


def test_without_tops_no_point_has_a_label():
    points = Standing(np.zeros((4, 3)), CAMERA_M)
    assert label_points(points, np.empty((0, 2)), np.empty(0)).tolist() == [-1] * 4
    assert label_points(Standing(np.empty((0, 3)), CAMERA_M), np.zeros((1, 2)), np.ones(1) * 0.01).shape == (0,)


@pytest.mark.parametrize("tube", TUBES, ids=lambda tube: tube.name)
@pytest.mark.parametrize("wanted", [[0], [7, 24, 49], range(50)], ids=["a corner", "three", "all"])
def test_a_picture_has_the_same_scores_where_few_slots_want_them(tube, wanted):
    rng = np.random.default_rng(1)
    windows = _windows(RACK, tube, CONFIG.reach_m)
    shape = tuple(windows[1].max(axis=0) + 3)
    filled = (rng.random(shape) < 0.7).astype(np.float32)
    off_m = np.where(filled > 0, rng.normal(0, 3e-4, shape), 0).astype(np.float32)
    chosen = np.isin(np.arange(len(NAMES)), wanted)
    found = _scores_in(windows, chosen, filled, off_m, tube, CONFIG)
    whole = _top_score(filled, off_m, tube, CONFIG)
    for low, high in zip(windows[0][chosen], windows[1][chosen], strict=True):
        own = tuple(slice(max(a, 0), b) for a, b in zip(low, high, strict=True))
        np.testing.assert_allclose(found[own], whole[own], atol=1e-5)
