"""Hints: how they are written, and what they decide about places of a slot."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
import scenes
from scipy.spatial.transform import Rotation

from tubepose.capture.hints import HEIGHT_M, Hint, SlotHint, Toward, pointed_at, read_hint, word_of
from tubepose.labware import load_rack
from tubepose.transforms import HALF_TURN, QUARTER_TURN, transform_points

RACK = load_rack("chen2023-soft-5x10")
UP = np.array([0.0, 0.0, -1.0])


def openings(T_camera_rack, slot="A1", turn=HALF_TURN, turns=2):
    place = np.array([*RACK.slot(slot).center_m, RACK.height_m])
    return np.stack([transform_points(T_camera_rack @ np.linalg.matrix_power(turn, k), place) for k in range(turns)])


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("A1@412,300", Hint(SlotHint(slot="A1", pixel=(412, 300)))),
        ("A1@412.5, -3", Hint(SlotHint(slot="A1", pixel=(412.5, -3)))),
        ("E10@bottom-right", Hint(SlotHint(slot="E10", toward="bottom-right"))),
        ("A1@0.10,-0.05,0.62", Hint(SlotHint(slot="A1", point_m=(0.1, -0.05, 0.62)))),
        ("previous", Hint(None, True)),
        ("A1@top,previous", Hint(SlotHint(slot="A1", toward="top"), True)),
        ("previous, A1@412,300", Hint(SlotHint(slot="A1", pixel=(412, 300)), True)),
    ],
)
def test_every_kind_of_hint_is_read(text, hint):
    assert read_hint(text) == hint


@pytest.mark.parametrize(
    "text",
    [
        *("", "A1", "A1@", "@top", "@1,2", "A1@1", "A1@1,2,3,4", "A1@nan,2", "A1@1,inf", "A1@up", "A1@1,2,B1@3,4"),
        *("before", "previous,previous", "A1@top,B1@left", "A1@top,", "A1@one,2"),
    ],
)
def test_what_is_no_hint_is_refused_with_the_kinds_there_are(text):
    with pytest.raises(ValueError, match=r"^expected SLOT@U,V \(a pixel\), SLOT@WHERE \(top-left, top, .*previous"):
        read_hint(text)


def test_a_point_in_millimetres_is_refused():
    with pytest.raises(ValueError, match="the point is 630 m away; expected metres, in the camera frame"):
        read_hint("A1@100,-50,620")
    with pytest.raises(ValueError, match="metres, camera frame"):
        SlotHint(slot="A1", point_m=(100, -50, 620))


@pytest.mark.parametrize("given", [{}, {"pixel": (1, 2), "toward": "top"}, {"toward": "top", "point_m": (0, 0, 1)}])
def test_a_slot_has_one_place(given):
    with pytest.raises(ValueError, match="one of pixel, toward and point_m"):
        SlotHint(slot="A1", **given)


@pytest.mark.parametrize("yaw_deg", [0, 15, 45, 100, 222, 300])
@pytest.mark.parametrize("tilt_deg", [0, 25])
def test_the_word_of_a_place_means_that_place(yaw_deg, tilt_deg):
    T_camera_rack = scenes.camera_from_rack(RACK, np.deg2rad(yaw_deg), np.deg2rad(tilt_deg))
    for turn, turns in ((HALF_TURN, 2), (QUARTER_TURN, 4)):
        places = openings(T_camera_rack, "A1", turn, turns)
        words = [word_of(places, k) for k in range(turns)]
        assert len(set(words)) == turns
        for k, word in enumerate(words):
            assert pointed_at(SlotHint(slot="A1", toward=word), places, UP, None) == k


def test_corners_are_those_of_the_image():
    """x of the camera frame points right, y down."""
    for word, at in {"top-left": (-1, -1), "right": (1, 0), "bottom": (0, 1), "bottom-left": (-1, 1)}.items():
        places = np.array([[*at, 10.0], [-at[0], -at[1], 10.0]]) * 0.05
        assert word_of(places, 0) == word


def test_the_nearest_of_the_eight_words_decides_however_a_square_rack_is_turned():
    words = {word: np.array([("right" in word) - ("left" in word), ("bottom" in word) - ("top" in word)])
             for word in get_args(Toward)}  # fmt: skip
    for yaw_deg in range(0, 360, 5):
        turns = Rotation.from_rotvec([[0, 0, yaw_deg + 90 * k] for k in range(4)], degrees=True).as_matrix()
        places = turns @ [0.05, 0.0, 0.0] + [0.0, 0.0, 0.6]
        nearest = max(words, key=lambda word: places[0, :2] @ words[word] / np.linalg.norm(words[word]))
        assert pointed_at(SlotHint(slot="A1", toward=nearest), places, UP, None) == 0


def test_a_direction_between_two_places_decides_nothing():
    square = np.array([[-1, -1, 10], [1, -1, 10], [1, 1, 10], [-1, 1, 10]]) * 0.05
    assert pointed_at(SlotHint(slot="A1", toward="left"), square, UP, None) is None
    assert pointed_at(SlotHint(slot="A1", toward="top-left"), square, UP, None) == 0
    level = np.array([[-1, 0, 10], [1, 0, 10]]) * 0.05
    assert pointed_at(SlotHint(slot="A1", toward="top"), level, UP, None) is None
    assert pointed_at(SlotHint(slot="A1", toward="top-right"), level, UP, None) == 1


def test_a_corner_at_which_no_place_is_decides_nothing():
    """A1 is at the top right or the bottom left of an upright rack; who says top left has mistaken something."""
    upright = np.array([[45, -90, 600], [-45, 90, 600]]) * 1e-3
    assert pointed_at(SlotHint(slot="A1", toward="top-left"), upright, UP, None) is None
    for word in ("top", "top-right", "right"):
        assert pointed_at(SlotHint(slot="A1", toward=word), upright, UP, None) == 0


def test_the_middle_slot_tells_nothing():
    """Its places differ by what a registration errs, and in some direction they always do."""
    places = np.array([[0.0, 0.0, 0.5], [3e-4, 0.0, 0.5]])
    assert pointed_at(SlotHint(slot="C3", toward="left"), places, UP, None) is None
    assert pointed_at(SlotHint(slot="C3", point_m=(0.0, 0.0, 0.5)), places, UP, None) is None
    assert word_of(places, 0) is None
    assert pointed_at(SlotHint(slot="C3", toward="left"), places * [100, 1, 1], UP, None) == 0


@pytest.mark.parametrize("turn", [0, 1])
@pytest.mark.parametrize("above_m", [0.1, 0.0, -0.08], ids=["cap", "opening", "floor"])
def test_a_point_anywhere_along_its_slot_decides(turn, above_m):
    T_camera_rack = scenes.camera_from_rack(RACK, 0.7, 0.3)
    places = openings(T_camera_rack, "B4")
    up = T_camera_rack[:3, 2]
    point = places[turn] + above_m * up + 0.01 * T_camera_rack[:3, 0]
    assert pointed_at(SlotHint(slot="B4", point_m=tuple(point)), places, up, None) == turn


def test_a_point_far_off_or_halfway_decides_nothing():
    T_camera_rack = scenes.camera_from_rack(RACK, 0.7, 0.3)
    places = openings(T_camera_rack, "A1")
    up, beside = T_camera_rack[:3, 2], T_camera_rack[:3, 1]
    for point in (places.mean(axis=0), places[0] + 1.1 * HEIGHT_M * up, places[0] + 0.1 * beside):
        assert pointed_at(SlotHint(slot="A1", point_m=tuple(point)), places, up, None) is None


def test_a_pixel_needs_the_camera():
    places = openings(scenes.camera_from_rack(RACK, 0.7))
    hint = SlotHint(slot="A1", pixel=tuple(scenes.CAMERA.project(places[1])))
    assert pointed_at(hint, places, UP, scenes.CAMERA) == 1
    assert pointed_at(hint, places, UP, None) is None


def test_places_behind_the_camera_are_no_ones():
    places = np.array([[-0.05, 0.0, -0.5], [0.05, 0.0, -0.5]])
    assert pointed_at(SlotHint(slot="A1", toward="left"), places, UP, None) is None
    assert pointed_at(SlotHint(slot="A1", pixel=(1, 2)), places, UP, scenes.CAMERA) is None
