"""What `wrong_labware` calls wrong, on answers whose faults are known; and the wrong files that it asks with."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scenes import tube_pose

from benchmarks import wrong_labware
from benchmarks.wrong_labware_cases import KINDS, cases, changed, is_same_rack, listed
from benchmarks.wrong_labware_judging import Answer, StatedTube, TrueTube, Truth, Verdict, judge, slots_under
from benchmarks.wrong_labware_scenes import View, racks, types_for
from tubepose.capture.frame import RgbdFrame
from tubepose.labware import load_rack, load_tube
from tubepose.simulation.camera import default_camera
from tubepose.transforms import HALF_TURN, axis_rotation, make_transform

RACK = load_rack("chen2023-soft-5x10")
LONE = load_rack("mixed-6x15ml-4x50ml")
CAPPED, OPEN = load_tube("chen2023-tube-3"), load_tube("chen2023-tube-1")
FACING = make_transform(np.diag([1.0, -1.0, -1.0]), np.array([0.01, 0.02, 0.7]))
HELD = {"A1": CAPPED, "C5": OPEN}


def truth(rack=RACK, held=HELD):
    placed = tuple(TrueTube(slot, model, FACING @ tube_pose(rack, slot)) for slot, model in held.items())
    return Truth(rack, FACING, placed)


def stated(slot, model, T_rack_tube, T_camera_rack=FACING, name=None):
    return StatedTube(slot, name or model.name, model, T_camera_rack @ T_rack_tube)


def answer(T_camera_rack=FACING, ambiguous=False, rack=RACK, tubes=None, slots=None):
    if tubes is None:
        tubes = [stated(slot, model, tube_pose(RACK, slot)) for slot, model in HELD.items()]
    states = {slot.name: "occupied" if slot.name in HELD else "empty" for slot in rack.all_slots}
    return Answer(rack, T_camera_rack, ambiguous, "", tuple(tubes), states | (slots or {}))


def moved(x_m=0.0, z_m=0.0, lean_rad=0.0):
    """A small motion of a tube in its own frame."""
    return make_transform(axis_rotation(np.array([np.sin(lean_rad), 0.0, np.cos(lean_rad)])), np.array([x_m, 0, z_m]))


def one_off(slot, motion):
    tubes = [stated(s, m, tube_pose(RACK, s) @ (motion if s == slot else np.eye(4))) for s, m in HELD.items()]
    return judge(truth(), answer(tubes=tubes), same_rack=True)


def test_a_right_answer_has_no_fault():
    assert judge(truth(), answer(), same_rack=True) == Verdict(racks=1, tubes=2, kept=2)


def test_a_refused_rack_states_nothing():
    assert judge(truth(), Answer(RACK, None, False, "why"), same_rack=False) == Verdict()


@pytest.mark.parametrize(("x_mm", "turn_deg", "wrong"), [(1.9, 0, 0), (2.1, 0, 1), (0, 1.9, 0), (0, 2.1, 1)])
def test_a_rack_is_wrong_more_than_2_mm_or_2_deg_off_at_its_face(x_mm, turn_deg, wrong):
    face = np.array([0.0, 0.0, RACK.height_m])
    R = axis_rotation(np.array([np.sin(np.deg2rad(turn_deg)), 0.0, np.cos(np.deg2rad(turn_deg))]))
    about_face = make_transform(R, face - R @ face + np.array([x_mm * 1e-3, 0, 0]))
    found = judge(truth(), answer(FACING @ about_face, tubes=[]), same_rack=True)
    assert (found.wrong_racks, found.wrong) == (wrong, wrong)


def test_another_rack_is_wrong_wherever_it_is_put():
    assert judge(truth(), answer(), same_rack=False).wrong_racks == 1
    assert judge(Truth(None, FACING, ()), answer(tubes=[], slots=dict.fromkeys(HELD, "empty")), True).wrong_racks == 1


def test_a_half_turn_is_right_only_where_it_is_marked():
    """The slots of a turned rack have their counterparts' names: A1 is E10, C5 is C6."""
    T, names = FACING @ HALF_TURN, {"A1": "E10", "C5": "C6"}
    tubes = [stated(names[slot], model, tube_pose(RACK, slot)) for slot, model in HELD.items()]
    slots = dict.fromkeys(HELD, "empty") | dict.fromkeys(names.values(), "occupied")
    marked = judge(truth(), answer(T, True, tubes=tubes, slots=slots), same_rack=True)
    assert marked == Verdict(racks=1, ambiguous=1, tubes=2, kept=2)
    bare = judge(truth(), answer(T, False, tubes=tubes, slots=slots), same_rack=True)
    assert (bare.wrong_racks, bare.wrong_slot, bare.false_empty, bare.false_occupied) == (1, 2, 2, 2)


def test_a_mark_is_needless_on_a_rack_that_looks_the_same_under_no_turn():
    assert slots_under(LONE, HALF_TURN) is None
    assert slots_under(RACK, HALF_TURN)["A1"] == "E10"
    held = {"A1": load_tube("centrifuge-15ml-conical")}
    for ambiguous in (False, True):
        said = answer(FACING, ambiguous, LONE, [], {"A1": "occupied"})
        found = judge(truth(LONE, held), dataclasses.replace(said, slots={"A1": "occupied"}), same_rack=True)
        assert (found.needless, found.wrong) == (int(ambiguous), 0)


@pytest.mark.parametrize(
    ("motion", "faults"),
    [
        (moved(x_m=1.9e-3), {}),
        (moved(x_m=2.1e-3), {"lateral": 1}),
        (moved(lean_rad=np.deg2rad(1.9)), {}),
        (moved(lean_rad=np.deg2rad(2.1)), {"tilt": 1}),
        (moved(z_m=1.9e-3), {}),
        (moved(z_m=-2.1e-3), {"axial": 1}),
    ],
)
def test_a_capped_tube_is_wrong_across_and_along_its_axis(motion, faults):
    expected = Verdict(racks=1, tubes=2, kept=2 - len(faults), wrong_tubes=len(faults), **faults)
    assert one_off("A1", motion) == expected


def test_an_open_tube_that_is_off_along_its_axis_is_counted_apart():
    assert one_off("C5", moved(z_m=38e-3)) == Verdict(racks=1, tubes=2, kept=2, axial_unseen=1)


def test_a_tube_of_another_type_or_name_or_where_none_is():
    A1 = tube_pose(RACK, "A1")
    other_type = judge(truth(), answer(tubes=[stated("A1", OPEN, A1)]), same_rack=True)
    assert (other_type.wrong_type, other_type.wrong_tubes, other_type.kept) == (1, 1, 0)
    other_name = judge(truth(), answer(tubes=[stated("A2", CAPPED, A1)]), same_rack=True)
    assert (other_name.wrong_slot, other_name.wrong_type, other_name.wrong_tubes) == (1, 0, 1)
    nothing = judge(truth(), answer(tubes=[stated("E10", CAPPED, tube_pose(RACK, "E10"))]), same_rack=True)
    assert (nothing.wrong_type, nothing.lateral, nothing.wrong_tubes) == (1, 0, 1)


def test_slots_are_wrong_only_where_something_is_stated():
    slots = {"A1": "empty", "C5": "not_seen", "B1": "occupied", "B2": "unclear"}
    found = judge(truth(), answer(tubes=[], slots=slots), same_rack=True)
    assert found == Verdict(racks=1, not_stated=2, false_empty=1, false_occupied=1)
    assert found.wrong == 2


def test_states_come_from_old_and_new_tables():
    assert wrong_labware.stated({"occupied": True}) == "occupied"
    assert wrong_labware.stated({"occupied": False}) == "empty"
    assert wrong_labware.stated({"state": "not_seen", "occupied": False}) == "not_seen"


def test_the_table_adds_up():
    zero = dict.fromkeys(wrong_labware.COUNTS, 0)
    right = zero | {"frame": "a", "kind": "right", "racks": 1, "tubes": 3, "kept": 2, "n_tubes_true": 4, "wrong": 0}
    bad = zero | {"frame": "a", "kind": "pitch", "racks": 1, "wrong_racks": 1, "n_tubes_true": 4, "wrong": 3}
    words = wrong_labware.table([right, bad | {"false_empty": 2}])
    assert "| all | 2 | 1 | 2 | 1 | 3 | 0 | 0 | 0 | 0 | 0 | 0 | 0 | 2 | 0 | 0 |" in words
    assert "3 statements, in 1 of 2 questions" in words
    assert "1 of 1 racks accepted; 2 of 4 tubes kept" in words


@pytest.fixture(scope="module")
def view():
    """A level table seen from above, without a rack: what is asked does not depend on it."""
    k = default_camera(64).intrinsics
    frame = RgbdFrame(k.backproject(np.full((64, 64), 0.7)), np.zeros((64, 64), np.uint8), k, None, "")
    return View("v", frame, truth(), (CAPPED, OPEN))


def test_only_the_right_case_is_right(view):
    asked = cases(view, tuple(KINDS), 0, 0)
    as_it_is = [c.name for c in asked if c.rack == RACK and c.tubes == view.types and c.frame is view.frame]
    assert as_it_is == ["right"]
    assert {case.kind for case in asked} == set(wrong_labware.KINDS_ORDER)
    assert len({(case.kind, case.name) for case in asked}) == len(asked)


def test_wrong_files_are_wrong_by_what_their_names_say(view):
    asked = {case.name: case for case in cases(view, tuple(KINDS), 0, 0)}
    assert asked["pitch x +2 %"].rack.slot("A10").center_mm[0] == pytest.approx(1.02 * RACK.slot("A10").center_mm[0])
    assert asked["pitch x +2 %"].rack.slot("A10").center_mm[1] == RACK.slot("A10").center_mm[1]
    assert asked["openings -1 mm"].rack.slot("B2").size_mm == (15.5, 15.5)
    assert asked["floor +10 mm"].rack.floor_mm == 13.5
    assert asked["height -5 mm"].rack.height_mm == 48
    assert "floor -10 mm" not in asked, "below the base"
    fewer = asked["columns -1 low side"].rack
    assert (fewer.slot("A1").center_mm, fewer.grid.columns) == (RACK.slot("A1").center_mm, 9)
    assert asked["rows +1 outline too"].rack.outline_mm == (192.5, pytest.approx(95.5 + 17.7))
    assert asked["caps +2 mm"].tubes[0].height_m == pytest.approx(CAPPED.height_m + 2e-3)
    assert asked["caps +2 mm"].tubes[1] == OPEN
    assert not asked["rows -1 centred"].same_rack
    assert all(case.same_rack for case in asked.values() if case.kind in ("pitch", "floor", "openings"))


def test_clouds_are_wrong_by_what_their_names_say(view):
    asked = {case.name: case for case in cases(view, tuple(KINDS), 0, 0)}
    scaled = asked["scale +1 %"]
    assert np.allclose(scaled.frame.cloud_m, 1.01 * view.frame.cloud_m)
    assert scaled.truth.T_camera_rack[:3, 3] == pytest.approx(1.01 * FACING[:3, 3])
    assert scaled.face_truth is view.truth
    up = asked["origin below the face, organised"]
    assert up.truth.T_camera_rack[:3, 2] == pytest.approx([0, 0, 1])
    assert up.truth.T_camera_rack[2, 3] == pytest.approx(0.0)
    assert up.frame.cloud_m[..., 2] == pytest.approx(np.zeros((64, 64)), abs=1e-9)
    height_m = 0.7 - asked["plate"].frame.cloud_m[32, 32, 2]
    assert height_m == pytest.approx(RACK.height_m, abs=3e-4)
    assert asked["plate"].truth.rack is None


def test_frames_get_different_cases_but_the_same_ones_each_time(view):
    other = dataclasses.replace(view, name="w")
    first, again, others = ([c.name for c in cases(v, ("pitch",), 2, 0)] for v in (view, view, other))
    assert first == again
    assert len(first) == 2
    assert first != others


def test_no_rack_can_have_slots_that_overlap():
    assert changed(RACK, floor_mm=60.0) is None
    assert listed(RACK, np.array([0.5, 1.0])) is None
    assert is_same_rack(RACK, RACK.model_copy(update={"name": "other"}))
    assert not is_same_rack(load_rack("round-5ml-3x4"), load_rack("round-10ml-3x4"))


def test_every_rack_of_the_catalogue_has_tubes():
    for rack in racks():
        assert types_for(rack), rack.name
