"""Label files as Ultralytics, Roboflow, Darknet, CVAT and Label Studio lay them out."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tubepose.capture.frame import RgbdFrame
from tubepose.detection.label_formats import picture_names, read_class_names
from tubepose.detection.labelled_images import labelled_set
from tubepose.detection.recorded import RecordedDetector
from tubepose.errors import DetectorError

NAMES = ("rack", "tube")
CLASS_TEXTS = {
    "classes.txt": "rack\ntube\n",
    "obj.names": "rack\ntube\n",
    "_darknet.labels": "rack\r\ntube\r\n",
    "data.yaml": "train: ../train/images\nnc: 2\nnames: ['rack', 'tube']\n",
    "data.yml": "names:\n  0: rack\n  1: tube\n",
    "notes.json": json.dumps({"categories": [{"id": 0, "name": "rack"}, {"id": 1, "name": "tube"}], "info": {}}),
}
LINE = "1 0.5 0.5 0.25 0.5\n"


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def picture(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.zeros((40, 80, 3), np.uint8))


@pytest.mark.parametrize("name", CLASS_TEXTS)
def test_every_list_of_class_names(tmp_path, name):
    write(tmp_path / name, CLASS_TEXTS[name])
    assert read_class_names(tmp_path / name) == NAMES


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("data.yaml", "names: 3\n", "no class names; expected 'names:'"),
        ("data.yaml", "names: {0: rack, 2: tube}\n", "numbered from 0"),
        ("data.yaml", "names: [rack]\nnc: 2\n", "'nc: 2', but 1 names"),
        ("data.yaml", "names: [rack, [tube]]\n", "names that are words"),
        ("data.yaml", "names: [", "not valid YAML"),
        ("notes.json", "{}", "expected 'categories'"),
        ("notes.json", "[]", "expected a JSON object"),
        ("obj.names", "rack\n\ntube\n", "found an empty line"),
        ("obj.names", "", "no class names"),
    ],
)
def test_wrong_lists_are_refused_in_one_line(tmp_path, name, text, message):
    write(tmp_path / name, text)
    with pytest.raises(DetectorError, match=message) as told:
        read_class_names(tmp_path / name)
    assert "\n" not in str(told.value)


def test_names_of_pictures_before_label_formats_changed_them():
    assert picture_names("shot_2") == ("shot_2",)
    assert picture_names("shot_2_png.rf.0a1b2c3d4e5f60718293a4b5c6d7e8f9")[-1] == "shot_2"
    assert picture_names("3fa9c1d2-shot_2")[-1] == "shot_2"
    assert picture_names("3fa9c1d2-shot_2_jpg.rf.AbCdEf123456")[-1] == "shot_2"
    assert picture_names("beef-rack") == ("beef-rack",)


FILES = {
    "plain": ("", "{}"),
    "roboflow": ("", "{}_png.rf.0a1b2c3d4e5f60718293a4b5c6d7e8f9"),
    "label studio": ("", "3fa9c1d2-{}"),
}


@pytest.mark.parametrize("tool", FILES)
@pytest.mark.parametrize("classes", ["obj.names", "../data.yaml", "../../data.yaml", "../notes.json"])
def test_recorded_boxes_of_label_formats(tmp_path, tool, classes):
    folder = tmp_path / "set" / "train" / "labels"
    write(folder / f"{FILES[tool][1].format('trial_01_original')}.txt", LINE)
    write(folder / classes, CLASS_TEXTS[Path(classes).name])
    frame = RgbdFrame(np.full((40, 80, 3), np.nan), None, None, None, "trial_01/original")
    (found,) = RecordedDetector(folder).detect(frame)
    assert (found.class_name, found.box_xyxy_px) == ("tube", (30, 10, 49, 29))


def test_two_label_files_of_one_picture_are_refused(tmp_path):
    write(tmp_path / "classes.txt", CLASS_TEXTS["classes.txt"])
    for start in ("3fa9c1d2", "00000001"):
        write(tmp_path / f"{start}-shot.txt", LINE)
    frame = RgbdFrame(np.full((40, 80, 3), np.nan), None, None, None, "shot")
    with pytest.raises(DetectorError, match=r"2 files fit .*; keep one of them"):
        RecordedDetector(tmp_path).detect(frame)


@pytest.mark.parametrize("name", ["images/3fa9c1d2-shot.png", "shot_jpg.rf.0a1b2c3d4e5f6071.jpg"])
def test_coco_of_label_formats(tmp_path, name):
    data = {
        "images": [{"id": 0, "file_name": name, "width": 80, "height": 40}],
        "categories": [{"id": 0, "name": "rack"}, {"id": 1, "name": "tube"}],
        "annotations": [{"id": 0, "image_id": 0, "category_id": 1, "bbox": [30, 10, 20, 20]}],
    }
    write(tmp_path / "result.json", json.dumps(data))
    frame = RgbdFrame(np.full((40, 80, 3), np.nan), None, None, None, "shot")
    (found,) = RecordedDetector(tmp_path / "result.json").detect(frame)
    assert found.class_name == "tube"


def layouts(root: Path) -> dict[str, Path]:
    """What is given for a set of one picture, by the tool that laid it out."""
    for tool, (image, label, names) in {
        "plain": ("images/a.png", "labels/a.txt", "classes.txt"),
        "label studio": ("images/3fa9c1d2-a.png", "labels/3fa9c1d2-a.txt", "notes.json"),
        "roboflow": ("train/images/a_png.rf.0123456789ab.png", "train/labels/a_png.rf.0123456789ab.txt", "data.yaml"),
        "ultralytics": ("images/train/a.png", "labels/train/a.txt", "data.yaml"),
        "darknet": ("obj_train_data/a.png", "obj_train_data/a.txt", "obj.names"),
        "labels of roboflow": ("images/a.png", "labels/a_png.rf.0123456789ab.txt", "obj.names"),
    }.items():
        picture(root / tool / image)
        write(root / tool / label, LINE)
        write(root / tool / names, CLASS_TEXTS[names])
    (root / "ultralytics" / "data.yaml").write_text(yaml.safe_dump({"train": "images/train", "names": list(NAMES)}))
    return {
        "plain": root / "plain", "label studio": root / "label studio", "roboflow": root / "roboflow" / "train",
        "roboflow data.yaml": root / "roboflow" / "data.yaml", "ultralytics": root / "ultralytics" / "images" / "train",
        "ultralytics data.yaml": root / "ultralytics" / "data.yaml", "darknet": root / "darknet" / "obj_train_data",
        "labels of roboflow": root / "labels of roboflow",
    }  # fmt: skip


def test_sets_of_every_layout(tmp_path):
    for tool, place in layouts(tmp_path).items():
        found = labelled_set(place)
        assert found.classes == NAMES, tool
        ids, edges = found.read_boxes(0, (80, 40))
        assert ids.tolist() == [1], tool
        np.testing.assert_allclose(edges, [[30, 10, 50, 30]])
        assert found.read_image(0).shape == (40, 80, 3)


@pytest.mark.parametrize("tool", ["roboflow", "ultralytics", "darknet"])
def test_a_set_in_parts_names_them_and_the_hint_works(tmp_path, tool):
    layouts(tmp_path)
    with pytest.raises(DetectorError, match="a set in parts; give one of them: ") as told:
        labelled_set(tmp_path / tool)
    part = Path(str(told.value).rsplit("give one of them: ", 1)[1].split(", ")[0])
    assert labelled_set(part).classes == NAMES


def test_sets_that_are_none_are_refused(tmp_path):
    picture(tmp_path / "images" / "a.png")
    with pytest.raises(DetectorError, match=r"no class names; expected one of classes\.txt, obj\.names, data\.yaml"):
        labelled_set(tmp_path)
    write(tmp_path / "data.yaml", "names: [rack, tube]\n")
    with pytest.raises(DetectorError, match="expected 'train:' with a folder of pictures"):
        labelled_set(tmp_path / "data.yaml")
    with pytest.raises(DetectorError, match="no such folder"):
        labelled_set(tmp_path / "gone")
