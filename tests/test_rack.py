"""Registration of the rack by its edges: recovery, what tells racks and turns apart, and every refusal."""

import dataclasses
import re

import numpy as np
import pytest
import scenes
from scipy.spatial.transform import Rotation

from tubepose.capture.hints import EarlierRack, SlotHint, read_hint
from tubepose.checks import failed
from tubepose.config import Config, RackConfig
from tubepose.labware import RackModel, load_rack, load_tube
from tubepose.rack import RackStatus, register_rack
from tubepose.rack.turns import example_hints
from tubepose.transforms import HALF_TURN, QUARTER_TURN, invert_transform, make_transform, transform_points

CONFIG = Config()
SOFT = load_rack("chen2023-soft-5x10")
HARD = load_rack("chen2023-hard-5x10")
MIXED = load_rack("mixed-6x15ml-4x50ml")
SQUARE = RackModel.model_validate(
    {
        "kind": "rack", "name": "square", "outline_mm": [96, 96], "height_mm": 60, "floor_mm": 4,
        "grid": {"rows": 5, "columns": 5, "pitch_mm": [18, 18], "slot": {"shape": "round", "size_mm": [15, 15]}},
    }
)  # fmt: skip
T_CAMERA_SOFT = scenes.camera_from_rack(SOFT, yaw_rad=0.3, tilt_rad=0.2)


@pytest.fixture(scope="module")
def soft_scan():
    return transform_points(T_CAMERA_SOFT, scenes.rack_top(SOFT))


def assert_same_pose(T_found, T_true, angle_deg=0.1, distance_m=1.5e-4):
    """Within 0.1 degrees and 0.15 mm: a fifth of the scan's spacing."""
    assert scenes.angle_deg(T_found[:3, :3], T_true[:3, :3]) < angle_deg
    assert np.linalg.norm((T_found - T_true)[:3, 3]) < distance_m


def turned_to_match(T_camera_rack, T_true):
    """The same pose, or its half turn if that is nearer: for what geometry cannot tell."""
    return min((T_camera_rack, T_camera_rack @ HALF_TURN), key=lambda T: scenes.angle_deg(T[:3, :3], T_true[:3, :3]))


@pytest.mark.parametrize(
    "name", ["chen2023-soft-5x10", "chen2023-hard-5x10", "steel-round-16mm-5x10", "round-10ml-3x4", "quincunx-17mm-8"]
)
def test_any_yaw_and_tilts_to_25_degrees_are_recovered(name):
    rack = load_rack(name)
    rng = np.random.default_rng(sum(name.encode()))
    for seed, tilt in enumerate(np.deg2rad([25.0, rng.uniform(0, 25)])):
        T_true = scenes.camera_from_rack(rack, rng.uniform(0, 2 * np.pi), tilt, rng.uniform(0.5, 0.7))
        pose = register_rack(transform_points(T_true, scenes.rack_top(rack, seed)), rack, CONFIG)
        assert pose.status is RackStatus.OK
        assert_same_pose(turned_to_match(pose.T_camera_rack, T_true), T_true)
        assert (pose.ambiguous, pose.resolved_by) == (True, "rule")
        assert abs(pose.turn_margin_m) < CONFIG.rack.ambiguous_margin_m
        assert pose.fitness > 0.99
        assert pose.in_slot_share < 0.01
        assert pose.coverage > 0.9


@pytest.mark.parametrize("yaw_deg", [0, 100, 200, 300])
def test_an_irregular_rack_is_told_from_its_half_turn_by_geometry(yaw_deg):
    T_true = scenes.camera_from_rack(MIXED, np.deg2rad(yaw_deg), 0.2)
    pose = register_rack(transform_points(T_true, scenes.rack_top(MIXED)), MIXED, CONFIG)
    assert (pose.status, pose.ambiguous, pose.resolved_by) == (RackStatus.OK, False, "geometry")
    assert pose.turn_margin_m > CONFIG.rack.ambiguous_margin_m
    assert_same_pose(pose.T_camera_rack, T_true)


def test_geometry_outweighs_a_wrong_hint():
    T_true = scenes.camera_from_rack(MIXED, 0.4)
    wrong = scenes.CAMERA.project(
        transform_points(T_true @ HALF_TURN, np.array([*MIXED.slot("A1").center_m, MIXED.height_m]))
    )
    points = transform_points(T_true, scenes.rack_top(MIXED))
    pose = register_rack(points, MIXED, CONFIG, SlotHint(slot="A1", pixel=tuple(wrong)), scenes.CAMERA)
    assert pose.resolved_by == "geometry"
    assert_same_pose(pose.T_camera_rack, T_true)


@pytest.mark.parametrize("turn", [np.eye(4), HALF_TURN], ids=["as-it-is", "half-turn"])
def test_a_hint_decides_for_either_turn(soft_scan, turn):
    T_true = T_CAMERA_SOFT @ turn
    place = transform_points(T_true, np.array([*SOFT.slot("B2").center_m, SOFT.height_m]))
    u, v = scenes.CAMERA.project(place)
    pose = register_rack(soft_scan, SOFT, CONFIG, SlotHint(slot="B2", pixel=(u + 5, v - 5)), scenes.CAMERA)
    assert (pose.ambiguous, pose.resolved_by) == (False, "hint")
    assert_same_pose(pose.T_camera_rack, T_true)


def test_a_hint_halfway_between_the_turns_decides_nothing(soft_scan):
    middle = scenes.CAMERA.project(T_CAMERA_SOFT[:3, 3] + SOFT.height_m * T_CAMERA_SOFT[:3, 2])
    hint = SlotHint(slot="A1", pixel=tuple(middle))
    pose = register_rack(soft_scan, SOFT, CONFIG, hint, scenes.CAMERA)
    assert (pose.ambiguous, pose.resolved_by) == (True, "rule")


@pytest.mark.parametrize("yaw_deg", [10, 190])
def test_a_hint_far_from_both_places_decides_nothing_and_the_note_says_which_turn_is_given(yaw_deg):
    scan = transform_points(scenes.camera_from_rack(SOFT, np.deg2rad(yaw_deg)), scenes.rack_top(SOFT))
    for pixel in ((-5000.0, 300.0), (9000.0, 9000.0)):
        pose = register_rack(scan, SOFT, CONFIG, SlotHint(slot="A1", pixel=pixel), scenes.CAMERA)
        assert (pose.ambiguous, pose.resolved_by) == (True, "rule")
        said = re.fullmatch(
            rf"the hint says that A1 is seen at {pixel[0]:.0f},{pixel[1]:.0f}, but it is at (-?\d+),(-?\d+) in the "
            r"pose given or, the rack turned, at (-?\d+),(-?\d+): point nearer to one of them, .*",
            pose.hint_note,
        )
        assert said
        # Whoever points where it says is understood, and the first place is that of the pose given.
        for place, turn in ((said.group(1, 2), np.eye(4)), (said.group(3, 4), HALF_TURN)):
            told = SlotHint(slot="A1", pixel=(float(place[0]), float(place[1])))
            again = register_rack(scan, SOFT, CONFIG, told, scenes.CAMERA)
            assert (again.resolved_by, again.hint_note) == ("hint", "")
            assert_same_pose(again.T_camera_rack, pose.T_camera_rack @ turn)


@pytest.mark.parametrize("yaw_deg", [10, 80, 170, 280, 350])
def test_a_rack_that_a_quarter_turn_leaves_as_it_is_has_four_turns(yaw_deg):
    T_true = scenes.camera_from_rack(SQUARE, np.deg2rad(yaw_deg))
    scan = transform_points(T_true, scenes.rack_top(SQUARE))
    pose = register_rack(scan, SQUARE, CONFIG)
    assert (pose.ambiguous, pose.resolved_by) == (True, "rule")
    sums = [(pose.T_camera_rack @ np.linalg.matrix_power(QUARTER_TURN, k))[:2, 0].sum() for k in range(4)]
    assert np.argmax(sums) == 0
    place = transform_points(T_true, np.array([*SQUARE.slot("B3").center_m, SQUARE.height_m]))
    u, v = scenes.CAMERA.project(place)
    told = register_rack(scan, SQUARE, CONFIG, SlotHint(slot="B3", pixel=(u + 3, v - 2)), scenes.CAMERA)
    assert (told.ambiguous, told.resolved_by) == (False, "hint")
    assert_same_pose(told.T_camera_rack, T_true)
    # The covariance is about the axes of the pose that is given.
    axes = np.kron(np.eye(2), T_true[:3, :3].T @ pose.T_camera_rack[:3, :3])
    np.testing.assert_allclose(axes.T @ told.covariance @ axes, pose.covariance, rtol=1e-3, atol=2e-11)
    lost = register_rack(scan, SQUARE, CONFIG, SlotHint(slot="B3", pixel=(-900.0, 50.0)), scenes.CAMERA)
    assert len(re.findall(r"-?\d+,-?\d+ (?:or|in)|-?\d+,-?\d+:", lost.hint_note)) == 4


def test_a_hint_without_intrinsics_is_not_used(soft_scan):
    pose = register_rack(soft_scan, SOFT, CONFIG, SlotHint(slot="A1", pixel=(0.0, 0.0)), None)
    assert (pose.ambiguous, pose.resolved_by) == (True, "rule")
    assert pose.hint_note.startswith("the hint for A1 is a pixel, and this cloud has none")
    assert register_rack(soft_scan, SOFT, CONFIG, None, None).hint_note == ""


@pytest.mark.parametrize("turn", [np.eye(4), HALF_TURN], ids=["as-it-is", "half-turn"])
@pytest.mark.parametrize("method", ["edges", "obb-icp"])
def test_hints_without_pixels_decide_for_either_turn(soft_scan, turn, method):
    config = CONFIG.model_copy(update={"rack": RackConfig(method=method)})
    T_true = T_CAMERA_SOFT @ turn
    place = transform_points(T_true, np.array([*SOFT.slot("B2").center_m, SOFT.height_m + 0.05]))
    near = transform_points(T_true, np.array([*SOFT.slot("A1").center_m, SOFT.height_m]))
    told = example_hints(T_true, SOFT)[0]
    hints = {
        "point": SlotHint(slot="B2", point_m=tuple(place + 0.01)),
        "side": SlotHint(slot="A1", toward="left" if near[0] < 0 else "right"),
        "example": read_hint(told).place,
    }
    for hint in hints.values():
        pose = register_rack(soft_scan, SOFT, config, hint)
        assert (pose.ambiguous, pose.resolved_by, pose.hint_note) == (False, "hint", "")
        assert_same_pose(pose.T_camera_rack, T_true, 0.3, 1e-3)


def test_the_examples_name_every_turn_the_one_given_first():
    T_camera_square = scenes.camera_from_rack(SQUARE, np.deg2rad(10))
    assert example_hints(T_camera_square, SQUARE) == (
        "A1@top-left",
        "A1@bottom-left",
        "A1@bottom-right",
        "A1@top-right",
    )
    lone = {"grid": {"rows": 1, "columns": 1, "pitch_mm": [18, 18], "slot": {"shape": "round", "size_mm": [15, 15]}}}
    single = RackModel.model_validate(SQUARE.model_dump(exclude_defaults=True) | {"kind": "rack"} | lone)
    assert example_hints(T_camera_square, single) == ()


@pytest.mark.parametrize(
    ("hint", "words"),
    [
        (
            SlotHint(slot="A1", toward="top"),
            "A1 is seen at the top, which does not tell its places apart: it is at the left in the pose given or, the "
            "rack turned, at the right",
        ),
        (SlotHint(slot="A1", point_m=(0.5, 0.2, 0.6)), "A1 is seen at 0.500,0.200,0.600, but it is at "),
        (EarlierRack(None, 5e-3, "no earlier frame"), "no earlier frame: give a hint for this capture"),
    ],
)
def test_the_note_of_a_hint_without_pixels_says_why_it_decides_nothing(hint, words):
    row = RackModel.model_validate(
        {
            "kind": "rack", "name": "row", "outline_mm": [180, 50], "height_mm": 60, "floor_mm": 4,
            "grid": {"rows": 2, "columns": 8, "pitch_mm": [20, 20], "slot": {"shape": "round", "size_mm": [15, 15]}},
        }
    )  # fmt: skip
    T_true = scenes.camera_from_rack(row)
    pose = register_rack(transform_points(T_true, scenes.rack_top(row)), row, CONFIG, hint)
    assert (pose.ambiguous, pose.resolved_by) == (True, "rule")
    assert words in pose.hint_note


@pytest.mark.parametrize("turn", [np.eye(4), HALF_TURN], ids=["as-it-is", "half-turn"])
def test_a_rack_that_stands_still_is_turned_as_before(soft_scan, turn):
    within = CONFIG.rack.left_alone_m
    for shift_m in (0.0, 0.9 * within):
        T_before = T_CAMERA_SOFT @ turn
        T_before[0, 3] += shift_m
        pose = register_rack(soft_scan, SOFT, CONFIG, EarlierRack(T_before, within))
        assert (pose.ambiguous, pose.resolved_by, pose.hint_note) == (False, "previous", "")
        assert_same_pose(pose.T_camera_rack, T_CAMERA_SOFT @ turn)


@pytest.mark.parametrize("turned_deg", [0.0, 4.0])
def test_a_rack_that_was_moved_may_have_been_turned(soft_scan, turned_deg):
    """Shifted, or turned about one of its corners, which then has not moved."""
    within = CONFIG.rack.left_alone_m
    corner = np.array([*SOFT.outline_m / 2, SOFT.height_m])
    R = Rotation.from_euler("z", turned_deg, degrees=True).as_matrix()
    T_before = T_CAMERA_SOFT @ make_transform(R, corner - R @ corner)
    moved_mm = 2e3 * np.sin(np.deg2rad(turned_deg / 2)) * np.hypot(*SOFT.outline_m)
    if not turned_deg:
        T_before[1, 3] += 1.2 * within
        moved_mm = 1.2e3 * within
    pose = register_rack(soft_scan, SOFT, CONFIG, EarlierRack(T_before, within))
    assert (pose.ambiguous, pose.resolved_by) == (True, "rule")
    said = re.match(r"the rack has moved by (\d+\.\d) mm or more .*, at most 5 mm expected", pose.hint_note)
    assert float(said.group(1)) == pytest.approx(moved_mm, abs=0.3)


def test_what_fits_every_turn_decides_nothing():
    """The middle slot, and a rack that may have moved by as much as a turn moves it."""
    T_true = scenes.camera_from_rack(SQUARE, np.deg2rad(35))
    scan = transform_points(T_true, scenes.rack_top(SQUARE))
    for hint, note in (
        (
            SlotHint(slot="C3", toward="left"),
            "C3 is at nearly the same place however the rack is turned: name a slot at",
        ),
        (EarlierRack(T_true, 1.0), "a turn of this rack moves it by less than 1000 mm: give a hint for this capture"),
    ):
        pose = register_rack(scan, SQUARE, CONFIG, hint)
        assert (pose.ambiguous, pose.resolved_by) == (True, "rule")
        assert pose.hint_note.startswith(note)


@pytest.mark.parametrize("turn", range(4))
def test_all_four_turns_of_a_square_rack_are_told_by_words_and_by_an_earlier_frame(turn):
    T_true = scenes.camera_from_rack(SQUARE, np.deg2rad(35)) @ np.linalg.matrix_power(QUARTER_TURN, turn)
    scan = transform_points(T_true, scenes.rack_top(SQUARE))
    told = read_hint(example_hints(T_true, SQUARE)[0]).place
    for hint, by in ((told, "hint"), (EarlierRack(T_true, CONFIG.rack.left_alone_m), "previous")):
        pose = register_rack(scan, SQUARE, CONFIG, hint)
        assert (pose.ambiguous, pose.resolved_by) == (False, by)
        assert_same_pose(pose.T_camera_rack, T_true)


@pytest.mark.parametrize("yaw_deg", [10, 100, 190, 280])
def test_the_rule_lets_the_racks_x_point_to_the_bottom_right(yaw_deg):
    T_true = scenes.camera_from_rack(SOFT, np.deg2rad(yaw_deg))
    pose = register_rack(transform_points(T_true, scenes.rack_top(SOFT)), SOFT, CONFIG)
    assert pose.T_camera_rack[:2, 0].sum() > 0
    assert_same_pose(turned_to_match(pose.T_camera_rack, T_true), T_true)


def test_half_of_the_top_hidden_under_tubes():
    tube = load_tube("chen2023-tube-3")
    whole = top = scenes.rack_top(SOFT)
    held = [slot for slot in SOFT.all_slots if slot.center_mm[0] < 0 or slot.name[1:] == "10"]
    for slot in held:
        top = top[np.hypot(*(top[:, :2] - slot.center_m).T) > 13e-3]
    assert len(top) < 0.5 * len(whole)
    view = scenes.towards_camera(T_CAMERA_SOFT)
    tubes = [
        scenes.tube_surface(tube, scenes.tube_pose(SOFT, slot.name), SOFT.height_m + 4e-3, seen_from=view)
        for slot in held
    ]
    pose = register_rack(transform_points(T_CAMERA_SOFT, np.vstack([top, *tubes])), SOFT, CONFIG)
    assert pose.status is RackStatus.OK
    assert_same_pose(turned_to_match(pose.T_camera_rack, T_CAMERA_SOFT), T_CAMERA_SOFT)


def test_tubes_slot_floors_and_the_table_do_not_move_the_rack(soft_scan):
    tube = load_tube("chen2023-tube-1")
    table = np.random.default_rng(0).uniform([-0.2, -0.2, 0], [0.2, 0.2, 0], (8000, 3))
    view = scenes.towards_camera(T_CAMERA_SOFT)
    others = [
        *(
            scenes.tube_surface(tube, scenes.tube_pose(SOFT, name), SOFT.height_m, seen_from=view)
            for name in ("A1", "C5", "E9")
        ),
        scenes.slot_floors(SOFT),
        table,
    ]
    seen = scenes.seen_past_the_top(transform_points(T_CAMERA_SOFT, np.vstack(others)), SOFT, T_CAMERA_SOFT)
    crowded = np.vstack([soft_scan, seen])
    pose = register_rack(crowded, SOFT, CONFIG)
    assert pose.status is RackStatus.OK
    assert_same_pose(turned_to_match(pose.T_camera_rack, T_CAMERA_SOFT), T_CAMERA_SOFT)


def test_moving_the_camera_moves_the_pose_with_it():
    T_true = scenes.camera_from_rack(MIXED, 0.5, 0.1)
    points = transform_points(T_true, scenes.rack_top(MIXED))
    T_moved_camera = make_transform(
        Rotation.from_euler("zyx", [40, 8, -6], degrees=True).as_matrix(), np.array([0.03, -0.02, 0.05])
    )
    before = register_rack(points, MIXED, CONFIG).T_camera_rack
    after = register_rack(transform_points(T_moved_camera, points), MIXED, CONFIG).T_camera_rack
    assert_same_pose(invert_transform(T_moved_camera) @ after, before)


def test_the_order_of_the_points_does_not_matter(soft_scan):
    before = register_rack(soft_scan, SOFT, CONFIG).T_camera_rack
    after = register_rack(soft_scan[::-1], SOFT, CONFIG).T_camera_rack
    assert_same_pose(after, before, angle_deg=0.05, distance_m=5e-5)


def test_the_same_points_give_the_same_bits(soft_scan):
    first, second = (register_rack(soft_scan, SOFT, CONFIG).T_camera_rack for _ in range(2))
    assert np.array_equal(first, second)


@pytest.mark.parametrize(("true", "asked"), [(SOFT, HARD), (HARD, SOFT)], ids=["soft-as-hard", "hard-as-soft"])
def test_a_rack_of_another_pitch_is_refused_by_the_points_in_its_openings(true, asked):
    T_true = scenes.camera_from_rack(true, 0.3, 0.2)
    pose = register_rack(transform_points(T_true, scenes.rack_top(true)), asked, CONFIG)
    assert pose.status is RackStatus.REFUSED
    assert pose.T_camera_rack is None
    assert pose.resolved_by == ""
    assert f"lie inside the openings of {asked.name}" in pose.reason


def test_tubes_in_a_rack_of_another_pitch_are_not_taken_for_noise():
    tube = load_tube("chen2023-tube-3")
    T_true = scenes.camera_from_rack(HARD, 0.3, 0.2)
    view = scenes.towards_camera(T_true)
    tubes = [
        scenes.tube_surface(tube, scenes.tube_pose(HARD, slot.name), HARD.height_m + 4e-3, seen_from=view)
        for slot in HARD.all_slots[::3]
    ]
    pose = register_rack(transform_points(T_true, np.vstack([scenes.rack_top(HARD), *tubes])), SOFT, CONFIG)
    assert pose.status is RackStatus.REFUSED
    assert "another rack?" in pose.reason


def test_a_rack_of_another_size_is_not_found(soft_scan):
    pose = register_rack(soft_scan, load_rack("round-10ml-3x4"), CONFIG)
    assert pose.status is RackStatus.NOT_FOUND
    assert "no top of round-10ml-3x4 (130 x 90 mm)" in pose.reason
    assert pose.reason_code
    assert pose.T_camera_rack is None


def test_half_a_rack_is_not_found_and_the_reason_tells_what_lacks():
    top = scenes.rack_top(SOFT)
    pose = register_rack(transform_points(T_CAMERA_SOFT, top[top[:, 0] > 0]), SOFT, CONFIG)
    assert pose.status is RackStatus.NOT_FOUND
    assert "no top of chen2023-soft-5x10 (192.5 x 95.5 mm)" in pose.reason
    assert "is the rack in the image as a whole?" in pose.reason


@pytest.mark.parametrize(
    ("rack", "factor", "words"),
    [
        (SOFT, 1000.0, "1000 times larger"),
        (MIXED, 0.001, "1000 times smaller"),
        (MIXED, 10.0, "10 times larger"),
        (SOFT, 0.1, "10 times smaller"),
    ],
    ids=["x1000", "/1000", "x10", "/10"],
)
def test_a_wrong_unit_is_the_suspect_and_names_the_factor(rack, factor, words):
    points = transform_points(scenes.camera_from_rack(rack, 0.3, 0.2), scenes.rack_top(rack))
    pose = register_rack(points * factor, rack, CONFIG)
    assert pose.status is RackStatus.UNIT
    assert pose.T_camera_rack is None
    assert words in pose.reason
    assert pose.reason_code == "wrong_unit"


def test_a_wrong_unit_is_not_suspected_of_another_rack(soft_scan):
    pose = register_rack(soft_scan * 1000, load_rack("round-10ml-3x4"), CONFIG)
    assert pose.status is not RackStatus.UNIT
    assert pose.T_camera_rack is None


@pytest.mark.parametrize("count", [0, 1, 49])
def test_too_few_points(soft_scan, count):
    pose = register_rack(soft_scan[:count], SOFT, CONFIG)
    assert pose.status is RackStatus.INSUFFICIENT
    assert pose.reason_code == "too_few_points"
    assert f"{count} valid points" in pose.reason


def test_a_scan_coarser_than_the_ribs_is_insufficient():
    scan = scenes.rack_top(SOFT, spacing_m=2.2e-3)
    pose = register_rack(transform_points(T_CAMERA_SOFT, scan), SOFT, CONFIG)
    assert pose.status is RackStatus.INSUFFICIENT
    assert pose.reason_code == "too_coarse"
    assert "mm apart, and the ribs of chen2023-soft-5x10 are 1.20 mm wide" in pose.reason
    assert pose.spacing_m > SOFT.min_rib_m
    assert pose.T_camera_rack is None


def test_noisy_depth_is_insufficient(soft_scan):
    along = soft_scan / np.linalg.norm(soft_scan, axis=1, keepdims=True)
    noisy = soft_scan + along * np.random.default_rng(0).normal(0, 3e-3, (len(soft_scan), 1))
    pose = register_rack(noisy, SOFT, CONFIG)
    assert pose.status is RackStatus.INSUFFICIENT
    assert pose.reason_code == "too_noisy"
    assert "depth scatters by" in pose.reason
    assert "at most 1.1 mm" in pose.reason
    assert pose.T_camera_rack is None


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"min_seen": 1.01}, "little_seen"),
        ({"max_inlier_rmse_m": 5e-5}, "inlier_rmse"),
        ({"max_stray_share": -1.0}, "in_openings"),
        ({"max_outside_share": -1.0}, "beside_outline"),
        ({"max_unseen_share": -1.0}, "not_in_view"),
        ({"min_slot_margin": 1e9}, "slot_step"),
        ({"max_turn_std_deg": 0.0}, "uncertain_turn"),
        ({"max_shift_std_mm": 0.0}, "uncertain_shift"),
        ({"max_gain": -1e9}, "no_openings"),
        ({"max_pitch_mm": -1e9}, "pitch_x"),
        ({"max_openings_mm": -1e9}, "openings"),
        ({"max_outline_mm": -1e9}, "outline"),
        ({"max_scale": -1e9}, "scale"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_every_check_can_refuse(soft_scan, change, code):
    # Limits below zero, which a file cannot have, that nothing keeps.
    config = CONFIG.model_copy(update={"rack": RackConfig().model_copy(update=change)})
    pose = register_rack(soft_scan, SOFT, config)
    assert pose.status is not RackStatus.OK
    assert code in {check.code for check in failed(pose.checks)}
    assert pose.reason
    assert pose.T_camera_rack is None
    assert pose.covariance is None


def test_a_failed_pose_has_no_numbers_that_look_like_one():
    pose = register_rack(np.empty((0, 3)), SOFT, CONFIG)
    numbers = [value for value in dataclasses.asdict(pose).values() if isinstance(value, float)]
    assert len(numbers) == 7
    assert np.isnan(numbers).all()
