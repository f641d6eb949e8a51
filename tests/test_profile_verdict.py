"""Checks of tubes by code, what they say, and what is known of types."""

import numpy as np
import pytest

from tubepose.checks import SENTENCES, failed, first_reason, sentence
from tubepose.config import ProfileConfig
from tubepose.labware import load_rack, load_tube
from tubepose.profile.verdict import p_type, tube_checks

CONFIG = ProfileConfig()
RACK = load_rack("chen2023-soft-5x10")
TUBE = load_tube("chen2023-tube-2")
GOOD = {"sectors": 0.9, "allowed": 0.7, "higher": 0.05, "filled": 0.1, "high_m": 2e-4, "tilt_std_rad": 0.003}


def checks(**changed):
    return tube_checks(**{**GOOD, **changed}, tube=TUBE, rack=RACK, slot="C5", config=CONFIG)


def codes(**changed):
    return [check.code for check in failed(checks(**changed))]


def test_a_good_tube_passes_every_check():
    assert codes() == codes(high_m=float("nan")) == []
    assert first_reason(checks(), TUBE.name) == ""
    assert {check.code for check in checks()} >= {"circle_little_seen", "height_off", "not_in_slot", "tilt_uncertain"}
    # What was not measured is not checked.
    assert "height_off" not in {check.code for check in checks(high_m=float("nan"))}


@pytest.mark.parametrize(
    ("changed", "code", "value", "words"),
    [
        ({"sectors": 0.31, "spacing_m": 1.0e-3}, "circle_little_seen", 31, "31% of the top's circle"),
        ({"sectors": 0.31, "spacing_m": 1.7e-3}, "points_apart", 1.7, "1.7 mm apart: too coarse"),
        ({"sectors": 0.31}, "circle_little_seen", 31, "at least 40% expected"),
        ({"high_m": 5e-3}, "height_off", 5.0, "+5.0 mm off the height of chen2023-tube-2 in chen2023-soft-5x10"),
        ({"high_m": -1.3e-3}, "height_off", -1.3, "-1.3 mm off"),
        ({"higher": 0.4}, "something_higher", 40, "something taller stands there"),
        ({"filled": 0.8}, "mouth_filled", 80, "a closed top"),
        ({"allowed": 1e-5}, "not_in_slot", 1e-5, "slot C5 of chen2023-soft-5x10 does not let it"),
        ({"tilt_std_rad": np.deg2rad(0.75)}, "tilt_uncertain", 0.75, "known to 0.75 deg only"),
        ({"runner_up": 0.95}, "type_unclear", 95, "as well as chen2023-tube-2 (95%"),
        ({"looked_at": False}, "not_looked_at", 0, "this cloud has no pixels"),
    ],
)
def test_codes_values_and_words(changed, code, value, words):
    (check,) = failed(checks(**changed))
    assert (check.code, check.value) == (code, pytest.approx(value))
    assert words in sentence(check, TUBE.name)


def test_what_was_not_seen_is_said_before_what_was_seen_wrong():
    assert codes(sectors=0.1, high_m=5e-3, allowed=0.0) == ["circle_little_seen", "height_off", "not_in_slot"]
    assert "circle" in first_reason(checks(sectors=0.1, high_m=5e-3, allowed=0.0), TUBE.name)
    assert codes(looked_at=False, sectors=0.0)[0] == "not_looked_at"


@pytest.mark.parametrize(
    ("key", "limit", "worse"),
    [
        ("sectors", CONFIG.min_sectors, -1e-6),
        ("high_m", CONFIG.max_height_error_m, 1e-9),
        ("high_m", -CONFIG.max_height_error_m, -1e-9),
        ("allowed", CONFIG.min_allowed, -1e-9),
        ("tilt_std_rad", CONFIG.max_tilt_std_rad, 1e-9),
        ("runner_up", CONFIG.max_runner_up, 1e-9),
    ],
)
def test_limits_are_where_the_settings_say(key, limit, worse):
    assert codes(**{key: limit}) == []
    assert len(codes(**{key: limit + worse})) == 1


def test_every_code_of_a_tube_has_a_sentence():
    assert {check.code for check in checks(runner_up=0.5, looked_at=False)} <= set(SENTENCES)


def test_types_by_their_support():
    assert p_type(0.8, 0.8, 7e-3) == 0.5
    assert p_type(0.8, -np.inf, 7e-3) == pytest.approx(1.0)
    assert p_type(0.8, 0.6, 7e-3) == pytest.approx(1 - p_type(0.6, 0.8, 7e-3))
    # Log odds of height and radius, where there are some, have the last word.
    assert p_type(0.8, 0.1, 7e-3, np.log(99)) == pytest.approx(0.99)
    # A larger top has more patches that tell.
    assert 0.5 < p_type(0.8, 0.75, 5e-3) < p_type(0.8, 0.75, 8e-3) < 1
