"""Boxes without a network: what stands on the rack, parted tube by tube."""

import numpy as np
import pytest
import scenes

from tubepose.config import Config
from tubepose.detection import rows_in_box
from tubepose.detection.geometric import GeometricDetector
from tubepose.labware import load_rack, load_tube
from tubepose.transforms import transform_points

RACK = load_rack("chen2023-soft-5x10")
TUBE_1, TUBE_2, TUBE_3 = (load_tube(f"chen2023-tube-{i}") for i in (1, 2, 3))
T_CAMERA_RACK = scenes.camera_from_rack(RACK, 0.4, 0.15)
# Five degrees off: no cap of a tube hides its neighbour's here, since nothing is hidden in these scenes.
CAP_HEIGHT_M = TUBE_3.height_m


def scene(tubes, rack=RACK, T=T_CAMERA_RACK):
    """Points in the camera frame and, per point, the number of its tube (-1: the rack's top)."""
    clouds = [scenes.rack_top(rack)]
    for i, (tube, T_rack_tube) in enumerate(tubes):
        clouds.append(scenes.tube_surface(tube, T_rack_tube, rack.height_m, seed=i, seen_from=scenes.towards_camera(T)))
    owner = np.concatenate([np.full(len(cloud), i - 1) for i, cloud in enumerate(clouds)])
    order = np.random.default_rng(0).permutation(len(owner))
    return transform_points(T, np.vstack(clouds))[order], owner[order]


def detect(frame, tubes=(TUBE_1, TUBE_2, TUBE_3), rack=RACK):
    found = GeometricDetector(rack, tubes).detect(frame)
    assert [d.is_rack for d in found] == [True] + [False] * (len(found) - 1)
    return found[0], found[1:]


def assert_one_each(detections, owner, count, purity=0.98, completeness=0.95):
    """Every tube has one detection: nearly all points in it are the tube's, and nearly all of the tube's are in it."""
    assert len(detections) == count
    claimed = []
    for detection in detections:
        owners = owner[detection.point_rows]
        tube = np.bincount(owners[owners >= 0]).argmax()
        claimed.append(tube)
        assert np.mean(owners == tube) > purity
    assert sorted(claimed) == list(range(count))
    for detection, tube in zip(detections, claimed, strict=True):
        # The lowest millimetres belong to the band of the top.
        assert np.sum(owner[detection.point_rows] == tube) > completeness * 0.8 * np.sum(owner == tube)


def touching(names, extra_m=0.1e-3):
    """Tubes of kind 3 that lean apart just so far that the caps of a column pair touch: pitch 17.7, caps 18.55."""
    gap_m = TUBE_3.max_radius_m * 2 + extra_m
    tubes = []
    for name, sign in names.items():
        lean = np.arcsin(sign * (gap_m - 17.7e-3) / 2 / (CAP_HEIGHT_M - 6.5e-3))
        tubes.append((TUBE_3, scenes.tube_pose(RACK, name, alpha_rad=-lean)))
    return tubes


def test_an_empty_rack_has_no_tube():
    points, _ = scene([])
    rack, tubes = detect(scenes.unorganised(points))
    assert tubes == ()
    assert rack.score == 1.0
    assert len(rack.point_rows) == len(points)


def test_an_empty_rack_with_slot_floors_and_a_table_has_no_tube():
    table = np.random.default_rng(0).uniform([-0.2, -0.2, 0], [0.2, 0.2, 0], (8000, 3))
    more = transform_points(T_CAMERA_RACK, np.vstack([scenes.slot_floors(RACK), table]))
    more = scenes.seen_past_the_top(more, RACK, T_CAMERA_RACK)
    points, _ = scene([])
    rack, tubes = detect(scenes.unorganised(np.vstack([points, more])))
    assert tubes == ()
    assert rack.score == 1.0


def test_tubes_of_three_kinds_are_found_once_each():
    places = {"A1": TUBE_1, "A2": TUBE_2, "C5": TUBE_3, "E10": TUBE_1, "D3": TUBE_2, "B8": TUBE_3}
    points, owner = scene([(tube, scenes.tube_pose(RACK, name)) for name, tube in places.items()])
    _, tubes = detect(scenes.unorganised(points))
    assert all((d.class_name, d.source, d.score) == ("tube", "geometric", 1.0) for d in tubes)
    assert_one_each(tubes, owner, 6)


@pytest.mark.parametrize("extra_m", [0.05e-3, 0.5e-3])
def test_caps_that_touch_are_parted(extra_m):
    tubes = touching({"B4": 1, "C4": -1, "D8": 1, "E8": -1}, extra_m)
    points, owner = scene(tubes)
    _, found = detect(scenes.unorganised(points), (TUBE_3,))
    assert_one_each(found, owner, 4, purity=0.97)


def test_a_row_of_caps_is_parted():
    names = [f"C{i}" for i in range(1, 11, 2)] + [f"A{i}" for i in range(2, 11, 2)]
    points, owner = scene([(TUBE_3, scenes.tube_pose(RACK, name)) for name in names])
    _, found = detect(scenes.unorganised(points), (TUBE_3,))
    assert_one_each(found, owner, 10)


def test_a_tube_of_unknown_height_is_still_a_tube():
    points, owner = scene([(TUBE_2, scenes.tube_pose(RACK, "C5")), (TUBE_3, scenes.tube_pose(RACK, "A2"))])
    _, found = detect(scenes.unorganised(points), (TUBE_3,))
    assert len(found) == 2
    assert {int(np.bincount(owner[d.point_rows]).argmax()) for d in found} == {0, 1}


def test_without_any_tube_model_tubes_are_parted_by_the_slots():
    points, owner = scene([(TUBE_2, scenes.tube_pose(RACK, name)) for name in ("C5", "C7", "A1")])
    _, found = detect(scenes.unorganised(points), ())
    assert_one_each(found, owner, 3)


def test_a_few_stray_points_are_no_tube():
    points, _ = scene([])
    above = np.array([*RACK.slot("C5").center_m, RACK.height_m + 0.05])
    stray = transform_points(T_CAMERA_RACK, above + np.random.default_rng(0).normal(0, 2e-3, (20, 3)))
    _, tubes = detect(scenes.unorganised(np.vstack([points, stray])))
    assert tubes == ()


def test_stray_points_over_another_slot_belong_to_no_tube():
    points, _ = scene([(TUBE_3, scenes.tube_pose(RACK, "C5"))])
    above = np.array([*RACK.slot("C8").center_m, RACK.height_m + 0.05])
    stray = transform_points(T_CAMERA_RACK, above + np.random.default_rng(0).normal(0, 2e-3, (20, 3)))
    _, (tube,) = detect(scenes.unorganised(np.vstack([points, stray])))
    assert tube.point_rows.max() < len(points)


def test_light_behind_glass_in_a_corner_of_a_slot_is_no_tube():
    points, _ = scene([])
    corner = np.array([*RACK.slot("C5").center_m + 3e-3, RACK.height_m + 0.03])
    ghosts = transform_points(T_CAMERA_RACK, corner + np.random.default_rng(0).normal(0, 5e-4, (100, 3)))
    _, tubes = detect(scenes.unorganised(np.vstack([points, ghosts])))
    assert tubes == ()


def test_what_lies_below_the_base_is_not_the_racks():
    points, _ = scene([])
    below = transform_points(T_CAMERA_RACK, np.random.default_rng(0).uniform(-0.03, 0.03, (200, 3)) * [1, 1, 0.2])
    deep = below - 0.02 * T_CAMERA_RACK[:3, 2]
    rack, _ = detect(scenes.unorganised(np.vstack([points, deep])))
    assert rack.point_rows.max() < len(points)


def test_an_unorganised_cloud_has_no_boxes_and_the_right_rows():
    points, owner = scene([(TUBE_3, scenes.tube_pose(RACK, "C5"))])
    holes = np.full((500, 3), np.nan)
    frame = scenes.unorganised(np.vstack([holes, points, holes]))
    owner = np.concatenate([np.full(500, -9), owner, np.full(500, -9)])
    rack, (tube,) = detect(frame)
    assert np.isnan(rack.box_xyxy_px).all()
    assert np.isnan(tube.box_xyxy_px).all()
    assert np.array_equal(rows_in_box(frame, tube), tube.point_rows)
    assert np.mean(owner[tube.point_rows] == 0) > 0.99
    assert np.min(owner[rack.point_rows]) == -1


def test_boxes_of_an_organised_cloud_frame_their_points():
    points, _ = scene([(TUBE_3, scenes.tube_pose(RACK, "C5"))])
    frame = scenes.organised(points)
    rack, (tube,) = detect(frame)
    left, top, right, bottom = tube.box_xyxy_px
    u, v = scenes.CAMERA.project(frame.points_m[tube.point_rows]).T
    assert [left, top, right, bottom] == pytest.approx([u.min(), v.min(), u.max(), v.max()], abs=0.6)
    outline = np.array([[x, y, RACK.height_m * 2] for x in (-1, 1) for y in (-1, 1)]) / 2 * [*RACK.outline_m, 1]
    corners = scenes.CAMERA.project(transform_points(T_CAMERA_RACK, outline))
    expected = [*corners.min(axis=0), *corners.max(axis=0)]
    assert rack.box_xyxy_px == pytest.approx(expected, abs=3.0)


def test_a_cloud_without_the_rack_is_returned_whole_with_score_0():
    wall = np.random.default_rng(0).uniform([-0.2, -0.2, 0.6], [0.2, 0.2, 0.6], (3000, 3))
    rack, tubes = detect(scenes.unorganised(wall))
    assert (rack.score, tubes) == (0.0, ())
    assert np.array_equal(rack.point_rows, np.arange(3000))


@pytest.mark.parametrize("count", [0, 49])
def test_nearly_nothing_is_a_rack_of_score_0(count):
    points, _ = scene([])
    cloud = np.vstack([np.full((10, 3), np.nan), points[:count]])
    rack, tubes = detect(scenes.unorganised(cloud))
    assert (rack.score, tubes, len(rack.point_rows)) == (0.0, (), count)


def test_the_thresholds_are_the_configured_ones():
    points, _ = scene([(TUBE_3, scenes.tube_pose(RACK, "C5"))])
    config = Config.model_validate({"slots": {"clearance_m": 0.07}})
    found = GeometricDetector(RACK, (TUBE_3,), config).detect(scenes.unorganised(points))
    assert len(found) == 1
