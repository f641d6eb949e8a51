import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tubepose.detection import Detection
from tubepose.detection.evaluation import evaluate_detector, kinds_of
from tubepose.detection.labelled_images import find_labelled, labelled_set
from tubepose.detection.metrics import ComparedBoxes, average_precision, box_accuracy, match, overlaps
from tubepose.errors import DetectorError

NONE = np.empty((0, 4))


def boxes(*rows):
    return np.array(rows, float).reshape(-1, 4)


def image(truth, found, scores, ignored=NONE):
    return ComparedBoxes(truth, found, np.array(scores, float), ignored)


def test_overlap_of_known_boxes():
    a, b = boxes([0, 0, 10, 10]), boxes([0, 0, 10, 10], [5, 0, 15, 10], [20, 20, 30, 30])
    assert overlaps(a, b)[0] == pytest.approx([1.0, 1 / 3, 0.0])


def test_the_better_score_takes_the_truth_and_a_second_box_is_false():
    one = image(boxes([0, 0, 10, 10]), boxes([0, 0, 10, 9], [0, 0, 10, 10]), [0.9, 0.8])
    rows, ignored = match(one, 0.5)
    assert rows.tolist() == [0, -1]
    assert not ignored.any()


def test_each_detection_takes_the_free_truth_that_it_overlaps_most():
    truth = boxes([0, 0, 10, 10], [4, 0, 14, 10])
    rows, _ = match(image(truth, boxes([3, 0, 13, 10], [1, 0, 11, 10]), [0.5, 0.4]), 0.5)
    assert rows.tolist() == [1, 0]


def test_a_box_on_something_that_does_not_count_is_neither_right_nor_wrong():
    one = image(boxes([0, 0, 10, 10]), boxes([0, 0, 10, 10], [50, 50, 60, 60]), [0.9, 0.8], boxes([45, 45, 70, 70]))
    found = box_accuracy([one], 0.5)
    assert (found.n_detected, found.precision, found.recall, found.ap50) == (1, 1.0, 1.0, pytest.approx(1.0))


def test_average_precision_of_a_known_ranking():
    # Right, wrong, right of two: precision 1 up to recall 0.5, then 2/3.
    scores, right = np.array([0.9, 0.8, 0.7]), np.array([True, False, True])
    assert average_precision(scores, right, 2) == pytest.approx((51 * 1.0 + 50 * 2 / 3) / 101)
    assert average_precision(scores[:1], right[:1], 2) == pytest.approx(51 / 101)
    assert np.isnan(average_precision(scores, right, 0))


def test_loose_boxes_count_at_half_an_overlap_and_not_at_more():
    truth = boxes([0, 0, 100, 100])
    found = box_accuracy([image(truth, boxes([0, 0, 100, 72]), [0.9])], 0.5)  # overlap 0.72: five of ten thresholds
    assert found.ap50 == pytest.approx(1.0)
    assert found.ap50_95 == pytest.approx(0.5)


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_average_precision_does_not_depend_on_order_and_only_grows_with_a_right_answer(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 30))
    scores, right, n_truth = rng.permutation(n) / n, rng.uniform(size=n) < 0.6, 40
    value, order = average_precision(scores, right, n_truth), rng.permutation(n)
    assert average_precision(scores[order], right[order], n_truth) == pytest.approx(value)
    assert 0.0 <= value <= 1.0
    more = average_precision(np.append(scores, 2.0), np.append(right, True), n_truth)
    assert more >= value - 1e-12


@pytest.fixture
def labelled(tmp_path):
    """Two pictures: a rack with two tubes, and one box that is something else."""
    import cv2

    for folder in ("images", "labels"):
        (tmp_path / folder).mkdir()
    (tmp_path / "classes.txt").write_text("tube_rack\nblood_tube\ncentrifuge\n")
    for name, text in (
        ("a", "0 0.5 0.5 0.8 0.8\n1 0.3 0.3 0.1 0.1\n1 0.7 0.3 0.1 0.1\n"),
        ("b", "2 0.5 0.5 0.2 0.2\n"),
    ):
        cv2.imwrite(str(tmp_path / "images" / f"{name}.png"), np.full((100, 200, 3), 90, np.uint8))
        (tmp_path / "labels" / f"{name}.txt").write_text(text)
    return tmp_path


def detection(name, score_, *box):
    return Detection(name, score_, tuple(float(value) for value in box), "yolo")


def test_figures_of_a_set_with_classes_of_its_own(labelled):
    files = labelled_set(labelled)
    kinds = kinds_of(files.classes, {"centrifuge": "ignore"})
    assert kinds == {"tube_rack": "rack", "blood_tube": "tube", "centrifuge": "ignore"}
    answers = iter(
        [
            (
                detection("rack", 0.9, 20, 10, 179, 89),
                detection("tube-capped", 0.8, 50, 25, 69, 34),
                detection("tube-open", 0.1, 130, 25, 149, 34),
            ),
            (detection("tube-capped", 0.9, 80, 40, 119, 59),),
        ]
    )
    report = evaluate_detector(lambda _: next(answers), ("rack", "tube-capped", "tube-open"), files, kinds, 0.3)
    table = report.summary.set_index("class")
    assert list(table.columns) == ["n_truth", "n_detected", "precision", "recall", "ap50", "ap50_95"]
    assert table.loc["tubes", ["n_truth", "n_detected", "precision", "recall"]].tolist() == [2, 1, 1.0, 0.5]
    assert table.loc["tubes", "ap50"] == pytest.approx(1.0)  # the second one is found at a lower score
    assert table.loc["racks", "recall"] == 1.0
    assert table.loc["blood_tube", "recall"] == 0.5
    assert pd.isna(table.loc["blood_tube", "ap50"])  # the detector has no such class
    assert (report.n_frames, report.n_success, report.errors.tolist()) == (1, 0, [1, 0])


def test_a_picture_is_all_right_only_with_the_right_classes(labelled):
    (labelled / "classes.txt").write_text("rack\ntube-capped\ntube-open\n")
    files = labelled_set(labelled)
    kinds = kinds_of(files.classes, {})
    right = [
        (
            detection("rack", 0.9, 20, 10, 179, 89),
            detection("tube-capped", 0.8, 50, 25, 69, 34),
            detection("tube-capped", 0.5, 130, 25, 149, 34),
        ),
        (detection("tube-open", 0.9, 80, 40, 119, 59),),
    ]
    words = ("rack", "tube-capped", "tube-open")
    assert evaluate_detector(_answers(right), words, files, kinds, 0.3).n_success == 2
    wrong = [right[0], (detection("tube-capped", 0.9, 80, 40, 119, 59),)]
    report = evaluate_detector(_answers(wrong), words, files, kinds, 0.3)
    assert report.n_success == 1
    assert report.success_rate == 0.5
    assert report.summary.set_index("class").loc["tubes", "recall"] == 1.0


def _answers(rows):
    left = iter(rows)
    return lambda _: next(left)


def test_classes_of_labels_are_mapped_or_guessed():
    assert kinds_of(("5ML_tube_rack", "Tube", "hand"), {}) == {
        "5ML_tube_rack": "rack",
        "Tube": "tube",
        "hand": "ignore",
    }
    with pytest.raises(DetectorError, match="no such class"):
        kinds_of(("tube",), {"tub": "tube"})
    with pytest.raises(DetectorError, match="expected one of tube, rack, ignore"):
        kinds_of(("tube",), {"tube": "cap"})


def test_folders_without_labels_are_refused_in_a_line(labelled, tmp_path):
    with pytest.raises(DetectorError, match="no such folder"):
        find_labelled(tmp_path / "none", labelled / "labels", labelled / "classes.txt")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DetectorError, match="found 2 pictures, but none with a label file"):
        find_labelled(labelled / "images", tmp_path / "empty", labelled / "classes.txt")


def test_a_picture_without_a_label_file_is_left_out(labelled):
    (labelled / "labels" / "b.txt").unlink()
    assert [path.stem for path in labelled_set(labelled).images] == ["a"]


def test_a_broken_picture_is_named(labelled):
    (labelled / "images" / "a.png").write_bytes(b"no picture")
    with pytest.raises(DetectorError, match=r"a\.png: cannot be read as a picture"):
        labelled_set(labelled).read_image(0)
