"""What a registration has to pass: bow, named alternatives, sizes, tops in the slots; on points with known answers."""

import numpy as np
import pytest
import scenes

from tubepose.checks import failed, mark_codes
from tubepose.config import Config, RackConfig
from tubepose.labware import RackModel, load_rack, load_tube
from tubepose.rack import RackStatus, register_rack
from tubepose.rack.alternatives import alternatives, gains, lookalikes
from tubepose.rack.face import face_grid, look_at_face
from tubepose.rack.fit import top_frame
from tubepose.rack.fit_kernels import bow_at
from tubepose.rack.size import measure_size
from tubepose.rack.tops_in_slots import tops_in_slots
from tubepose.transforms import HALF_TURN, QUARTER_TURN, transform_points

CONFIG = Config()
SOFT = load_rack("chen2023-soft-5x10")
HARD = load_rack("chen2023-hard-5x10")
FIVE, TEN = load_rack("round-5ml-3x4"), load_rack("round-10ml-3x4")
CAPPED = load_tube("blood-16x100")
SPACING_M = 0.6e-3
BOW = np.array([1.5e-3, -2.0e-3, 0.3e-3])
FLAT = np.zeros(3)


def changed(rack: RackModel, **changes: object) -> RackModel:
    """A rack whose file says something else."""
    data = {key: value for key, value in rack.model_dump().items() if value not in (None, ())}
    grid = data["grid"] | {key: value for key, value in changes.items() if key in data["grid"]}
    slot = grid["slot"] | {key: value for key, value in changes.items() if key in grid["slot"]}
    rest = {key: value for key, value in changes.items() if key in data}
    return RackModel.model_validate(data | rest | {"name": "changed", "grid": grid | {"slot": slot}})


def scan(rack: RackModel, bow_m: np.ndarray = FLAT, *, floors: bool = True, seed: int = 0) -> np.ndarray:
    """Points of an empty rack's face, bowed, and of the table beside it, in the rack's frame; floors too."""
    rng = np.random.default_rng(seed)
    top = scenes.rack_top(rack, seed, SPACING_M)
    top[:, 2] += bow_at(bow_m, *(top[:, :2] / (rack.outline_m / 2)).T)
    half = rack.outline_m / 2 + 0.04
    table = rng.uniform(-half, half, (int(4 * half.prod() / SPACING_M**2), 2))
    table = table[np.any(np.abs(table) > rack.outline_m / 2 + 8e-3, axis=1)]
    parts = [top, np.column_stack([table, np.zeros(len(table))])]
    return np.vstack([*parts, scenes.slot_floors(rack, seed)] if floors else parts)


def seen_at(rack: RackModel, points_m: np.ndarray, yaw_rad: float = 0.4, tilt_rad: float = 0.12):
    """Points (N, 3) of the rack's frame as a camera sees them, and where it stands."""
    T = scenes.camera_from_rack(rack, yaw_rad=yaw_rad, tilt_rad=tilt_rad)
    return scenes.seen_past_the_top(transform_points(T, points_m), rack, T), T


def codes(pose) -> set[str]:
    return {check.code for check in failed(pose.checks)}


@pytest.mark.parametrize("bow", [FLAT, BOW, -BOW, np.array([0.0, 2.5e-3, 0.0])], ids=["flat", "+", "-", "short side"])
def test_a_bowed_face_is_registered_with_its_bow(bow):
    points, T = seen_at(SOFT, scan(SOFT, bow))
    pose = register_rack(points, SOFT, CONFIG)
    assert pose.status is RackStatus.OK, pose.reason
    T_found = min((pose.T_camera_rack, pose.T_camera_rack @ HALF_TURN), key=lambda F: -F[:3, 0] @ T[:3, 0])
    assert scenes.angle_deg(T_found[:3, :3], T[:3, :3]) < 0.03
    assert np.linalg.norm((top_frame(T_found, SOFT) - top_frame(T, SOFT))[:3, 3]) < 0.1e-3
    np.testing.assert_allclose(pose.bow_m, bow, atol=0.1e-3)


def test_a_flat_face_has_no_bow_at_all():
    points, _ = seen_at(SOFT, scan(SOFT))
    pose = register_rack(points, SOFT, CONFIG)
    assert not pose.bow_m.any()
    assert np.all(pose.bow_std_m < 0.1e-3)


GRID = SOFT.grid
WRONG = {
    "a row fewer, at one side": (
        {"rows": 4, "offset_mm": (0.0, GRID.pitch_mm[1] / 2)}, {"row_more", "other_rack"},
    ),
    "a row more, outline grown": (
        {"rows": 6, "outline_mm": (192.5, 95.5 + GRID.pitch_mm[1])}, {"row_fewer", "not_in_view"},
    ),
    "a column fewer, outline cut": (
        {"columns": 9, "outline_mm": (192.5 - GRID.pitch_mm[0], 95.5)},
        {"column_more", "beside_outline", "slot_step", "other_rack", "two_places"},
    ),
    "pitch along x 2 % larger": ({"pitch_mm": (18.5 * 1.02, 17.7)}, {"pitch_x", "other_rack"}),
    "pitch along y 4 % larger": ({"pitch_mm": (18.5, 17.7 * 1.04)}, {"pitch_y", "other_rack"}),
    "floor 10 mm higher": ({"floor_mm": 13.5}, {"floor"}),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_file_is_refused_for_what_is_wrong_with_it(what):
    changes, expected = WRONG[what]
    points, _ = seen_at(SOFT, scan(SOFT))
    assert register_rack(points, SOFT, CONFIG).status is RackStatus.OK
    pose = register_rack(points, changed(SOFT, **changes), CONFIG)
    assert pose.status is not RackStatus.OK
    assert codes(pose) & expected, pose.reason


@pytest.mark.parametrize(("true", "asked"), [(FIVE, TEN), (TEN, FIVE)], ids=["wider file", "narrower file"])
@pytest.mark.parametrize("floors", [True, False])
def test_a_rack_of_the_same_outline_and_pitch_with_other_openings_is_refused(true, asked, floors):
    points, _ = seen_at(true, scan(true, floors=floors))
    assert register_rack(points, true, CONFIG).status is RackStatus.OK
    pose = register_rack(points, asked, CONFIG)
    assert pose.status is not RackStatus.OK
    assert codes(pose) & {"openings", "other_rack", "floor", "in_openings"}, pose.reason


@pytest.mark.parametrize("share", [-0.02, 0.01, 0.02])
def test_a_cloud_of_another_scale_is_refused_or_marked(share):
    points, _ = seen_at(SOFT, scan(SOFT))
    pose = register_rack(points * (1 + share), SOFT, CONFIG)
    marks = {check.code for check in pose.checks if not check.passed}
    assert "scale" in marks or pose.status is not RackStatus.OK


@pytest.mark.parametrize("stretch", [(0.01, 0.0), (0.0, -0.012), (0.008, 0.008)])
def test_another_pitch_is_measured_within_its_stated_error(stretch):
    truth = changed(SOFT, pitch_mm=tuple(np.array(GRID.pitch_mm) * (1 + np.array(stretch))))
    points, T = seen_at(truth, scan(truth))
    face = look_at_face(points, T, SOFT, 0.4e-3, face_grid(SOFT, SPACING_M, 0.03), SPACING_M)
    size = measure_size(face, SOFT)
    off = np.abs(size.stretch - stretch) / size.std[:2]
    assert np.all(off < 3.5), (size.stretch, size.std)
    assert np.all(size.std[:2] < 0.004)


def test_sizes_turn_with_the_rack():
    points, T = seen_at(SOFT, scan(SOFT))
    face = look_at_face(points, T, SOFT, 0.4e-3, face_grid(SOFT, SPACING_M, 0.03), SPACING_M)
    size = measure_size(face, SOFT)
    turned = size.quarter_turned()
    np.testing.assert_array_equal(turned.stretch, size.stretch[::-1])
    np.testing.assert_array_equal(turned.std, size.std[[1, 0, 2, 4, 3]])


def test_no_alternative_is_likelier_than_the_right_file():
    points, T = seen_at(SOFT, scan(SOFT))
    face = look_at_face(points, T, SOFT, 0.4e-3, face_grid(SOFT, SPACING_M, 0.03), SPACING_M)
    found = {gain.code: gain.nats for gain in gains(face, SOFT)}
    assert set(found) == {
        "no_openings", "other_rack", "row_more", "row_fewer", "column_more", "column_fewer",
    }  # fmt: skip
    assert max(found.values()) < -100


def test_every_alternative_differs_from_its_rack():
    for rack in (SOFT, FIVE, load_rack("quincunx-17mm-8"), load_rack("mixed-6x15ml-4x50ml")):
        for other in alternatives(rack, face_grid(rack, SPACING_M, 0.03)):
            assert len(other.rows) > 20, (rack.name, other.code)


def test_racks_that_look_alike_have_nearly_one_outline():
    assert HARD in lookalikes(SOFT)
    assert TEN in lookalikes(FIVE)
    assert SOFT not in lookalikes(SOFT)
    assert FIVE not in lookalikes(SOFT)


def test_cells_say_solid_open_standing_or_nothing():
    """Four squares of points: on the face, below it, above it, and none between them."""
    T = scenes.camera_from_rack(SOFT)
    grid = face_grid(SOFT, SPACING_M, 0.03)
    square = np.stack(np.meshgrid(np.linspace(-8e-3, 8e-3, 60), np.linspace(-8e-3, 8e-3, 60)), axis=-1).reshape(-1, 2)

    def at(x_m: float, y_m: float, over_m: float) -> np.ndarray:
        return np.column_stack([square + np.array([x_m, y_m]), np.full(len(square), SOFT.height_m + over_m)])

    points = np.vstack([at(-0.05, 0.0, 0.0), at(0.05, 0.0, -5e-3), at(0.0, 0.03, 30e-3), at(0.0, -0.03, 0.0)])
    face = look_at_face(transform_points(T, points), T, SOFT, 0.4e-3, grid, SPACING_M)
    cell = {
        name: tuple(np.rint((np.array(place) - grid.low_m) / grid.cell_m).astype(int))
        for name, place in (("solid", (-0.05, 0.0)), ("open", (0.05, 0.0)), ("over", (0.0, 0.03)), ("none", (0.0, 0.0)))
    }
    assert face.solid[cell["solid"]] == 1
    assert face.solid[cell["open"]] == 0
    assert face.standing[cell["over"]]
    assert not face.seen[cell["over"]]
    assert face.nothing[cell["none"]]
    assert not face.nothing[0, 0]  # beyond what was seen


def tops(rack: RackModel, stretch: float = 0.0, bow_m: np.ndarray = FLAT, lean_m: float = 0.0) -> np.ndarray:
    """Discs of caps over every slot, rack frame: upright, or pushed apart along x; along the normal of a bowed face."""
    rng = np.random.default_rng(1)
    over_m = rack.floor_m + CAPPED.height_m - rack.height_m
    half, found = rack.outline_m / 2, []
    for slot in rack.all_slots:
        uv = slot.center_m / half
        slope = (2 * bow_m[:2] * uv + bow_m[2] * uv[::-1]) / half
        middle = slot.center_m * (1 + stretch * np.array([1, 0])) - slope * over_m + rng.normal(0, lean_m, 2)
        r, phi = 7e-3 * np.sqrt(rng.uniform(size=200)), rng.uniform(0, 2 * np.pi, 200)
        disc = middle + np.column_stack([r * np.cos(phi), r * np.sin(phi)])
        found.append(np.column_stack([disc, np.full(200, rack.height_m + over_m)]))
    return np.vstack(found)


@pytest.mark.parametrize(("stretch", "bow"), [(0.0, FLAT), (0.02, FLAT), (0.0, BOW)], ids=["as is", "apart", "bowed"])
def test_tops_tell_how_far_apart_slots_lie(stretch, bow):
    T = scenes.camera_from_rack(SOFT)
    seen = tops_in_slots(transform_points(T, tops(SOFT, stretch, bow, 0.2e-3)), top_frame(T, SOFT), bow, SOFT)
    assert seen.count == len(SOFT.all_slots)
    assert seen.median_share < 0.12
    assert abs(seen.stretch[0] - stretch) < 2 * seen.std[0]
    assert abs(seen.stretch[1]) < 2 * seen.std[1]
    assert np.all(seen.std < 0.02)


def test_tops_half_a_slot_off_are_told():
    T = scenes.camera_from_rack(SOFT)
    moved = tops(SOFT) + np.array([GRID.pitch_mm[0] * 0.4e-3, 0.0, 0.0])
    seen = tops_in_slots(transform_points(T, moved), top_frame(T, SOFT), FLAT, SOFT)
    assert seen.median_share > CONFIG.rack.max_tops_off


def test_no_tops_tell_nothing():
    T = scenes.camera_from_rack(SOFT)
    points = transform_points(T, scenes.rack_top(SOFT))
    seen = tops_in_slots(points, top_frame(T, SOFT), FLAT, SOFT)
    assert seen.count == 0
    assert np.all(np.isinf(seen.std))


def test_a_bow_turns_with_the_rack():
    square = RackModel.model_validate(
        {
            "kind": "rack", "name": "square", "outline_mm": [110, 110], "height_mm": 60, "floor_mm": 4,
            "grid": {"rows": 5, "columns": 5, "pitch_mm": [20, 20], "slot": {"shape": "square", "size_mm": [16, 16]}},
        }
    )  # fmt: skip
    points, T = seen_at(square, scan(square, BOW))
    pose = register_rack(points, square, CONFIG)
    assert pose.status is RackStatus.OK, pose.reason
    turns = [np.linalg.matrix_power(QUARTER_TURN, k) for k in range(4)]
    k = int(np.argmin([scenes.angle_deg(pose.T_camera_rack[:3, :3], (T @ turn)[:3, :3]) for turn in turns]))
    expected = BOW if k % 2 == 0 else np.array([BOW[1], BOW[0], -BOW[2]])
    np.testing.assert_allclose(pose.bow_m, expected, atol=0.1e-3)


def beside_clear_tubes(rack: RackModel, points: np.ndarray, seed: int = 0) -> np.ndarray:
    """The points of a face with tubes in half of its slots, whose bent light sinks much of the face beside them."""
    rng = np.random.default_rng(seed)
    parts, sunk = [points], np.zeros(len(points), bool)
    for slot in rack.all_slots[::2]:
        reach = slot.half_size_m[0]
        disc = rng.uniform(-reach, reach, (2000, 2))
        disc = disc[np.hypot(*disc.T) < 0.8 * reach] + slot.center_m
        parts.append(np.column_stack([disc, np.full(len(disc), rack.height_m + 0.04)]))
        off = points[:, :2] - slot.center_m
        sunk |= (np.abs(off[:, 0]) < reach) & (off[:, 1] < -0.8 * reach) & (off[:, 1] > -reach - 8e-3)
    sunk &= (np.abs(points[:, 2] - rack.height_m) < 2e-3) & (rng.random(len(points)) < 0.6)
    parts[0] = points - np.where(sunk, 6e-3, 0.0)[:, None] * [0.0, 0.0, 1.0]
    return np.vstack(parts)


def test_light_that_tubes_bend_makes_no_opening_wider():
    points, T = seen_at(TEN, beside_clear_tubes(TEN, scan(TEN)))
    size = measure_size(look_at_face(points, T, TEN, 0.4e-3, face_grid(TEN, SPACING_M, 0.03), SPACING_M), TEN)
    wider_m, std_m = size.wider_openings_m()
    assert abs(2 * wider_m) < 0.8e-3
    assert abs(wider_m) < 4 * std_m
    assert register_rack(points, TEN, CONFIG).status is RackStatus.OK


@pytest.mark.parametrize(("calibrated", "marked"), [(0.0005, False), (0.05, True)])
def test_a_distance_that_nothing_checks_is_marked(calibrated, marked):
    points, _ = seen_at(FIVE, scan(FIVE))
    config = CONFIG.model_copy(update={"rack": RackConfig(scale_std=calibrated)})
    pose = register_rack(points, FIVE, config)
    assert pose.status is RackStatus.OK
    assert ("scale_unknown" in mark_codes(pose.checks)) == marked
