"""Folders of pictures with YOLO label files: what a detector learns from, and what it is judged by."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.detection.box_files import read_yolo_txt
from tubepose.detection.label_formats import CLASS_FILES, by_picture_name, find_class_file, read_class_names
from tubepose.errors import DetectorError
from tubepose.labware.reading import read_yaml
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
    found = _pictures(images)
    files = by_picture_name(sorted(path for path in labels.glob("*.txt") if path.name not in CLASS_FILES))
    pairs = [(path, label) for path in found if (label := _label_of(path, labels, files)) is not None]
    if not pairs:
        raise DetectorError(
            f"{images}: found {len(found)} pictures, but none with a label file NAME.txt in {labels}; "
            "expected YOLO label files"
        )
    return LabelledFiles(names, tuple(image for image, _ in pairs), tuple(label for _, label in pairs))


def _pictures(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and path.name[0] != ".")


def _label_of(picture: Path, labels: Path, files: dict[str, list[Path]]) -> Path | None:
    """The label file of a picture: of its name, else the one that a label tool wrote for it."""
    exact = labels / f"{picture.stem}.txt"
    if exact.is_file():
        return exact
    fitting = files.get(picture.stem, [])
    if len(fitting) > 1:
        raise DetectorError(f"{labels}: {len(fitting)} label files fit {picture.name}; keep one of them")
    return fitting[0] if fitting else None


def labelled_set(place: Path) -> LabelledFiles:
    """Pictures with labels in one of the layouts that label tools write.

    A folder with ``images/`` and ``labels/``; a folder of pictures in an ``images/`` that lies beside a ``labels/``
    with a folder of the same name (Ultralytics); a folder of pictures with their label files (Darknet); a `data.yaml`,
    of which the ``train`` entry is taken. The class names are in it or above it, in one of `label_formats.CLASS_FILES`.

    Raises:
        DetectorError: No such layout, no class names, or no picture has labels.
    """
    if place.suffix.lower() in (".yaml", ".yml"):
        return _merged([_folder_set(folder, place) for folder in _train_folders(place)])
    return _folder_set(place, None)


def _folder_set(folder: Path, classes: Path | None) -> LabelledFiles:
    if not folder.is_dir():
        raise DetectorError(f"{folder}: no such folder; expected a folder of pictures with labels, or a data.yaml")
    images, labels = _layout(folder)
    names = classes or find_class_file(folder)
    if names is None:
        raise DetectorError(f"{folder}: no class names; expected one of {', '.join(CLASS_FILES)} there or above it")
    return find_labelled(images, labels, names)


def _layout(folder: Path) -> tuple[Path, Path]:
    """Where the pictures of a folder lie, and where their labels."""
    whole = folder.resolve()
    if (folder / "images").is_dir() and _pictures(folder / "images"):
        return folder / "images", folder / "labels"
    if whole.name == "images":
        return folder, whole.parent / "labels"
    if whole.parent.name == "images":
        return folder, whole.parent.parent / "labels" / whole.name
    if _pictures(folder):
        return folder, folder
    levels = (("*/*", 0), ("*/images/*", 1), ("images/*/*", 0))
    found = ((path, up) for pattern, up in levels for path in folder.glob(pattern))
    parts = sorted({path.parents[up] for path, up in found if path.suffix.lower() in _SUFFIXES})
    if parts:
        raise DetectorError(f"{folder}: a set in parts; give one of them: {', '.join(map(str, parts[:5]))}")
    return folder / "images", folder / "labels"


def _train_folders(file: Path) -> list[Path]:
    """Folders of the pictures to learn from, as Ultralytics finds them."""
    data = read_yaml(file, DetectorError)
    entries = data.get("train")
    entries = entries if isinstance(entries, list) else [entries]
    if not all(isinstance(entry, str) and entry for entry in entries):
        raise DetectorError(f"{file}: expected 'train:' with a folder of pictures, found {str(data.get('train'))[:80]}")
    base = file.parent / str(data.get("path") or "")
    # Roboflow writes ../train/images for what lies beside the file.
    return [next((p for p in (base / e, base / e.removeprefix("../")) if p.is_dir()), base / e) for e in entries]


def labelled_sets(folders: Sequence[Path]) -> LabelledFiles:
    """Several folders as one set; a folder that is given twice counts twice.

    Raises:
        DetectorError: As `labelled_set`, or the folders have different classes.
    """
    return _merged([labelled_set(folder) for folder in folders])


def _merged(sets: Sequence[LabelledFiles]) -> LabelledFiles:
    folders = [found.images[0].parent for found in sets]
    for folder, found in zip(folders, sets, strict=True):
        if found.classes != sets[0].classes:
            raise DetectorError(
                f"{folder}: classes {', '.join(found.classes)}, but {folders[0]} has {', '.join(sets[0].classes)}; "
                "expected the same names in the same order"
            )
    images, labels = (tuple(path for found in sets for path in getattr(found, name)) for name in ("images", "labels"))
    return LabelledFiles(sets[0].classes, images, labels)
