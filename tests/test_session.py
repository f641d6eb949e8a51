from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from tubepose.capture.hints import SlotHint
from tubepose.capture.session import is_session, load_session
from tubepose.errors import CaptureError, LabwareError
from tubepose.labware import load_tube


def session_keys(**changes) -> dict[str, Any]:
    keys: dict[str, Any] = {
        "format": 1,
        "name": "monday",
        "origin": "recorded",
        "sensor": "PhoXi 3D Scanner M",
        "rack": "chen2023-soft-5x10",
        "printed_cap": "printed-square-16.7",
        "trials": [
            {
                "name": "t1",
                "tubes": {"A1": "chen2023-tube-1", "C5": "chen2023-tube-2", "E10": "chen2023-tube-1"},
                "original": "t1/original",
                "printed": "t1/printed",
                "hint": {"slot": "A1", "pixel": [412, 300]},
            },
            {"name": "t2", "tubes": {}, "original": "t2.mcap"},
        ],
    }
    return keys | changes


def write_session(folder: Path, **changes) -> Path:
    (folder / "session.yaml").write_text(yaml.safe_dump(session_keys(**changes)), encoding="utf-8")
    return folder


def trial(**changes) -> dict[str, Any]:
    return session_keys()["trials"][0] | changes


def test_session_is_read_with_its_labware(tmp_path):
    session = load_session(write_session(tmp_path))
    assert (session.name, session.origin, session.rack.name) == ("monday", "recorded", "chen2023-soft-5x10")
    assert session.printed_cap is not None
    first, second = session.trials
    assert [tube.name for tube in session.tubes_of(first)] == ["chen2023-tube-1", "chen2023-tube-2"]
    assert first.hint is not None
    assert (first.hint.slot, first.hint.pixel) == ("A1", (412.0, 300.0))
    assert (second.printed, second.hint, session.tubes_of(second)) == (None, None, ())


@pytest.mark.parametrize(
    ("given", "hint", "previous"),
    [
        ("A1@412,300", SlotHint(slot="A1", pixel=(412, 300)), False),
        ("A1@0.1,-0.05,0.62", SlotHint(slot="A1", point_m=(0.1, -0.05, 0.62)), False),
        ({"slot": "E10", "toward": "bottom"}, SlotHint(slot="E10", toward="bottom"), False),
        ({"slot": "E10", "point_m": [0, 0, 1]}, SlotHint(slot="E10", point_m=(0, 0, 1)), False),
        ("previous", None, True),
        ("A1@top-left,previous", SlotHint(slot="A1", toward="top-left"), True),
    ],
)
def test_a_trial_takes_every_kind_of_hint(tmp_path, given, hint, previous):
    session = load_session(write_session(tmp_path, trials=[trial(hint=given)]))
    assert (session.trials[0].hint, session.trials[0].previous) == (hint, previous)


def test_a_tube_that_is_named_in_two_ways_is_one_type(tmp_path):
    mine = load_tube("chen2023-tube-1").model_dump(mode="json", exclude_none=True)
    tubes = {"A1": "chen2023-tube-1", "B3": "mine.yaml"}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(mine), encoding="utf-8")
    session = load_session(write_session(tmp_path, trials=[trial(tubes=tubes)]))
    assert [tube.name for tube in session.tubes_of(session.trials[0])] == ["chen2023-tube-1"]
    assert session.types == {"chen2023-tube-1": load_tube("chen2023-tube-1")}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(mine | {"source": "another calliper"}), encoding="utf-8")
    with pytest.raises(LabwareError, match="two different tubes are named 'chen2023-tube-1'; give one of them another"):
        load_session(tmp_path)


def test_session_file_and_folder_are_the_same(tmp_path):
    assert not is_session(tmp_path)
    write_session(tmp_path)
    assert is_session(tmp_path)
    assert load_session(tmp_path / "session.yaml") == load_session(tmp_path)


def test_labware_files_are_looked_for_in_the_session_folder(tmp_path):
    rack = {
        "kind": "rack", "name": "mine", "outline_mm": [100, 60], "height_mm": 50, "floor_mm": 3, "source": "calliper",
        "grid": {"rows": 2, "columns": 3, "pitch_mm": [20, 20], "slot": {"shape": "round", "size_mm": [16, 16]}},
    }  # fmt: skip
    (tmp_path / "rack.yaml").write_text(yaml.safe_dump(rack), encoding="utf-8")
    session = load_session(write_session(tmp_path, rack="rack.yaml", trials=[trial(tubes={"B3": "chen2023-tube-1"})]))
    assert session.rack.name == "mine"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"racks": "x"}, "unknown key 'racks'; known keys: format, name"),
        ({"trials": [trial(tube="x")]}, r"unknown key 'trials\.0\.tube'; known keys: name, tubes, original"),
        ({"format": 2}, r"format: Input should be 1 \(found 2\)"),
        ({"origin": "guessed"}, "origin: Input should be 'recorded' or 'simulated'"),
        ({"trials": []}, "trials"),
        ({"trials": [trial(), trial()]}, "trial names must be unique, found twice: t1"),
        ({"trials": [trial(tubes={"Z9": "chen2023-tube-1"})]}, "trial t1: no slot Z9 in rack .* from A1 to E10"),
        ({"trials": [trial(hint={"slot": "K1", "pixel": [1, 2]})]}, "no slot K1"),
        ({"trials": [trial(hint="K1@top")]}, "no slot K1"),
        ({"trials": [trial(hint="A1@up")]}, r"hint A1@up: expected SLOT@U,V \(a pixel\), SLOT@WHERE"),
        ({"trials": [trial(hint={"slot": "A1"})]}, "one of pixel, toward and point_m for its slot, found none of them"),
        ({"printed_cap": None}, "trial t1 has a printed capture, but the session names no printed_cap"),
    ],
)
def test_wrong_session_is_refused_in_one_line(tmp_path, changes, message):
    with pytest.raises(CaptureError, match=message) as caught:
        load_session(write_session(tmp_path, **changes))
    assert "\n" not in str(caught.value)
    assert "session.yaml" in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rack": "chen2023-soft-5x1"}, r"session\.yaml: unknown rack .* did you mean 'chen2023-soft-5x10'"),
        ({"trials": [trial(tubes={"A1": "nothing"})]}, r"session\.yaml: unknown tube 'nothing'"),
        ({"printed_cap": "chen2023-tube-1"}, "unknown cap 'chen2023-tube-1'"),
    ],
)
def test_unknown_labware_is_named(tmp_path, changes, message):
    with pytest.raises(LabwareError, match=message):
        load_session(write_session(tmp_path, **changes))


def test_missing_and_broken_files_are_refused(tmp_path):
    with pytest.raises(CaptureError, match=r"no session\.yaml found"):
        load_session(tmp_path)
    (tmp_path / "session.yaml").write_text("trials: [", encoding="utf-8")
    with pytest.raises(CaptureError, match="not valid YAML"):
        load_session(tmp_path)
    (tmp_path / "session.yaml").write_text("- a\n", encoding="utf-8")
    with pytest.raises(CaptureError, match="expected a mapping of keys to values, found a list"):
        load_session(tmp_path)
