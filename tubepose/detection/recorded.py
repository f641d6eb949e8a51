"""Boxes from a file: YOLO label files or COCO JSON, found by the capture's name (paper, section III)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tubepose.capture.frame import RgbdFrame
from tubepose.detection.box_files import ImageBoxes, read_coco, read_yolo_txt
from tubepose.detection.boxes import box_from_edges, class_words, image_size_px
from tubepose.detection.label_formats import CLASS_FILES, by_picture_name, find_class_file, read_class_names
from tubepose.detection.model import Detection, Detector
from tubepose.errors import DetectorError


class RecordedDetector(Detector):
    """Boxes that somebody, or another program, wrote to a file.

    For frame 2 of capture ``trial_01/original`` these names are looked for, in this order (for COCO they are compared
    with each image's file name, without its ending, with and without its folders):
    ``trial_01_original_2``, ``original_2``, ``trial_01_original``, ``original``; and then those as Roboflow and Label
    Studio change them.

    Attributes:
        name: ``recorded``.
    """

    name = "recorded"

    def __init__(self, path: Path, *, classes: Path | None = None, class_map: Mapping[str, str] | None = None) -> None:
        """Find out what kind of file it is; COCO is read at once, YOLO files when their frame comes.

        Args:
            path: A COCO .json file, a folder of YOLO .txt files, or one .txt file, which is used for every frame.
            classes: Class names for YOLO files: a text file with one a line, a `data.yaml` or a `notes.json`;
                default `classes.txt`, `obj.names` or `data.yaml` beside them or in a folder above.
            class_map: From class names to the words that detections carry.

        Raises:
            DetectorError: The file or the class names are missing or malformed.
        """
        self._path = Path(path)
        self._folder: Path | None = self._path if self._path.is_dir() else None
        self._used_by: dict[str, str] = {}
        self._images: dict[str, list[ImageBoxes]] = {}
        if not self._path.exists():
            raise DetectorError(
                f"{path}: no such file or folder; expected a COCO .json, a YOLO .txt or a folder of them"
            )
        if self._path.suffix.lower() == ".json":
            self._names, self._images = read_coco(self._path)
        elif self._folder is not None or self._path.suffix.lower() == ".txt":
            self._names = read_class_names(classes if classes is not None else self._default_classes())
        else:
            raise DetectorError(f"{path}: expected a COCO .json, a YOLO .txt or a folder of YOLO .txt files")
        self._words = class_words(self._names, class_map, str(path))

    def detect(self, frame: RgbdFrame) -> tuple[Detection, ...]:
        """The recorded boxes of a frame, in the order of the file.

        Raises:
            DetectorError: There are no boxes for this frame (an image without objects has an empty entry instead), or
                they are malformed or outside the image.
        """
        size = image_size_px(frame)
        if size is None:
            raise DetectorError(f"{_title(frame)}: neither an image nor an organised cloud, so boxes have no pixels")
        entry = self._find(frame, size)
        if entry.image_size is not None and entry.image_size != size:
            raise DetectorError(
                f"{entry.where}: boxes for an image of {entry.image_size[0]} x {entry.image_size[1]} pixels, but "
                f"{_title(frame)} has {size[0]} x {size[1]}; draw the boxes on the capture's own image"
            )
        found = []
        for row in entry.rows:
            box = box_from_edges(row.edges_xyxy, size)
            if box is None:
                raise DetectorError(
                    f"{row.where}: box lies outside the image of {size[0]} x {size[1]} pixels; correct it"
                )
            found.append(Detection(self._words[row.class_id], row.score, box, self.name))
        return tuple(found)

    def _default_classes(self) -> Path:
        folder = self._folder if self._folder is not None else self._path.parent
        found = find_class_file(folder)
        if found is None:
            raise DetectorError(
                f"{self._path}: no class names; expected {folder / CLASS_FILES[0]} with one name a line (or "
                f"{', '.join(CLASS_FILES[1:])}), or give classes"
            )
        return found

    def _find(self, frame: RgbdFrame, size: tuple[int, int]) -> ImageBoxes:
        keys = _keys(frame)
        if self._path.suffix.lower() == ".json":
            matches = next((self._images[key] for key in keys if key in self._images), [])
            if len(matches) > 1:
                raise DetectorError(f"{self._path}: {len(matches)} images fit {_title(frame)}; make their names differ")
            if matches:
                self._claim(matches[0].where, frame)
                return matches[0]
            raise DetectorError(f"{self._path}: no image for {_title(frame)}; looked for {', '.join(keys)}")
        if self._folder is None:
            return read_yolo_txt(self._path, len(self._names), size)
        path = next((self._folder / f"{key}.txt" for key in keys if (self._folder / f"{key}.txt").is_file()), None)
        if path is None:
            path = self._as_label_formats_name_it(keys, frame)
        if path is None:
            looked = ", ".join(f"{key}.txt" for key in keys)
            raise DetectorError(f"{self._folder}: no boxes for {_title(frame)}; looked for {looked}")
        self._claim(str(path), frame)
        return read_yolo_txt(path, len(self._names), size)

    def _as_label_formats_name_it(self, keys: list[str], frame: RgbdFrame) -> Path | None:
        """A label file whose picture had one of these names before Roboflow or Label Studio changed it."""
        named = by_picture_name(sorted(self._path.glob("*.txt")))
        paths = next((named[key] for key in keys if key in named), [])
        if len(paths) > 1:
            told = ", ".join(path.name for path in paths[:3])
            raise DetectorError(f"{self._path}: {len(paths)} files fit {_title(frame)} ({told}); keep one of them")
        return paths[0] if paths else None

    def _claim(self, where: str, frame: RgbdFrame) -> None:
        """Refuse that ``original.txt`` silently serves the captures of two trials."""
        owner = self._used_by.setdefault(where, frame.capture)
        if owner != frame.capture:
            raise DetectorError(
                f"{where}: fits captures '{owner}' and '{frame.capture}'; name the boxes by the whole capture, "
                f"such as {_keys(frame)[-2]}"
            )


def _keys(frame: RgbdFrame) -> list[str]:
    """Names that boxes of a frame may have, most exact first."""
    whole = frame.capture.strip("/").replace("/", "_")
    last = frame.capture.strip("/").split("/")[-1]
    return list(dict.fromkeys([f"{whole}_{frame.index}", f"{last}_{frame.index}", whole, last]))


def _title(frame: RgbdFrame) -> str:
    return f"capture '{frame.capture}' frame {frame.index}"
