"""Verdicts word by word, and scores."""

import numpy as np
import pytest

from tubepose.config import ProfileConfig
from tubepose.labware import load_rack, load_tube
from tubepose.profile.verdict import rejection, score

CONFIG = ProfileConfig()
RACK = load_rack("chen2023-soft-5x10")
TUBE = load_tube("chen2023-tube-2")
GOOD = {"sectors": 0.9, "allowed": 0.7, "high_m": 2e-4, "tilt_std_rad": 0.003}


def reason(**changed):
    return rejection(**{**GOOD, **changed}, tube=TUBE, rack=RACK, slot="C5", config=CONFIG)


def test_a_good_tube_has_no_reason():
    assert reason() == ""
    assert reason(high_m=float("nan")) == ""


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"sectors": 0.31, "spacing_m": 1.0e-3}, "31% of the top's circle seen, at least 40% expected"),
        (
            {"sectors": 0.31, "spacing_m": 1.7e-3},
            "the points on its top lie 1.7 mm apart: too coarse to tell where its circle ends, 1.3 mm or less expected",
        ),
        ({"sectors": 0.31}, "31% of the top's circle seen, at least 40% expected"),
        (
            {"high_m": 5e-3},
            "the top is +5.0 mm off the height of chen2023-tube-2 in chen2023-soft-5x10: another type, or it stands on "
            "something",
        ),
        (
            {"high_m": -1.3e-3},
            "the top is -1.3 mm off the height of chen2023-tube-2 in chen2023-soft-5x10: another type, or it stands on "
            "something",
        ),
        (
            {"allowed": 1e-5},
            "stands or leans as slot C5 of chen2023-soft-5x10 does not let it: jammed, on something, "
            "or not in the slot",
        ),
        ({"tilt_std_rad": np.deg2rad(0.75)}, "its tilt is known to 0.75 deg only"),
    ],
)
def test_reasons_word_by_word(changed, words):
    assert reason(**changed) == words


def test_an_open_rim_that_could_not_be_looked_at():
    words = "an open rim is measured in the image, and this cloud has no pixels"
    assert reason(looked_at=False) == reason(looked_at=False, sectors=0.0) == words


def test_what_was_not_seen_is_said_before_what_was_seen_wrong():
    assert "circle" in reason(sectors=0.1, high_m=5e-3, allowed=0.0)
    assert "off the height" in reason(high_m=5e-3, allowed=0.0)


@pytest.mark.parametrize(
    ("key", "limit", "worse"),
    [
        ("sectors", CONFIG.min_sectors, -1e-6),
        ("high_m", CONFIG.max_height_error_m, 1e-9),
        ("high_m", -CONFIG.max_height_error_m, -1e-9),
        ("allowed", CONFIG.min_allowed, -1e-9),
        ("tilt_std_rad", CONFIG.max_tilt_std_rad, 1e-9),
    ],
)
def test_limits_are_where_the_settings_say(key, limit, worse):
    assert reason(**{key: limit}) == ""
    assert reason(**{key: limit + worse}) != ""


def test_scores_by_hand_and_in_order():
    def of(tilt_std_rad=CONFIG.score_tilt_rad, sectors=1.0, allowed=0.5):
        return score(tilt_std_rad, sectors, allowed, CONFIG)

    assert of() == pytest.approx(0.5)
    assert of(tilt_std_rad=0.0) == pytest.approx(1.0)
    assert of(sectors=0.375) == pytest.approx(0.25)
    assert of(allowed=0.01) == pytest.approx(0.25)
    assert 0 < of(tilt_std_rad=0.02) < of(tilt_std_rad=0.01) < of()
    assert of(sectors=0.0) == 0.0
