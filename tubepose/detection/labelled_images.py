"""Folders of pictures with YOLO label files: what a detector learns from, and what it is judged by."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.detection.box_files import read_class_names, read_yolo_txt
from tubepose.errors import DetectorError
from tubepose.transforms import FloatArray

_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True, slots=True)
class LabelledFiles:
    """Pictures and their label files, by name, in the same order.

    Attributes:
        classes: Class names in the order of their numbers.
        images: The pictures.
        labels: Their label files.
    """

    classes: tuple[str, ...]
    images: tuple[Path, ...]
    labels: tuple[Path, ...]

    def read_image(self, number: int) -> NDArray[np.uint8]:
        """Picture k as 8-bit RGB, shape (H, W, 3).

        Raises:
            DetectorError: It cannot be read.
        """
        picture = cv2.imread(str(self.images[number]), cv2.IMREAD_COLOR)
        if picture is None:
            raise DetectorError(f"{self.images[number]}: cannot be read as a picture; expected JPEG, PNG, BMP or TIFF")
        return np.ascontiguousarray(picture[:, :, ::-1], np.uint8)

    def read_boxes(self, number: int, image_size: tuple[int, int]) -> tuple[NDArray[np.intp], FloatArray]:
        """Class numbers (N,) and continuous edges (N, 4) of the boxes of picture k, pixels.

        Args:
            number: Which picture.
            image_size: Its width and height, pixels.

        Raises:
            DetectorError: The label file breaks the format.
        """
        rows = read_yolo_txt(self.labels[number], len(self.classes), image_size).rows
        ids = np.array([row.class_id for row in rows], dtype=np.intp)
        return ids, np.array([row.edges_xyxy for row in rows], dtype=float).reshape(-1, 4)

    def fingerprint(self) -> str:
        """Digest of the files' names and sizes, in their order: tells sets apart without reading them."""
        pairs = zip(self.images, self.labels, strict=True)
        lines = [f"{image.name} {image.stat().st_size} {label.stat().st_size}" for image, label in pairs]
        return hashlib.sha256("\n".join([*self.classes, *lines]).encode()).hexdigest()


def find_labelled(images: Path, labels: Path, classes: Path) -> LabelledFiles:
    """Pictures of a folder that have a label file of the same name.

    A picture without a label file is left out: it may be unlabelled rather than empty (an empty label file says empty).

    Raises:
        DetectorError: A folder or the list of names is missing, or no picture has labels.
    """
    for folder, what in ((images, "pictures"), (labels, "label files")):
        if not folder.is_dir():
            raise DetectorError(f"{folder}: no such folder; expected a folder of {what}")
    names = read_class_names(classes)
    found = sorted(path for path in images.iterdir() if path.suffix.lower() in _SUFFIXES and path.name[0] != ".")
    pairs = [(path, labels / f"{path.stem}.txt") for path in found if (labels / f"{path.stem}.txt").is_file()]
    if not pairs:
        raise DetectorError(
            f"{images}: found {len(found)} pictures, but none with a label file NAME.txt in {labels}; "
            "expected YOLO label files"
        )
    return LabelledFiles(names, tuple(image for image, _ in pairs), tuple(label for _, label in pairs))


def labelled_set(folder: Path) -> LabelledFiles:
    """A folder with ``images/``, ``labels/`` and ``classes.txt``.

    Raises:
        DetectorError: One of them is missing, or no picture has labels.
    """
    return find_labelled(folder / "images", folder / "labels", folder / "classes.txt")


def labelled_sets(folders: Sequence[Path]) -> LabelledFiles:
    """Several folders as one set; a folder that is given twice counts twice.

    Raises:
        DetectorError: As `labelled_set`, or the folders have different classes.
    """
    sets = [labelled_set(folder) for folder in folders]
    for folder, found in zip(folders, sets, strict=True):
        if found.classes != sets[0].classes:
            raise DetectorError(
                f"{folder}: classes {', '.join(found.classes)}, but {folders[0]} has {', '.join(sets[0].classes)}; "
                "expected the same names in the same order"
            )
    images, labels = (tuple(path for found in sets for path in getattr(found, name)) for name in ("images", "labels"))
    return LabelledFiles(sets[0].classes, images, labels)
