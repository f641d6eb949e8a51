"""The stages together: from a frame with known poses to estimates, and what each stage hands on when it fails."""

import dataclasses
import re
from dataclasses import dataclass

import numpy as np
import profile_scenes as ps
import pytest
import scenes

from tubepose.capture.hints import SlotHint
from tubepose.checks import said
from tubepose.config import Config
from tubepose.detection import Detection, Detector
from tubepose.detection.geometric import GeometricDetector
from tubepose.labware import load_rack, load_tube
from tubepose.methods import METHODS
from tubepose.methods.profile_boxes import allowed_types
from tubepose.pipeline import estimate_tubes, prepare_scene
from tubepose.rack import RackStatus
from tubepose.records import FIT_COLUMNS, estimate_row, slot_rows
from tubepose.simulation.camera import default_camera
from tubepose.transforms import make_transform, tilt_rad, transform_points
from tubepose.tube import TubeStatus

CONFIG = Config()
TUBE_METHODS = [name for name, method in METHODS.items() if method.needs_targets]
RACK = load_rack("chen2023-soft-5x10")
TUBES = tuple(load_tube(f"chen2023-tube-{i}") for i in (1, 2, 3))
T_CAMERA_RACK = scenes.camera_from_rack(RACK, 0.3, 0.15)
PLACED = {
    "A1": (TUBES[0], scenes.tube_pose(RACK, "A1", 0.004, -0.003)),
    "C5": (TUBES[1], scenes.tube_pose(RACK, "C5", -0.015, 0.02)),
    "E10": (TUBES[2], scenes.tube_pose(RACK, "E10", 0.008, 0.008)),
}


@dataclass(frozen=True)
class Fixed(Detector):
    """A detector that says what it is told to."""

    detections: tuple[Detection, ...]
    name: str = "recorded"

    def detect(self, frame):
        return self.detections


def hint_for(T_camera_rack):
    place = transform_points(T_camera_rack, np.array([*RACK.slot("A1").center_m, RACK.height_m]))
    return SlotHint(slot="A1", pixel=tuple(scenes.CAMERA.project(place)))


def frame_of(placed=PLACED, T=T_CAMERA_RACK, organised=False):
    view = scenes.towards_camera(T)
    tubes = [
        scenes.tube_surface(tube, T_rack_tube, RACK.height_m, seed=i, seen_from=view)
        for i, (tube, T_rack_tube) in enumerate(placed.values())
    ]
    points = transform_points(T, np.vstack([scenes.rack_top(RACK), *tubes]))
    frame = scenes.organised(points) if organised else scenes.unorganised(points)
    return frame if organised else type(frame)(frame.cloud_m, None, scenes.CAMERA, None, "test", organised=False)


def prepare(frame, tubes=TUBES, detector=None, hint=None):
    return prepare_scene(frame, RACK, tubes, detector or GeometricDetector(RACK, tubes), CONFIG, hint)


@pytest.fixture(scope="module")
def scene():
    return prepare(frame_of(), hint=hint_for(T_CAMERA_RACK))


def test_slots_and_kinds_of_all_tubes_are_found(scene):
    assert scene.rack_pose.status is RackStatus.OK
    assert scene.rack_pose.resolved_by == "hint"
    assert {target.slot: target.tube for target in scene.targets} == {slot: tube for slot, (tube, _) in PLACED.items()}
    assert all(target.why is None for target in scene.targets)


def test_the_paper_recovers_the_poses_in_both_frames(scene):
    estimates = estimate_tubes(scene, "paper", CONFIG).estimates
    assert len(estimates) == 3
    for estimate in estimates:
        _, T_rack_tube = PLACED[estimate.target.slot]
        assert estimate.pose.status is TubeStatus.OK
        T_camera_tube = T_CAMERA_RACK @ T_rack_tube
        assert np.rad2deg(tilt_rad(estimate.T_camera_tube[:3, 2], T_camera_tube[:3, 2])) < 0.3
        assert np.linalg.norm((estimate.T_camera_tube - T_camera_tube)[:3, 3]) < 0.3e-3
        assert np.allclose(estimate.T_camera_tube, scene.rack_pose.T_camera_rack @ estimate.pose.T_rack_tube)


@pytest.mark.parametrize("method", sorted(TUBE_METHODS))
def test_every_method_answers_for_every_target_once(scene, method):
    for package in METHODS[method].packages:
        pytest.importorskip(package, reason="an extra: pip install '.[rivals]'")
    seed = 0 if METHODS[method].is_stochastic else None
    result = estimate_tubes(scene, method, CONFIG, seed)
    estimates, times = result.estimates, result.times
    assert [estimate.target for estimate in estimates] == list(scene.targets)
    assert {(estimate.method, estimate.seed) for estimate in estimates} == {(method, seed)}
    assert [time.instance for time in times] == [target.slot for target in scene.targets]
    assert all((time.stage, time.method, time.seed) == ("tube", method, seed) for time in times)
    assert all(time.duration_ms > 0 for time in times)


@pytest.mark.parametrize(
    ("method", "columns"),
    [
        ("paper", {"excess_rms_m", "inside_share"}),
        ("slot-icp", {"inlier_rmse_m", "fitness"}),
        ("upright", set()),
        ("profile", {"top_rms_m", "top_seen_share"}),
    ],
)
def test_each_way_of_fitting_has_columns_of_its_own(scene, seen, method, columns):
    asked = seen if method == "profile" else scene
    estimates = [e for e in estimate_tubes(asked, method, CONFIG).estimates if not e.target.tube.is_open]
    assert estimates
    for estimate in estimates:
        row = estimate_row({}, asked, estimate)
        assert {name for name in FIT_COLUMNS if np.isfinite(row[name])} == columns


def test_the_shared_stages_are_timed_in_the_papers_order(scene):
    assert [time.stage for time in scene.times] == ["detect", "rack", "sensor", "slots"]
    assert {time.method for time in scene.times} == {"all"}


def test_an_organised_frame_without_intrinsics_still_uses_the_hint():
    frame = frame_of(organised=True)
    T_turned = T_CAMERA_RACK @ np.diag([-1.0, -1.0, 1.0, 1.0])
    rays = scenes.CAMERA.rays()
    exact = np.where(np.isfinite(frame.cloud_m), rays * frame.cloud_m[..., 2:], np.nan)
    bare = type(frame)(exact, None, None, None, "test")
    found = prepare(bare, hint=hint_for(T_turned))
    assert found.intrinsics.fx == pytest.approx(scenes.CAMERA.fx, rel=0.01)
    assert found.rack_pose.resolved_by == "hint"
    assert {target.slot for target in found.targets} == {"E10", "C6", "A1"}  # the same places, named from the other end


def test_moving_the_camera_changes_no_pose_in_the_rack(scene):
    T_moved_camera = make_transform(
        np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        @ scenes.camera_from_rack(RACK, 0, 0.1)[:3, :3]
        @ np.diag([1, -1, -1]),
        np.array([0.02, 0.06, 0.03]),
    )
    frame = frame_of()
    T_new = T_moved_camera @ T_CAMERA_RACK
    moved = type(frame)(
        transform_points(T_moved_camera, frame.cloud_m), None, scenes.CAMERA, None, "test", organised=False
    )
    found = prepare(moved, hint=hint_for(T_new))
    before = {e.target.slot: e.pose for e in estimate_tubes(scene, "paper", CONFIG).estimates}
    after = {e.target.slot: e.pose for e in estimate_tubes(found, "paper", CONFIG).estimates}
    assert set(after) == set(before)
    for slot, pose in after.items():
        assert np.rad2deg(tilt_rad(pose.T_rack_tube[:3, 2], before[slot].T_rack_tube[:3, 2])) < 0.15
        assert np.allclose(pose.T_rack_tube[:3, 3], before[slot].T_rack_tube[:3, 3])


def test_boxes_of_a_detector_select_their_points():
    frame = frame_of(organised=True)
    everything = (0.0, 0.0, 639.0, 479.0)
    tube, T_rack_tube = PLACED["C5"]
    axis = np.array([[0.0, 0.0, RACK.depth_m], [0.0, 0.0, tube.height_m]])
    u, v = scenes.CAMERA.project(transform_points(T_CAMERA_RACK @ T_rack_tube, axis)).T
    box = (u.min() - 16, v.min() - 16, u.max() + 16, v.max() + 16)
    detector = Fixed((Detection("rack", 0.9, everything, "recorded"), Detection("purple-cap", 0.8, box, "recorded")))
    found = prepare(frame, detector=detector, hint=hint_for(T_CAMERA_RACK))
    (target,) = found.targets
    assert (target.detection, target.slot, target.tube) == (1, "C5", TUBES[1])
    (estimate,) = estimate_tubes(found, "paper", CONFIG).estimates
    assert estimate.pose.status is TubeStatus.OK


def test_without_a_rack_nothing_is_invented():
    frame = frame_of()
    found = prepare(frame, detector=Fixed((Detection("tube", 1.0, (0.0, 0.0, 9.0, 9.0), "recorded"),)))
    assert found.rack_pose.status is RackStatus.NOT_FOUND
    assert found.rack_pose.reason_code == "no_detection"
    assert found.targets == ()
    assert estimate_tubes(found, "paper", CONFIG).estimates == ()
    assert [time.stage for time in found.times] == ["detect", "rack"]
    assert (found.noise.source, found.noise.note) == ("prior", "the rack's pose is not known")


def test_the_rack_with_the_best_score_is_taken():
    frame = frame_of()
    rows = np.arange(frame.points_m.shape[0])
    nowhere = Detection("rack", 0.3, (np.nan,) * 4, "recorded", rows[:10])
    right = Detection("rack", 0.9, (np.nan,) * 4, "recorded", rows)
    assert prepare(frame, detector=Fixed((nowhere, right))).rack_pose.status is RackStatus.OK


def test_an_empty_frame_has_a_status_and_no_estimate():
    found = prepare(scenes.unorganised(np.full((100, 3), np.nan)))
    assert found.rack_pose.status is RackStatus.INSUFFICIENT
    assert found.rack_pose.T_camera_rack is None
    assert found.targets == ()


def test_a_flat_wall_has_a_status_and_no_estimate():
    grid = np.stack(np.meshgrid(np.arange(-0.2, 0.2, 4e-3), np.arange(-0.2, 0.2, 4e-3), [0.6]), axis=-1).reshape(-1, 3)
    found = prepare(scenes.unorganised(grid))
    assert found.rack_pose.status is not RackStatus.OK
    assert found.rack_pose.reason
    assert found.targets == ()


def test_a_target_that_no_method_can_be_asked_is_rejected_with_its_reason():
    lying = np.random.default_rng(0).uniform([-50, -8, 60], [50, 8, 70], (800, 3)) * 1e-3
    points = transform_points(T_CAMERA_RACK, np.vstack([scenes.rack_top(RACK), lying]))
    rows = np.arange(len(points))
    box = (np.nan,) * 4
    detector = Fixed(
        (Detection("rack", 1.0, box, "recorded", rows), Detection("tube", 1.0, box, "recorded", rows[-800:]))
    )
    found = prepare(scenes.unorganised(points), detector=detector)
    assert found.targets[0].slot is None
    for method in TUBE_METHODS:
        result = estimate_tubes(found, method, CONFIG, 0)
        (estimate,), times = result.estimates, result.times
        assert estimate.pose.status is TubeStatus.REJECTED
        assert estimate.pose.reason_code == "in_no_slot"
        assert estimate.pose.T_rack_tube is None
        assert estimate.T_camera_tube is None
        assert times == ()


def test_without_tube_models_the_slots_are_known_and_the_reason_names_the_option():
    capped = {slot: PLACED[slot] for slot in ("C5", "E10")}
    found = prepare(frame_of(capped), tubes=(), hint=hint_for(T_CAMERA_RACK))
    assert {target.slot for target in found.targets} == set(capped)
    assert {(target.tube, target.why.code) for target in found.targets} == {(None, "no_types_given")}


def test_an_unknown_kind_keeps_its_slot_and_says_why():
    found = prepare(frame_of({"C5": PLACED["C5"]}), tubes=TUBES[2:], hint=hint_for(T_CAMERA_RACK))
    (target,) = found.targets
    assert (target.slot, target.tube) == ("C5", None)
    assert target.why.code == "unknown_type"
    (estimate,) = estimate_tubes(found, "paper", CONFIG).estimates
    assert (estimate.pose.status, estimate.pose.reason_code) == (TubeStatus.REJECTED, "unknown_type")


def test_points_in_the_box_that_no_such_tube_can_own_do_not_reach_the_fit():
    tube, T_rack_tube = PLACED["C5"]
    own = scenes.tube_surface(tube, T_rack_tube, RACK.height_m, seen_from=scenes.towards_camera(T_CAMERA_RACK))
    high = own[:60] * [1, 1, 0] + [0, 0, RACK.floor_m + tube.height_m + 25e-3]
    points = transform_points(T_CAMERA_RACK, np.vstack([scenes.rack_top(RACK), own, high]))
    rows = np.arange(len(points))
    box = (np.nan,) * 4
    standing = rows[-len(own) - len(high) :]
    detector = Fixed(
        (Detection("rack", 1.0, box, "recorded", rows), Detection("purple-cap", 1.0, box, "recorded", standing))
    )
    frame = type(frame_of())(points[None], None, scenes.CAMERA, None, "test", organised=False)
    (target,) = prepare(frame, detector=detector, hint=hint_for(T_CAMERA_RACK)).targets
    assert target.slot == "C5"
    above = np.sum(own[:, 2] > RACK.height_m + CONFIG.slots.clearance_m)
    assert len(target.points_m) == pytest.approx(above, abs=0.01 * above)
    assert target.points_m[:, 2].max() < RACK.floor_m + tube.height_m + 1e-3


# The method that looks at the whole frame


@pytest.fixture(scope="module")
def seen():
    """A ray cast frame of the placed tubes, each looked at by `profile` with its rack's pose given."""
    frame = ps.rendered(RACK, PLACED, T_CAMERA_RACK)
    return prepare_scene(frame, RACK, TUBES, Fixed(()), CONFIG, T_camera_rack=T_CAMERA_RACK, methods=("profile",))


def test_profile_needs_neither_boxes_nor_the_slots_of_others(seen):
    assert seen.targets == ()
    assert [time.stage for time in seen.times] == ["detect", "sensor", "slots"]
    result = estimate_tubes(seen, "profile", CONFIG)
    estimates, times = result.estimates, result.times
    assert {e.target.slot: e.target.tube for e in estimates} == {slot: tube for slot, (tube, _) in PLACED.items()}
    assert {(e.method, e.seed, e.target.detection, e.target.why) for e in estimates} == {("profile", None, None, None)}
    assert [time.instance for time in times] == [estimate.target.slot for estimate in estimates]
    assert len({time.duration_ms for time in times}) == 1
    for estimate in estimates:
        _, T_rack_tube = PLACED[estimate.target.slot]
        assert estimate.pose.status is TubeStatus.OK
        T_camera_tube = T_CAMERA_RACK @ T_rack_tube
        assert np.rad2deg(tilt_rad(estimate.T_camera_tube[:3, 2], T_camera_tube[:3, 2])) < 0.35
        assert np.allclose(estimate.T_camera_tube, T_CAMERA_RACK @ estimate.pose.T_rack_tube)
        assert 0 < estimate.target.top_support <= 1
        assert len(estimate.target.points_m) == estimate.pose.n_points


def test_other_methods_still_have_their_targets_beside_profile():
    found = prepare_scene(
        frame_of(),
        RACK,
        TUBES,
        GeometricDetector(RACK, TUBES),
        CONFIG,
        hint_for(T_CAMERA_RACK),
        methods=("profile", "paper"),
    )
    assert {target.slot for target in found.targets} == set(PLACED)
    alone = prepare_scene(
        frame_of(), RACK, TUBES, GeometricDetector(RACK, TUBES), CONFIG, hint_for(T_CAMERA_RACK), methods=("profile",)
    )
    assert alone.targets == ()


def test_profile_without_a_rack_or_types_invents_nothing(seen):
    lost = prepare(frame_of(), detector=Fixed(()))
    assert estimate_tubes(lost, "profile", CONFIG).estimates == ()
    bare = prepare_scene(seen.frame, RACK, (), Fixed(()), CONFIG, T_camera_rack=T_CAMERA_RACK, methods=("profile",))
    estimates = estimate_tubes(bare, "profile", CONFIG).estimates
    assert {(entry.target.tube, entry.pose.status, entry.T_camera_tube) for entry in estimates} == {
        (None, TubeStatus.REJECTED, None)
    }


def test_a_tube_across_the_rack_is_no_target_of_profile_but_a_row_with_a_reason():
    lying = np.random.default_rng(0).uniform([-45, -8, 68], [45, 8, 72], (20_000, 3)) * 1e-3
    points = transform_points(T_CAMERA_RACK, np.vstack([scenes.rack_top(RACK), lying]))
    found = prepare_scene(
        scenes.unorganised(points), RACK, TUBES, Fixed(()), CONFIG, T_camera_rack=T_CAMERA_RACK, methods=("profile",)
    )
    result = estimate_tubes(found, "profile", CONFIG)
    (estimate,), (time,) = result.estimates, result.times
    assert (estimate.target.slot, estimate.target.tube, estimate.T_camera_tube) == (None, None, None)
    assert estimate.target.why == estimate.pose.checks[0]
    assert estimate.pose.reason_code == "lies_across"
    assert time.instance == ""
    rows = {row["slot"]: row for row in slot_rows({}, "profile", found, (estimate,))}
    # Nothing can be put into the slots under it.
    covered = {slot.name for slot in RACK.all_slots if np.all(np.abs(slot.center_m) < (38e-3, 4e-3))}
    beside = {slot.name for slot in RACK.all_slots if np.any(np.abs(slot.center_m) > (52e-3, 14e-3))}
    assert covered
    for name, row in rows.items():
        assert row["state"] != "empty" or name not in covered
        assert not (row.get("status") and name in beside)
        if row.get("status"):
            assert (row["status"], row["reason"]) == ("rejected", estimate.pose.reason)


def test_a_slot_with_two_finds_has_one_row_and_it_is_the_first(seen):
    estimates = estimate_tubes(seen, "profile", CONFIG).estimates
    first = estimates[0]
    second = dataclasses.replace(
        first,
        target=dataclasses.replace(first.target, tube=None, why=said("second_top", "a second top")),
        pose=dataclasses.replace(first.pose, status=TubeStatus.REJECTED, reason="a second top", T_rack_tube=None),
    )
    rows = slot_rows({}, "profile", seen, (*estimates, second))
    (row,) = [row for row in rows if row["slot"] == first.target.slot]
    assert (row["tube"], row["status"], row["state"]) == (first.target.tube.name, "ok", "occupied")
    assert sum(row["state"] == "occupied" for row in rows) == len(estimates)


# What a detector's classes say of the types


def top_box(slot, tube, class_name, half_px=14.0, off_px=0.0, score=0.9):
    top = np.array([*RACK.slot(slot).center_m, RACK.floor_m + tube.height_m])
    u, v = seen_camera().project(transform_points(T_CAMERA_RACK, top)) + off_px
    return Detection(class_name, score, (u - half_px, v - half_px, u + half_px, v + half_px), "recorded")


def seen_camera():
    return default_camera(700).intrinsics


def told(seen, *boxes):
    return allowed_types(dataclasses.replace(seen, detections=boxes))


def test_a_box_of_a_known_class_leaves_its_slot_that_type_alone(seen):
    may = told(seen, top_box("C5", TUBES[2], "white-cap"), top_box("A1", TUBES[0], "chen2023-tube-1", off_px=3.0))
    names = [slot.name for slot in RACK.all_slots]
    assert may[:, names.index("C5")].tolist() == [False, False, True]
    assert may[:, names.index("A1")].tolist() == [True, False, False]
    others = [i for i, name in enumerate(names) if name not in ("C5", "A1")]
    assert may[:, others].all()


def test_the_better_of_two_boxes_of_a_slot_tells_its_type(seen):
    better, worse = top_box("C5", TUBES[2], "white-cap"), top_box("C5", TUBES[1], "purple-cap", score=0.8)
    slot = [slot.name for slot in RACK.all_slots].index("C5")
    for boxes in ((better, worse), (worse, better)):
        assert told(seen, *boxes)[:, slot].tolist() == [False, False, True]


def test_boxes_that_say_no_type_leave_all(seen):
    nowhere = Detection("white-cap", 0.9, (np.nan,) * 4, "recorded", np.arange(3))
    assert told(seen) is None
    assert told(seen, top_box("C5", TUBES[2], "tube"), top_box("C5", TUBES[2], "rack"), nowhere) is None
    far = Detection("white-cap", 0.9, (0.0, 0.0, 4.0, 4.0), "recorded")
    assert told(seen, far).all()


def test_a_wrong_class_costs_its_tube_and_no_other(seen):
    wrong = dataclasses.replace(seen, detections=(top_box("E10", TUBES[1], "purple-cap"),))
    ok = {e.target.slot for e in estimate_tubes(wrong, "profile", CONFIG).estimates if e.pose.status is TubeStatus.OK}
    assert ok == {"A1", "C5"}


@pytest.mark.parametrize(
    ("tubes", "words"), [(TUBES, "none of the given types was found"), ((), r"no tube model is given \(--tubes\)")]
)
def test_a_slot_where_a_detector_is_sure_and_nothing_is_found_is_not_empty(tubes, words):
    rng = np.random.default_rng(0)
    few = np.array([*RACK.slot("C5").center_m, 85e-3]) + rng.uniform(-4, 4, (60, 3)) * np.array([1, 1, 6]) * 1e-3
    frame = scenes.organised(transform_points(T_CAMERA_RACK, np.vstack([scenes.rack_top(RACK), few])))
    pixels = scenes.CAMERA.project(transform_points(T_CAMERA_RACK, few))
    box = (*pixels.min(axis=0), *pixels.max(axis=0))
    for score in (0.3, 0.9):
        seen = prepare_scene(
            frame, RACK, tubes, Fixed((Detection("tube-open", score, box, "yolo"),)), CONFIG,
            T_camera_rack=T_CAMERA_RACK, methods=("profile",),
        )  # fmt: skip
        told = [e for e in estimate_tubes(seen, "profile", CONFIG).estimates if e.target.slot == "C5"]
        assert bool(told) == (score == 0.9)
    assert [bool(re.search(words, e.pose.reason)) for e in told] == [True]
