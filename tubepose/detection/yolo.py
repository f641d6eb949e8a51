"""Boxes from a YOLO network in an ONNX file, whatever family it was exported by (paper, section III)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import RgbdFrame
from tubepose.detection.boxes import box_from_edges, class_words
from tubepose.detection.closer_look import LEAST_TUBE_SCORE, look_twice
from tubepose.detection.model import Detection, Detector
from tubepose.detection.transformers import refuse_queries
from tubepose.detection.yolo_decoding import (
    LAYOUT_SHAPES,
    LAYOUTS,
    Layout,
    RawBoxes,
    class_count,
    decode,
    is_decoded_yolox,
    matching_layouts,
    suppress,
)
from tubepose.detection.yolo_input import fit_letterbox, to_8bit_rgb, to_tensor
from tubepose.detection.yolo_session import SIZE_STEP, YoloSession, open_session
from tubepose.errors import DetectorError
from tubepose.labware.tubes import RACK_CLASS


class YoloDetector(Detector):
    """Boxes from a YOLO model.

    The layout of the output is taken from the argument, else from the file's metadata, else from the shape of a real
    run and the number of class names. Whether a YOLOX output is decoded is then told by the values of that run.
    docs/detectors.md lists the families and how to export them.

    Attributes:
        name: ``yolo``.
        classes: The model's own class names, in the order of their numbers.
        layout: What the output's columns mean, one of `yolo_decoding.LAYOUTS`.
        net_size: Width and height of the network's input, pixels.
        looks: Sizes of the input for whole pictures and for racks, if the file asks for a second look; else None.
    """

    name = "yolo"

    def __init__(
        self,
        model: Path,
        *,
        classes: Sequence[str] | None = None,
        layout: str | None = None,
        score_threshold: float = 0.25,
        iou_threshold: float = 0.45,
        class_map: Mapping[str, str] | None = None,
        providers: Sequence[str] = ("CPUExecutionProvider",),
        threads: int | None = None,
        image_size: int | tuple[int, int] | None = None,
    ) -> None:
        """Load a model and run it once on a gray image, so that a wrong file fails before the first frame.

        Args:
            model: The .onnx file.
            classes: Class names in the order of their numbers; needed when the file names none, and wins over it.
            layout: One of `yolo_decoding.LAYOUTS`, where it cannot be told or is told wrongly.
            score_threshold: Smallest score of a box, 0 to 1.
            iou_threshold: Of two tubes (or two racks) that overlap more than this, 0 to 1, the better one stays.
            class_map: From the model's class names to the words that detections carry.
            providers: onnxruntime execution providers, best first; all of them must be in use.
            threads: Threads of the network; None leaves it to onnxruntime.
            image_size: Width and height (or one number for both) of the input of a model that takes any size.

        Raises:
            DetectorError: The file is no usable detection model, or an argument does not fit it.
        """
        _check_thresholds(score_threshold, iou_threshold)
        self._session = open_session(Path(model), providers, threads, image_size)
        self._score_threshold, self._iou_threshold = score_threshold, iou_threshold
        names = tuple(name.strip() for name in classes) if classes is not None else self._session.metadata.names
        self.net_size = self._session.net_size
        self._output_index, self.layout = _recognise(self._session, layout, names)
        # `_recognise` refuses a model without names, with the number of names that it needs.
        self.classes: tuple[str, ...] = names or ()
        self._words = class_words(self.classes, class_map, str(model))
        # One group for tubes, one for racks: a tube has one type, but a rack lies behind all of its tubes.
        self._is_rack = np.array([word == RACK_CLASS for word in self._words])
        self.looks = self._session.metadata.looks if self._session.any_size and image_size is None else None
        # What decides about a larger look must not depend on what is wanted in the end.
        self._decoded_from = min(score_threshold, LEAST_TUBE_SCORE) if self.looks is not None else score_threshold

    @property
    def words(self) -> tuple[str, ...]:
        """What its detections can carry, by the numbers of `classes`."""
        return self._words

    def detect(self, frame: RgbdFrame) -> tuple[Detection, ...]:
        """Find racks and tubes in the frame's image, best score first.

        Raises:
            DetectorError: The frame has no image, or the network's values make no sense.
        """
        if frame.image is None:
            raise DetectorError(
                f"{frame.capture} frame {frame.index}: no image, but a YOLO model needs one; "
                "use the geometric detector or recorded boxes"
            )
        return self.detect_image(frame.image)

    def detect_image(self, image: NDArray[np.generic]) -> tuple[Detection, ...]:
        """Find racks and tubes in a picture, best score first.

        Args:
            image: Gray (H, W) or RGB (H, W, 3), of any depth.

        Raises:
            DetectorError: The picture is empty, or the network's values make no sense.
        """
        image = to_8bit_rgb(image)
        size = (image.shape[1], image.shape[0])
        if self.looks is None:
            boxes = self._look(image, self.net_size)
        else:
            boxes = look_twice(image, self._look_rectangular, self.looks, self._is_rack)
            boxes = boxes.take(boxes.scores >= self._score_threshold)
        found = []
        for row in suppress(boxes, self._is_rack[boxes.class_ids].astype(np.intp), self._iou_threshold):
            box = box_from_edges(boxes.edges_xyxy[row], size)
            if box is not None:
                word = self._words[boxes.class_ids[row]]
                found.append(Detection(word, float(boxes.scores[row]), box, self.name))
        return tuple(found)

    def _look_rectangular(self, image: NDArray[np.uint8], long_side_px: int) -> RawBoxes:
        """Boxes in pixels of a picture that is shown as large as the longer side says, without border."""
        scale = long_side_px / max(image.shape[:2])
        width, height = (SIZE_STEP * max(1, int(np.ceil(side * scale / SIZE_STEP))) for side in image.shape[1::-1])
        return self._look(image, (width, height))

    def _look(self, image: NDArray[np.uint8], net_size: tuple[int, int]) -> RawBoxes:
        """One run of the network; boxes in pixels of the picture."""
        yolox = self.layout.startswith("yolox")
        letterbox = fit_letterbox((image.shape[1], image.shape[0]), net_size, centred=not yolox)
        tensor = to_tensor(letterbox.apply(image), yolox=yolox, dtype=self._session.dtype)
        boxes = self._boxes(self._session.run(tensor), net_size)
        return RawBoxes(letterbox.to_image(boxes.edges_xyxy), boxes.scores, boxes.class_ids)

    def _boxes(self, outputs: list[NDArray[np.floating]], net_size: tuple[int, int]) -> RawBoxes:
        path = self._session.path
        try:
            boxes = decode(outputs[self._output_index][0], self.layout, net_size, self._decoded_from)
        except DetectorError as problem:
            raise DetectorError(f"{path}: {problem}") from None
        if boxes.class_ids.size and boxes.class_ids.max() >= len(self.classes):
            raise DetectorError(
                f"{path}: the network found class number {boxes.class_ids.max()}, but there are only "
                f"{len(self.classes)} class names ({', '.join(self.classes)}); give all names in classes"
            )
        return boxes


def _check_thresholds(score_threshold: float, iou_threshold: float) -> None:
    for key, value in (("score_threshold", score_threshold), ("iou_threshold", iou_threshold)):
        if not 0.0 <= value <= 1.0:
            raise DetectorError(f"{key} {value}: expected 0 to 1")


def _recognise(session: YoloSession, layout: str | None, names: tuple[str, ...] | None) -> tuple[int, Layout]:
    """Index of the output with the boxes, and its layout, from a run on a gray image."""
    width, height = session.net_size
    gray = np.full((height, width, 3), 114, dtype=np.uint8)
    # The run decides about the layout, so the layout's own value range is not known yet; gray does for both.
    outputs = session.run(to_tensor(gray, yolox=False, dtype=session.dtype))
    index = _find_output(session.path, [output.shape for output in outputs])
    shape = outputs[index].shape
    chosen = _choose_layout(session, shape, layout, names)
    if chosen == "final":
        refuse_queries(session.path, outputs[index][0])
    stated = layout or (session.metadata.layout if session.metadata.layout in LAYOUTS else None)
    if chosen == "yolox" and stated is None:
        output = outputs[index][0].astype(float)
        chosen = "yolox-decoded" if is_decoded_yolox(output, session.net_size) else "yolox"
    return index, chosen


def _find_output(path: Path, shapes: list[tuple[int, ...]]) -> int:
    """The one output with rows of boxes; YOLOv5 v6.0 and v6.1 give raw maps beside it."""
    found = ", ".join(str(list(shape)) for shape in shapes)
    if any(len(shape) == 4 for shape in shapes):
        raise DetectorError(
            f"{path}: outputs {found}: a 4-D output belongs to a segmentation model; train or export a detection model"
        )
    tables = [index for index, shape in enumerate(shapes) if len(shape) == 3 and shape[0] == 1]
    if not tables and any(len(shape) == 5 for shape in shapes):
        raise DetectorError(
            f"{path}: outputs {found}: raw maps of YOLOv5 v5.0 or older; expected {LAYOUT_SHAPES['yolov5']}: "
            "export the same weights with YOLOv5 v6.0 or later (python export.py --include onnx)"
        )
    if len(tables) != 1:
        raise DetectorError(
            f"{path}: outputs {found}: expected one of three dimensions, such as {LAYOUT_SHAPES['yolov8']}; "
            "export without a suppression plugin and with batch size 1"
        )
    return tables[0]


def _choose_layout(
    session: YoloSession, shape: tuple[int, ...], flag: str | None, names: tuple[str, ...] | None
) -> Layout:
    """The layout by the user's word, else the file's, else the shape; refuses one that does not fit the names."""
    path, metadata = session.path, session.metadata
    if flag is not None and flag not in LAYOUTS:
        raise DetectorError(f"layout '{flag}' is unknown; known: {', '.join(LAYOUTS)}")
    stated = flag or metadata.layout
    counts = matching_layouts(shape, session.net_size)
    if stated in LAYOUTS:
        chosen: Layout = next(known for known in LAYOUTS if known == stated)
        counts = {chosen: class_count(chosen, shape)}
    elif metadata.final_boxes and "final" in counts:
        counts = {"final": None}
    fitting = [
        known
        for known, count in counts.items()
        if count is None or (count > 0 if names is None else count == len(names))
    ]
    if len(fitting) > 1 and "final" in fitting:  # rows that are grid cells are no accident
        fitting.remove("final")
    if len(fitting) != 1:
        raise DetectorError(_misfit(session, shape, counts, fitting, names))
    if names is None:
        needed = counts[fitting[0]]
        raise DetectorError(
            f"{path}: the file names no classes; give classes with {needed or 'all'} names, in the order of training"
        )
    return fitting[0]


def _misfit(
    session: YoloSession,
    shape: tuple[int, ...],
    counts: dict[Layout, int | None],
    fitting: list[Layout],
    names: tuple[str, ...] | None,
) -> str:
    """Why no single layout fits, in one line."""
    what = f"{session.path}: output {list(shape)} for an input of {session.net_size[0]} x {session.net_size[1]}"
    if fitting:
        return f"{what} may be {' or '.join(fitting)}; say which with layout"
    possible = [f"{known} with {count} classes" for known, count in counts.items() if count is not None and count > 0]
    if names is not None and possible:
        return f"{what} is {' or '.join(possible)}, but there are {len(names)} class names: {', '.join(names)}"
    expected = "; ".join(f"{known} {LAYOUT_SHAPES[known]}" for known in (counts or LAYOUTS))
    return f"{what} fits no known layout; expected {expected}; export a detection model again (docs/detectors.md)"
