"""The cells of `coverage_factors`, and what it counts, on known answers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scenes import tube_pose

from benchmarks.coverage_factors import FACTORS, MIDDLE, Cell, Outcome, Setting, line, settings, squares
from benchmarks.wrong_labware_judging import Answer, StatedTube, TrueTube, Truth
from tubepose.labware import load_rack, load_tube
from tubepose.transforms import translation

RACK, TUBE = load_rack("chen2023-soft-5x10"), load_tube("chen2023-tube-3")


def test_each_factor_is_changed_alone_then_all_are():
    found = dict(settings(tuple(FACTORS), 30, 0))
    assert found["middle"] == MIDDLE
    alone = [s for name, s in found.items() if name != "middle" and not name.startswith("combination")]
    assert len(alone) == sum(len(levels) for levels in FACTORS.values()) - len(FACTORS)
    for setting in alone:
        assert sum(getattr(setting, name) != getattr(MIDDLE, name) for name in FACTORS) == 1
    together = [s for name, s in found.items() if name.startswith("combination")]
    assert len(set(together)) == 30
    for name, levels in FACTORS.items():
        drawn = [getattr(setting, name) for setting in together]
        assert min(levels) <= min(drawn)
        assert max(drawn) <= max(levels)
        assert np.ptp(drawn) > 0.6 * (max(levels) - min(levels))
    assert dict(settings(tuple(FACTORS), 30, 0)) == found


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_both_parts_of_the_noise_add_up_to_all_of_it(share):
    noise = Setting(noise_mm=0.5, shared_share=share).depth_noise
    assert noise.independent_m**2 + noise.shared_m**2 == pytest.approx(0.25e-6)
    assert noise.shared_m**2 == pytest.approx(share * 0.25e-6)


def test_squares_are_in_units_of_the_stated_covariance():
    """An error of two standard deviations along x is 4; a tube of another type, or without a covariance, has none."""
    T = tube_pose(RACK, "B3")
    truth = Truth(RACK, np.eye(4), (TrueTube("B3", TUBE, T),))
    covariance = np.diag([0.01, 0.01, 1e-3, 1e-3, 1e-3]) ** 2
    stated = StatedTube("B3", TUBE.name, TUBE, T @ translation([2e-3, 0.0, 0.0]), covariance)
    others = [dataclasses.replace(stated, type_name="other"), dataclasses.replace(stated, covariance=None)]
    answer = Answer(RACK, np.eye(4), False, "", (stated, *others))
    assert squares(truth, answer) == pytest.approx((4.0,))
    assert squares(Truth(RACK, np.eye(4), ()), answer) == ()


def test_a_line_counts_captures_tubes_and_what_lies_inside():
    """11.07 bounds the 95 % region of five errors."""
    outcomes = (Outcome(4, 1, 3, 1, (1.0, 2.0, 11.0), ("low",)), Outcome(6, 1, 1, 0, (11.2,), ("low", "high")))
    cells = [cell.strip() for cell in line(Cell("c", MIDDLE, outcomes)).strip("|").split("|")]
    assert cells[:8] == ["c", "2", "2", "10", "4", "0.400", "1", "0.750"]
    assert cells[8] == "0.000 to 1.000"
    assert cells[9] == f"{25.2 / 4 / 5:.2f}"
    assert cells[10] == "2 x low; 1 x high"
