"""`tubepose detector` from the outside, and the network that comes with the package."""

import cv2
import numpy as np
import onnx
import onnxruntime
import pandas as pd
import pytest
from commands import tubepose
from test_yolo import constant_model, decoded_yolox_table

from tubepose.detection.bundled import bundled_model
from tubepose.detection.labelled_images import labelled_set
from tubepose.detection.model import CAPPED_CLASS, OPEN_CLASS, RACK_CLASS
from tubepose.detection.yolo import YoloDetector
from tubepose.labware import catalogue
from tubepose_cli.detector import read_labware_list

SMALL = ("--labware", "round-10ml-3x4,centrifuge-10ml", "--side", "128", "--count", "2", "--threads", "1")


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    out = tmp_path_factory.mktemp("detector") / "set"
    assert tubepose("detector", "render", "--out", out, *SMALL).code == 0
    return out


def test_rendered_pictures_are_a_set_with_labels(rendered):
    files = labelled_set(rendered)
    assert files.classes == (RACK_CLASS, CAPPED_CLASS, OPEN_CLASS)
    assert len(files.images) == 2
    assert max(files.read_image(0).shape) == 128


def test_a_set_of_another_recipe_is_one_line(rendered):
    ended = tubepose("detector", "render", "--out", rendered, *SMALL, "--seed", "5")
    assert ended.code == 1
    assert len(ended.errors) == 1
    assert "pictures of another recipe" in ended.errors[0]


@pytest.mark.parametrize("fill", ["0.4-0.1", "3", "much"])
def test_a_fill_that_is_no_share_is_one_line(tmp_path, fill):
    ended = tubepose("detector", "render", "--out", tmp_path / "set", *SMALL, "--fill", fill)
    assert ended.code == 1
    assert ended.errors[0].startswith(f"error: --fill {fill}: expected")
    assert not (tmp_path / "set").exists()


def test_labware_is_a_list_of_names_and_files_or_the_catalogue():
    everything = read_labware_list("catalogue")
    assert len(everything.racks) + len(everything.tubes) + len(everything.caps) == len(catalogue())
    ended = tubepose("detector", "render", "--out", "nowhere", "--labware", "round-10ml-3x5,centrifuge-10ml")
    assert "did you mean 'round-10ml-3x4'" in ended.errors[0]
    ended = tubepose("detector", "render", "--out", "nowhere", "--labware", "centrifuge-10ml")
    assert "found 0 racks and 1 tubes" in ended.errors[0]


@pytest.fixture
def judged(tmp_path):
    """One picture of the network's own size with a rack and a tube, and a network that finds both and one too many."""
    for folder in ("images", "labels"):
        (tmp_path / folder).mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.full((64, 96, 3), 90, np.uint8))
    (tmp_path / "labels" / "a.txt").write_text("0 0.5 0.5 0.5 0.5\n1 0.25 0.25 0.125 0.125\n2 0.9 0.9 0.1 0.1\n")
    (tmp_path / "classes.txt").write_text("rack\nblood\nhand\n")
    rows = {
        0: [48, 32, 48, 32, 0.9, 1, 0, 0],
        1: [24, 16, 12, 8, 0.8, 0, 1, 0],
        2: [70, 20, 8, 8, 0.4, 0, 1, 0],
    }
    names = {"names": str({0: RACK_CLASS, 1: CAPPED_CLASS, 2: OPEN_CLASS}), "layout": "yolox-decoded"}
    model = constant_model(tmp_path / "model.onnx", decoded_yolox_table(rows), metadata=names)
    place = ("--images", tmp_path / "images", "--labels", tmp_path / "labels", "--classes", tmp_path / "classes.txt")
    return (*place, "--model", model, "--out", tmp_path / "out"), tmp_path / "out"


def test_evaluation_writes_figures_success_and_the_worst(judged):
    arguments, out = judged
    ended = tubepose("detector", "evaluate", *arguments, "--map", "blood=tube")
    assert ended.code == 0, ended.err
    table = pd.read_csv(out / "detection_summary.csv").set_index("class")
    assert list(table.columns) == ["n_truth", "n_detected", "precision", "recall", "ap50", "ap50_95"]
    assert list(table.index) == ["rack", "blood", "tubes", "racks"]  # a hand is neither
    assert table.loc["tubes", ["n_truth", "n_detected", "precision", "recall"]].tolist() == [1, 2, 0.5, 1.0]
    assert table.loc["racks", "ap50"] == pytest.approx(1.0)
    success = pd.read_csv(out / "detection_success.csv")
    assert success.iloc[0].tolist() == [1, 1, 1.0]
    assert cv2.imread(str(out / "worst.png")).shape[0] > 100
    assert "1 of 1 pictures" in ended.out


def test_the_score_of_an_answer_and_wrong_maps(judged):
    arguments, out = judged
    assert tubepose("detector", "evaluate", *arguments, "--map", "blood=tube", "--score", "0.5").code == 0
    assert pd.read_csv(out / "detection_summary.csv").set_index("class").loc["tubes", "precision"] == 1.0
    for given, words in (
        ("blood", "expected NAME=tube"),
        ("bleed=tube", "no such class"),
        ("blood=cap", "expected one of"),
    ):
        ended = tubepose("detector", "evaluate", *arguments, "--map", given)
        assert ended.code == 1
        assert words in ended.errors[0]


def test_training_without_its_packages_names_the_extra(tmp_path, monkeypatch):
    def missing(name):
        raise ImportError(f"No module named '{name}'")

    monkeypatch.setattr("importlib.import_module", missing)
    ended = tubepose("detector", "train", "--out", tmp_path / "model.onnx")
    assert ended.code == 1
    assert "pip install '.[train]'" in ended.errors[0]
    for option in ("--sample-side", "--late-side", "--side"):
        ended = tubepose("detector", "train", "--out", tmp_path / "model.onnx", option, "100")
        assert ended.code == 1
        assert "multiple of 32" in ended.errors[0]
    assert "expected a name that ends in .onnx" in tubepose("detector", "train", "--out", tmp_path / "m.pt").errors[0]
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- the bundled network


def test_the_bundled_model_is_small_and_says_what_it_is():
    path = bundled_model()
    assert path.stat().st_size < 10e6
    said = {entry.key: entry.value for entry in onnx.load(str(path)).metadata_props}
    assert said["license"] == "Apache-2.0"
    assert said["task"] == "detect"
    assert said["color_order"] == "BGR"
    assert len(said["training_sha256"]) == 64
    assert '"simulated": true' in said["training"]


def test_the_bundled_model_loads_by_its_own_word():
    detector = YoloDetector(bundled_model())
    assert detector.layout == "yolox"
    assert detector.words == (RACK_CLASS, CAPPED_CLASS, OPEN_CLASS)
    assert detector.net_size == (640, 640)
    assert detector.looks is not None
    assert detector.looks.rack_px == 640


def test_the_bundled_model_finds_the_rack_and_tubes_of_the_sample():
    """The sample's pictures are SIMULATED too, but by another renderer than those the network learned from."""
    from tubepose.batch import session_jobs
    from tubepose.capture.session import load_session
    from tubepose_cli.inputs import sample_session

    detector, session = YoloDetector(bundled_model()), load_session(sample_session())
    jobs, _ = session_jobs(session)
    for job, trial in zip(jobs, session.trials, strict=True):
        found = detector.detect(next(iter(job.capture.frames())))
        racks = [detection for detection in found if detection.is_rack]
        assert len(racks) == 1
        assert racks[0].score > 0.5
        assert len(found) - 1 >= 0.9 * len(trial.tubes)


def test_the_runtime_needs_nothing_but_the_file():
    session = onnxruntime.InferenceSession(str(bundled_model()), providers=["CPUExecutionProvider"])
    assert [entry.shape for entry in session.get_inputs()] == [[1, 3, "height", "width"]]
    assert [entry.type for entry in session.get_inputs()] == ["tensor(float)"]


def test_a_start_that_is_no_file_is_refused(tmp_path):
    ended = tubepose("detector", "train", "--out", tmp_path / "model.onnx", "--start", "nowhere.onnx")
    assert ended.code == 1
    assert ended.errors[0].startswith("error: --start nowhere.onnx: no such file; expected bundled, or the .onnx")
