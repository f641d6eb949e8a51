"""The level of a full rack by the tops of what stands in it."""

import numpy as np
import pytest
import scenes
from scipy.spatial.transform import Rotation

from tubepose.config import Config
from tubepose.labware import load_rack, load_tube
from tubepose.rack import RackStatus, register_rack, settling, tops
from tubepose.rack.fit import top_frame
from tubepose.rack.tops import LEAST_TOPS, level_by_tops
from tubepose.transforms import make_transform, transform_points

CONFIG = Config()
SOFT = load_rack("chen2023-soft-5x10")
SHORT, LONG, OPEN = (load_tube(name) for name in ("blood-13x75", "chen2023-tube-2", "chen2023-tube-1"))
T_TRUE = scenes.camera_from_rack(SOFT, yaw_rad=0.4, tilt_rad=0.15)
VIEW = scenes.towards_camera(T_TRUE)
SLOTS = SOFT.all_slots


def standing(tubes, slots=SLOTS, lean_rad=0.02):
    """Tubes in slots, each leaning its own way, in the camera frame."""
    rng = np.random.default_rng(1)
    return transform_points(
        T_TRUE,
        np.vstack(
            [
                scenes.tube_surface(
                    tube,
                    scenes.tube_pose(SOFT, slot.name, *rng.uniform(-lean_rad, lean_rad, 2)),
                    SOFT.height_m,
                    spacing_m=0.8e-3,
                    seen_from=VIEW,
                )
                for tube, slot in zip(tubes, slots, strict=True)
            ]
        ),
    )


def ribs(slope=0.0, sunk_m=0.0, shown=1.0):
    """What a camera aslant sees of the top between caps; but for the share `shown`, sunk as stray light sinks it."""
    top = scenes.rack_top(SOFT, spacing_m=0.6e-3)
    for behind_m in np.linspace(0, 10e-3, 5):
        top = scenes.hidden_by(top, [(x, y + behind_m) for x, y in (slot.center_m for slot in SLOTS)], 9e-3)
    rng = np.random.default_rng(0)
    patch = np.floor(top[:, :2] / 6e-3).astype(int) + 20
    top = top[rng.uniform(size=(40, 40))[patch[:, 0], patch[:, 1]] < 0.6]
    stray = rng.uniform(size=len(top)) > shown
    top[stray, 2] += slope * top[stray, 1] - sunk_m
    return transform_points(T_TRUE, top)


def turned(x_deg, y_deg, up_m=0.0):
    """The true frame of the top, turned off its level and lifted."""
    turn = Rotation.from_rotvec(np.deg2rad([x_deg, y_deg, 0.0])).as_matrix()
    return top_frame(T_TRUE, SOFT) @ make_transform(turn, np.array([0.0, 0.0, up_m]))


def level_of(top, tubes, T_camera_top=None):
    """The level from a frame of the top that is half a degree off unless one is given."""
    return level_by_tops(np.vstack([top, tubes]), top, turned(0.5, 0.0) if T_camera_top is None else T_camera_top, SOFT)


def off_level_deg(T_camera_top):
    return float(np.rad2deg(np.arccos(min(1.0, T_camera_top[:3, 2] @ T_TRUE[:3, 2]))))


@pytest.mark.parametrize("start", [(0.0, 0.0), (1.9, -0.4), (-1.2, 1.5)])
def test_caps_tell_the_level_from_any_start(start):
    level = level_of(ribs(), standing([LONG] * 50), turned(*start, up_m=-1.5e-3))
    assert level.count >= 35
    assert off_level_deg(level.T_camera_top) < 0.06
    assert np.all(np.linalg.eigvalsh(level.covariance) > 0)
    up_m = (level.T_camera_top[:3, 3] - top_frame(T_TRUE, SOFT)[:3, 3]) @ T_TRUE[:3, 2]
    assert abs(up_m) < 0.25e-3


def test_tubes_of_other_heights_among_them_do_not_turn_it():
    tubes = [LONG if k % 3 else SHORT for k in range(50)]
    level = level_of(ribs(), standing(tubes), turned(1.5, 0.5))
    assert 28 <= level.count <= tubes.count(LONG)
    assert off_level_deg(level.T_camera_top) < 0.08


def test_a_tube_lifted_out_of_every_third_slot_does_not_turn_it():
    points = standing([LONG] * 50)
    T = top_frame(T_TRUE, SOFT)
    local = (points - T[:3, 3]) @ T[:3, :3]
    lifted = [slot for slot in SLOTS if slot.center_m[1] > 0.02]
    up = np.any([np.hypot(*(local[:, :2] - slot.center_m).T) < 9e-3 for slot in lifted], axis=0)
    points[up] += 4e-3 * T[:3, 2]
    level = level_of(ribs(), points, turned(1.0, 0.0))
    assert off_level_deg(level.T_camera_top) < 0.12


@pytest.mark.parametrize("step_m", [0.5e-3, 0.8e-3, 1.2e-3, 1.5e-3])
def test_two_kinds_in_blocks_of_rows_that_differ_by_little_make_no_level_that_leans(step_m):
    points = standing([LONG] * 50)
    T = top_frame(T_TRUE, SOFT)
    points[(points - T[:3, 3]) @ T[:3, 1] > 9e-3] += step_m * T[:3, 2]
    level = level_of(ribs(), points)
    assert level is None or off_level_deg(level.T_camera_top) < 0.1
    pose = register_rack(np.vstack([ribs(), points]), SOFT, CONFIG)
    assert pose.status is not RackStatus.OK or off_level_deg(pose.T_camera_rack) < 0.1


@pytest.mark.parametrize("count", [LEAST_TOPS - 1, 0])
def test_too_few_tops_tell_nothing(count):
    tubes = [standing([LONG] * count, SLOTS[:: 50 // count][:count])] if count else []
    assert level_of(transform_points(T_TRUE, scenes.rack_top(SOFT)), np.vstack([np.empty((0, 3)), *tubes])) is None


def test_tops_in_one_row_tell_no_level_across_it(monkeypatch):
    row = [slot for slot in SLOTS if abs(slot.center_m[1]) < 1e-3]
    monkeypatch.setattr(tops, "LEAST_TOPS", len(row))
    assert level_of(ribs(), standing([LONG] * len(row), row)) is None


def test_open_tubes_have_no_tops_that_tell_a_level():
    assert level_of(ribs(), standing([OPEN] * 50)) is None


def test_depth_that_scatters_by_millimetres_tells_no_level():
    points = standing([LONG] * 50)
    towards = points / np.linalg.norm(points, axis=1)[:, None]
    rough = points + towards * np.random.default_rng(0).normal(0, 1.5e-3, (len(points), 1))
    assert level_of(ribs(), rough) is None


def test_a_plate_that_lies_aslant_over_slots_is_no_row_of_tops():
    rng = np.random.default_rng(0)
    plate = rng.uniform([-0.095, -0.045, 0.0], [0.095, 0.045, 0.0], (40_000, 3))
    plate[:, 2] = SOFT.height_m + 0.05 + np.tan(np.deg2rad(2.0)) * plate[:, 0] + rng.normal(0, 1e-4, len(plate))
    assert level_of(ribs(), transform_points(T_TRUE, plate)) is None


def test_what_stands_around_a_rack_takes_no_tops_from_it():
    rng = np.random.default_rng(0)
    table = rng.uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 1e-3], (300_000, 3))
    beside = transform_points(T_TRUE, table[np.any(np.abs(table[:, :2]) > 0.11, axis=1)])
    tubes = standing([LONG] * 50)
    assert level_of(ribs(), np.vstack([tubes, beside])).count == level_of(ribs(), tubes).count


def test_heights_of_no_kind_tell_nothing():
    rng = np.random.default_rng(0)
    heap = [transform_points(T_TRUE, np.column_stack([rng.uniform(-4e-3, 4e-3, (200, 2)) + slot.center_m,
            np.full(200, SOFT.height_m + rng.uniform(0.01, 0.1))])) for slot in SLOTS]  # fmt: skip
    assert level_of(ribs(), np.vstack(heap)) is None


def full_rack():
    """Caps over every slot; of what shows between them three quarters are sunk by light, more at one side."""
    return np.vstack([ribs(slope=0.03, sunk_m=1.2e-3, shown=0.2), standing([LONG] * 50)])


def test_a_full_rack_whose_ribs_lean_by_stray_light_is_held_by_its_tubes(monkeypatch):
    points = full_rack()
    half = np.vstack([transform_points(T_TRUE, scenes.rack_top(SOFT)), standing([LONG] * 25, SLOTS[::2])])
    assert register_rack(half, SOFT, CONFIG).level_tops == 0
    pose = register_rack(points, SOFT, CONFIG)
    assert pose.status is RackStatus.OK, pose.reason
    assert off_level_deg(pose.T_camera_rack) < 0.15
    assert pose.level_tops > 40
    turn_std_deg = np.rad2deg(np.sqrt(np.diag(pose.covariance)[:2]))
    assert np.all(turn_std_deg < 0.3)
    assert off_level_deg(pose.T_camera_rack) < 3 * np.hypot(*turn_std_deg)
    monkeypatch.setattr(settling, "level_by_tops", lambda *_: None)
    alone = register_rack(points, SOFT, CONFIG)
    assert alone.status is not RackStatus.OK or off_level_deg(alone.T_camera_rack) > 0.5


def test_another_rack_is_not_made_of_a_full_one_by_its_tubes():
    for name in ("chen2023-hard-5x10", "steel-round-13mm-5x10", "round-10ml-3x4"):
        assert register_rack(full_rack(), load_rack(name), CONFIG).status is not RackStatus.OK
