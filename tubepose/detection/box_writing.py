"""Writing files of boxes that `RecordedDetector` and label tools read: YOLO label files and COCO JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tubepose.detection.boxes import Box, edges_from_box
from tubepose.detection.model import Detection
from tubepose.errors import DetectorError


@dataclass(frozen=True, slots=True, eq=False)
class LabelledImage:
    """What `write_coco` writes about one image.

    Attributes:
        file_name: Name of the image, for example ``trial_01/original.png``.
        image_size: Width and height, pixels.
        detections: Its boxes.
    """

    file_name: str
    image_size: tuple[int, int]
    detections: tuple[Detection, ...]


def write_yolo_txt(
    path: Path,
    detections: Sequence[Detection],
    image_size: tuple[int, int],
    class_names: Sequence[str],
    *,
    with_scores: bool = False,
) -> None:
    """Write boxes as a YOLO label file.

    Args:
        path: The .txt file.
        detections: Boxes in pixels.
        image_size: Width and height of the image, pixels.
        class_names: Names in the order of their numbers; write them to ``classes.txt``, one a line.
        with_scores: Also write the score; training labels have none.

    Raises:
        DetectorError: A class is not among the names, or a box has no pixels.
    """
    lines = []
    for detection in detections:
        left, top, right, bottom = _edges(detection, path)
        numbers = [(left + right) / 2, (top + bottom) / 2, right - left, bottom - top]
        values = [value / side for value, side in zip(numbers, image_size * 2, strict=True)]
        values += [detection.score] if with_scores else []
        lines.append(" ".join([str(_class_id(detection, class_names, path)), *(f"{value:.12g}" for value in values)]))
    _write_text(path, "".join(f"{line}\n" for line in lines))


def write_coco(path: Path, images: Sequence[LabelledImage], class_names: Sequence[str]) -> None:
    """Write boxes of several images as COCO JSON; ids count from 1, scores are written.

    Args:
        path: The .json file.
        images: Images with their boxes in pixels.
        class_names: Names of the categories, in the order of their ids.

    Raises:
        DetectorError: A class is not among the names, or a box has no pixels.
    """
    annotations: list[dict[str, Any]] = []
    for image_id, image in enumerate(images, start=1):
        for detection in image.detections:
            left, top, right, bottom = _edges(detection, path)
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": image_id,
                    "category_id": _class_id(detection, class_names, path) + 1,
                    "bbox": [left, top, right - left, bottom - top],
                    "area": (right - left) * (bottom - top),
                    "iscrowd": 0,
                    "score": detection.score,
                }
            )
    data = {
        "images": [
            {"id": number, "file_name": image.file_name, "width": image.image_size[0], "height": image.image_size[1]}
            for number, image in enumerate(images, start=1)
        ],
        "annotations": annotations,
        "categories": [{"id": number, "name": name} for number, name in enumerate(class_names, start=1)],
    }
    _write_text(path, json.dumps(data, indent=1) + "\n")


def _edges(detection: Detection, path: Path) -> Box:
    edges = edges_from_box(detection.box_xyxy_px)
    if not all(math.isfinite(edge) for edge in edges):
        raise DetectorError(
            f"{path}: a {detection.class_name} has a box without pixels; write boxes of organised clouds only"
        )
    return edges


def _class_id(detection: Detection, class_names: Sequence[str], path: Path) -> int:
    if detection.class_name not in class_names:
        raise DetectorError(f"{path}: class '{detection.class_name}' is not among the names: {', '.join(class_names)}")
    return list(class_names).index(detection.class_name)


def _write_text(path: Path, text: str) -> None:
    # Written aside and renamed, so that a reader never finds half a file.
    aside = path.with_name(path.name + ".part")
    aside.write_text(text, encoding="utf-8", newline="\n")
    aside.replace(path)
