"""Sizes of labware as scans show them, on answers that are made up with known errors."""

from dataclasses import replace

import numpy as np
import pytest

from tubepose.checks import Check, mark_codes
from tubepose.config import Config
from tubepose.labware import load_rack, load_tube
from tubepose.labware_check import (
    TOLERANCE_MM,
    SizeCheck,
    compare_sizes,
    pooled,
    pooled_rows,
    size_row,
)
from tubepose.rack import RackPose, RackStatus
from tubepose.rack.size import FaceSize
from tubepose.scene import Scene, TubeEstimate, TubeTarget
from tubepose.sensor import prior_noise
from tubepose.tube import TopMeasure, TubePose, TubeStatus
from tubepose.tubes_pitch import LEAST_TOPS, refuse_by_tops
from tubepose_cli.show import describe_sizes

CONFIG = Config()
NOISE = prior_noise(CONFIG.sensor, "not measured")
RACK = load_rack("chen2023-soft-5x10")
OPEN, LOW, HIGH = (load_tube(f"chen2023-tube-{k}") for k in (1, 2, 3))
CAMERA = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.7], [0, 0, 0, 1]])
AS_DEFINED = FaceSize(np.zeros(2), 0.0, np.zeros(2), np.diag(np.square([1e-3, 1e-3, 1e-4, 2e-4, 2e-4])))
UNSEEN = replace(AS_DEFINED, covariance=np.diag(np.square([0.03, 0.03, 1.5e-3, 1.5e-3, 1.5e-3])))


def a_scene(size=AS_DEFINED, tubes=(LOW, HIGH), **of_pose):
    pose = {"T_camera_rack": CAMERA, "size": size, "resolved_by": "geometry"} | of_pose
    rack_pose = RackPose(pose.pop("status", RackStatus.OK), **pose)
    return Scene(None, RACK, tubes, None, (), rack_pose, NOISE, (), ())


def an_estimate(slot, tube=LOW, off_mm=(0.0, 0.0), high_mm=0.0, wide_mm=0.0, code=""):
    """A tube whose top is measured with these errors; of no type if `tube` is a height in mm."""
    model = None if isinstance(tube, float) else tube
    height_mm = tube if model is None else model.height_mm
    wide = np.nan if model is None or model.cap is None else 1e-3 * (model.cap.diameter_mm + wide_mm)
    off = (np.nan, np.nan) if model is None else tuple(1e-3 * np.array(off_mm))
    top = TopMeasure(1e-3 * (height_mm + high_mm), float(wide), off)
    checks = (Check(code, 0, 0, False),) if code else ()
    pose = TubePose(TubeStatus.REJECTED if code else TubeStatus.OK, T_rack_tube=np.eye(4), checks=checks, top=top)
    return TubeEstimate("profile", None, TubeTarget(None, slot, model, 1.0, None, np.empty((0, 3))), pose, np.eye(4))


def stretched(stretch, slots=RACK.all_slots[::3], scatter_mm=0.3, seed=0):
    """Tubes whose slots lie farther apart than defined by these shares, with scatter about them."""
    rng = np.random.default_rng(seed)
    return tuple(
        an_estimate(slot.name, off_mm=np.array(slot.center_mm) * stretch + rng.normal(0, scatter_mm, 2))
        for slot in slots
    )


def by_quantity(sizes):
    return {(size.labware, size.quantity): size for size in sizes}


def test_labware_as_defined_contradicts_nothing():
    tubes = [an_estimate(slot.name) for slot in RACK.all_slots[:12]]
    found = by_quantity(compare_sizes(a_scene(floor_m=(RACK.floor_m, 1e-4)), tubes, CONFIG))
    assert not any(size.contradicts for size in found.values())
    for size in found.values():
        assert size.measured == pytest.approx(size.defined)
    names = {quantity for _, quantity in found}
    assert names == {
        *("pitch_x_mm", "pitch_y_mm", "opening_mm", "outline_x_mm", "outline_y_mm", "scale", "floor_mm"),
        *("top_height_mm", "cap_diameter_mm"),
    }
    assert found[RACK.name, "pitch_x_mm"].defined == RACK.grid.pitch_mm[0]
    assert found[LOW.name, "top_height_mm"].n == 12


def test_a_cap_of_another_height_with_the_number_to_write():
    tubes = [an_estimate(slot.name, HIGH, high_mm=-2.8 + 0.05 * k) for k, slot in enumerate(RACK.all_slots[:9])]
    size = by_quantity(compare_sizes(a_scene(), tubes, CONFIG))[HIGH.name, "top_height_mm"]
    assert size.contradicts
    assert size.measured == pytest.approx(HIGH.height_mm - 2.6)
    assert (size.key, size.other_key) == ("top_mm", "floor_mm")
    # A file with that number has a tube of that height.
    right = HIGH.model_copy(update={"cap": HIGH.cap.model_copy(update={"top_mm": size.write})})
    assert right.height_mm == pytest.approx(size.measured)


def test_a_height_is_told_above_the_floor_that_is_seen():
    tubes = [an_estimate(slot.name, HIGH, high_mm=2.0) for slot in RACK.all_slots[:9]]
    seen = a_scene(floor_m=(RACK.floor_m + 2e-3, 1e-4))
    found = by_quantity(compare_sizes(seen, tubes, CONFIG))
    assert found[HIGH.name, "top_height_mm"].measured == pytest.approx(HIGH.height_mm)
    assert found[HIGH.name, "top_height_mm"].other_key == ""
    assert found[RACK.name, "floor_mm"].contradicts
    assert found[RACK.name, "floor_mm"].write == pytest.approx(RACK.floor_mm + 2)


def test_a_height_under_a_cap_that_cannot_float_is_the_bodys():
    tubes = [an_estimate(slot.name, LOW, high_mm=-LOW.cap.top_mm - 1) for slot in RACK.all_slots[:9]]
    size = by_quantity(compare_sizes(a_scene(), tubes, CONFIG))[LOW.name, "top_height_mm"]
    assert (size.key, size.write) == ("body.height_mm", pytest.approx(LOW.body.height_mm - LOW.cap.top_mm - 1))


def test_tubes_that_are_not_believed_for_other_reasons_say_nothing():
    tubes = [an_estimate(slot.name, HIGH, high_mm=1.3, code="not_in_slot") for slot in RACK.all_slots[:9]]
    assert (HIGH.name, "top_height_mm") not in by_quantity(compare_sizes(a_scene(), tubes, CONFIG))
    tubes = [replace_code(tube, "height_off") for tube in tubes]
    assert by_quantity(compare_sizes(a_scene(), tubes, CONFIG))[HIGH.name, "top_height_mm"].contradicts


def replace_code(estimate, code):
    return replace(estimate, pose=replace(estimate.pose, checks=(Check(code, 0, 0, False),)))


@pytest.mark.parametrize(("count", "spread_mm", "told"), [(4, 0.1, True), (2, 0.1, False), (4, 1.0, False)])
def test_alike_tops_of_no_type_may_be_a_wrong_file(count, spread_mm, told):
    heights = HIGH.height_mm + 2.0 + spread_mm * np.arange(count)
    strange = [
        an_estimate(slot.name, float(height), code="unknown_type")
        for slot, height in zip(RACK.all_slots, heights, strict=False)
    ]
    found = by_quantity(compare_sizes(a_scene(), strange, CONFIG))
    assert ((HIGH.name, "top_height_mm") in found) == told
    assert (LOW.name, "top_height_mm") not in found
    if told:
        size = found[HIGH.name, "top_height_mm"]
        assert (size.contradicts, size.other_key) == (True, "another type")
        assert "or it is another type" in describe_sizes([size_row(size)])[0]


def test_tops_that_a_wrong_height_made_unknown_count_with_the_others():
    slots = RACK.all_slots
    known = [an_estimate(slot.name, HIGH, high_mm=1.0) for slot in slots[:3]]
    unknown = [an_estimate(slot.name, HIGH.height_mm + 1.6, code="unknown_type") for slot in slots[3:9]]
    size = by_quantity(compare_sizes(a_scene(), known + unknown, CONFIG))[HIGH.name, "top_height_mm"]
    assert (size.n, size.measured) == (9, pytest.approx(HIGH.height_mm + 1.6))


def test_wider_caps_need_more_than_blur():
    for wide_mm, told in ((1.0, False), (2.5, True)):
        tubes = [an_estimate(slot.name, LOW, wide_mm=wide_mm) for slot in RACK.all_slots[:20]]
        size = by_quantity(compare_sizes(a_scene(), tubes, CONFIG))[LOW.name, "cap_diameter_mm"]
        assert size.measured == pytest.approx(LOW.cap.diameter_mm + wide_mm)
        assert size.contradicts == told


# Pitch


def test_the_pitch_of_tubes_is_recovered_where_no_rib_is_seen():
    size = by_quantity(compare_sizes(a_scene(UNSEEN), stretched((0.03, -0.02), scatter_mm=0.05), CONFIG))
    for axis, (name, share) in enumerate(zip("xy", (0.03, -0.02), strict=True)):
        found = size[RACK.name, f"pitch_{name}_mm"]
        assert found.measured == pytest.approx(RACK.grid.pitch_mm[axis] * (1 + share), abs=3 * found.std)
        assert found.std < 0.005 * found.defined
        assert found.contradicts


def test_ribs_that_are_seen_outweigh_tubes_that_scatter():
    sharp = replace(AS_DEFINED, covariance=np.diag(np.square([1e-4, 1e-4, 1e-4, 1e-4, 1e-4])))
    found = by_quantity(compare_sizes(a_scene(sharp), stretched((0.01, 0.01), scatter_mm=1.0), CONFIG))
    assert abs(found[RACK.name, "pitch_x_mm"].measured - RACK.grid.pitch_mm[0]) < 0.01


def test_another_pitch_refuses_the_rack_and_its_tubes():
    scene, tubes = refuse_by_tops(a_scene(UNSEEN), stretched((0.03, 0.0), scatter_mm=0.1), CONFIG)
    assert (scene.rack_pose.status, scene.rack_pose.reason_code) == (RackStatus.REFUSED, "pitch_x")
    assert scene.rack_pose.T_camera_rack is None
    assert {(tube.pose.status, tube.pose.reason_code) for tube in tubes} == {(TubeStatus.REJECTED, "labware")}
    assert all(tube.pose.T_rack_tube is not None for tube in tubes)
    assert "correct pitch_mm" in tubes[0].pose.reason
    # And its sizes are still told.
    assert by_quantity(compare_sizes(scene, tubes, CONFIG))[RACK.name, "pitch_x_mm"].contradicts


@pytest.mark.parametrize("seed", range(20))
def test_tubes_that_only_lean_refuse_nothing(seed):
    slots = np.random.default_rng(seed).permutation(np.array(RACK.all_slots, dtype=object))[: 6 + 2 * seed]
    before = a_scene(UNSEEN)
    tubes = stretched((0.0, 0.0), tuple(slots), scatter_mm=1.0, seed=seed)
    scene, after = refuse_by_tops(before, tubes, CONFIG)
    assert scene.rack_pose.status is RackStatus.OK
    assert after == tubes
    assert [check.code for check in scene.rack_pose.checks if check.decides] == ["pitch_x", "pitch_y"]


def test_few_tubes_tell_no_pitch_and_a_given_pose_is_not_asked():
    few = stretched((0.05, 0.05), RACK.all_slots[: LEAST_TOPS - 1], scatter_mm=0.01)
    assert refuse_by_tops(a_scene(UNSEEN), few, CONFIG)[0].rack_pose.checks == ()
    given = a_scene(UNSEEN, resolved_by="given")
    assert refuse_by_tops(given, stretched((0.05, 0.0)), CONFIG)[0] is given
    # One row of tubes says nothing of the other axis.
    row = [slot for slot in RACK.all_slots if slot.name.startswith("A")]
    scene, _ = refuse_by_tops(a_scene(UNSEEN), stretched((0.0, 0.0), row), CONFIG)
    assert [check.code for check in scene.rack_pose.checks if check.decides] == ["pitch_x"]


@pytest.mark.parametrize(("stretch", "marks"), [(0.0, set()), (0.009, {"pitch_x"})])
def test_a_pitch_that_is_off_but_not_by_enough_to_refuse_is_marked(stretch, marks):
    scene, _ = refuse_by_tops(a_scene(UNSEEN), stretched((stretch, 0.0), scatter_mm=0.1), CONFIG)
    assert scene.rack_pose.status is RackStatus.OK
    assert set(filter(None, mark_codes(scene.rack_pose.checks).split(";"))) == marks


# Which racks


@pytest.mark.parametrize(
    ("status", "codes", "told"),
    [
        (RackStatus.OK, (), True),
        (RackStatus.REFUSED, ("pitch_x", "openings"), True),
        (RackStatus.REFUSED, ("pitch_x", "other_rack"), False),
        (RackStatus.REFUSED, (), False),
        (RackStatus.NOT_FOUND, ("pitch_x",), False),
    ],
)
def test_sizes_of_another_rack_are_not_told(status, codes, told):
    checks = tuple(Check(code, 1, 0, False) for code in codes)
    pose = None if status is not RackStatus.OK else CAMERA
    assert bool(compare_sizes(a_scene(status=status, checks=checks, T_camera_rack=pose), (), CONFIG)) == told


def test_a_cloud_that_is_too_large_has_a_factor_for_its_depth():
    half = RACK.outline_m / 2
    larger = replace(AS_DEFINED, stretch=np.full(2, 0.01), outline_m=0.01 * half)
    size = by_quantity(compare_sizes(a_scene(larger), (), CONFIG))[RACK.name, "scale"]
    assert size.measured == pytest.approx(1.01)
    assert size.contradicts
    assert size.measured * size.write == pytest.approx(1.0)
    assert "multiply depth_scale_m by 0.9901" in describe_sizes([size_row(size)])[0]


# Pooling

SIZE = SizeCheck("top_height_mm", "t", "top_mm", 111.0, 108.2, 0.2, 3, TOLERANCE_MM, 3.2)


def test_frames_are_pooled_by_inverse_variances():
    (found,) = pooled([SIZE, replace(SIZE, measured=108.5, std=0.4, n=5, write=3.5)])
    assert found.measured == pytest.approx((108.2 * 4 + 108.5) / 5)
    assert found.std == pytest.approx(0.2 * 0.4 / np.hypot(0.2, 0.4))
    assert found.write == pytest.approx(3.2 + found.measured - 108.2)
    assert found.n == 8


def test_frames_that_contradict_each_other_are_less_sure():
    (alike,) = pooled([SIZE] * 4)
    apart = [replace(SIZE, measured=108.2 + off, write=3.2 + off) for off in (-2.0, -1.0, 1.0, 2.0)]
    (found,) = pooled(apart)
    assert found.std == pytest.approx(alike.std * np.sqrt((4 + 1 + 1 + 4) / 0.04 / 3))
    assert pooled(apart[::-1])[0].measured == pytest.approx(found.measured)


def test_rows_of_frames_give_rows_of_the_run_by_quantity_and_labware():
    sizes = [SIZE, replace(SIZE, labware="u"), replace(SIZE, quantity="floor_mm"), SIZE]
    rows = [{"capture": f"c{k}", "frame": k, **size_row(size)} for k, size in enumerate(sizes)]
    found = pooled_rows(rows)
    assert [(row["labware"], row["quantity"], row["n"]) for row in found] == [
        ("t", "top_height_mm", 6),
        ("u", "top_height_mm", 3),
        ("t", "floor_mm", 3),
    ]
    assert "frame" not in found[0]


def test_the_line_on_the_screen():
    assert describe_sizes([size_row(SIZE), size_row(replace(SIZE, measured=110.9))]) == [
        "labware: the scan shows caps 108.2 mm high (3 tubes, +-0.2), t says 111: correct top_mm to 3.2"
    ]


@pytest.mark.parametrize(
    ("measured", "std", "told"), [(111.49, 0.01, False), (111.51, 0.01, True), (112.0, 0.4, False)]
)
def test_a_contradiction_is_beyond_tolerance_and_three_standard_deviations(measured, std, told):
    assert replace(SIZE, measured=measured, std=std).contradicts == told


def test_three_standard_deviations_are_as_sure_with_few_tubes_as_with_many():
    """Tubes that lean at random: by the three standard deviations of a Gaussian, 1 of 370 is off by more."""
    slots, beyond = RACK.all_slots[::9], 0
    for seed in range(400):
        found = by_quantity(compare_sizes(a_scene(None), stretched((0, 0), slots, 0.3, seed), CONFIG))
        size = found[RACK.name, "pitch_x_mm"]
        beyond += abs(size.measured - size.defined) > 3 * size.std
    assert len(slots) == LEAST_TOPS
    assert beyond <= 4
