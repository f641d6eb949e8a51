"""The programs behind the claims: the floor of an ideal estimator, and the verdicts on rows of errors."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from benchmarks import claims, floor
from tubepose.labware import load_rack, load_tube

RACK = load_rack("chen2023-soft-5x10")
CAPPED = load_tube("chen2023-tube-3")
SESSION = SimpleNamespace(types={CAPPED.name: CAPPED})


def floor_of(top_std_m, slope_std, **how):
    rng = np.random.default_rng(0)
    answers = floor.ideal_answers(RACK, CAPPED, top_std_m, slope_std, rng, **({"judged": 60, "draws": 2000} | how))
    return np.abs(answers.slope).mean()


def test_the_floor_falls_with_what_is_known():
    _, spread = floor.placed(RACK, CAPPED, 60, np.random.default_rng(0))
    top_only, both, all_exact = (
        floor_of(0.1e-3, np.inf),
        floor_of(0.1e-3, np.deg2rad(0.15)),
        floor_of(0.0, np.deg2rad(0.1)),
    )
    assert all_exact < both < 0.75 * top_only < 0.5 * np.abs(spread).mean()


def test_a_crooked_cap_is_part_of_the_floor():
    assert floor_of(0.1e-3, np.deg2rad(0.1)) < floor_of(0.1e-3, np.deg2rad(0.3))


def test_the_floor_does_not_depend_on_the_number_of_draws():
    few, many = (floor_of(0.0, np.deg2rad(0.15), judged=200, draws=draws) for draws in (1000, 4000))
    assert few == pytest.approx(many, rel=0.05)


def test_a_floor_that_rests_on_too_few_draws_is_refused():
    with pytest.raises(ArithmeticError, match="effective draws, 100 expected: raise DRAWS"):
        floor_of(0.0, np.deg2rad(0.01))


def test_what_the_floor_allows_is_what_the_simulator_places():
    rng = np.random.default_rng(1)
    held, slope = floor.placed(RACK, CAPPED, 200, rng)
    assert floor.allowed(RACK, CAPPED, held, slope).mean() > 0.99
    assert not floor.allowed(RACK, CAPPED, held, slope + 0.2).any()


def errors(method, rx_deg, tx_mm, outcomes=("ok",)):
    rows = []
    for trial in range(4):
        for slot, outcome in enumerate(outcomes):
            rows.append(
                {
                    "session": "s", "trial": f"t{trial}", "slot": f"A{slot}", "tube": CAPPED.name, "method": method,
                    "outcome": outcome, "rx_deg": rx_deg, "ry_deg": 0.0, "tilt_deg": abs(rx_deg), "tx_mm": tx_mm,
                    "ty_mm": 0.0, "tz_mm": 0.0, "cap_mm": 0.0, "type_correct": True,
                    "reason": "upside down" if outcome == "failed" else "",
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


@pytest.mark.parametrize(
    ("rx_deg", "tx_mm", "outcomes", "verdicts"),
    [
        (0.1, 0.1, ("ok",), (True, True, True, True)),
        (0.13, 0.1, ("ok",), (False, True, True, True)),
        (0.5, 0.1, ("ok",), (False, False, True, True)),
        (0.1, 0.3, ("ok",), (True, True, False, True)),
        (0.1, 2.1, ("ok",), (True, True, False, False)),
        (0.1, 0.1, ("ok", "missed"), (True, True, True, False)),
        (0.1, 0.1, ("ok",) * 99 + ("missed",), (True, True, True, True)),
        (0.1, 0.1, ("ok",) * 99 + ("failed",), (True, True, True, False)),
        (0.1, 0.1, ("ok",) * 99 + ("false",), (True, True, True, False)),
    ],
)
def test_targets_are_met_or_not(rx_deg, tx_mm, outcomes, verdicts):
    (row,) = claims.accuracy_rows(errors("profile", rx_deg, tx_mm, outcomes), SESSION, "exact")
    assert (row["R met"], row["p95 met"], row["T met"], row["kept, none wrong"]) == verdicts


def test_what_is_wrong_is_counted_whatever_kind_of_wrong():
    rows = errors("profile", 0.1, 0.1, ("ok", "ok", "failed", "false", "rejected")).iloc[:5]
    rows["type_correct"] = pd.array([True, False, True, None, False], dtype="boolean")
    (row,) = claims.accuracy_rows(rows, SESSION, "exact")
    assert (row["wrong"], row["false"], row["ok/expected"]) == (2, 1, "2/4")


def test_no_expected_tube_meets_nothing():
    (row,) = claims.accuracy_rows(errors("profile", 0.1, 0.1).iloc[:0], SESSION, "exact")
    assert not any(row[name] for name in ("R met", "p95 met", "T met", "kept, none wrong"))


def test_an_interval_of_one_capture_says_nothing():
    table = pd.concat([errors("profile", 0.1, 0.1).iloc[:1], errors("worse", 0.3, 0.1).iloc[:1]])
    (told,) = claims.rival_rows(table, "exact")
    assert told["rx_deg"].endswith("too few captures")


def test_rivals_are_behind_level_or_ahead():
    table = pd.concat([errors("profile", 0.1, 0.1), errors("worse", 0.3, 0.1), errors("better", 0.05, 0.1)])
    told = {row["rival"]: row for row in claims.rival_rows(table, "exact")}
    assert told["worse"]["rx_deg"].endswith("ahead")
    assert told["worse"]["tx_mm"].endswith("level")
    assert told["better"]["rx_deg"].endswith("behind")
    assert told["worse"]["pairs"] == 4


def test_the_gain_is_on_tubes_that_both_answered():
    trivial = errors("upright", 0.6, 0.5, ("ok", "ok"))
    (row,) = claims.gain_rows(pd.concat([errors("profile", 0.2, 0.1, ("ok", "rejected")), trivial]), "exact")
    assert row["ratio"] == pytest.approx(3.0)
