"""What the numbers in the output of each YOLO family mean: layouts, decoding, suppression of doubles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.errors import DetectorError
from tubepose.transforms import FloatArray

Layout = Literal["yolov5", "yolov8", "final", "yolox", "yolox-decoded"]
LAYOUTS: tuple[Layout, ...] = get_args(Layout)
LAYOUT_SHAPES: dict[Layout, str] = {
    "yolov5": "[1, 3A, 5 + classes]",
    "yolov8": "[1, 4 + classes, A]",
    "final": "[1, N, 6]",
    "yolox": "[1, A, 5 + classes]",
    "yolox-decoded": "[1, A, 5 + classes]",
}

# The usual three levels, and the families' variants with one level more at either end.
_STRIDES = ((8, 16, 32), (8, 16, 32, 64), (4, 8, 16, 32))


@dataclass(frozen=True, slots=True, eq=False)
class RawBoxes:
    """Boxes in network pixels.

    Attributes:
        edges_xyxy: Array of shape (N, 4): left, top, right, bottom edges, network pixels.
        scores: Array of shape (N,), 0 to 1.
        class_ids: Array of shape (N,).
    """

    edges_xyxy: FloatArray
    scores: FloatArray
    class_ids: NDArray[np.intp]

    def take(self, chosen: NDArray[np.bool_]) -> RawBoxes:
        """The same of some of the boxes."""
        return RawBoxes(self.edges_xyxy[chosen], self.scores[chosen], self.class_ids[chosen])


def anchor_count(net_size: tuple[int, int], strides: tuple[int, ...]) -> int:
    """Number of grid cells over all levels for a network input of (width, height) pixels."""
    return sum((net_size[0] // stride) * (net_size[1] // stride) for stride in strides)


def matching_layouts(shape: tuple[int, ...], net_size: tuple[int, int]) -> dict[Layout, int | None]:
    """Layouts that an output of this shape may have, each with its number of classes (None: the shape does not say).

    Args:
        shape: Shape (1, rows, columns) of the output of a real run.
        net_size: Width and height of the network's input, pixels.
    """
    _, rows, columns = shape
    counts = {anchor_count(net_size, strides) for strides in _STRIDES}
    found: dict[Layout, int | None] = {}
    if columns in counts and rows > 4:
        found["yolov8"] = rows - 4
    if rows in {3 * count for count in counts} and columns > 5:
        found["yolov5"] = columns - 5
    if rows in counts and columns > 5:
        found["yolox"] = columns - 5
    if columns == 6:
        found["final"] = None
    return found


def class_count(layout: Layout, shape: tuple[int, ...]) -> int | None:
    """Number of classes that an output of a given layout has; None for `final`, 0 or less when it cannot be."""
    if layout == "final":
        return None if shape[2] == 6 else 0
    return shape[1] - 4 if layout == "yolov8" else shape[2] - 5


def is_decoded_yolox(output: FloatArray, net_size: tuple[int, int]) -> bool:
    """Tell a decoded YOLOX output from a raw one by its values.

    Decoded centres lie near their own grid cell, in pixels. Raw centres are offsets of about one cell, all near zero.
    Whichever of the two fits better, in the median over all rows, is taken.

    Args:
        output: Array of shape (A, 5 + classes) of a real run.
        net_size: Width and height of the network's input, pixels.
    """
    cells, strides = yolox_grid(net_size, len(output))
    if_decoded = np.median(np.abs(output[:, :2] / strides - cells - 0.5))
    if_raw = np.median(np.abs(output[:, :2] - 0.5))
    return bool(if_decoded < if_raw)


def yolox_grid(net_size: tuple[int, int], rows: int) -> tuple[FloatArray, FloatArray]:
    """Grid cell (A, 2) as (x, y) and stride (A, 1) in pixels of every row of a YOLOX output.

    Raises:
        DetectorError: The rows do not fit the network's input.
    """
    for strides in _STRIDES:
        if anchor_count(net_size, strides) == rows:
            break
    else:
        expected = anchor_count(net_size, _STRIDES[0])
        raise DetectorError(
            f"YOLOX output with {rows} rows for an input of {net_size[0]} x {net_size[1]}: expected {expected}; "
            "give the size that the model was exported for"
        )
    cells, steps = [], []
    for stride in strides:
        x, y = np.meshgrid(np.arange(net_size[0] // stride), np.arange(net_size[1] // stride))
        cells.append(np.column_stack([x.ravel(), y.ravel()]))
        steps.append(np.full((x.size, 1), stride))
    return np.concatenate(cells).astype(float), np.concatenate(steps).astype(float)


def decode(output: NDArray[np.floating], layout: Layout, net_size: tuple[int, int], threshold: float) -> RawBoxes:
    """Boxes of at least the given score from one output.

    Args:
        output: Array (rows, columns): the output without its batch axis.
        layout: What the columns mean.
        net_size: Width and height of the network's input, pixels.
        threshold: Smallest score that is kept.

    Raises:
        DetectorError: The network gave values that are not finite, or class numbers that are not whole.
    """
    table = np.asarray(output.T if layout == "yolov8" else output, dtype=float)
    if layout == "final":
        scores, class_ids = table[:, 4], table[:, 5]
    else:
        class_scores = table[:, 4:] if layout == "yolov8" else table[:, 5:] * table[:, 4:5]
        scores = class_scores.max(axis=1)
        class_ids = class_scores.argmax(axis=1).astype(float)
    if np.isnan(scores).any():
        raise DetectorError("the network gave scores that are not numbers; export it with float32 weights")
    keep = np.flatnonzero(scores >= threshold)
    edges = _edges(table, keep, layout, net_size)
    if not np.isfinite(edges).all():
        raise DetectorError("the network gave boxes that are not finite; export it with float32 weights")
    if np.any(scores[keep] > 1.0 + 1e-3):
        raise DetectorError(
            f"the network gave a score of {scores.max():.4g}, expected 0 to 1: the output is not '{layout}', or was "
            "exported without its last sigmoid; give layout or export again"
        )
    chosen = class_ids[keep]
    if np.any(chosen != np.round(chosen)) or np.any(chosen < 0):
        raise DetectorError("column 6 of the output holds no class numbers; expected x1 y1 x2 y2 score class")
    return RawBoxes(edges, np.minimum(scores[keep], 1.0), chosen.astype(np.intp))


def _edges(table: FloatArray, keep: NDArray[np.intp], layout: Layout, net_size: tuple[int, int]) -> FloatArray:
    """Box edges (N, 4) in network pixels of the rows that are kept."""
    boxes = table[keep, :4]
    if layout == "final":
        return boxes
    centre, size = boxes[:, :2], boxes[:, 2:]
    if layout == "yolox":
        cells, strides = yolox_grid(net_size, len(table))
        centre = (centre + cells[keep]) * strides[keep]
        with np.errstate(over="ignore"):  # what overflows is reported as not finite
            size = np.exp(size) * strides[keep]
    return np.concatenate([centre - size / 2, centre + size / 2], axis=1)


def suppress(boxes: RawBoxes, group_ids: NDArray[np.intp], iou_threshold: float) -> NDArray[np.intp]:
    """Rows that survive non-maximum suppression, best score first.

    Args:
        boxes: Boxes that overlap.
        group_ids: Array of shape (N,); boxes of different groups never suppress each other.
        iou_threshold: Of two boxes whose intersection over union is larger, the one with the lower score goes.
    """
    # Ties go to the first row, so that the same input always gives the same order.
    order = np.argsort(-boxes.scores, kind="stable")
    kept = []
    for group in np.unique(group_ids):
        rows = order[group_ids[order] == group]
        edges = boxes.edges_xyxy[rows]
        xywh = np.concatenate([edges[:, :2], edges[:, 2:] - edges[:, :2]], axis=1)
        # OpenCV drops scores of zero; ranks keep the order and never are zero.
        ranks = np.linspace(1.0, 0.5, len(rows)).astype(np.float32)
        kept.append(
            rows[np.asarray(cv2.dnn.NMSBoxes(xywh.tolist(), ranks.tolist(), 0.0, iou_threshold), dtype=np.intp)]
        )
    if not kept:
        return np.empty(0, dtype=np.intp)
    survivors = np.concatenate(kept)
    return np.asarray(survivors[np.lexsort((survivors, -boxes.scores[survivors]))])
