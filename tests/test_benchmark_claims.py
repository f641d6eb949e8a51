"""The programs behind the claims: the floor of an ideal estimator, and the verdicts on rows of errors."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import tubepose
from benchmarks import claims, floor
from tubepose.capture.source import TRUTH_FOLDER
from tubepose.labware import load_rack, load_tube
from tubepose.simulation import read_exact_truth
from tubepose.simulation.placement import lean
from tubepose.simulation.scene import CapFit

SAMPLE = Path(tubepose.__file__).parent / "sample"

RACK = load_rack("chen2023-soft-5x10")
CAPPED = load_tube("chen2023-tube-3")
SESSION = SimpleNamespace(types={CAPPED.name: CAPPED})


def floor_of(top_std_m, plane_std, tubes=None, count=60, draws=2000):
    rng = np.random.default_rng(0)
    tubes = floor.drawn(RACK, CAPPED, count, np.random.default_rng(1)) if tubes is None else tubes
    return np.abs(floor.ideal_answers(RACK, CAPPED, tubes, top_std_m, plane_std, rng, draws).slope).mean()


def test_the_floor_falls_with_what_is_known():
    spread = np.mean([np.abs(one.slope) for one in floor.drawn(RACK, CAPPED, 60, np.random.default_rng(1))])
    top_only, both, all_exact = (floor_of(0.1e-3, np.deg2rad(5)), floor_of(0.1e-3, np.deg2rad(0.1)), floor_of(0, 0))
    assert all_exact < both < 0.75 * top_only < 0.5 * spread


def test_a_crooked_cap_is_part_of_the_floor():
    slot, rng = RACK.all_slots[0], np.random.default_rng(2)
    poses = [lean(RACK, slot, CAPPED, rng) for _ in range(60)]
    straight, crooked = (
        floor_of(0, 0, [floor.placed(slot, CAPPED, T, CapFit(tuple(t))) for T, t in zip(poses, tilts, strict=True)])
        for tilts in (np.zeros((60, 2)), rng.normal(0, np.deg2rad(0.15), (60, 2)))
    )
    assert straight < 0.8 * crooked


def test_a_cap_turns_about_the_rim():
    slot, T = RACK.all_slots[0], np.eye(4)
    T[:3, 3] = [*RACK.all_slots[0].center_m, RACK.floor_m]
    tilt = 0.01
    found = floor.placed(slot, CAPPED, T, CapFit(tilt_rad=(0.0, tilt)))
    assert found.held_m == pytest.approx([0, 0], abs=1e-12)
    assert found.slope == pytest.approx([0, 0], abs=1e-12)
    assert found.cap_slope == pytest.approx([np.tan(tilt), 0])
    assert found.top_m == pytest.approx([(CAPPED.height_m - CAPPED.rim_height_m) * np.sin(tilt), 0], abs=1e-12)
    opened = load_tube("chen2023-tube-1")
    assert np.isnan(floor.placed(slot, opened, T, CapFit()).cap_slope).all()


def test_the_floor_does_not_depend_on_the_number_of_draws():
    few, many = (floor_of(0.0, np.deg2rad(0.1), count=200, draws=draws) for draws in (1000, 4000))
    assert few == pytest.approx(many, rel=0.05)


def test_a_floor_that_rests_on_too_few_draws_is_refused():
    with pytest.raises(ArithmeticError, match="effective draws, 100 expected: raise DRAWS"):
        floor_of(0.0, 0.0, draws=200)


def test_what_the_floor_allows_is_what_the_simulator_places():
    tubes = floor.drawn(RACK, CAPPED, 200, np.random.default_rng(1))
    held, slope = np.array([one.held_m for one in tubes]), np.array([one.slope for one in tubes])
    slot = RACK.all_slots[0]
    assert floor.allowed(RACK, slot, CAPPED, held, slope).mean() > 0.99
    assert not floor.allowed(RACK, slot, CAPPED, held, slope + 0.2).any()


def test_the_floor_of_a_session_is_that_of_its_own_tubes(monkeypatch, capsys):
    monkeypatch.setattr(floor, "JUDGED", 1)
    rack, found = floor.placed_in(SAMPLE)
    assert rack == RACK
    exact = {trial: read_exact_truth(SAMPLE, trial.stem) for trial in (SAMPLE / TRUTH_FOLDER).iterdir()}
    assert sum(len(tubes) for _, tubes in found.values()) == sum(len(one.tubes) for one in exact.values())
    for tube, tubes in found.values():
        slope = np.array([one.slope for one in tubes])
        assert (floor.allowed(rack, rack.all_slots[0], tube, np.array([one.held_m for one in tubes]), slope)).all()
    assert floor.main(["--session", str(SAMPLE)]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split("|")[1].strip() for row in rows[::2]] == list(found)


def test_a_session_without_exact_truth_has_no_floor(tmp_path, capsys):
    copy = tmp_path / "session"
    shutil.copytree(SAMPLE, copy, ignore=shutil.ignore_patterns(TRUTH_FOLDER))
    assert floor.main(["--session", str(copy)]) == 1
    assert capsys.readouterr().err.startswith("error: ")


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
