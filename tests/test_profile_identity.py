"""Types of closed tops: which one a height and a radius belong to, and when to none of those given."""

from dataclasses import replace

import numpy as np
import profile_scenes as ps
import pytest
import scenes

from tubepose.config import Config, ProfileConfig
from tubepose.labware import TubeModel, load_rack, load_tube
from tubepose.profile.closed_tops import filled_share, higher_share
from tubepose.profile.identity import Radii, measured_radii, name_tops
from tubepose.profile.measure import measure_tops
from tubepose.profile.tops import top_level_m, top_radius_m
from tubepose.tube import TubeStatus

CONFIG = ProfileConfig()
RACK = load_rack("chen2023-soft-5x10")
WIDE, NARROW, LOW = (load_tube(name) for name in ("blood-16x100", "blood-13x100", "chen2023-tube-2"))
OPEN = load_tube("white-tapered-112mm")
FIT_M = 8e-5


def tops(*rows):
    """Heights and radii of tops of types, off by so many millimetres: (type, up, wider)."""
    height = np.array([top_level_m(tube, RACK) + 1e-3 * up for tube, up, _ in rows])
    radius = np.array([top_radius_m(tube) + 1e-3 * wider for tube, _, wider in rows])
    return height, radius


def names(rows, tubes, spacing_mm=0.6, may=None):
    height, radius = tops(*rows)
    radii = Radii(radius, np.full(len(rows), FIT_M), 1e-3 * spacing_mm / np.sqrt(12))
    may = np.tile([not tube.is_open for tube in tubes], (len(rows), 1)) if may is None else may
    return name_tops(height, radii, may, RACK, tubes, CONFIG)


def believed(rows, tubes, **more):
    """Names of the types that are sure, None where none is."""
    found = names(rows, tubes, **more)
    sure = found.odds >= CONFIG.min_type_odds
    return [tubes[k].name if ok else None for k, ok in zip(found.tube, sure, strict=True)]


def test_two_types_of_one_height_are_told_apart_by_their_radius():
    rows = [(WIDE, 0.1, 0.05), (NARROW, -0.1, -0.05), (LOW, 0.0, 0.1)]
    assert believed(rows, [WIDE, NARROW, LOW]) == [WIDE.name, NARROW.name, LOW.name]
    assert believed(rows, [LOW, NARROW, WIDE]) == [WIDE.name, NARROW.name, LOW.name]


def test_a_type_that_is_not_given_is_none_of_the_others():
    # The other types of the frame tell where the sensor's points end: 0.75 mm are then far off.
    rows = [(NARROW, 0.0, 0.0), *[(WIDE, 0.0, 0.0)] * 3, *[(LOW, 0.0, 0.0)] * 3]
    found = names(rows, [WIDE, LOW])
    assert believed(rows, [WIDE, LOW]) == [None, *[WIDE.name] * 3, *[LOW.name] * 3]
    assert found.rival[0] == -1
    assert believed([(NARROW, 0.0, 0.0)] * 4, [WIDE], spacing_mm=0.3) == [None] * 4


@pytest.mark.parametrize("wider_mm", [-0.3, 0.3])
def test_an_end_that_all_tops_share_is_the_sensors(wider_mm):
    rows = [(tube, 0.0, wider_mm) for tube in (WIDE, LOW) for _ in range(3)]
    shared, alone = names(rows, [WIDE, LOW]), names([rows[0]], [WIDE, LOW])
    assert believed(rows, [WIDE, LOW]) == [tube.name for tube, *_ in rows]
    assert shared.odds[0] > alone.odds[0] + 0.5


def test_a_height_that_all_tubes_of_a_type_share_is_the_files():
    off = [(LOW, 1.1, 0.0)]
    lone, pooled = names(off, [LOW]), names(off * 5, [LOW])
    assert pooled.odds[0] > lone.odds[0] + 1
    # One tube that is off where the others are not is none of them.
    others = names(off + [(LOW, 0.0, 0.0)] * 5, [LOW])
    assert others.odds[0] < lone.odds[0]


def test_odds_by_hand():
    """A lone top exactly as defined: its density against 12 mm of radius, and 100 mm of height or the same height."""
    ends, seat = 0.6 / np.sqrt(12), CONFIG.cap_height_m * 1e3
    floor = RACK.floor_tolerance_mm
    each = 0.08**2 + (1e3 * CONFIG.top_radius_m) ** 2
    radius = 1 / np.sqrt(2 * np.pi * (0.1**2 + ends**2 + each))
    heights = [
        share / np.sqrt(2 * np.pi * (spread**2 + floor**2 + seat**2)) for spread, share in ((0.3, 0.9), (1.0, 0.1))
    ]
    expected = np.log(radius * sum(heights) / (0.98 / 100 + 0.02 * sum(heights)) * 12)
    assert names([(LOW, 0.0, 0.0)], [LOW]).odds[0] == pytest.approx(expected, abs=1e-6)


def test_two_types_with_one_top_are_not_told_apart():
    twin = LOW.model_copy(update={"name": "twin"})
    found = names([(LOW, 0.0, 0.0)], [LOW, twin])
    assert found.odds[0] == pytest.approx(0.0, abs=1e-9)
    assert {int(found.tube[0]), int(found.rival[0])} == {0, 1}


def test_a_closed_top_is_of_no_open_type_and_of_no_type_that_is_excluded():
    assert names([(OPEN, 0.0, 0.0)], [OPEN]).odds[0] == -np.inf
    found = names([(LOW, 0.0, 0.0)], [LOW, WIDE], may=np.array([[False, True]]))
    assert found.tube[0] == 1
    assert found.odds[0] < 0


def test_what_is_not_known_of_a_top_says_nothing():
    height, _ = tops((LOW, 0.0, 0.0))
    radii = measured_radii(np.array([np.nan]), np.eye(2)[None], np.array([np.nan]))
    may = np.ones((1, 1), bool)
    assert name_tops(np.array([np.nan]), radii, may, RACK, [LOW], CONFIG).odds[0] == pytest.approx(0.0)
    by_height = name_tops(height, radii, may, RACK, [LOW], CONFIG).odds[0]
    assert 0 < by_height < names([(LOW, 0.0, 0.0)], [LOW]).odds[0]
    assert name_tops(
        np.empty(0),
        measured_radii(*np.empty((1, 0)), np.empty((0, 2, 2)), np.empty(0)),
        np.ones((0, 1), bool),
        RACK,
        [LOW],
        CONFIG,
    ).odds.shape == (0,)


VIEW = scenes.camera_from_rack(RACK, yaw_rad=0.3, tilt_rad=0.1, distance_m=0.6)
PLACED = {
    slot: (tube, scenes.tube_pose(RACK, slot))
    for slot, tube in (("A1", WIDE), ("A5", WIDE), ("C3", LOW), ("C7", LOW), ("E2", NARROW), ("E9", NARROW))
}


@pytest.fixture(scope="module")
def frame():
    return ps.rendered(RACK, PLACED, VIEW)


def test_all_given_types_keep_their_tubes(frame):
    found = ps.by_slot(ps.fit(frame, VIEW, RACK, [WIDE, NARROW, LOW]))
    assert {slot: entry.tube.name for slot, entry in found.items()} == {s: t.name for s, (t, _) in PLACED.items()}
    assert {entry.pose.status for entry in found.values()} == {TubeStatus.OK}


@pytest.mark.parametrize("missing", [WIDE, NARROW], ids=lambda tube: tube.name)
def test_tubes_of_a_type_that_is_not_given_have_no_pose_and_a_reason(frame, missing):
    given = [tube for tube in (WIDE, NARROW, LOW) if tube is not missing]
    found = ps.by_slot(ps.fit(frame, VIEW, RACK, given))
    assert set(found) == set(PLACED)
    for slot, (tube, _) in PLACED.items():
        entry: ps.ProfileTube = found[slot]
        if tube is missing:
            assert (entry.tube, entry.pose.T_rack_tube, entry.pose.status) == (None, None, TubeStatus.REJECTED)
            assert entry.pose.reason.startswith("unknown type: its top is 10")
            assert len(entry.points_m) > 100
        else:
            assert (entry.tube, entry.pose.status) == (tube, TubeStatus.OK)


def test_a_cap_of_another_width_is_said_to_be_one(frame):
    data = LOW.model_dump()
    data["cap"]["diameter_mm"] += 2.0
    other = TubeModel.model_validate(data | {"name": "other"})
    found = ps.by_slot(ps.fit(frame, VIEW, RACK, [WIDE, NARROW, other]))
    for slot in ("C3", "C7"):
        assert found[slot].tube is None
        assert "100." in found[slot].pose.reason or "99." in found[slot].pose.reason
        assert "19.4 mm" in found[slot].pose.reason  # what it was compared with


@pytest.mark.parametrize("narrower_mm", [1.0, 2.2])
def test_a_width_is_measured_where_the_top_ends_however_far_its_type_is_off(frame, narrower_mm):
    cap = WIDE.cap.model_copy(update={"diameter_mm": WIDE.cap.diameter_mm - narrower_mm})
    wrong = WIDE.model_copy(update={"name": "narrower", "cap": cap})
    entry = ps.by_slot(ps.fit(frame, VIEW, RACK, [wrong]))["A1"]
    assert entry.pose.status is TubeStatus.REJECTED
    measured_mm = float(entry.pose.reason.split(" mm wide")[0].split()[-1])
    assert measured_mm == pytest.approx(WIDE.cap.diameter_mm, abs=0.6)


def test_a_top_is_the_highest_thing_over_its_slot(frame):
    tubes = [WIDE, NARROW, LOW]
    found = measure_tops(frame, frame.intrinsics, VIEW, RACK, tubes, Config())
    assert np.all(higher_share(found, tubes, RACK) < 0.02)
    lower = replace(found, level_m=found.level_m - 4e-3)
    assert np.all(higher_share(lower, tubes, RACK) > 0.9)


def test_a_height_alone_does_not_tell_a_type():
    """Another type of a standard length is as high: what was not measured across is not sure."""
    radii = Radii(np.array([np.nan]), np.array([FIT_M]), 1e-4)
    found = name_tops(np.array([top_level_m(WIDE, RACK)]), radii, np.array([[True]]), RACK, [WIDE], CONFIG)
    assert 0 < found.odds[0] < CONFIG.min_type_odds


def test_an_open_rim_has_nothing_in_its_mouth(frame):
    """A closed cap that is taken for an open tube's rim of its height is told by what fills it."""
    level_mm = WIDE.height_mm - OPEN.height_mm
    rim = OPEN.model_copy(update={"name": "rim", "body": OPEN.body.model_copy(
        update={"height_mm": OPEN.body.height_mm + level_mm, "top_diameter_mm": WIDE.cap.diameter_mm}
    )})  # fmt: skip
    tubes = [WIDE, NARROW, LOW]
    found = measure_tops(frame, frame.intrinsics, VIEW, RACK, tubes, Config())
    assert np.isnan(filled_share(found, tubes, RACK)).all()
    taken = replace(found, tops=replace(found.tops, tube=np.zeros_like(found.tops.tube)))
    assert np.all(filled_share(taken, [rim], RACK) > 0.9)
