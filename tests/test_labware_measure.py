"""A rack measured from a scan that it was sampled for: sizes, heights, tops, and what is said where none is there."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
import yaml
from commands import tubepose

from tubepose.capture import write_folder_capture
from tubepose.config import Config
from tubepose.errors import LabwareError
from tubepose.labware import load_rack, load_tube, read_labware
from tubepose.labware.racks import RackModel
from tubepose.labware_measure import MeasuredRack, measure_rack
from tubepose.standing_tops import kinds_of_tops, measure_tops
from tubepose.transforms import invert_transform, transform_points

GRID = RackModel.model_validate(
    {
        "kind": "rack", "name": "odd", "outline_mm": [140, 84], "height_mm": 62, "floor_mm": 5,
        "grid": {"rows": 4, "columns": 7, "pitch_mm": [18.9, 19.7],
                 "slot": {"shape": "round", "size_mm": [14.2, 14.2]}},
    }
)  # fmt: skip
QUINCUNX = load_rack("quincunx-17mm-8")
CAPPED, OPEN = load_tube("blood-13x100"), load_tube("white-tapered-112mm")


def scan(rack: RackModel, tubes: dict[str, object], yaw_rad: float = 0.4, seed: int = 0):
    """A frame of a rack on a table with tubes in it, 0.5 mm between points."""
    rng = np.random.default_rng(seed)
    T = scenes.camera_from_rack(rack, yaw_rad, 0.12)
    table = rng.uniform(-0.15, 0.15, (60_000, 2))
    table = table[np.any(np.abs(table) > rack.outline_m / 2 + 0.01, axis=1)]
    surfaces = [scenes.rack_top(rack, seed, 0.5e-3, 5e-5), scenes.slot_floors(rack, seed)]
    surfaces.append(np.column_stack([table, rng.normal(0, 5e-5, len(table))]))
    for slot, tube in tubes.items():
        pose = scenes.tube_pose(rack, slot, 0.01, -0.02)
        surfaces.append(scenes.tube_surface(tube, pose, rack.height_m, seed, 0.4e-3, 5e-5, scenes.towards_camera(T)))
    points = transform_points(T, np.concatenate(surfaces))
    return scenes.unorganised(seen(points, rack, T))


def seen(points_m, rack, T_camera_rack):
    """The top itself, what stands above it, and what is below it and seen past it."""
    local = transform_points(invert_transform(T_camera_rack), points_m)
    top = np.abs(local[:, 2] - rack.height_m) < 1e-3
    return np.vstack([points_m[top], scenes.seen_past_the_top(points_m[~top], rack, T_camera_rack)])


def found(measured: MeasuredRack) -> dict[str, tuple[float, float]]:
    return {size.quantity: (size.value, size.std) for size in measured.sizes}


TUBES = {"A2": CAPPED, "C5": CAPPED, "D1": CAPPED}


@pytest.fixture(scope="module")
def measured() -> MeasuredRack:
    return measure_rack(scan(GRID, TUBES), Config())


def test_rows_pitch_and_outline_of_an_unknown_rack(measured):
    grid = measured.rack.grid
    assert grid is not None
    assert (grid.rows, grid.columns, grid.slot.shape) == (4, 7, "round")
    sizes = found(measured)
    for name, true in (("pitch_x_mm", 18.9), ("pitch_y_mm", 19.7)):
        assert sizes[name][0] == pytest.approx(true, abs=0.06)
    for name, true in (("outline_x_mm", 140), ("outline_y_mm", 84)):
        assert sizes[name][0] == pytest.approx(true, abs=0.5)
    assert sizes["opening_mm"][0] == pytest.approx(14.2, abs=0.8)
    for value, std in sizes.values():
        assert np.isfinite(value)
        assert std > 0


def test_height_of_the_rack_and_of_its_tubes(measured):
    sizes = found(measured)
    assert sizes["height_mm"][0] == pytest.approx(62, abs=0.15)
    assert sizes["slot_depth_mm"][0] == pytest.approx(57, abs=0.3)
    assert sizes["top_height_mm"][0] == pytest.approx(CAPPED.height_mm, abs=0.3)
    assert sizes["top_diameter_mm"][0] == pytest.approx(CAPPED.cap.diameter_mm, abs=0.5)
    (kind,) = measured.kinds
    assert (kind.count, kind.closed) == (3, True)
    assert (measured.known_height, measured.known_floor) == (True, True)


def test_a_rack_like_another_whatever_its_slots():
    like = QUINCUNX.model_copy(update={"outline_mm": (132.6, 69.6)})
    sizes = found(measure_rack(scan(QUINCUNX, {}), Config(), like))
    assert sizes["outline_x_mm"][0] == pytest.approx(132, abs=0.6)
    nominal = {s.quantity: s.nominal for s in measure_rack(scan(QUINCUNX, {}), Config(), like).sizes}
    assert nominal["outline_x_mm"] == 132.6
    assert nominal["height_mm"] == QUINCUNX.height_mm


def test_no_rack_is_said_in_one_line():
    rng = np.random.default_rng(1)
    table = np.column_stack([rng.uniform(-0.2, 0.2, (20_000, 2)), rng.normal(0.6, 1e-4, 20_000)])
    with pytest.raises(LabwareError, match=r"no rack of slots in rows and columns was found; .*--like NAME") as told:
        measure_rack(scenes.unorganised(table), Config())
    assert "\n" not in str(told.value)


def test_open_tubes_are_told_from_closed_ones():
    rack = load_rack("chen2023-soft-5x10")
    tubes = {"A1": OPEN, "C3": load_tube("chen2023-tube-3")}
    local = np.concatenate(
        [scenes.tube_surface(t, scenes.tube_pose(rack, s), rack.height_m, 3, 0.4e-3, 5e-5) for s, t in tubes.items()]
    )
    # Seen from above: only what is near a tube's top.
    tops = {top.slot: top for top in measure_tops(local, rack)}
    assert tops["C3"].closed
    assert tops["C3"].height_mm == pytest.approx(tubes["C3"].height_mm - 49.5, abs=0.2)
    assert "A1" not in tops or not tops["A1"].closed


def test_tops_of_several_kinds_are_kept_apart():
    rack = load_rack("chen2023-soft-5x10")
    kinds = (load_tube("chen2023-tube-2"), load_tube("chen2023-tube-3"))
    slots = {slot.name: kinds[i % 2] for i, slot in enumerate(rack.all_slots[:7])}
    local = np.concatenate([
        scenes.tube_surface(t, scenes.tube_pose(rack, s), rack.height_m, 3, 0.4e-3, 5e-5, np.array([0, 0, 1.0]))
        for s, t in slots.items()
    ])  # fmt: skip
    found_kinds = kinds_of_tops(measure_tops(local, rack))
    assert [kind.count for kind in found_kinds] == [4, 3]
    for kind, tube in zip(found_kinds, kinds, strict=True):
        assert kind.height_mm == pytest.approx(tube.height_mm - 49.5, abs=0.1)
        assert kind.diameter_mm == pytest.approx(tube.cap.diameter_mm, abs=0.4)
    assert kinds_of_tops(()) == ()


def test_the_command_writes_a_definition_beside_the_nominal(tmp_path):
    write_folder_capture(tmp_path / "shot", scan(GRID, {}))
    (tmp_path / "near.yaml").write_text(
        yaml.safe_dump({"kind": "rack", **GRID.model_dump(mode="json", exclude={"kind", "slots"}), "height_mm": 63})
    )
    done = tubepose(
        "labware", "measure", tmp_path / "shot", "--like", tmp_path / "near.yaml", "--out", tmp_path / "mine.yaml"
    )
    assert done.code == 0, done.err
    rows = {line.split()[0]: line.split() for line in done.out.splitlines()[1:]}
    assert float(rows["height_mm"][4 - 1]) == 63
    assert "4 rows of 7 slots, round openings" in done.err
    rack = read_labware(tmp_path / "mine.yaml")
    assert isinstance(rack, RackModel)
    assert rack.height_mm == pytest.approx(62, abs=0.2)
    wrong = tubepose("labware", "measure", tmp_path / "shot", "--out", tmp_path / "mine.txt")
    assert wrong.code == 1
    assert "expected a .yaml file in a folder that exists" in wrong.err
