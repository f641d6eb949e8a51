"""Racks of Opentrons and PyLabRobot: what their files say, and what is asked for."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from commands import tubepose
from hypothesis import given, settings
from hypothesis import strategies as st

from tubepose.errors import LabwareError
from tubepose.labware import load_rack, read_labware
from tubepose.labware.racks import RackModel

PITCH = (20.0, 19.5)
SIDE = {"height_mm": 60, "floor_mm": 3, "slot": {"shape": "round", "size_mm": [11, 11]}}
CENTERS = {f"{'ABC'[r]}{c + 1}": (15 + c * PITCH[0], 55 - r * PITCH[1]) for c in range(4) for r in range(3)}


def opentrons(**changes) -> dict:
    wells = {
        name: {"depth": 40, "shape": "circular", "diameter": 8.7, "x": x, "y": y, "z": 41.3}
        for name, (x, y) in CENTERS.items()
    }
    data = {
        "ordering": [[f"{row}{c + 1}" for row in "ABC"] for c in range(4)],
        "metadata": {"displayName": "Rack", "displayCategory": "tubeRack"},
        "dimensions": {"xDimension": 90.0, "yDimension": 72.0, "zDimension": 84},
        "wells": wells, "parameters": {"loadName": "my_tuberack"}, "schemaVersion": 2, "version": 1,
        "cornerOffsetFromSlot": {"x": 0, "y": 0, "z": 0},
    }  # fmt: skip
    return data | changes


def pylabrobot(**changes) -> dict:
    still = {"x": 0, "y": 0, "z": 0, "type": "Rotation"}
    children = [
        {"name": f"rack_holder_{name}", "type": "ResourceHolder", "size_x": 16.0, "size_y": 15.0, "size_z": 0.0,
         "location": {"x": x - 8, "y": y - 7.5, "z": 4, "type": "Coordinate"}, "rotation": still, "children": []}
        for name, (x, y) in CENTERS.items()
    ]  # fmt: skip
    data = {
        "name": "rack", "type": "TubeRack", "size_x": 90.0, "size_y": 72.0, "size_z": 50, "location": None,
        "rotation": still, "category": "tube_rack", "model": None, "children": children,
        "ordering": {name: f"rack_holder_{name}" for name in CENTERS},
    }  # fmt: skip
    return data | changes


def write(folder: Path, data: object, side: object = SIDE) -> Path:
    (folder / "rack.json").write_text(data if isinstance(data, str) else json.dumps(data))
    if side is not None:
        (folder / "rack.side.yaml").write_text(yaml.safe_dump(side))
    return folder / "rack.json"


def check(rack: object) -> None:
    assert isinstance(rack, RackModel)
    assert rack.outline_mm == (90, 72)
    assert [slot.name for slot in rack.all_slots] == [f"{row}{column}" for row in "ABC" for column in range(1, 5)]
    for slot in rack.all_slots:
        x, y = CENTERS[slot.name]
        assert slot.center_mm == pytest.approx((x - 45, y - 36))
    assert rack.slot("A1").center_mm[1] > rack.slot("C1").center_mm[1]


@pytest.mark.parametrize("schema", [2, 3])
def test_opentrons_rack(tmp_path, schema):
    rack = read_labware(write(tmp_path, opentrons(schemaVersion=schema)))
    check(rack)
    assert (rack.name, rack.height_mm, rack.floor_mm) == ("my_tuberack", 60, 3)
    assert {slot.size_mm for slot in rack.all_slots} == {(11, 11)}


@pytest.mark.parametrize("ordering", ["mapping", "list", None])
def test_pylabrobot_rack(tmp_path, ordering):
    kinds = {"mapping": pylabrobot()["ordering"], "list": list(CENTERS), None: None}
    data = pylabrobot(ordering=kinds[ordering])
    rack = read_labware(write(tmp_path, data))
    assert sorted(slot.name for slot in rack.all_slots) == sorted(CENTERS)
    if ordering == "mapping":
        assert rack.name == "rack"


def test_slots_of_several_sizes(tmp_path):
    big = {"shape": "square", "size_mm": [14, 13], "corner_radius_mm": 1}
    rack = load_rack(str(write(tmp_path, opentrons(), SIDE | {"slots": {"A1, B2": big}, "name": "mixed"})))
    assert rack.name == "mixed"
    assert [slot.name for slot in rack.all_slots if slot.shape == "square"] == ["A1", "B2"]


@pytest.mark.parametrize("data", [opentrons(), pylabrobot()])
def test_what_is_missing_is_asked_for_and_the_hint_works(tmp_path, data):
    path = write(tmp_path, data, None)
    with pytest.raises(
        LabwareError, match="gives outline, slot centres and names; the rest has to be measured"
    ) as told:
        read_labware(path)
    assert f"write {tmp_path / 'rack.side.yaml'} with 'height_mm: '" in str(told.value)
    for words in ("'floor_mm: '", "'slot: {shape: round, size_mm: [ , ]}'", 'slots: {"A1, ...": {...}}'):
        assert words in str(told.value)
    text = 'height_mm: 60\nfloor_mm: 3\nslot: {shape: round, size_mm: [11, 11]}\nslots: {"A1, A2": '
    (tmp_path / "rack.side.yaml").write_text(text + "{shape: round, size_mm: [12, 12]}}\n")
    assert isinstance(read_labware(path), RackModel)


@pytest.mark.parametrize(
    ("data", "side", "message"),
    [
        (opentrons(schemaVersion=1), SIDE, "schemaVersion 2 or 3, found 1"),
        (opentrons(metadata={"displayCategory": "wellPlate"}), SIDE, "an Opentrons wellPlate; expected a rack"),
        (opentrons(ordering=[["A1"]]), SIDE, "'ordering' names other wells"),
        (opentrons(dimensions={"xDimension": "wide"}), SIDE, "expected a number of millimetres at 'xDimension'"),
        (opentrons(wells={}, ordering=[]), SIDE, "without slots"),
        (pylabrobot(rotation={"x": 0, "y": 0, "z": 90}), SIDE, "that is rotated"),
        (pylabrobot(type="Plate"), SIDE, "a PyLabRobot Plate; expected a rack"),
        (pylabrobot(ordering={"A1": "gone"}), SIDE, "'ordering' does not name the 12 children"),
        ({"a": 1}, SIDE, "expected an Opentrons labware definition"),
        ([1], SIDE, "expected a JSON object, found a list"),
        ("{", SIDE, "not valid JSON"),
        (opentrons(), {"height_mm": 60}, "the key 'floor_mm' is missing"),
        (opentrons(), SIDE | {"depth": 3}, "unknown key 'depth'; known keys: height_mm"),
        (opentrons(), SIDE | {"slots": {"Z9": SIDE["slot"]}}, "no slot Z9; known: A1"),
        (opentrons(), {"height_mm": 60, "floor_mm": 3}, "no opening for slot A1"),
        (opentrons(), SIDE | {"slot": {"shape": "round", "size_mm": [30, 30]}}, "overlap|reaches over"),
    ],
)  # fmt: skip
def test_wrong_files_are_refused_in_one_line(tmp_path, data, side, message):
    with pytest.raises(LabwareError, match=message) as told:
        read_labware(write(tmp_path, data, side))
    assert "\n" not in str(told.value)


VALUES = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4) | st.lists(st.integers(), max_size=3)
)


@settings(max_examples=60, deadline=None)
@given(base=st.sampled_from([opentrons, pylabrobot]), key=st.integers(0, 20), value=VALUES, inner=st.booleans())
def test_any_value_at_any_key_is_read_or_refused(tmp_path_factory, base, key, value, inner):
    data = base()
    place = data
    if inner:
        place = data["wells"]["A1"] if "wells" in data else data["children"][0]
    place[list(place)[key % len(place)]] = value
    path = write(tmp_path_factory.mktemp("rack"), data)
    try:
        read_labware(path)
    except LabwareError as problem:
        told = str(problem)
    else:
        return
    assert "\n" not in told


def test_commands_take_such_files(tmp_path):
    path = write(tmp_path, opentrons())
    shown = tubepose("labware", "show", path)
    assert "my_tuberack (rack)" in shown.out
    assert tubepose("labware", "check", path).out.strip().endswith("ok (rack my_tuberack)")
