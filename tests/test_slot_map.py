from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from commands import tubepose

from tubepose.errors import ConfigError
from tubepose.evaluation.slot_map import FINDINGS, MapLimits, compare_map, grid, slot_map
from tubepose.foreign.expected_slots import read_expected
from tubepose.labware import load_rack
from tubepose.records import pose_columns
from tubepose.transforms import make_transform

RACK = load_rack("round-10ml-3x4")
KEYS = {"session": "", "trial": "", "capture": "c", "frame": 0, "method": "m"}
TURN = make_transform(np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.0, 0.9]))


def tables(lifted_mm: float = 0.0, tilt_deg: float = 1.0):
    """A rack with a tube in A1 (as asked for) and A2, A3 not seen, all others empty."""
    states = {"A1": "occupied", "A2": "occupied", "A3": "not_seen"}
    slots = [
        {**KEYS, "slot": slot.name, "state": states.get(slot.name, "empty"), "p_occupied": 0.5, "ambiguous": False,
         "tube": "t1" if slot.name in ("A1", "A2") else None, "status": "ok" if slot.name in ("A1", "A2") else None}
        for slot in RACK.all_slots
    ]  # fmt: skip
    estimates = []
    for name, up_mm in (("A1", lifted_mm), ("A2", 0.0)):
        place = np.add(RACK.bottom_center_m(RACK.slot(name)), [0, 0, up_mm / 1e3])
        pose = pose_columns(TURN @ make_transform(np.eye(3), place))
        estimates.append({**KEYS, "slot": name, "status": "ok", "tilt_deg": tilt_deg if name == "A1" else 1.0, **pose})
    racks = [{**KEYS, "rack": RACK.name, **pose_columns(TURN)}]
    return pd.DataFrame(slots), pd.DataFrame(estimates), pd.DataFrame(racks)


def findings(declared: dict[str, str], **scene: float) -> dict[str, str]:
    found = slot_map(*tables(**scene), {RACK.name: RACK})
    rows = compare_map(found, pd.DataFrame({"slot": list(declared), "expected": list(declared.values())}), MapLimits())
    return dict(zip(rows["slot"], rows["finding"], strict=True))


def test_every_kind_of_difference_is_told() -> None:
    assert findings({"A1": "t1", "A2": "*"}) == {
        slot.name: "not_seen" if slot.name == "A3" else "ok" for slot in RACK.all_slots
    }
    assert findings({"A1": "t2"})["A1"] == "wrong_type"
    assert findings({"A1": "t1"})["A2"] == "extra"
    assert findings({"B1": "t1"})["B1"] == "missing"
    assert findings({"A1": "t1"}, tilt_deg=15)["A1"] == "tilted"
    assert findings({"A1": "t1"}, lifted_mm=8)["A1"] == "not_seated"
    assert set(FINDINGS) >= {"ok", "missing", "extra", "wrong_type", "tilted", "not_seated", "not_seen", "unclear"}


def test_the_height_over_the_floor_is_in_the_racks_frame() -> None:
    found = slot_map(*tables(lifted_mm=8), {RACK.name: RACK}).set_index("slot")["seat_mm"]
    assert (found["A1"], found["A2"]) == pytest.approx((8.0, 0.0), abs=1e-9)
    assert slot_map(*tables(), {})["seat_mm"].isna().all()


def test_the_grid_is_the_racks() -> None:
    shown = grid(slot_map(*tables(), {}), "state")
    assert list(shown.columns) == ["", *(str(n) for n in range(1, shown.shape[1]))]
    assert list(shown.iloc[0])[:4] == ["A", "occupied", "occupied", "not_seen"]
    assert shown.shape[0] * (shown.shape[1] - 1) == len(RACK.all_slots)


def test_the_same_declaration_in_every_format(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("slot,tube\nA1,t1\nA2,*\nA3,\n")
    (tmp_path / "a.json").write_text(json.dumps({"A1": "t1", "A2": "*", "A3": None}))
    spots = [("A1", [{"model": "t1"}]), ("A2", [{"model": "other"}]), ("A3", [])]
    children = [{"name": f"rack_{slot}", "children": held} for slot, held in spots]
    (tmp_path / "plr.json").write_text(json.dumps({"type": "TubeRack", "children": children}))
    for name in ("a.csv", "a.json", "plr.json"):
        found = read_expected(tmp_path / name, {"t1"})
        assert dict(zip(found["slot"], found["expected"], strict=True)) == {"A1": "t1", "A2": "*", "A3": ""}


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "slot\nA1\n", "column tube is missing"),
        ("a.csv", "slot,tube\nA1,t9\n", "tube 't9' is none of those"),
        ("a.csv", "slot,tube\nA1,t1\nA1,t1\n", "slot A1 is declared twice"),
        ("a.json", "[1]", "expected an object of slots to tubes"),
        ("a.json", "{", "cannot be read as JSON"),
        ("a.json", '{"children": [1]}', "has no name"),
    ],
)
def test_a_declaration_that_is_none_is_refused(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=words):
        read_expected(tmp_path / name, {"t1"})


def test_the_command_compares_a_run_with_its_session(small_session: Path, tmp_path: Path) -> None:
    made = ("--method", "upright", "--detector", "geometric", "--out", tmp_path / "o", "--allow", "not_seen,unclear")
    first = tubepose("slots", small_session, *made, "--expect", small_session, "--max-seat-mm", "50")
    assert (first.code, first.errors) == (0, [])
    found = pd.read_csv(tmp_path / "o" / "slot_map.csv")
    assert len(found) == 24
    declared = yaml.safe_load((small_session / "session.yaml").read_text())["trials"][0]["tubes"]
    slot, tube = next(iter(declared.items()))
    (tmp_path / "wrong.csv").write_text(f"slot,tube\n{slot},{tube}\n")
    again = tubepose(
        "slots", tmp_path / "o", "--out", tmp_path / "p", "--method", "upright", "--expect", tmp_path / "wrong.csv"
    )
    assert again.code == 1
    assert " extra: " in "".join(again.errors)
    assert "!" in again.out
