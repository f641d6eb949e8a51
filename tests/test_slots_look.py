"""What was seen of every slot: known answers by frames whose every line of sight is known."""

import dataclasses

import numpy as np
import pytest
import scenes
from profile_scenes import rendered
from slot_scenes import CAMERA, Post, looked_at, without_pixels

from tubepose.labware import load_rack, load_tube
from tubepose.rack.fit import laid_flat
from tubepose.slots import Finding, SlotState, look_at_slots, state_slot
from tubepose.transforms import make_transform

RACK = load_rack("round-10ml-3x4")  # openings of 21 mm, 78.5 mm deep, 30 x 25 mm apart
SQUARE = load_rack("chen2023-soft-5x10")
WIDE = load_tube("chen2023-tube-2")  # cap of 17.45 mm on openings of 16.5 mm
SQUARELY = scenes.camera_from_rack(SQUARE, 0.2, 0.05)
ABOVE = scenes.camera_from_rack(RACK, 0.2, 0.05)
HIGH = Post(9.0e-3, RACK.height_m + 0.04)


def looks_of(frame, T=ABOVE, rack=RACK, tubes=(), intrinsics="own"):
    known = frame.intrinsics if intrinsics == "own" else intrinsics
    return {look.slot: look for look in look_at_slots(frame, known, T, rack, tubes)}


def states_of(looks):
    return {name: state_slot(look, Finding.NONE).state for name, look in looks.items()}


def total(look):
    return look.passed + look.standing + look.filled + look.at_face + look.hidden + look.silent


def test_an_empty_rack_that_is_seen_is_empty_in_every_slot():
    looks = looks_of(looked_at(RACK, ABOVE))
    assert set(states_of(looks).values()) == {SlotState.EMPTY}
    for look in looks.values():
        assert look.in_image == 1.0
        assert look.passed > 0.85
        assert look.seen_share == pytest.approx(1.0, abs=0.02)
        assert (look.standing, look.covered, look.patches_stopped, look.patches_covered) == (0.0,) * 4


@pytest.mark.parametrize("black", [False, True])
def test_every_part_of_an_opening_has_one_fate(black):
    frame = looked_at(RACK, ABOVE, {"B2": dataclasses.replace(HIGH, black=black)}, dark=("A4",))
    for look in looks_of(frame).values():
        assert total(look) == pytest.approx(look.in_image, abs=1e-9)


def test_what_stands_in_a_slot_is_seen_there_and_nowhere_else():
    looks = looks_of(looked_at(RACK, ABOVE, {"B2": HIGH}))
    states = states_of(looks)
    assert states.pop("B2") is SlotState.OCCUPIED
    assert set(states.values()) == {SlotState.EMPTY}
    assert looks["B2"].covered == 1.0
    assert looks["B2"].hidden == 0.0
    # Its own tube hides the opening, and is what was to be looked at.
    assert looks["B2"].seen_share > 0.95


def test_a_slot_outside_of_the_image_is_not_seen_and_one_on_its_border_by_its_share():
    shift = np.array([*(-RACK.slot("B1").center_m), 0.0])
    T = scenes.camera_from_rack(RACK) @ make_transform(np.eye(3), shift)
    camera = dataclasses.replace(CAMERA, cx=0.0)  # the border goes through the middle of B1
    looks = looks_of(looked_at(RACK, T, camera=camera), T)
    assert looks["B1"].in_image == pytest.approx(0.5, abs=0.05)
    assert looks["B2"].in_image == 1.0
    shifted = dataclasses.replace(CAMERA, cx=-40.0)
    looks = looks_of(looked_at(RACK, T, camera=shifted), T)
    assert (looks["B1"].in_image, looks["B1"].seen_share) == (0.0, 0.0)
    assert state_slot(looks["B1"], Finding.NONE).state is SlotState.NOT_SEEN
    assert state_slot(looks["B1"], Finding.NONE).p_occupied == 0.5


def test_a_slot_behind_a_tall_cap_is_hidden_and_not_empty():
    T = scenes.camera_from_rack(RACK, 0.0, np.deg2rad(40))  # the camera looks along y
    y = {name: (T @ np.array([*RACK.slot(name).center_m, RACK.height_m, 1.0]))[2] for name in ("A2", "C2")}
    near, far = sorted(y, key=y.get)
    posts = {name: Post(12.4e-3, RACK.height_m + 0.06) for name in ("B1", "B2", "B3")}
    looks = looks_of(looked_at(RACK, T, posts), T)
    assert looks[far].hidden > 0.8
    assert looks[near].hidden < 0.05
    states = states_of(looks)
    assert states[far] is SlotState.NOT_SEEN
    assert states[near] is SlotState.EMPTY
    assert states["B2"] is SlotState.OCCUPIED


@pytest.mark.parametrize("tubes", [(), (load_tube("blood-16x100"),)], ids=["no-types", "types"])
def test_a_black_cap_is_never_empty(tubes):
    looks = looks_of(looked_at(RACK, ABOVE, {"B2": dataclasses.replace(HIGH, black=True)}), tubes=tubes)
    assert looks["B2"].silent > 0.6
    stated = state_slot(looks["B2"], Finding.NONE)
    assert stated.state is SlotState.NOT_SEEN
    assert stated.p_occupied == 0.5


def test_a_dark_well_is_not_seen_where_ribs_tell_nothing():
    looks = looks_of(looked_at(RACK, ABOVE, dark=("B2",)))
    assert looks["B2"].silent > 0.95
    assert states_of(looks)["B2"] is SlotState.NOT_SEEN


def test_a_dark_well_is_empty_where_every_given_type_would_hide_ribs_that_are_seen():
    T = scenes.camera_from_rack(SQUARE, 0.3, 0.2, 0.5)
    dark = ("C5", "B8")
    free = looks_of(looked_at(SQUARE, T, dark=dark), T, SQUARE, (WIDE,))
    cap = Post(WIDE.max_radius_m, SQUARE.floor_m + WIDE.height_m, black=True)
    capped = looks_of(looked_at(SQUARE, T, dict.fromkeys(dark, cap), dark=dark), T, SQUARE, (WIDE,))
    unknown = looks_of(looked_at(SQUARE, T, dark=dark), T, SQUARE)
    for name in dark:
        assert free[name].silent > 0.95
        assert states_of(free)[name] is SlotState.EMPTY
        # The cap hides those ribs, returned or not.
        assert capped[name].patches_passed < 0.5
        assert states_of(capped)[name] is SlotState.NOT_SEEN
        # Of what is not given nothing is known.
        assert states_of(unknown)[name] is SlotState.NOT_SEEN


def test_a_short_thing_below_the_face_is_not_empty():
    posts = {"B2": Post(8e-3, RACK.height_m - 0.015), "C3": Post(8e-3, RACK.floor_m + 0.003)}
    looks = looks_of(looked_at(RACK, ABOVE, posts))
    assert looks["B2"].filled > 0.3
    assert states_of(looks)["B2"] is SlotState.OCCUPIED
    # As low as the floor's own tolerance: the floor may be there.
    assert looks["C3"].filled == 0.0


def test_where_the_floor_is_not_known_a_low_thing_is_no_evidence():
    posts = {"B2": Post(8e-3, RACK.floor_m + 0.03)}
    unsure = RACK.model_copy(update={"floor_tolerance_mm": 20.0})
    frame = looked_at(RACK, ABOVE, posts)
    assert looks_of(frame)["B2"].filled > 0.3
    assert looks_of(frame, rack=unsure)["B2"].filled == 0.0


def test_the_far_wall_of_a_slot_that_is_seen_at_a_slant_is_no_content():
    T = scenes.camera_from_rack(RACK, 0.4, np.deg2rad(40))
    looks = looks_of(looked_at(RACK, T), T)
    assert set(states_of(looks).values()) == {SlotState.EMPTY}
    assert max(look.filled for look in looks.values()) < 0.05


@pytest.mark.parametrize(("share", "state"), [(0.05, SlotState.EMPTY), (1.0, SlotState.OCCUPIED)])
def test_ghosts_above_a_slot_are_judged_by_their_area(share, state):
    frame = looked_at(RACK, ABOVE)
    ghosts = looked_at(RACK, ABOVE, {"B2": HIGH}).cloud_m
    place = np.isfinite(ghosts[..., 2]) & (np.abs(ghosts - frame.cloud_m).max(axis=-1) > 1e-6)
    v, u = np.nonzero(place)
    few = np.random.default_rng(0).permutation(len(v))[: int(share * len(v))]
    cloud = frame.cloud_m.copy()
    cloud[v[few], u[few]] = ghosts[v[few], u[few]]
    assert states_of(looks_of(dataclasses.replace(frame, cloud_m=cloud)))["B2"] is state


@pytest.mark.parametrize("view", [(0.0, 0.0, 0.5), (1.0, 0.15, 0.6), (2.5, 0.3, 0.55), (-1.2, 0.45, 0.65)])
def test_the_states_do_not_depend_on_where_the_camera_is(view):
    T = scenes.camera_from_rack(RACK, *view)
    looks = looks_of(looked_at(RACK, T, {"A1": HIGH, "C4": HIGH}), T)
    occupied = {name for name, state in states_of(looks).items() if state is SlotState.OCCUPIED}
    empty = {name for name, state in states_of(looks).items() if state is SlotState.EMPTY}
    assert occupied == {"A1", "C4"}
    assert len(empty) == 10


def test_points_without_pixels_give_the_same_states_and_nothing_returned_is_not_known():
    frame = looked_at(RACK, ABOVE, {"B2": HIGH, "C3": dataclasses.replace(HIGH, black=True)}, dark=("A4",))
    bare = without_pixels(frame)
    pixels, points = looks_of(frame), looks_of(bare)
    assert states_of(pixels) == states_of(points)
    assert (states_of(points)["B2"], states_of(points)["A1"]) == (SlotState.OCCUPIED, SlotState.EMPTY)
    assert {states_of(points)[name] for name in ("A4", "C3")} == {SlotState.NOT_SEEN}
    assert points["A4"].silent == pytest.approx(1.0, abs=0.05)
    # An organised cloud whose camera is not known is looked at through its points as well.
    assert states_of(looks_of(frame, intrinsics=None)) == states_of(points)


def test_a_cloud_in_which_the_camera_is_below_the_face_shows_nothing():
    upside = np.diag([1.0, 1.0, 1.0, 1.0])
    looks = looks_of(without_pixels(looked_at(RACK, ABOVE)), T=upside)
    assert {state_slot(look, Finding.NONE).state for look in looks.values()} == {SlotState.NOT_SEEN}
    assert {look.seen_share for look in looks.values()} == {0.0}


def test_a_rack_without_points_is_not_seen():
    frame = looked_at(RACK, ABOVE)
    nothing = dataclasses.replace(frame, cloud_m=np.full_like(frame.cloud_m, np.nan))
    for frame_of_it in (nothing, without_pixels(nothing)):
        looks = looks_of(frame_of_it)
        assert set(states_of(looks).values()) == {SlotState.NOT_SEEN}
        assert max(look.seen_share for look in looks.values()) == 0.0


def test_no_argument_is_changed():
    frame = looked_at(RACK, ABOVE, {"B2": HIGH})
    before, pose = frame.cloud_m.copy(), ABOVE.copy()
    looks_of(frame)
    assert np.array_equal(before, frame.cloud_m, equal_nan=True)
    assert np.array_equal(pose, ABOVE)


def test_a_ray_cast_rack_has_no_wrong_state():
    T = scenes.camera_from_rack(SQUARE, 0.3, 0.2, 0.6)
    held = ("A2", "B5", "B6", "C9", "E1", "E10")
    placed = {name: (WIDE, scenes.tube_pose(SQUARE, name)) for name in held}
    frame = rendered(SQUARE, placed, T)
    states = states_of(looks_of(frame, T, SQUARE, (WIDE,)))
    assert {states[name] for name in held} == {SlotState.OCCUPIED}
    rest = [state for name, state in states.items() if name not in held]
    assert SlotState.OCCUPIED not in rest
    # Wells are dark in a scanner with a projector: ribs tell.
    assert rest.count(SlotState.EMPTY) >= 0.8 * len(rest)


@pytest.mark.parametrize("bow_mm", [-2.5, 2.5])
def test_an_empty_bowed_rack_is_empty_where_its_bow_is_known(bow_mm):
    flat, bow_m = looked_at(SQUARE, SQUARELY), np.array([bow_mm, -bow_mm, 0.0]) * 1e-3
    bent = laid_flat(flat.cloud_m.reshape(-1, 3), SQUARELY, -bow_m, SQUARE).reshape(flat.cloud_m.shape)
    frame = dataclasses.replace(flat, cloud_m=bent)
    known = look_at_slots(frame, frame.intrinsics, SQUARELY, SQUARE, (), 1e-4, bow_m)
    assert {state_slot(look, Finding.NONE).state for look in known} == {SlotState.EMPTY}
    assert max(look.covered for look in known) == 0.0
    taken_for_flat = look_at_slots(frame, frame.intrinsics, SQUARELY, SQUARE, (), 1e-4, np.zeros(3))
    right, wrong = (sum(look.passed for look in looks) for looks in (known, taken_for_flat))
    assert wrong < right
