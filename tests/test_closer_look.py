"""A network that looks at each rack again: which part it is shown, and which boxes of which look remain."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import helper, numpy_helper
from test_yolo import METADATA, TABLES, constant_model, save

from tubepose.detection.closer_look import LEAST_SCORE, MARGIN, MOST_RACKS, Looks, look_twice
from tubepose.detection.yolo import YoloDetector
from tubepose.detection.yolo_decoding import RawBoxes
from tubepose.errors import DetectorError

RACK, TUBE = 0, 1
IS_RACK = np.array([True, False])
LOOKS = Looks(64, 128)


def boxes(*rows):
    """Rows of (class, score, left, top, right, bottom)."""
    table = np.array(rows, float).reshape(-1, 6)
    return RawBoxes(table[:, 2:], table[:, 1], table[:, 0].astype(np.intp))


class Network:
    """Finds every object of a scene that lies in what it is shown; remembers what it was shown.

    A picture holds each pixel's own x and y, so that a part says where it was cut from.
    """

    def __init__(self, *objects, width=400, height=300):
        v, u = np.mgrid[:height, :width]
        self.image = np.stack([u % 256, v % 256, u // 256 + 4 * (v // 256)], axis=2).astype(np.uint8)
        self.objects, self.shown = objects, []

    def __call__(self, part, long_side_px):
        left = int(part[0, 0, 0]) + 256 * (int(part[0, 0, 2]) % 4)
        top = int(part[0, 0, 1]) + 256 * (int(part[0, 0, 2]) // 4)
        self.shown.append((left, top, part.shape[1], part.shape[0], long_side_px))
        rows = []
        for kind, score, *edges in self.objects:
            moved = np.array(edges, float) - [left, top, left, top]
            cut = np.clip(moved, 0, np.tile(part.shape[1::-1], 2))
            if (cut[2:] > cut[:2]).all():
                # What is seen larger is seen with more score: tells the looks apart.
                rows.append((kind, score + (0.05 if long_side_px == LOOKS.rack_px else 0.0), *cut))
        return boxes(*rows)

    def look(self):
        return look_twice(self.image, self, LOOKS, IS_RACK)


def test_tubes_of_a_rack_come_from_its_own_picture_and_unlikely_ones_beside_it_from_the_whole():
    network = Network((RACK, 0.9, 100, 80, 200, 140), (TUBE, 0.5, 120, 90, 140, 110), (TUBE, 0.08, 300, 200, 320, 220))
    found = network.look()
    margin = MARGIN * 100
    assert network.shown == [(0, 0, 400, 300, 64), (100 - margin, 80 - margin, 100 + 2 * margin, 60 + 2 * margin, 128)]
    rows = sorted(zip(found.class_ids.tolist(), found.scores.round(2).tolist(), found.edges_xyxy.tolist(), strict=True))
    assert rows == [
        (RACK, 0.9, [100, 80, 200, 140]),
        (TUBE, 0.08, [300, 200, 320, 220]),
        (TUBE, 0.55, [120, 90, 140, 110]),
    ]


def test_a_likely_tube_beside_the_rack_is_worth_a_larger_look_at_the_whole():
    network = Network((RACK, 0.9, 100, 80, 200, 140), (TUBE, 0.5, 120, 90, 140, 110), (TUBE, 0.6, 300, 200, 320, 220))
    assert sorted(network.look().scores.round(2)) == [0.55, 0.65, 0.9]
    assert [entry[2:] for entry in network.shown] == [(400, 300, 64), (400, 300, 128), (116, 76, 128)]


@given(
    at=st.tuples(st.integers(0, 200), st.integers(0, 140)),
    size=st.tuples(st.integers(100, 190), st.integers(40, 150)),
    tubes=st.lists(st.tuples(st.integers(0, 380), st.integers(0, 280)), max_size=8),
)
def test_every_tube_is_told_once_and_in_place(at, size, tubes):
    """Whatever the rack's place: a tube that is seen at all is one box, of one look, where it is."""
    right, bottom = min(at[0] + size[0], 400), min(at[1] + size[1], 300)
    network = Network((RACK, 0.9, *at, right, bottom), *((TUBE, 0.5, x, y, x + 8, y + 6) for x, y in tubes))
    found = network.look()
    assert (found.class_ids == RACK).sum() == 1
    told = found.edges_xyxy[found.class_ids == TUBE]
    assert len(told) == len(tubes)
    assert sorted(map(tuple, told)) == sorted((x, y, x + 8, y + 6) for x, y in tubes)


def test_a_picture_without_a_sure_rack_is_seen_large_as_a_whole():
    network = Network((RACK, LEAST_SCORE - 0.01, 100, 80, 200, 140), (TUBE, 0.5, 120, 90, 140, 110))
    assert set(network.look().scores.round(2)) == {0.34, 0.55}
    assert [entry[4] for entry in network.shown] == [64, 128]


def test_doubles_of_a_rack_are_one_look_and_there_is_an_end_to_looking():
    many = [(RACK, 0.5 + 0.01 * k, 30 * k, 10, 30 * k + 25, 40) for k in range(MOST_RACKS + 3)]
    network = Network(*many)
    network.look()
    assert len(network.shown) == 1 + MOST_RACKS
    network = Network((RACK, 0.9, 100, 80, 200, 140), (RACK, 0.8, 104, 82, 204, 142), (RACK, 0.7, 110, 90, 150, 120))
    network.look()
    assert len(network.shown) == 2


# ---------------------------------------------------------------- the file asks for it


def any_size_model(path, looks):
    """A network of any size with a YOLOX output of three levels, all of its cells empty."""
    # Rows of zeros, as many as cells of strides 8, 16 and 32: the input's mean over each cell times nothing.
    nodes, outputs = [], []
    for stride in (8, 16, 32):
        name = f"pool{stride}"
        nodes.append(
            helper.make_node("AveragePool", ["images"], [name], kernel_shape=[stride, stride], strides=[stride, stride])
        )
        nodes.append(helper.make_node("Concat", [name, name, name], [f"wide{stride}"], axis=1))
        nodes.append(helper.make_node("Slice", [f"wide{stride}", "zero", "seven", "one"], [f"seven{stride}"]))
        nodes.append(helper.make_node("Mul", [f"seven{stride}", "nothing"], [f"cells{stride}"]))
        nodes.append(helper.make_node("Reshape", [f"cells{stride}", "flat"], [f"flat{stride}"]))
        nodes.append(helper.make_node("Transpose", [f"flat{stride}"], [f"rows{stride}"], perm=[0, 2, 1]))
        outputs.append(f"rows{stride}")
    nodes.append(helper.make_node("Concat", outputs, ["output"], axis=1))
    constants = {"zero": [0], "seven": [7], "one": [1], "flat": [1, 7, -1]}
    initializers = [numpy_helper.from_array(np.array(value, np.int64), name) for name, value in constants.items()]
    initializers.append(numpy_helper.from_array(np.array(0, np.float32), "nothing"))
    metadata = {"names": "['rack', 'tube']", "layout": "yolox", "looks": looks}
    return save(path, nodes, initializers, ["output"], shape=(1, 3, "height", "width"), metadata=metadata)


def test_the_file_says_how_large_it_wants_to_see_things(tmp_path):
    path = any_size_model(tmp_path / "m.onnx", "[64, 128]")
    detector = YoloDetector(path)
    assert detector.looks == Looks(64, 128)
    sizes = []
    run = detector._session.runtime.run

    class Spy:
        def __getattr__(self, name):
            return getattr(session, name)

        def run(self, outputs, feeds):
            sizes.append(next(iter(feeds.values())).shape[2:])
            return run(outputs, feeds)

    session = detector._session.runtime
    object.__setattr__(detector._session, "runtime", Spy())
    assert detector.detect_image(np.zeros((100, 200, 3), np.uint8)) == ()
    assert sizes == [(32, 64), (64, 128)]  # no rack: the whole again, as large as a rack; height before width
    assert YoloDetector(path, image_size=96).looks is None  # a size of one's own is one look


@pytest.mark.parametrize("asked", [0.01, 0.25])
def test_what_is_asked_for_in_the_end_does_not_decide_about_the_looks(tmp_path, monkeypatch, asked):
    """A tube of score 0.22 beside the rack is worth a larger look, though no box under 0.25 be wanted."""
    shown = []

    def decoded(_output, _layout, net_size, least):
        shown.append(net_size)
        found = boxes((RACK, 0.9, 0, 0, 20, 20), (TUBE, 0.22, 50, 10, 54, 14))
        return found.take(found.scores >= least)

    detector = YoloDetector(any_size_model(tmp_path / "m.onnx", "[64, 128]"), score_threshold=asked)
    monkeypatch.setattr("tubepose.detection.yolo.decode", decoded)
    found = detector.detect_image(np.zeros((32, 64, 3), np.uint8))
    assert shown == [(64, 32), (128, 64), (128, 128)]
    assert sorted({box.score for box in found}) == [score for score in (0.22, 0.9) if score >= asked]


@pytest.mark.parametrize("looks", ["[64]", "[60, 128]", "64", "['a', 'b']", "[0, 64]"])
def test_looks_that_make_no_sense_are_refused(tmp_path, looks):
    with pytest.raises(DetectorError, match=r"metadata 'looks' is .* expected \[whole, rack\], multiples of 32"):
        YoloDetector(any_size_model(tmp_path / "m.onnx", looks))


def test_a_model_of_one_size_looks_once(tmp_path):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov8"], metadata=METADATA | {"looks": "[64, 128]"})
    assert YoloDetector(path).looks is None
