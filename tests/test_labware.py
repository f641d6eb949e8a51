"""Definitions, catalogue, geometry and drawings of labware."""

import pickle
import re
import subprocess
import sys
from importlib.resources import files
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from pydantic import BaseModel

from tubepose.errors import LabwareError, TubePoseError
from tubepose.labware import (
    CapModel,
    RackModel,
    SlotModel,
    TubeModel,
    catalogue,
    load_cap,
    load_rack,
    load_tube,
    read_labware,
)
from tubepose.labware.drawing import draw_labware
from tubepose.labware.racks import SlotGrid
from tubepose.labware.reading import read_yaml
from tubepose.labware.tubes import TubeBody, TubeCap, WallOptics

TUBES = [item for item in catalogue().values() if isinstance(item, TubeModel)]
RACKS = [item for item in catalogue().values() if isinstance(item, RackModel)]
TEN_LINES = """\
kind: rack
name: my-rack
outline_mm: [100, 60]
height_mm: 50
floor_mm: 3
grid:
  rows: 2
  columns: 4
  pitch_mm: [22, 24]
  slot: {shape: round, size_mm: [17, 17]}
"""


def written(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "item.yaml"
    file.write_text(text)
    return file


def tube_data(**body: object) -> dict[str, object]:
    shape = {"height_mm": 100, "bottom_diameter_mm": 14, "top_diameter_mm": 16, "material": "opaque", **body}
    return {"kind": "tube", "name": "t", "body": shape}


def solid_volume(profile_zr: np.ndarray) -> float:
    """Volume swept by a profile (z, r) about the axis, by cones."""
    z, r = profile_zr.T
    return float(np.pi / 3 * np.sum(np.diff(z) * (r[1:] ** 2 + r[1:] * r[:-1] + r[:-1] ** 2)))


# Catalogue


def test_catalogue_has_the_names_that_stay() -> None:
    racks = {"chen2023-soft-5x10", "chen2023-hard-5x10"}
    tubes = {"chen2023-tube-1", "chen2023-tube-2", "chen2023-tube-3"}
    assert racks <= {rack.name for rack in RACKS}
    assert tubes <= {tube.name for tube in TUBES}
    assert load_cap("printed-square-16.7").square_m == pytest.approx(0.0167)


def test_catalogue_files_are_named_as_their_definitions() -> None:
    for entry in (files("tubepose.labware") / "catalogue").iterdir():
        if entry.name.endswith(".yaml"):
            assert yaml.safe_load(entry.read_text(encoding="utf-8"))["name"] == entry.name.removesuffix(".yaml")


@pytest.mark.parametrize("item", catalogue().values(), ids=lambda item: item.name)
def test_catalogue_says_where_measures_come_from(item: RackModel | TubeModel | CapModel) -> None:
    assert item.description
    assert len(item.source) > 30


@pytest.mark.parametrize(
    ("name", "pitch_mm", "size_mm", "outline_mm"),
    [
        ("chen2023-soft-5x10", (18.5, 17.7), (16.5, 16.5), (192.5, 95.5)),
        ("chen2023-hard-5x10", (18, 19), (16.5, 17), (191, 95.3)),
    ],
)
def test_the_papers_racks(
    name: str, pitch_mm: tuple[float, float], size_mm: tuple[float, float], outline_mm: tuple[float, float]
) -> None:
    rack = load_rack(name)
    a1, a2, b1 = (rack.slot(slot).center_m for slot in ("A1", "A2", "B1"))
    assert_allclose(a2 - a1, [pitch_mm[0] * 1e-3, 0], atol=1e-12)
    assert_allclose(a1 - b1, [0, pitch_mm[1] * 1e-3], atol=1e-12)
    assert_allclose(rack.slot("C7").half_size_m * 2e3, size_mm)
    assert_allclose(rack.outline_m * 1e3, outline_mm)
    assert_allclose(rack.slot_centers_m.mean(axis=0), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "count", "first", "last"),
    [
        ("chen2023-soft-5x10", 50, "A1", "E10"),
        ("chen2023-hard-5x10", 50, "A1", "E10"),
        ("steel-round-13mm-5x10", 50, "A1", "E10"),
        ("steel-round-16mm-5x10", 50, "A1", "E10"),
        ("steel-round-13mm-5x10-large", 50, "A1", "E10"),
        ("steel-round-16mm-5x10-large", 50, "A1", "E10"),
        ("round-5ml-3x4", 12, "A1", "C4"),
        ("round-10ml-3x4", 12, "A1", "C4"),
        ("quincunx-17mm-8", 8, "A1", "C3"),
        ("mixed-6x15ml-4x50ml", 10, "A1", "B4"),
    ],
)
def test_racks_have_their_slots(name: str, count: int, first: str, last: str) -> None:
    rack = load_rack(name)
    names = [slot.name for slot in rack.all_slots]
    assert (len(names), names[0], names[-1]) == (count, first, last)
    assert rack.min_rib_m > 1e-3


def test_every_catalogue_rack_is_tested_for_its_slots() -> None:
    assert len(RACKS) == 10


@pytest.mark.parametrize("tube", TUBES, ids=lambda tube: tube.name)
def test_profiles_are_closed_and_rise(tube: TubeModel) -> None:
    outer, body, cavity = tube.outer_profile_m(), tube.body_profile_m(), tube.cavity_profile_m()
    assert_allclose(body[0], 0, atol=1e-12)
    assert body[-1, 0] == pytest.approx(tube.rim_height_m)
    assert np.all(np.diff(body[:, 0]) >= -1e-12)
    assert np.all(np.diff(cavity[:, 0]) <= 1e-12)
    assert cavity[-1, 1] == 0
    assert cavity[-1, 0] > 0
    assert outer[:, 0].max() == pytest.approx(tube.height_m)
    assert outer[:, 1].max() == pytest.approx(tube.max_radius_m)
    assert np.all(outer[:, 1] >= 0)
    assert (outer[-1, 1] > 0) == tube.is_open
    assert not any(np.array_equal(a, b) for a, b in pairwise(outer))


@pytest.mark.parametrize("tube", TUBES, ids=lambda tube: tube.name)
def test_volumes_are_positive_and_the_wall_is_between_them(tube: TubeModel) -> None:
    body, cavity = solid_volume(tube.body_profile_m()), solid_volume(tube.cavity_profile_m()[::-1])
    assert 0.3 * body < cavity < body


@pytest.mark.parametrize(
    ("name", "millilitres"),
    [("centrifuge-15ml-conical", 15), ("centrifuge-50ml-conical", 50), ("microtube-1.5ml", 1.5)],
)
def test_nominal_volumes_fit_in(name: str, millilitres: float) -> None:
    inside = solid_volume(load_tube(name).cavity_profile_m()[::-1]) * 1e6
    assert millilitres < inside < 1.5 * millilitres


def test_no_class_means_two_tubes() -> None:
    words = [word for tube in TUBES for word in {tube.name, *tube.classes}]
    assert len(words) == len(set(words))
    assert all(tube.name in tube.classes for tube in TUBES)


def test_the_papers_tubes_fit_both_of_its_racks() -> None:
    for rack in ("chen2023-soft-5x10", "chen2023-hard-5x10"):
        slot = load_rack(rack).slot("A1")
        for name in ("chen2023-tube-1", "chen2023-tube-2", "chen2023-tube-3"):
            tube = load_tube(name)
            widest = float(tube.body_radius_m(load_rack(rack).depth_m))
            assert widest < slot.half_size_m.min(), (rack, name)
            assert tube.height_m > load_rack(rack).depth_m + 0.03


def test_known_measures_of_tube_3() -> None:
    tube = load_tube("chen2023-tube-3")
    assert tube.height_m == pytest.approx(0.1055)
    assert tube.max_radius_m == pytest.approx(0.01855 / 2)
    assert not tube.is_open
    assert load_tube("chen2023-tube-1").is_open
    cap = load_cap("printed-square-16.7")
    assert cap.offset_m(tube) == pytest.approx(tube.rim_height_m + 0.005)


# Definitions


def test_ten_lines_make_a_rack(tmp_path: Path) -> None:
    rack = read_labware(written(tmp_path, TEN_LINES))
    assert isinstance(rack, RackModel)
    assert [slot.name for slot in rack.all_slots] == ["A1", "A2", "A3", "A4", "B1", "B2", "B3", "B4"]
    assert_allclose(rack.slot("A1").center_m, [-0.033, 0.012])
    assert_allclose(rack.bottom_center_m(rack.slot("B4")), [0.033, -0.012, 0.003])


def test_load_from_a_file_is_relative_to_its_folder(tmp_path: Path) -> None:
    written(tmp_path, TEN_LINES)
    assert load_rack("item.yaml", tmp_path).name == "my-rack"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("floor_mm: 3", "flor_mm: 3", r"unknown key 'flor_mm'; known keys: .*floor_mm"),
        ("  rows: 2", "  rows: 2\n  depth: 4", r"unknown key 'grid\.depth'; known keys: rows, columns"),
        ("size_mm: [17, 17]", "size_mm: [17, 17], radius: 2", r"unknown key 'grid\.slot\.radius'"),
        ("height_mm: 50", "height_mm: -50", r"height_mm.*greater than 0.*-50"),
        ("height_mm: 50", "height_mm: tall", r"height_mm.*number.*'tall'"),
        ("floor_mm: 3", "floor_mm: 60", r"floor_mm 60\.0 is not below height_mm"),
        ("columns: 4", "columns: 5", r"slot A1 reaches over the outline"),
        ("pitch_mm: [22, 24]", "pitch_mm: [16, 24]", r"slots A1 and A2 overlap"),
        ("[17, 17]", "[17, 18]", r"a round slot has one diameter"),
        ("kind: rack", "kind: rak", r"expected 'kind: rack', 'kind: tube' or 'kind: cap', found 'rak'"),
        ("kind: rack", "kind: tube", r"unknown key 'outline_mm'"),
        ("height_mm: 50\n", "", r"the key 'height_mm' is missing"),
        ("grid:", "grid: [", r"not valid YAML"),
    ],
)
def test_a_wrong_definition_is_refused_in_one_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in TEN_LINES
    with pytest.raises(LabwareError, match=message) as caught:
        read_labware(written(tmp_path, TEN_LINES.replace(old, new)))
    assert "\n" not in str(caught.value)
    assert "item.yaml" in str(caught.value)


def test_grid_and_slots_exclude_each_other(tmp_path: Path) -> None:
    slots = "slots:\n  - {name: A1, center_mm: [0, 0], shape: round, size_mm: [9, 9]}\n"
    with pytest.raises(LabwareError, match="either 'grid' or 'slots'"):
        read_labware(written(tmp_path, TEN_LINES + slots))


def test_slot_names_are_unique(tmp_path: Path) -> None:
    head = TEN_LINES[: TEN_LINES.index("grid:")]
    slots = [f"  - {{name: A1, center_mm: [{x}, 0], shape: round, size_mm: [9, 9]}}\n" for x in (-20, 20)]
    with pytest.raises(LabwareError, match="found twice: A1"):
        read_labware(written(tmp_path, head + "slots:\n" + "".join(slots)))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (tube_data(wall_mm=7), "leaves no room"),
        (tube_data(bottom="conical"), "cone_height_mm goes with"),
        (tube_data(height_mm=6), "is not below height_mm 6: is all of it in millimetres?"),
        (tube_data(height_mm=0.098), "5 mm high or more, found height_mm 0.098: is it in metres?"),
        (tube_data() | {"cap": {"diameter_mm": 15, "height_mm": 5, "top_mm": 0}}, "cap diameter_mm 15.0 is not more"),
        (tube_data(optics={"scattering_per_mm": 0.4}), "optics are those of a see-through wall"),
        (tube_data(material="translucent", optics={"refractive_index": 0.9}), r"body\.optics\.refractive_index.*0\.9"),
        (tube_data(material="translucent", optics={"scattering": 0.4}), r"unknown key 'body\.optics\.scattering'"),
        (tube_data() | {"cap": {"diameter_mm": 18, "height_mm": 99, "top_mm": 1}}, "the cap is 99 mm high, and"),
        (tube_data() | {"cap": {"diameter_mm": 18, "height_mm": 5, "top_mm": 1, "open": True}}, "top_mm must be 0"),
    ],
)
def test_wrong_tubes_are_refused(tmp_path: Path, data: dict[str, object], message: str) -> None:
    with pytest.raises(LabwareError, match=message):
        read_labware(written(tmp_path, yaml.safe_dump(data)))


def test_optics_of_a_wall_are_given_or_those_of_its_material(tmp_path: Path) -> None:
    walls = {
        name: read_labware(written(tmp_path, yaml.safe_dump(tube_data(**body)))).body.wall_optics
        for name, body in {
            "opaque": {},
            "translucent": {"material": "translucent"},
            "clear": {"material": "transparent", "optics": {"refractive_index": 1.57}},
        }.items()
    }
    assert walls["opaque"] is None
    assert walls["translucent"] == WallOptics(refractive_index=1.49, scattering_per_mm=0.4, absorption_per_mm=0.005)
    assert walls["clear"] == WallOptics(refractive_index=1.57, scattering_per_mm=0, absorption_per_mm=0)


def test_a_sunken_cap_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LabwareError, match="would sink below the rim"):
        read_labware(written(tmp_path, "kind: cap\nname: c\nsquare_mm: 17\nthickness_mm: 6\nseat_mm: 5\n"))


def test_unknown_names_are_told_with_a_guess() -> None:
    with pytest.raises(LabwareError, match=r"unknown tube 'chen2023-tube1'; did you mean 'chen2023-tube-1'\?"):
        load_tube("chen2023-tube1")
    with pytest.raises(LabwareError, match="unknown rack 'chen2023-tube-1'"):
        load_rack("chen2023-tube-1")


def test_what_is_equal_hashes_alike_after_copies_and_in_another_process() -> None:
    rack = load_rack("chen2023-soft-5x10")
    before = hash(rack)
    higher = rack.model_copy(update={"height_mm": rack.height_mm + 1})
    again = RackModel.model_validate(rack.model_dump() | {"height_mm": rack.height_mm + 1})
    assert higher == again
    assert hash(higher) == hash(again) != before
    # Texts have other hashes there.
    told = """if True:
        import pickle, sys
        rack = pickle.load(sys.stdin.buffer)
        print(rack in {type(rack).model_validate(rack.model_dump())})"""
    ran = subprocess.run([sys.executable, "-c", told], input=pickle.dumps(rack), capture_output=True, check=True)
    assert ran.stdout.split() == [b"True"]


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LabwareError, match="expected a tube, found a rack"):
        load_tube(str(written(tmp_path, TEN_LINES)))


@settings(max_examples=60)
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.text(max_size=5),
        lambda x: st.lists(x) | st.dictionaries(st.text(max_size=8), x),
        max_leaves=8,
    )
)
def test_any_yaml_gives_an_item_or_one_line(tmp_path_factory: pytest.TempPathFactory, data: object) -> None:
    file = tmp_path_factory.mktemp("any") / "x.yaml"
    for content in (data, {"kind": "rack", "grid": data}, {"kind": "tube", "body": data}):
        file.write_text(yaml.safe_dump(content))
        with pytest.raises(TubePoseError) as caught:
            read_labware(file)
        assert len(str(caught.value).splitlines()) == 1


# Documentation

DOCS = (Path(__file__).parent.parent / "docs" / "labware.md").read_text(encoding="utf-8")


def test_the_examples_in_the_docs_are_valid(tmp_path: Path) -> None:
    examples = re.findall(r"```yaml\n(.*?)```", DOCS, re.DOTALL)
    kinds = [read_labware(written(tmp_path, example)).kind for example in examples]
    assert kinds == ["rack", "rack", "tube"]
    assert len(examples[0].splitlines()) == 10


@pytest.mark.parametrize("model", [RackModel, SlotGrid, SlotModel, TubeModel, TubeBody, WallOptics, TubeCap, CapModel])
def test_every_key_is_in_the_docs(model: type[BaseModel]) -> None:
    words = set(re.findall(r"[a-z_]+", " ".join(re.findall(r"`([^`\n]*)`", DOCS))))
    assert not set(model.model_fields) - words


# Geometry


@pytest.mark.parametrize("shape", ["square", "round"])
def test_boundary_lies_at_distance_zero(shape: str) -> None:
    slot = SlotModel(
        name="A1", center_mm=(3, -4), shape=shape, size_mm=(16, 16), corner_radius_mm=0 if shape == "round" else 2
    )
    assert_allclose(slot.signed_distance_m(slot.boundary_m()), 0, atol=1e-12)
    assert slot.signed_distance_m(slot.center_m) == pytest.approx(-0.008)


def test_top_distance_is_negative_on_ribs_only() -> None:
    rack = load_rack("chen2023-soft-5x10")
    between = (rack.slot("A1").center_m + rack.slot("A2").center_m) / 2
    points = np.array([between, rack.slot("A1").center_m, [0.2, 0.0]])
    assert list(rack.top_signed_distance_m(points) < 0) == [True, False, False]
    assert rack.top_signed_distance_m(points)[0] == pytest.approx(-0.001)


@given(st.floats(5, 40), st.floats(0.0, 1.0), st.sampled_from(["round", "flat"]), st.booleans())
def test_taper_is_linear_between_bottom_and_rim(diameter: float, taper: float, bottom: str, widens: bool) -> None:
    ends = (diameter, diameter + taper) if widens else (diameter + taper, diameter)
    data = tube_data(bottom_diameter_mm=ends[0], top_diameter_mm=ends[1], bottom=bottom)
    tube = TubeModel.model_validate(data)
    start = tube.body.bottom_height_mm * 1e-3
    middle = tube.body_radius_m((start + tube.rim_height_m) / 2)
    assert middle == pytest.approx(np.mean(ends) * 0.5e-3)
    assert tube.body_radius_m(0.0) == pytest.approx(ends[0] * 0.5e-3)


# Drawings


@pytest.mark.parametrize("item", catalogue().values(), ids=lambda item: item.name)
def test_drawing_says_the_measures(item: RackModel | TubeModel | CapModel) -> None:
    figure = draw_labware(item)
    words = [text.get_text() for axes in figure.axes for text in (*axes.texts, axes.title)]
    said = "\n".join(words)
    if isinstance(item, RackModel):
        assert {slot.name for slot in item.all_slots} <= {word.split("\n")[0] for word in words}
        numbers = [*item.outline_mm, item.height_mm, item.floor_mm, item.all_slots[0].size_mm[0]]
    elif isinstance(item, TubeModel):
        numbers = [item.height_mm, item.body.bottom_diameter_mm, item.body.top_diameter_mm]
        numbers += [item.cap.diameter_mm] if item.cap is not None else []
    else:
        numbers = [item.square_mm, item.seat_mm, item.thickness_mm]
    assert [f"{number:g}" for number in numbers if f"{number:g}" not in said] == []


def test_section_shows_every_slot_that_it_cuts() -> None:
    figure = draw_labware(load_rack("mixed-6x15ml-4x50ml"))
    cut = {text.get_text() for text in figure.axes[1].texts}
    assert {"A1", "A2", "A3", "A4"} <= cut
    assert not {"B1", "C1", "B3"} & cut


def test_two_readings_of_a_file_are_the_same_rack_whatever_was_computed_of_them():
    path = Path(str(files("tubepose.labware") / "catalogue" / "steel-round-13mm-5x10.yaml"))
    first, second = read_labware(path), read_labware(path)
    assert first.slot_centers_m.shape == second.slot_centers_m.shape  # kept in both from now on
    assert first == second
    assert len({first, second}) == 1
    assert first != first.model_copy(update={"name": "another"})
    assert first != "steel-round-13mm-5x10"


@pytest.mark.parametrize("kind", ["[rack]", "{rack: 1}", "3", "racks"])
def test_a_kind_that_is_none_is_one_line(tmp_path, kind):
    (tmp_path / "r.yaml").write_text(f"kind: {kind}\nname: r\n")
    with pytest.raises(LabwareError, match="expected 'kind: rack', 'kind: tube' or 'kind: cap', found"):
        read_labware(tmp_path / "r.yaml")


@pytest.mark.parametrize("value", [".inf", ".nan", "-.inf"])
def test_no_length_is_infinite(tmp_path, value):
    text = (
        (files("tubepose.labware") / "catalogue" / "chen2023-tube-2.yaml")
        .read_text()
        .replace("height_mm:", f"height_mm: {value} #", 1)
    )
    (tmp_path / "t.yaml").write_text(text)
    with pytest.raises(LabwareError, match="finite number"):
        read_labware(tmp_path / "t.yaml")


# Measures and names that no labware has


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("chen2023-soft-5x10", {"name": "../../x"}, "files and rows are named by it, so it cannot hold '/'"),
        ("chen2023-soft-5x10", {"name": "a\nb"}, r"cannot hold '\\n'"),
        ("chen2023-soft-5x10", {"name": ".hidden"}, "a dot at the start"),
        ("chen2023-soft-5x10", {"name": "x" * 81}, "at most 80 characters"),
        ("chen2023-soft-5x10", {"name": "unknown"}, "is a word of the tables"),
        ("chen2023-soft-5x10", {"outline_mm": [0.2, 0.1]}, "a rack is 2 mm or more each way, .*: are they metres"),
        ("chen2023-soft-5x10", {"floor_play_mm": 100}, "more than half of the widest slot"),
        ("chen2023-soft-5x10", {"height_mm": True}, "height_mm: expected no yes or no"),
        ("chen2023-soft-5x10", {"outline_mm": [True, 90]}, "outline_mm: expected no yes or no"),
        ("chen2023-tube-2", {"classes": ["rack"]}, "'rack' is a detector's word for racks"),
        ("chen2023-tube-2", {"name": "rack"}, "name: 'rack' is a detector's word for racks"),
        ("chen2023-tube-2", {"name": "all"}, "is a word of the tables"),
        ("chen2023-tube-2", {"name": "NaN"}, "is a word of the tables"),
        ("chen2023-tube-2", {"classes": "red-cap"}, r"classes: expected a list in brackets"),
    ],
)
def test_what_no_labware_has_is_refused(tmp_path, name, changes, words):
    data = catalogue()[name].model_dump(mode="json", exclude_none=True) | changes
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
    with pytest.raises(LabwareError, match=words):
        read_labware(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("kind: rack\nheight_mm: 60\nheight_mm: 10\n", "the key 'height_mm' is there twice"),
        ("kind: rack\ngrid: {rows: 2, rows: 3}\n", "the key 'rows' is there twice"),
        ("kind: rack\nsource: 2024-13-45\n", "not valid YAML: month must be in 1..12"),
        ("kind: " + "[" * 2000, "not valid YAML"),
        ("? [a, b]\n: 1\n", "not valid YAML: while constructing a mapping"),
    ],
)
def test_yaml_that_loses_a_value_or_is_none_is_one_line(tmp_path, text, words):
    (tmp_path / "a.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(LabwareError, match=words):
        read_labware(tmp_path / "a.yaml")


def test_a_cap_that_floats_and_a_round_slot_with_corners_are_refused():
    cap = catalogue()["chen2023-tube-2"].cap.model_dump()
    with pytest.raises(ValueError, match="the cap floats over the rim"):
        TubeCap(**cap | {"top_mm": cap["height_mm"] + 1})
    with pytest.raises(ValueError, match="corner_radius_mm is of square openings"):
        SlotModel(name="A1", center_mm=(0, 0), shape="round", size_mm=(16, 16), corner_radius_mm=4)


def test_a_merged_key_may_be_overridden(tmp_path):
    text = "a: &A {k: 1}\nx: {y: &B {<<: *A, k: 2}}\nc: {<<: *B, j: 3}\n"
    (tmp_path / "a.yaml").write_text(text, encoding="utf-8")
    assert read_yaml(tmp_path / "a.yaml", LabwareError) == yaml.safe_load(text)
