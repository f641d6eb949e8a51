"""The network's boxes with the geometric detector at its side, and what the results say of it."""

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
import scenes
from test_pipeline import CONFIG, PLACED, RACK, T_CAMERA_RACK, TUBES, frame_of, hint_for

from tubepose import pipeline
from tubepose.capture.frame import RgbdFrame
from tubepose.detection import Detection, Detector, best_rack, points_in_box, rows_in_box
from tubepose.detection.assisted import AssistedDetector
from tubepose.detection.geometric import GeometricDetector
from tubepose.detection.model import CAPPED_CLASS, OPEN_CLASS
from tubepose.pipeline import prepare_scene
from tubepose.rack import RackPose, RackStatus
from tubepose.records import rack_row
from tubepose.slots import identify_tube
from tubepose.transforms import transform_points

WHOLE = (0.0, 0.0, 639.0, 479.0)
CORNER = (0.0, 0.0, 20.0, 20.0)


@dataclass
class Network(Detector):
    """A network that says what it is told to, and counts how often it is asked."""

    found: tuple[Detection, ...]
    asked: int = 0

    def detect(self, _frame):
        self.asked += 1
        return self.found


@pytest.fixture(scope="module")
def frame():
    plain = frame_of(organised=True)
    return replace(plain, image=np.zeros(plain.cloud_m.shape[:2], np.uint8), intrinsics=scenes.CAMERA)


def rack_box(score, box=WHOLE):
    return Detection("rack", score, box, "yolo")


def assisted(*found):
    return AssistedDetector(Network(tuple(found)), GeometricDetector(RACK, TUBES, CONFIG))


def test_a_network_that_is_sure_of_the_rack_is_alone(frame):
    tube = Detection(CAPPED_CLASS, 0.9, (10.0, 10.0, 20.0, 20.0), "yolo")
    rack = rack_box(0.8)
    assert assisted(rack, tube).detect(frame) == (rack, tube)


@pytest.mark.parametrize(
    ("found", "why"),
    [((), "the network saw no rack"), ((rack_box(0.4),), r"the network was unsure of the rack \(0.40\)")],
)
def test_the_cloud_helps_where_the_network_sees_no_rack_or_is_unsure(frame, found, why):
    helped = assisted(*found).detect(frame)
    assert {detection.source for detection in helped} == {"geometric"}
    assert len(helped) == 1 + len(PLACED)
    for detection in helped:
        assert re.fullmatch(why, detection.note)


def test_a_frame_without_an_image_is_not_shown_to_the_network(frame):
    detector = assisted(rack_box(0.9))
    helped = detector.detect(replace(frame, image=None))
    assert detector.yolo.asked == 0
    assert {detection.note for detection in helped} == {"the frame has no image for the network"}


def test_an_unsure_box_stays_where_the_cloud_has_no_rack_at_all(frame):
    empty = replace(frame, cloud_m=np.full_like(frame.cloud_m, np.nan))
    rack = rack_box(0.4)
    assert assisted(rack).detect(empty) == (rack,)


def test_a_wrong_box_of_the_network_gets_a_second_opinion_and_the_row_says_so(frame):
    detector = assisted(rack_box(0.9, CORNER))
    scene = prepare_scene(frame, RACK, TUBES, detector, CONFIG, hint_for(T_CAMERA_RACK))
    assert scene.rack_pose.status is RackStatus.OK
    row = rack_row(scene)
    assert [entry.stage for entry in scene.times] == ["detect", "rack", "sensor", "slots"]
    assert row["box_source"] == "geometric"
    assert row["box_note"].startswith("no rack in the network's box")
    assert np.allclose(
        transform_points(scene.rack_pose.T_camera_rack, np.zeros((1, 3))), T_CAMERA_RACK[:3, 3], atol=1e-3
    )
    assert sorted(target.slot for target in scene.targets) == sorted(PLACED)


def test_a_tube_that_the_network_did_not_see_is_added_from_the_cloud(frame):
    whole = GeometricDetector(RACK, TUBES, CONFIG).detect(frame)
    boxes = [Detection(CAPPED_CLASS, 0.9, tube.box_xyxy_px, "yolo") for tube in whole if not tube.is_rack]
    assert len(boxes) == len(PLACED)
    scene = prepare_scene(frame, RACK, TUBES, assisted(rack_box(0.9), *boxes[1:]), CONFIG, hint_for(T_CAMERA_RACK))
    assert [detection.source for detection in scene.detections] == ["yolo"] * len(boxes) + ["geometric"]
    assert scene.detections[-1].note == "the network saw no tube there"
    assert sorted(target.slot for target in scene.targets) == sorted(PLACED)
    # Doubtful boxes that are a little off cost no points: they are the cloud's. Sure ones keep what is in them.
    counts = {}
    for score, shift in ((0.4, 0.0), (0.4, 4.0), (0.9, 4.0)):
        off = [replace(box, score=score, box_xyxy_px=tuple(np.add(box.box_xyxy_px, shift))) for box in boxes]
        shifted = prepare_scene(frame, RACK, TUBES, assisted(rack_box(0.9), *off), CONFIG, hint_for(T_CAMERA_RACK))
        counts[score, shift] = {target.slot: len(target.points_m) for target in shifted.targets}
    assert counts[0.4, 0.0] == counts[0.4, 4.0]
    assert all(counts[0.9, 4.0][slot] < counts[0.4, 4.0][slot] for slot in counts[0.9, 4.0])
    # A doubtful box on an empty slot goes, a sure one stays.
    place = transform_points(T_CAMERA_RACK, np.array([[*RACK.slot("B3").center_m, RACK.height_m]]))
    u, v = scenes.CAMERA.project(place)[0]
    for score, kept in ((0.3, 0), (0.8, 1)):
        nothing = Detection(OPEN_CLASS, score, (u - 9, v - 9, u + 9, v + 9), "yolo")
        told = assisted(rack_box(0.9), nothing, *boxes)
        found = prepare_scene(frame, RACK, TUBES, told, CONFIG, hint_for(T_CAMERA_RACK)).detections
        assert sum(detection is nothing for detection in found) == kept
        assert len(found) == 1 + len(boxes) + kept
    # Nobody asks for tubes one by one: nothing is looked for.
    alone = prepare_scene(frame, RACK, TUBES, assisted(rack_box(0.9)), CONFIG, methods=("profile",))
    assert len(alone.detections) == 1


@pytest.mark.parametrize("name", [CAPPED_CLASS, OPEN_CLASS])
def test_a_sure_box_that_holds_neighbours_too_gives_a_closed_tube_its_own_points_alone(frame, name):
    tubes = GeometricDetector(RACK, TUBES, CONFIG).tubes_on(frame, T_CAMERA_RACK)
    wide = []
    for tube in tubes:
        left, top, right, bottom = tube.box_xyxy_px
        more = 0.4 * min(right - left, bottom - top)
        wide.append(Detection(name, 0.9, (left - more, top - more, right + more, bottom + more), "yolo"))
    assert any(len(rows_in_box(frame, box)) > 1.2 * len(tube.point_rows) for box, tube in zip(wide, tubes, strict=True))
    found = assisted(*wide).checked(frame, T_CAMERA_RACK, tuple(wide))
    for box, tube in zip(found, tubes, strict=True):
        if name == OPEN_CLASS:
            assert box.point_rows is None
        else:
            assert set(box.point_rows) <= set(tube.point_rows)
            assert len(box.point_rows) > 0.9 * len(tube.point_rows)


def test_a_sure_box_that_holds_hardly_anything_of_its_tube_gets_the_tubes_points(frame):
    tube = GeometricDetector(RACK, TUBES, CONFIG).tubes_on(frame, T_CAMERA_RACK)[0]
    left, top, right, bottom = tube.box_xyxy_px
    sliver = Detection(CAPPED_CLASS, 0.9, (left, top, left + 0.25 * (right - left), bottom), "yolo")
    (found, *_) = assisted(sliver).checked(frame, T_CAMERA_RACK, (sliver,))
    assert 0 < len(rows_in_box(frame, sliver)) < 0.3 * len(tube.point_rows)
    assert np.array_equal(found.point_rows, tube.point_rows)


def test_a_second_opinion_is_asked_for_once(frame):
    detector = assisted(rack_box(0.9, CORNER))
    found = detector.detect(frame)
    others = detector.second_opinion(frame, found, "no rack there")
    assert {box.source for box in others} == {"geometric"}
    assert {box.note for box in others} == {"no rack in the network's box (no rack there)"}
    assert detector.second_opinion(frame, others, "still none") == ()


def test_a_detector_with_one_source_of_boxes_offers_nothing_else(frame):
    found = (rack_box(0.9),)
    for detector in (Network(found), GeometricDetector(RACK, TUBES, CONFIG)):
        assert detector.second_opinion(frame, found, "no rack there") == ()
        assert detector.checked(frame, T_CAMERA_RACK, found) is found


def test_where_the_cloud_does_not_help_either_the_first_answer_stays(frame):
    cloud = frame.cloud_m.copy()
    cloud[100:] = np.nan  # what is left is no rack
    rack = rack_box(0.9, CORNER)
    scene = prepare_scene(replace(frame, cloud_m=cloud), RACK, TUBES, assisted(rack), CONFIG)
    assert scene.rack_pose.T_camera_rack is None
    assert best_rack(scene.detections) is rack
    assert rack_row(scene)["box_score"] == 0.9


def test_what_is_seen_of_a_tube_narrows_its_types_down():
    def points(tube):
        return np.tile([0.0, 0.0, RACK.floor_m + tube.height_m], (50, 1))

    closed = [tube for tube in TUBES if not tube.is_open]
    opened = [tube for tube in TUBES if tube.is_open]
    assert identify_tube(OPEN_CLASS, points(opened[0]), TUBES, RACK, CONFIG.slots)[0] == opened[0]
    for tube in closed:
        assert identify_tube(CAPPED_CLASS, points(tube), TUBES, RACK, CONFIG.slots)[0] == tube
    # As high as an open one, but seen to be capped.
    found, why = identify_tube(CAPPED_CLASS, points(opened[0]), TUBES, RACK, CONFIG.slots)
    assert found != opened[0]
    assert found is not None or why.code == "unknown_type"
    # A cap is easily taken for an opening: with no open type at hand, height decides alone.
    assert identify_tube(OPEN_CLASS, points(closed[0]), closed[:1], RACK, CONFIG.slots)[0] == closed[0]


def test_a_margin_takes_the_points_around_a_box_in():
    cloud = np.arange(20.0 * 30 * 3).reshape(20, 30, 3)
    cloud[6, 8] = np.nan
    frame = RgbdFrame(cloud, None, None, None, "plain")
    box = Detection("rack", 1.0, (5.0, 4.0, 14.0, 9.0), "recorded")
    assert len(rows_in_box(frame, box)) == 10 * 6 - 1
    assert len(rows_in_box(frame, box, 0.2)) == 14 * 10 - 1  # 1.8 pixels more on every side
    for margin in (0.0, 0.2):
        assert np.array_equal(points_in_box(frame, box, margin), frame.points_m[rows_in_box(frame, box, margin)])


def test_a_rack_is_looked_for_in_a_little_more_than_its_box(frame, monkeypatch):
    taken = []
    monkeypatch.setattr(
        pipeline, "register_rack", lambda points, *_: taken.append(len(points)) or RackPose(RackStatus.REFUSED)
    )
    for margin in (0.0, pipeline.RACK_MARGIN):
        monkeypatch.setattr(pipeline, "RACK_MARGIN", margin)
        prepare_scene(frame, RACK, TUBES, Network((rack_box(0.9, (200.0, 150.0, 400.0, 300.0)),)), CONFIG)
    assert taken[1] > 1.1 * taken[0] > 0
