"""Recorded boxes: YOLO label files and COCO JSON."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tubepose.capture.frame import RgbdFrame
from tubepose.detection.box_writing import LabelledImage, write_coco, write_yolo_txt
from tubepose.detection.model import Detection
from tubepose.detection.recorded import RecordedDetector
from tubepose.errors import DetectorError

WIDTH, HEIGHT = 200, 100
NAMES = ["rack", "tube_a"]


def frame(capture="trial_01/original", index=0, *, width=WIDTH, height=HEIGHT, organised=True):
    return RgbdFrame(np.full((height, width, 3), np.nan), None, None, None, capture, index, organised)


def label_folder(folder, classes="rack\ntube_a\n", **files):
    folder.mkdir(exist_ok=True)
    (folder / "classes.txt").write_text(classes)
    for name, text in files.items():
        (folder / f"{name}.txt").write_text(text)
    return folder


def coco(path, images, annotations, categories=((7, "Tube Rack"), (3, " tube_a "))):
    data = {
        "info": {"year": 2024},
        "images": images,
        "annotations": annotations,
        "categories": [{"id": number, "name": name, "supercategory": "x"} for number, name in categories],
    }
    path.write_text(json.dumps(data))
    return path


IMAGE = {"id": 11, "file_name": "trial_01/original.png", "width": WIDTH, "height": HEIGHT}
BOX = {"id": 1, "image_id": 11, "category_id": 3, "bbox": [20, 10, 40, 30], "area": 1200, "segmentation": []}


def test_yolo_line_becomes_first_and_last_pixel(tmp_path):
    # Centre 40, 25 and size 40 x 30 pixels: columns 20 to 59, rows 10 to 39.
    folder = label_folder(tmp_path / "labels", trial_01_original="1 0.2 0.25 0.2 0.3\n\n0 0.5 0.5 1 1 0.75\n")
    tube, rack = RecordedDetector(folder).detect(frame())
    assert tube.box_xyxy_px == pytest.approx((20, 10, 59, 39))
    assert (tube.class_name, tube.score, tube.source) == ("tube_a", 1.0, "recorded")
    assert rack.box_xyxy_px == pytest.approx((0, 0, 199, 99))
    assert (rack.class_name, rack.score) == ("rack", 0.75)


@pytest.mark.parametrize("name", ["trial_01_original_2", "original_2", "trial_01_original", "original"])
def test_every_name_of_a_frame_is_found(tmp_path, name):
    folder = label_folder(tmp_path / "labels", **{name: "1 0.2 0.25 0.2 0.3"})
    assert len(RecordedDetector(folder).detect(frame(index=2))) == 1


def test_the_most_exact_name_wins(tmp_path):
    folder = label_folder(tmp_path / "labels", original="", original_2="1 0.2 0.25 0.2 0.3")
    detector = RecordedDetector(folder)
    assert len(detector.detect(frame(index=2))) == 1
    assert detector.detect(frame(index=1)) == ()


def test_frame_without_boxes_says_what_was_looked_for(tmp_path):
    folder = label_folder(tmp_path / "labels", other="")
    message = "no boxes for capture 'trial_01/original' frame 2; looked for trial_01_original_2.txt, original_2.txt"
    with pytest.raises(DetectorError, match=message):
        RecordedDetector(folder).detect(frame(index=2))
    path = coco(tmp_path / "c.json", [IMAGE], [])
    with pytest.raises(DetectorError, match="no image for capture 'trial_02' frame 0; looked for trial_02_0, trial_02"):
        RecordedDetector(path).detect(frame("trial_02"))


def test_short_name_never_serves_two_captures(tmp_path):
    folder = label_folder(tmp_path / "labels", original="")
    detector = RecordedDetector(folder)
    detector.detect(frame("trial_01/original"))
    detector.detect(frame("trial_01/original"))
    with pytest.raises(
        DetectorError, match=r"fits captures 'trial_01/original' and 'trial_02/original'.*trial_02_original"
    ):
        detector.detect(frame("trial_02/original"))
    single = RecordedDetector(coco(tmp_path / "c.json", [IMAGE], [BOX]))
    single.detect(frame("trial_01/original"))
    with pytest.raises(DetectorError, match="fits captures"):
        single.detect(frame("trial_02/original"))


def test_one_file_is_used_for_every_frame(tmp_path):
    folder = label_folder(tmp_path / "labels", boxes="1 0.2 0.25 0.2 0.3")
    detector = RecordedDetector(folder / "boxes.txt")
    assert len(detector.detect(frame("a"))) == len(detector.detect(frame("b", 3))) == 1


def test_class_names_are_stripped_and_may_lie_elsewhere(tmp_path):
    folder = label_folder(
        tmp_path / "labels", " Tube Rack \n tube_a\t\n\n", original="0 0.5 0.5 1 1\n1 0.5 0.5 0.1 0.1"
    )
    assert [item.class_name for item in RecordedDetector(folder).detect(frame())] == ["rack", "tube_a"]
    given_names = tmp_path / "names.txt"
    given_names.write_bytes(b"\xef\xbb\xbfholder\r\nblue\r\n")
    found = RecordedDetector(folder, classes=given_names, class_map={"holder": "rack"}).detect(frame())
    assert [item.class_name for item in found] == ["rack", "blue"]
    (folder / "classes.txt").rename(tmp_path / "classes.txt")
    assert len(RecordedDetector(folder).detect(frame())) == 2


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 0.2 0.25 0.2", r"original.txt:2: found 4 fields, expected 5 or 6: class number"),
        ("1 0 0 1 0 1 1 0 1", r"original.txt:2: found 9 fields"),
        ("tube_a 0.2 0.25 0.2 0.3", r"original.txt:2: found 'tube_a .*expected numbers"),
        ("1.5 0.2 0.25 0.2 0.3", r"original.txt:2: .*expected numbers"),
        ("2 0.2 0.25 0.2 0.3", r"original.txt:2: found class number 2, expected 0 to 1: there are 2 class names"),
        ("-1 0.2 0.25 0.2 0.3", r"found class number -1"),
        ("1 40 25 40 30", r"original.txt:2: .*divide pixels by the image's size"),
        ("1 nan 0.25 0.2 0.3", r"original.txt:2: found '1 nan"),
        ("1 0.2 0.25 0 0.3", r"width 0 and height 0.3, expected more than 0"),
        ("1 0.2 0.25 0.2 0.3 80", r"original.txt:2: "),
    ],
)
def test_malformed_lines_name_file_and_line(tmp_path, line, message):
    folder = label_folder(tmp_path / "labels", original=f"0 0.5 0.5 1 1\n{line}\n")
    with pytest.raises(DetectorError, match=message) as caught:
        RecordedDetector(folder).detect(frame())
    assert "\n" not in str(caught.value)


def test_class_files_that_cannot_be_used(tmp_path):
    with pytest.raises(DetectorError, match=r"classes.txt:2: found an empty line, expected a class name"):
        RecordedDetector(label_folder(tmp_path / "a", "rack\n\ntube_a\n"))
    with pytest.raises(DetectorError, match="no class names; expected one name a line"):
        RecordedDetector(label_folder(tmp_path / "b", "\n"))
    bare = tmp_path / "c" / "labels"
    bare.mkdir(parents=True)
    with pytest.raises(
        DetectorError, match=r"no class names; expected .*classes.txt with one name a line .*, or give classes"
    ):
        RecordedDetector(bare)
    with pytest.raises(DetectorError, match=r"none.txt: no such file"):
        RecordedDetector(bare, classes=tmp_path / "none.txt")
    folder = label_folder(tmp_path / "d")
    with pytest.raises(DetectorError, match="class_map names unknown class 'blue'; known classes: rack, tube_a"):
        RecordedDetector(folder, class_map={"blue": "x"})


def test_paths_that_cannot_be_used(tmp_path):
    with pytest.raises(DetectorError, match=r"no such file or folder; expected a COCO .json"):
        RecordedDetector(tmp_path / "none")
    other = tmp_path / "boxes.csv"
    other.write_text("")
    with pytest.raises(DetectorError, match=r"expected a COCO .json, a YOLO .txt or a folder"):
        RecordedDetector(other)
    folder = label_folder(tmp_path / "labels")
    (folder / "original.txt").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(DetectorError, match=r"original.txt: cannot be read as text"):
        RecordedDetector(folder).detect(frame())


def test_coco_boxes(tmp_path):
    second = BOX | {"id": 2, "category_id": 7, "bbox": [0, 0, 200, 100.5], "score": 0.5}
    path = coco(tmp_path / "boxes.json", [IMAGE, {"id": 12, "file_name": "b.png"}], [BOX, second])
    detector = RecordedDetector(path)
    tube, rack = detector.detect(frame())
    assert (tube.class_name, tube.score, tube.box_xyxy_px) == ("tube_a", 1.0, (20, 10, 59, 39))
    assert (rack.class_name, rack.score, rack.box_xyxy_px) == ("rack", 0.5, (0, 0, 199, 99))
    assert detector.detect(frame("b")) == ()


@pytest.mark.parametrize(
    "file_name",
    [
        "trial_01/original.png",
        "original.png",
        "trial_01/original",
        "trial_01_original_0.png",
        "data\\original.jpg",
        "trial_01/original/image.png",
    ],
)
def test_coco_file_names_that_mean_the_capture(tmp_path, file_name):
    path = coco(tmp_path / "boxes.json", [IMAGE | {"file_name": file_name}], [BOX])
    assert len(RecordedDetector(path).detect(frame())) == 1


def test_coco_images_with_one_short_name(tmp_path):
    images = [IMAGE, IMAGE | {"id": 12, "file_name": "trial_02/original.png"}]
    detector = RecordedDetector(coco(tmp_path / "boxes.json", images, [BOX]))
    assert len(detector.detect(frame("trial_01/original"))) == 1
    assert detector.detect(frame("trial_02/original")) == ()
    with pytest.raises(DetectorError, match="2 images fit capture 'original' frame 0"):
        detector.detect(frame("original"))


def test_coco_of_another_image_size(tmp_path):
    detector = RecordedDetector(coco(tmp_path / "boxes.json", [IMAGE], [BOX]))
    with pytest.raises(DetectorError, match=r"boxes for an image of 200 x 100 pixels, but .* has 400 x 200"):
        detector.detect(frame(width=400, height=200))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bbox": [1, 2, 3]}, r"annotations.0.bbox.3: Field required; expected a COCO file"),
        ({"bbox": [1, 2, 0, 4]}, r"annotations.0: found a bbox of width 0 and height 4, expected more than 0"),
        ({"bbox": [1, 2, float("nan"), 4]}, r"annotations.0.bbox.2"),
        ({"image_id": 5}, r"annotations.0: image_id 5 is not among the images"),
        ({"category_id": 5}, r"annotations.0: category_id 5 is not among the categories"),
        ({"score": 80}, r"annotations.0.score"),
    ],
)
def test_coco_entries_that_are_wrong(tmp_path, change, message):
    path = coco(tmp_path / "boxes.json", [IMAGE], [BOX | change])
    with pytest.raises(DetectorError, match=message) as caught:
        RecordedDetector(path)
    assert "\n" not in str(caught.value)


def test_coco_files_that_are_wrong(tmp_path):
    path = tmp_path / "boxes.json"
    for text, message in (("{", "Invalid JSON"), ("[]", "expected a COCO file"), ('{"images": []}', "annotations")):
        path.write_text(text)
        with pytest.raises(DetectorError, match=message):
            RecordedDetector(path)
    with pytest.raises(DetectorError, match="images: found 2 entries with 1 ids"):
        RecordedDetector(coco(path, [IMAGE, IMAGE], []))


def test_box_outside_the_image_is_refused(tmp_path):
    path = coco(tmp_path / "boxes.json", [IMAGE], [BOX | {"bbox": [300, 10, 20, 20]}])
    with pytest.raises(DetectorError, match=r"annotations.0: box lies outside the image of 200 x 100"):
        RecordedDetector(path).detect(frame())


def test_frame_without_pixels_is_refused(tmp_path):
    folder = label_folder(tmp_path / "labels", original="")
    with pytest.raises(DetectorError, match="neither an image nor an organised cloud"):
        RecordedDetector(folder).detect(frame(organised=False))


pixel_boxes = st.tuples(st.floats(0, WIDTH - 1), st.floats(0, HEIGHT - 1), st.floats(0, 1), st.floats(0, 1)).map(
    lambda b: (b[0], b[1], b[0] + b[2] * (WIDTH - 1 - b[0]), b[1] + b[3] * (HEIGHT - 1 - b[1]))
)
detections = st.lists(
    st.builds(Detection, st.sampled_from(NAMES), st.floats(0, 1), pixel_boxes, st.just("recorded")), max_size=5
)


@given(found=detections)
@settings(max_examples=50)
def test_both_formats_give_back_what_was_written(tmp_path_factory, found):
    folder = label_folder(tmp_path_factory.mktemp("round") / "labels")
    write_yolo_txt(folder / "original.txt", found, (WIDTH, HEIGHT), NAMES, with_scores=True)
    path = folder.parent / "boxes.json"
    write_coco(path, [LabelledImage("trial_01/original.png", (WIDTH, HEIGHT), tuple(found))], NAMES)
    for detector in (RecordedDetector(folder), RecordedDetector(path)):
        again = detector.detect(frame())
        assert [item.class_name for item in again] == [item.class_name for item in found]
        for new, old in zip(again, found, strict=True):
            assert new.score == pytest.approx(old.score, abs=1e-9)
            assert new.box_xyxy_px == pytest.approx(old.box_xyxy_px, abs=1e-6)


def test_training_labels_carry_no_score(tmp_path):
    box = Detection("tube_a", 0.5, (20, 10, 59, 39), "yolo")
    write_yolo_txt(tmp_path / "a.txt", [box], (WIDTH, HEIGHT), NAMES)
    assert (tmp_path / "a.txt").read_text() == "1 0.2 0.25 0.2 0.3\n"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_what_cannot_be_written(tmp_path):
    box = Detection("blue", 1.0, (1, 2, 3, 4), "yolo")
    with pytest.raises(DetectorError, match="class 'blue' is not among the names: rack, tube_a"):
        write_yolo_txt(tmp_path / "a.txt", [box], (WIDTH, HEIGHT), NAMES)
    nowhere = Detection("rack", 1.0, (np.nan,) * 4, "geometric")
    with pytest.raises(DetectorError, match="a rack has a box without pixels"):
        write_coco(tmp_path / "a.json", [LabelledImage("a.png", (WIDTH, HEIGHT), (nowhere,))], NAMES)
    assert list(tmp_path.iterdir()) == []
