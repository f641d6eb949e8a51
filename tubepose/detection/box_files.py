"""Reading files of boxes: YOLO label files and COCO JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from tubepose.detection.label_formats import picture_names, read_text
from tubepose.errors import DetectorError
from tubepose.transforms import FloatArray

_YOLO_LINE = (
    "class number, then x centre, y centre, width and height as fractions of the image (0 to 1), and maybe a score"
)
# Labels are written with six digits, so a box at the border may end a little outside.
_ROUNDING = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class BoxRow:
    """One recorded box.

    Attributes:
        class_id: Position of its class in the list of names.
        score: 0 to 1.
        edges_xyxy: Array of shape (4,): continuous left, top, right, bottom edges, image pixels.
        where: File and line or entry, for messages.
    """

    class_id: int
    score: float
    edges_xyxy: FloatArray
    where: str


@dataclass(frozen=True, slots=True, eq=False)
class ImageBoxes:
    """The recorded boxes of one image.

    Attributes:
        where: File, or file and image, for messages.
        image_size: Width and height that the file states, pixels; None if it states none.
        rows: The boxes.
    """

    where: str
    image_size: tuple[int, int] | None
    rows: tuple[BoxRow, ...]


def read_yolo_txt(path: Path, n_classes: int, image_size: tuple[int, int]) -> ImageBoxes:
    """Boxes of a YOLO label file; an empty file is an image without objects.

    Args:
        path: The .txt file: ``class cx cy w h`` a line, fractions of the image, and maybe a score.
        n_classes: Number of class names.
        image_size: Width and height of the image, pixels.

    Raises:
        DetectorError: The file cannot be read, or a line is malformed; the message names file and line.
    """
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if line.strip():
            rows.append(_yolo_row(line.split(), f"{path}:{number}", n_classes, image_size))
    return ImageBoxes(str(path), None, tuple(rows))


def _yolo_row(fields: list[str], where: str, n_classes: int, image_size: tuple[int, int]) -> BoxRow:
    found = " ".join(fields)[:80]
    if len(fields) not in (5, 6):
        raise DetectorError(f"{where}: found {len(fields)} fields, expected 5 or 6: {_YOLO_LINE}")
    try:
        class_id, values = int(fields[0]), [float(field) for field in fields[1:]]
    except ValueError:
        raise DetectorError(f"{where}: found '{found}', expected numbers: {_YOLO_LINE}") from None
    if not 0 <= class_id < n_classes:
        raise DetectorError(
            f"{where}: found class number {class_id}, expected 0 to {n_classes - 1}: there are {n_classes} class names"
        )
    if not all(math.isfinite(value) and -_ROUNDING <= value <= 1.0 + _ROUNDING for value in values):
        raise DetectorError(f"{where}: found '{found}', expected {_YOLO_LINE}; divide pixels by the image's size")
    centre, size = np.array(values[:2]), np.array(values[2:4])
    if np.any(size <= 0):
        raise DetectorError(
            f"{where}: found a box of width {values[2]:g} and height {values[3]:g}, expected more than 0"
        )
    edges = np.concatenate([centre - size / 2, centre + size / 2]) * np.tile(image_size, 2)
    score = min(max(values[4], 0.0), 1.0) if len(values) == 5 else 1.0
    return BoxRow(class_id, score, edges, where)


class _CocoImage(BaseModel):
    model_config = ConfigDict(frozen=True)

    id: int
    file_name: str
    width: int | None = None
    height: int | None = None


class _CocoCategory(BaseModel):
    model_config = ConfigDict(frozen=True)

    id: int
    name: str


class _CocoAnnotation(BaseModel):
    model_config = ConfigDict(frozen=True)

    image_id: int
    category_id: int
    bbox: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
    score: Annotated[float, Field(ge=0, le=1)] = 1.0


class _Coco(BaseModel):
    model_config = ConfigDict(frozen=True)

    images: tuple[_CocoImage, ...]
    annotations: tuple[_CocoAnnotation, ...]
    categories: tuple[_CocoCategory, ...]


def read_coco(path: Path) -> tuple[tuple[str, ...], dict[str, list[ImageBoxes]]]:
    """Class names of a COCO file, and its images by every name that they may be looked for.

    An image ``trial_01/original.png`` goes by ``trial_01_original`` and ``original``; an image ``original/image.png``
    (the file name inside a capture folder) also by ``original``.

    Raises:
        DetectorError: The file cannot be read or is no COCO file with boxes; the message names the entry.
    """
    try:
        data = _Coco.model_validate_json(read_text(path))
    except ValidationError as problem:
        first = problem.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "file"
        raise DetectorError(
            f"{path}: {place}: {first['msg']}; expected a COCO file with images, annotations (bbox) and categories"
        ) from None
    names = tuple(category.name.strip() for category in data.categories)
    rows = _coco_rows(path, data)
    found: dict[str, list[ImageBoxes]] = {}
    for image in data.images:
        size = (image.width, image.height) if image.width is not None and image.height is not None else None
        entry = ImageBoxes(f"{path}: image '{image.file_name}'", size, tuple(rows[image.id]))
        for key in _image_keys(image.file_name):
            found.setdefault(key, []).append(entry)
    return names, found


def _coco_rows(path: Path, data: _Coco) -> dict[int, list[BoxRow]]:
    """Boxes by the id of their image."""
    rows: dict[int, list[BoxRow]] = {image.id: [] for image in data.images}
    classes = {category.id: number for number, category in enumerate(data.categories)}
    for kind, count, ids in (("images", len(data.images), rows), ("categories", len(data.categories), classes)):
        if len(ids) != count:
            raise DetectorError(
                f"{path}: {kind}: found {count} entries with {len(ids)} ids, expected an id of its own each"
            )
    for number, annotation in enumerate(data.annotations):
        where = f"{path}: annotations.{number}"
        left, top, width, height = annotation.bbox
        if annotation.image_id not in rows:
            raise DetectorError(f"{where}: image_id {annotation.image_id} is not among the images")
        if annotation.category_id not in classes:
            raise DetectorError(f"{where}: category_id {annotation.category_id} is not among the categories")
        if width <= 0 or height <= 0:
            raise DetectorError(f"{where}: found a bbox of width {width:g} and height {height:g}, expected more than 0")
        edges = np.array([left, top, left + width, top + height])
        rows[annotation.image_id].append(BoxRow(classes[annotation.category_id], annotation.score, edges, where))
    return rows


def _image_keys(file_name: str) -> set[str]:
    """Names by which an image may be looked for: without ending, folders, and the marks of label tools."""
    path = PurePosixPath(file_name.replace("\\", "/").strip("/"))
    bare = path.with_suffix("") if path.name else path
    keys = {"_".join(bare.parts), bare.name, "_".join(path.parts)}
    if bare.name == "image" and len(bare.parts) > 1:
        keys |= {"_".join(bare.parts[:-1]), bare.parts[-2]}
    return keys | set(picture_names(bare.name))
