"""YOLO models of every family, as tiny ONNX graphs made here."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from tubepose.capture.frame import RgbdFrame
from tubepose.detection.boxes import box_from_edges, class_word, edges_from_box
from tubepose.detection.yolo import YoloDetector
from tubepose.detection.yolo_decoding import RawBoxes, anchor_count, decode, suppress, yolox_grid
from tubepose.detection.yolo_input import fit_letterbox, to_8bit_rgb, to_tensor
from tubepose.errors import DetectorError

NET = (96, 64)  # width, height: not square, so that a swapped axis shows
A = anchor_count(NET, (8, 16, 32))
NAMES = ("rack", "tube_a", "tube_b")
METADATA = {"names": str(dict(enumerate(NAMES))), "task": "detect"}


def frame(image, capture="trial_01"):
    height, width = image.shape[:2] if image is not None else (4, 4)
    return RgbdFrame(np.full((height, width, 3), np.nan), image, None, None, capture)


def black(width=96, height=64):
    return np.zeros((height, width, 3), dtype=np.uint8)


def save(path, nodes, initializers, outputs, *, half=False, shape=(1, 3, 64, 96), metadata=None):
    kind = TensorProto.FLOAT16 if half else TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("images", kind, shape)],
        [helper.make_tensor_value_info(name, kind, None) for name in outputs],
        initializers,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, metadata or {})
    onnx.save(model, str(path))
    return path


def constant_model(path, *tables, half=False, **options):
    """A network that gives these tables whatever it sees (they are added to nothing of the input)."""
    dtype = np.float16 if half else np.float32
    tables = [np.asarray(table, dtype=dtype) for table in tables]
    nodes, initializers = [helper.make_node("ReduceMax", ["images"], ["peak"], keepdims=0)], []
    initializers.append(numpy_helper.from_array(np.array(0, dtype=dtype), "zero"))
    nodes.append(helper.make_node("Mul", ["peak", "zero"], ["nothing"]))
    for number, table in enumerate(tables):
        initializers.append(numpy_helper.from_array(table, f"table{number}"))
        nodes.append(helper.make_node("Add", [f"table{number}", "nothing"], [f"output{number}"]))
    outputs = [f"output{number}" for number in range(len(tables))]
    return save(path, nodes, initializers, outputs, half=half, **options)


def v5_table(rows, count=3 * A):
    table = np.zeros((1, count, 5 + len(NAMES)))
    table[0, : len(rows)] = rows
    return table


def v8_table(rows):
    table = np.zeros((1, A, 4 + len(NAMES)))
    table[0, : len(rows)] = rows
    return table.transpose(0, 2, 1)


def final_table(rows, count=7):
    table = np.zeros((1, count, 6))
    table[0, : len(rows)] = rows
    return table


def decoded_yolox_table(rows, count=A):
    cells, strides = yolox_grid(NET, count)
    table = np.zeros((1, count, 5 + len(NAMES)))
    table[0, :, :2] = (cells + 0.5) * strides
    table[0, :, 2:4] = strides
    for anchor, row in rows.items():
        table[0, anchor] = row
    return table


def raw_yolox_table(rows):
    """The decoded table, taken back by hand: centre in cells off its own cell, log of the size in strides."""
    table = decoded_yolox_table(rows)
    cells, strides = yolox_grid(NET, A)
    table[0, :, :2] = table[0, :, :2] / strides - cells
    table[0, :, 2:4] = np.log(table[0, :, 2:4] / strides)
    return table


# One tube_b: edges 20, 10 to 40, 30 in the network, score 0.72 = 0.9 * 0.8.
V5_ROW = [30, 20, 20, 20, 0.9, 0.0, 0.1, 0.8]
V8_ROW = [30, 20, 20, 20, 0.0, 0.1, 0.72]
FINAL_ROW = [20, 10, 40, 30, 0.72, 2]
TABLES = {
    "yolov5": v5_table([V5_ROW]),
    "yolov8": v8_table([V8_ROW]),
    "final": final_table([FINAL_ROW]),
    "yolox": raw_yolox_table({5: V5_ROW}),
    "yolox-decoded": decoded_yolox_table({5: V5_ROW}),
}


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("layout", TABLES)
def test_every_layout_is_recognised_and_decoded(tmp_path, layout, half):
    path = constant_model(tmp_path / "m.onnx", TABLES[layout], half=half, metadata=METADATA)
    detector = YoloDetector(path)
    assert detector.layout == layout
    assert detector.classes == NAMES
    (found,) = detector.detect(frame(black()))
    assert (found.class_name, found.source) == ("tube_b", "yolo")
    assert found.score == pytest.approx(0.72, abs=2e-3)
    # Edges 20 to 40 are the pixels 20 to 39.
    assert found.box_xyxy_px == pytest.approx((20, 10, 39, 29), abs=0.1 if half else 1e-4)


def test_image_twice_as_large_gives_boxes_twice_as_large(tmp_path):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov8"], metadata=METADATA)
    (found,) = YoloDetector(path).detect(frame(black(192, 128)))
    assert edges_from_box(found.box_xyxy_px) == pytest.approx((40, 20, 80, 60))


@pytest.mark.parametrize("layout", ["yolov5", "yolox"])
def test_box_is_mapped_back_through_the_border(tmp_path, layout):
    path = constant_model(tmp_path / "m.onnx", TABLES[layout], metadata=METADATA)
    # 64 x 64 fits the height; 16 columns of border on both sides, or 32 at the right for YOLOX.
    (found,) = YoloDetector(path).detect(frame(black(64, 64)))
    shift = 16 if layout == "yolov5" else 0
    assert edges_from_box(found.box_xyxy_px) == pytest.approx((20 - shift, 10, 40 - shift, 30), abs=1e-4)


def probe_model(path, layout, half=False):
    """A network that boxes the first brightest pixel of each of its planes; class = plane, score = brightness.

    The class scores are the maxima of the planes (over 255 for YOLOX), so a wrong value range is seen too.
    """
    dtype = np.float16 if half else np.float32
    rows = {"yolov8": A, "yolox-decoded": A}[layout]
    constants = {
        "flat": np.array([3, -1], dtype=np.int64),
        "width": np.array(NET[0], dtype=np.int64),
        "half_pixel": np.array(0.5, dtype=dtype),
        "unit": np.array(1 / 255 if layout.startswith("yolox") else 1, dtype=dtype),
        "sizes": np.ones((3, 2) if layout == "yolov8" else (3, 3), dtype=dtype),  # w, h and YOLOX's objectness
        "eye": np.eye(3, dtype=dtype),
        "filler": decoded_yolox_table({})[0, 3:].astype(dtype)
        if layout == "yolox-decoded"
        else np.zeros((rows - 3, 7), dtype=dtype),
        "one_axis": np.array([0], dtype=np.int64),
    }
    kind = TensorProto.FLOAT16 if half else TensorProto.FLOAT
    node = helper.make_node
    nodes = [
        node("Reshape", ["images", "flat"], ["planes"]),
        node("ArgMax", ["planes"], ["index"], axis=1, keepdims=1),
        node("Mod", ["index", "width"], ["u"]),
        node("Div", ["index", "width"], ["v"]),
        node("Concat", ["u", "v"], ["pixel"], axis=1),
        node("Cast", ["pixel"], ["pixel_f"], to=kind),
        node("Add", ["pixel_f", "half_pixel"], ["centre"]),
        node("ReduceMax", ["planes"], ["peak"], axes=[1], keepdims=1),
        node("Mul", ["peak", "unit"], ["bright"]),
        node("Mul", ["eye", "bright"], ["scores"]),
        node("Concat", ["centre", "sizes", "scores"], ["rows"], axis=1),
        node("Concat", ["rows", "filler"], ["table"], axis=0),
        *([node("Transpose", ["table"], ["turned"], perm=[1, 0])] if layout == "yolov8" else []),
        node("Unsqueeze", ["turned" if layout == "yolov8" else "table", "one_axis"], ["output"]),
    ]
    initializers = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    return save(path, nodes, initializers, ["output"], half=half)


@pytest.mark.parametrize(("layout", "half"), [("yolov8", False), ("yolov8", True), ("yolox-decoded", False)])
def test_network_sees_the_image_as_its_family_was_trained(tmp_path, layout, half):
    """Colour order, range of values and place of the image, seen by the network and mapped back to the image."""
    image = black(64, 64)
    image[10, 20, 0] = 255  # red
    image[30, 40, 1] = 204  # green, four fifths
    image[50, 5, 2] = 255  # blue
    detector = YoloDetector(probe_model(tmp_path / "m.onnx", layout, half), classes=["p0", "p1", "p2"], layout=layout)
    found = {item.class_name: item for item in detector.detect(frame(image))}
    red, blue = ("p2", "p0") if layout.startswith("yolox") else ("p0", "p2")
    assert found[red].box_xyxy_px == pytest.approx((20, 10, 20, 10), abs=0.01)
    assert found["p1"].box_xyxy_px == pytest.approx((40, 30, 40, 30), abs=0.01)
    assert found[blue].box_xyxy_px == pytest.approx((5, 50, 5, 50), abs=0.01)
    assert [found[name].score for name in ("p0", "p1", "p2")] == pytest.approx([1.0, 0.8, 1.0], abs=2e-3)


def test_gray_and_16_bit_images_reach_the_network_alike(tmp_path):
    detector = YoloDetector(
        probe_model(tmp_path / "m.onnx", "yolov8"), classes=["p0", "p1", "p2"], layout="yolov8", iou_threshold=1.0
    )
    gray = np.tile(np.arange(96, dtype=np.uint16) * 600, (64, 1))
    found = detector.detect(frame(gray))
    assert {item.class_name for item in found} == {"p0", "p1", "p2"}
    assert all(item.score == pytest.approx(1.0) for item in found)
    assert len({item.box_xyxy_px for item in found}) == 1


def test_8_bit_values_stay_and_16_bit_ones_are_scaled_without_the_glints():
    image = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    np.testing.assert_array_equal(to_8bit_rgb(image), image)
    np.testing.assert_array_equal(to_8bit_rgb(image[:, :, 0]), np.repeat(image[:, :, :1], 3, axis=2))
    gray = np.tile(np.linspace(100, 1000, 200), (50, 1)).astype(np.uint16)
    gray[0, 0] = 65535
    scaled = to_8bit_rgb(gray)
    assert scaled.shape == (50, 200, 3)
    assert scaled[25, 0, 0] == 0
    assert scaled[25, 199, 0] == 255
    assert scaled[25, 100, 0] == pytest.approx(128, abs=3)


@pytest.mark.parametrize("value", [0, 7, 65535])
def test_flat_16_bit_image_stays_flat(value):
    assert len(np.unique(to_8bit_rgb(np.full((5, 5), value, dtype=np.uint16)))) == 1


def test_image_with_alpha_is_refused():
    with pytest.raises(DetectorError, match=r"shape \(4, 4, 4\): expected \(H, W\) or \(H, W, 3\)"):
        to_8bit_rgb(np.zeros((4, 4, 4), dtype=np.uint8))


def test_border_is_centred_for_v5_and_at_the_bottom_right_for_yolox():
    image = np.full((32, 96, 3), 255, dtype=np.uint8)
    centred = fit_letterbox((96, 32), NET, centred=True).apply(image)
    assert (centred[:16] == 114).all()
    assert (centred[16:48] == 255).all()
    assert (centred[48:] == 114).all()
    corner = fit_letterbox((96, 32), NET, centred=False).apply(image)
    assert (corner[:32] == 255).all()
    assert (corner[32:] == 114).all()


def test_tensor_is_rgb_to_one_or_bgr_to_255():
    canvas = np.array([[[255, 51, 0]]], dtype=np.uint8)
    rgb = to_tensor(canvas, yolox=False, dtype=np.float32)
    assert rgb.shape == (1, 3, 1, 1)
    assert rgb.ravel() == pytest.approx([1.0, 0.2, 0.0])
    assert to_tensor(canvas, yolox=True, dtype=np.float16).ravel().tolist() == [0.0, 51.0, 255.0]


@given(
    image=st.tuples(st.integers(1, 4000), st.integers(1, 4000)),
    net=st.tuples(st.integers(1, 43), st.integers(1, 43)).map(lambda sides: (32 * sides[0], 32 * sides[1])),
    centred=st.booleans(),
    corners=st.lists(st.floats(0, 1), min_size=4, max_size=4),
)
@settings(max_examples=200)
def test_letterbox_keeps_inside_and_is_undone(image, net, centred, corners):
    box = fit_letterbox(image, net, centred=centred)
    edges = np.array([corners]) * np.tile(image, 2)
    inside = edges * np.tile(box.scale, 2) + np.tile(box.pad, 2)
    assert (inside >= -1e-6).all()
    assert (inside <= np.tile(net, 2) + 1e-6).all()
    np.testing.assert_allclose(box.to_image(inside), edges, atol=1e-6)
    assert box.pad[0] + box.resized[0] <= net[0]
    assert box.pad[1] + box.resized[1] <= net[1]


def test_box_edges_become_first_and_last_pixel_and_are_cut_at_the_image():
    assert box_from_edges(np.array([-5.0, 10, 21, 99]), (40, 30)) == (0, 10, 20, 29)
    assert box_from_edges(np.array([10.2, 5.0, 10.6, 6.0]), (40, 30)) == pytest.approx((10.2, 5, 10.2, 5))
    assert box_from_edges(np.array([50.0, 0, 60, 10]), (40, 30)) is None
    assert box_from_edges(np.array([10.0, 5, 10, 9]), (40, 30)) is None


def boxes(edges, scores, classes):
    return RawBoxes(np.array(edges, dtype=float), np.array(scores), np.array(classes, dtype=np.intp))


def test_suppression_known_answer():
    # The overlap of the first two is 90 / 110; of the first and third 50 / 150.
    raw = boxes([[0, 0, 10, 10], [1, 0, 11, 10], [5, 0, 15, 10], [40, 0, 50, 10]], [0.6, 0.9, 0.7, 0.8], [0, 0, 0, 0])
    same = np.zeros(4, dtype=np.intp)
    assert suppress(raw, same, 0.45).tolist() == [1, 3, 2]
    assert suppress(raw, same, 0.4).tolist() == [1, 3]
    assert suppress(raw, same, 0.9).tolist() == [1, 3, 2, 0]
    assert suppress(raw, np.array([0, 1, 0, 0]), 0.45).tolist() == [1, 3, 2, 0]


def test_suppression_of_nothing_and_of_equal_scores():
    none = boxes(np.empty((0, 4)), [], [])
    assert suppress(none, np.empty(0, dtype=np.intp), 0.5).size == 0
    twins = boxes([[0, 0, 10, 10], [0, 0, 10, 10], [30, 0, 40, 10]], [0.5, 0.5, 0.5], [0, 0, 0])
    assert suppress(twins, np.zeros(3, dtype=np.intp), 0.5).tolist() == [0, 2]


def test_tube_types_suppress_each_other_but_never_a_rack(tmp_path):
    rows = [[10, 10, 50, 50, 0.9, 0], [10, 10, 50, 50, 0.8, 1], [10, 11, 50, 50, 0.7, 2], [11, 10, 50, 50, 0.6, 0]]
    path = constant_model(tmp_path / "m.onnx", final_table(rows), metadata=METADATA)
    found = YoloDetector(path).detect(frame(black()))
    assert [(item.class_name, round(item.score, 3)) for item in found] == [("rack", 0.9), ("tube_a", 0.8)]
    assert [item.is_rack for item in found] == [True, False]


def test_score_threshold(tmp_path):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov5"], metadata=METADATA)
    assert len(YoloDetector(path, score_threshold=0.7).detect(frame(black()))) == 1
    # Objectness alone is 0.9: the product counts.
    assert YoloDetector(path, score_threshold=0.8).detect(frame(black())) == ()


def test_words_of_classes():
    assert class_word(" Tube-Rack ") == "rack"
    assert class_word(" tube 1 ") == "tube 1"
    assert class_word("holder", {"holder": "Rack"}) == "rack"
    assert class_word("tracked", {"tracked": "chen2023-tube-1"}) == "chen2023-tube-1"


def test_class_map_and_given_classes_win(tmp_path):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov8"], metadata=METADATA)
    detector = YoloDetector(path, classes=["holder", "b ", " blue"], class_map={"blue": "chen2023-tube-2"})
    assert detector.classes == ("holder", "b", "blue")
    assert detector.detect(frame(black()))[0].class_name == "chen2023-tube-2"
    with pytest.raises(
        DetectorError, match="class_map names unknown class 'green'; known classes: rack, tube_a, tube_b"
    ):
        YoloDetector(path, class_map={"green": "x"})


def test_v6_0_with_raw_maps_beside_the_decoded_output(tmp_path):
    maps = [np.zeros((1, 3, 64 // s, 96 // s, 8)) for s in (8, 16, 32)]
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov5"], *maps)
    detector = YoloDetector(path, classes=NAMES)
    assert detector.layout == "yolov5"
    assert len(detector.detect(frame(black()))) == 1


def test_raw_maps_alone_are_refused_with_the_way_out(tmp_path):
    maps = [np.zeros((1, 3, 64 // s, 96 // s, 8)) for s in (8, 16, 32)]
    path = constant_model(tmp_path / "m.onnx", *maps)
    with pytest.raises(
        DetectorError, match=r"raw maps of YOLOv5 v5.0 or older.*export the same weights with YOLOv5 v6.0"
    ):
        YoloDetector(path, classes=NAMES)


@pytest.mark.parametrize("task", ["segment", "pose", "obb", "classify"])
def test_other_tasks_are_refused(tmp_path, task):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov8"], metadata=METADATA | {"task": task})
    with pytest.raises(DetectorError, match=f"task '{task}', expected 'detect'"):
        YoloDetector(path)


def test_segmentation_without_metadata_is_refused(tmp_path):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov8"], np.zeros((1, 32, 16, 24)))
    with pytest.raises(DetectorError, match="4-D output belongs to a segmentation model"):
        YoloDetector(path, classes=NAMES)


@pytest.mark.parametrize("names", ["['a', 'b']", "{0: 'rack', 1: 'a', 2: 'b', 3: 'c'}"])
def test_number_of_names_must_fit_the_output(tmp_path, names):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov5"], metadata={"names": names})
    with pytest.raises(DetectorError, match=r"is yolov5 with 3 classes, but there are [24] class names"):
        YoloDetector(path)


@pytest.mark.parametrize("names", ["__import__('os').getcwd()", "{0: 'a', 2: 'b'}", "[]", "['a', '']", "7"])
def test_names_are_a_literal_of_names(tmp_path, names):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov5"], metadata={"names": names})
    with pytest.raises(DetectorError, match="metadata 'names' is"):
        YoloDetector(path)


def test_model_without_names_says_how_many_it_needs(tmp_path):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov5"])
    with pytest.raises(DetectorError, match="names no classes; give classes with 3 names"):
        YoloDetector(path)
    final = constant_model(tmp_path / "f.onnx", TABLES["final"])
    with pytest.raises(DetectorError, match="names no classes; give classes"):
        YoloDetector(final)


def test_class_number_beyond_the_names(tmp_path):
    path = constant_model(tmp_path / "m.onnx", final_table([[1, 1, 9, 9, 0.9, 5]]), metadata=METADATA)
    with pytest.raises(DetectorError, match="class number 5, but there are only 3 class names"):
        YoloDetector(path).detect(frame(black()))


def test_layout_by_flag_and_by_metadata(tmp_path):
    # Rows as many as YOLOX grid cells, but six columns: one class of YOLOX, or final boxes.
    table = final_table([[20, 10, 40, 30, 0.72, 0]], count=A)
    plain = constant_model(tmp_path / "m.onnx", table, metadata={"names": "['a']"})
    assert YoloDetector(plain).layout.startswith("yolox")
    assert YoloDetector(plain, layout="final").layout == "final"
    stated = constant_model(tmp_path / "s.onnx", table, metadata={"names": "['a']", "args": "{'nms': True}"})
    assert YoloDetector(stated).layout == "final"
    assert YoloDetector(stated, layout="yolox").layout == "yolox"
    ours = constant_model(tmp_path / "o.onnx", TABLES["yolox"], metadata=METADATA | {"layout": "yolox-decoded"})
    assert YoloDetector(ours).layout == "yolox-decoded"


def test_layout_that_does_not_fit(tmp_path):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov5"], metadata=METADATA)
    with pytest.raises(DetectorError, match="layout 'yolov9' is unknown; known: yolov5, yolov8, final, yolox"):
        YoloDetector(path, layout="yolov9")
    with pytest.raises(
        DetectorError, match=r"output \[1, 378, 8\] .* fits no known layout; expected final \[1, N, 6\]"
    ):
        YoloDetector(path, layout="final")
    odd = constant_model(tmp_path / "o.onnx", np.zeros((1, 50, 8)), metadata=METADATA)
    with pytest.raises(DetectorError, match=r"output \[1, 50, 8\] .* fits no known layout; expected yolov5 \[1, 3A"):
        YoloDetector(odd)
    with pytest.raises(DetectorError, match="YOLOX output with 50 rows"):
        YoloDetector(odd, layout="yolox").detect(frame(np.full((64, 96, 3), 255, dtype=np.uint8)))


def test_output_that_two_layouts_fit_needs_a_word(tmp_path):
    rows = A - 4  # as many classes as make the columns equal to the rows, but for one
    table = np.zeros((1, A, A))
    path = constant_model(tmp_path / "m.onnx", table, metadata={"names": str(["a"] * rows)})
    assert YoloDetector(path).layout == "yolov8"
    with pytest.raises(DetectorError, match="may be yolov8 or yolox; say which with layout"):
        YoloDetector(constant_model(tmp_path / "n.onnx", table))


def test_dynamic_size_is_taken_from_metadata_flag_or_640(tmp_path):
    shape = ("batch", 3, "height", "width")
    big = anchor_count((640, 640), (8, 16, 32))
    table = np.zeros((1, big, 7)).transpose(0, 2, 1)
    path = constant_model(tmp_path / "m.onnx", table, shape=shape, metadata=METADATA)
    assert YoloDetector(path).net_size == (640, 640)
    path = constant_model(tmp_path / "s.onnx", TABLES["yolov8"], shape=shape, metadata=METADATA | {"imgsz": "[64, 96]"})
    assert YoloDetector(path).net_size == NET
    path = constant_model(tmp_path / "f.onnx", TABLES["yolov8"], shape=shape, metadata=METADATA)
    assert YoloDetector(path, image_size=NET).net_size == NET
    with pytest.raises(DetectorError, match="expected multiples of 32"):
        YoloDetector(path, image_size=100)


def test_size_given_for_a_fixed_model(tmp_path):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov8"], metadata=METADATA)
    assert YoloDetector(path, image_size=NET).net_size == NET
    with pytest.raises(DetectorError, match=r"image_size \(640, 640\) given, but the model is made for \(96, 64\)"):
        YoloDetector(path, image_size=640)


def test_values_that_make_no_sense_are_refused(tmp_path):
    broken = v8_table([V8_ROW]).copy()
    broken[0, 6, 3] = np.nan
    with pytest.raises(DetectorError, match="scores that are not numbers"):
        YoloDetector(constant_model(tmp_path / "n.onnx", broken, metadata=METADATA)).detect(frame(black()))
    logits = v8_table([[30, 20, 20, 20, 0, 4.2, 0]])
    with pytest.raises(DetectorError, match=r"score of 4.2, expected 0 to 1"):
        YoloDetector(constant_model(tmp_path / "l.onnx", logits, metadata=METADATA)).detect(frame(black()))
    other = final_table([[0.1, 0.1, 0.2, 0.2, 0.9, 0.3]])
    with pytest.raises(DetectorError, match="holds no class numbers"):
        YoloDetector(constant_model(tmp_path / "r.onnx", other, metadata=METADATA)).detect(frame(black()))
    huge = raw_yolox_table({5: V5_ROW})
    huge[0, 5, 2] = 1e6
    with pytest.raises(DetectorError, match="boxes that are not finite"):
        decode(huge[0], "yolox", NET, 0.25)


def test_frame_without_image_is_refused(tmp_path):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov8"], metadata=METADATA)
    with pytest.raises(DetectorError, match="trial_01 frame 0: no image, but a YOLO model needs one"):
        YoloDetector(path).detect(frame(None))


def test_files_that_are_no_models(tmp_path):
    with pytest.raises(DetectorError, match="no such model file"):
        YoloDetector(tmp_path / "none.onnx")
    weights = tmp_path / "best.pt"
    weights.write_bytes(b"PK")
    with pytest.raises(DetectorError, match=r"PyTorch weights; expected an .onnx file"):
        YoloDetector(weights)
    cut = tmp_path / "cut.onnx"
    for content in (
        b"",
        b"not a model\nat all",
        constant_model(tmp_path / "m.onnx", TABLES["final"]).read_bytes()[:200],
    ):
        cut.write_bytes(content)
        with pytest.raises(DetectorError, match=r"cut.onnx: ") as caught:
            YoloDetector(cut, classes=NAMES)
        assert "\n" not in str(caught.value)


def test_wrong_inputs_are_refused(tmp_path):
    wrong = constant_model(tmp_path / "m.onnx", TABLES["final"], shape=(1, 64, 96, 3), metadata=METADATA)
    with pytest.raises(DetectorError, match=r"input images \[1, 64, 96, 3\], expected one image input \[1, 3, height"):
        YoloDetector(wrong)
    batch = constant_model(tmp_path / "b.onnx", TABLES["final"], shape=(4, 3, 64, 96), metadata=METADATA)
    with pytest.raises(DetectorError, match="expected one image input"):
        YoloDetector(batch)


def test_missing_provider_is_an_error_not_a_silent_fallback(tmp_path):
    path = constant_model(tmp_path / "m.onnx", TABLES["final"], metadata=METADATA)
    asked = ("NoSuchExecutionProvider", "CPUExecutionProvider")
    with pytest.raises(
        DetectorError, match=r"asked for providers NoSuchExecutionProvider.*found .*CPUExecutionProvider"
    ):
        YoloDetector(path, providers=asked)
    with pytest.raises(DetectorError, match=r"asked for providers \(none\)"):
        YoloDetector(path, providers=())


def test_provider_that_is_dropped_at_the_start_is_an_error(tmp_path, monkeypatch):
    import onnxruntime

    path = constant_model(tmp_path / "m.onnx", TABLES["final"], metadata=METADATA)
    real = onnxruntime.InferenceSession
    monkeypatch.setattr(
        onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"]
    )
    monkeypatch.setattr(
        onnxruntime, "InferenceSession", lambda model, **options: real(model, providers=["CPUExecutionProvider"])
    )
    with pytest.raises(DetectorError, match="asked for providers CUDAExecutionProvider, found CPUExecutionProvider"):
        YoloDetector(path, providers=["CUDAExecutionProvider"])


def test_missing_onnxruntime_is_one_line(tmp_path, monkeypatch):
    path = constant_model(tmp_path / "m.onnx", TABLES["final"], metadata=METADATA)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(DetectorError, match=r"onnxruntime cannot be imported.*pip install onnxruntime"):
        YoloDetector(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"score_threshold": 25}, "score_threshold 25: expected 0 to 1"), ({"threads": 0}, "threads 0: expected 1")],
)
def test_arguments_out_of_range(tmp_path, options, message):
    path = constant_model(tmp_path / "m.onnx", TABLES["final"], metadata=METADATA)
    with pytest.raises(DetectorError, match=message):
        YoloDetector(path, **options)


def test_threads_and_repeated_runs_give_the_same_boxes(tmp_path):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov5"], metadata=METADATA)
    detector = YoloDetector(path, threads=1)
    first, second = detector.detect(frame(black())), detector.detect(frame(black()))
    assert [item.box_xyxy_px for item in first] == [item.box_xyxy_px for item in second]


def test_importing_detection_does_not_load_onnxruntime():
    code = "import sys, tubepose.detection, tubepose.detection.yolo; sys.exit('onnxruntime' in sys.modules)"
    root = Path(__file__).parent.parent
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


def test_end_to_end_metadata_of_an_export_without_that_head(tmp_path):
    path = constant_model(tmp_path / "m.onnx", TABLES["yolov8"], metadata=METADATA | {"end2end": "True"})
    assert YoloDetector(path).layout == "yolov8"


# Transformers --------------------------------------------------------------------------------------------------------


def named_model(path, names, shapes, *, sizes=False, metadata=None):
    """A network with outputs of these names, and with a second input for the sizes of pictures."""
    nodes = [helper.make_node("Identity", [f"table_{name}"], [name]) for name in names]
    tables = [
        numpy_helper.from_array(np.zeros(s, np.float32), f"table_{n}") for n, s in zip(names, shapes, strict=True)
    ]
    inputs = [helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, 64, 96))]
    inputs += [helper.make_tensor_value_info("orig_target_sizes", TensorProto.INT64, (1, 2))] if sizes else []
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in names]
    model = helper.make_model(
        helper.make_graph(nodes, "t", inputs, outputs, tables),
        opset_imports=[helper.make_opsetid("", 17)],
        ir_version=9,
    )
    helper.set_model_props(model, metadata or {})
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize(
    ("names", "shapes", "sizes", "word"),
    [
        (("labels", "boxes", "scores"), [(1, 300), (1, 300, 4), (1, 300)], True, "an RT-DETR or D-FINE"),
        (("labels", "boxes", "scores"), [(1, 300), (1, 300, 4), (1, 300)], False, "an RT-DETR or D-FINE"),
        (("logits", "pred_boxes"), [(1, 300, 2), (1, 300, 4)], False, "of the Transformers library"),
        (("dets", "labels"), [(1, 300, 4), (1, 300, 3)], False, "an RF-DETR"),
    ],
)
def test_transformers_are_told_by_the_names_of_their_outputs(tmp_path, names, shapes, sizes, word):
    path = named_model(tmp_path / "m.onnx", names, shapes, sizes=sizes)
    with pytest.raises(DetectorError, match=f"{word}.*which is not read; expected a YOLO model") as told:
        YoloDetector(path, classes=("rack", "tube"))
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("classes", [("rack", "tube"), NAMES])
def test_an_rt_detr_of_ultralytics_is_told_by_its_metadata(tmp_path, classes):
    metadata = METADATA | {"names": str(dict(enumerate(classes))), "description": "Ultralytics rtdetr-l model"}
    path = constant_model(tmp_path / "m.onnx", np.zeros((1, 300, 4 + len(classes))), metadata=metadata)
    with pytest.raises(DetectorError, match=r"a transformer \(rtdetr, by its metadata\)"):
        YoloDetector(path)


def test_queries_of_two_classes_are_not_taken_for_final_boxes(tmp_path):
    """The shape is that of final boxes; the values are shares and scores."""
    queries = np.random.default_rng(2).uniform(0.01, 0.99, (1, 300, 6))
    with pytest.raises(DetectorError, match=r"an RT-DETR \(output \[1, 300, 6\] of shares"):
        YoloDetector(constant_model(tmp_path / "m.onnx", queries), classes=("rack", "tube"))
    for rows in ([FINAL_ROW], np.zeros((0, 6))):
        path = constant_model(tmp_path / "f.onnx", final_table(rows, 300), metadata=METADATA)
        assert YoloDetector(path).layout == "final"
