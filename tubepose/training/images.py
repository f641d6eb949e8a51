"""A set of labelled pictures on disk, in the layout that YOLO trainers read.

    images/000000.jpg  labels/000000.txt  visibility/000000.csv  classes.txt  set.yaml

Picture k of a set depends on the recipe and on k alone: a set that was cut off goes on where it stopped, a larger set
begins with the smaller one, and the number of processes changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray

from tubepose.detection.box_writing import write_yolo_txt
from tubepose.detection.boxes import box_from_edges
from tubepose.detection.model import CAPPED_CLASS, OPEN_CLASS, Detection
from tubepose.errors import DetectorError
from tubepose.labware import labware_sha256
from tubepose.labware.tubes import RACK_CLASS
from tubepose.report import write_aside, write_csv, write_text
from tubepose.simulation.looks.exposure import Quality, expose
from tubepose.simulation.looks.render import render
from tubepose.simulation.parallel import in_processes
from tubepose.training.labels import Label, label_objects
from tubepose.training.scenes import Stock, View, random_scene

CLASSES = (RACK_CLASS, CAPPED_CLASS, OPEN_CLASS)
"""Class names in the order of their numbers."""
LONG_SIDE_PX = 640
RECIPE_FILE = "set.yaml"
_CHUNK = 8
_QUALITY = (55, 97)


@dataclass(frozen=True, slots=True)
class ImageSet:
    """What the pictures of a set are drawn from.

    Attributes:
        labware: Racks, tubes and caps, the share of variants, and whether grounds are the held-out ones.
        seed: Sets of different seeds have no picture in common.
        long_side_px: Longer side of the pictures.
        view: From where the camera looks, as `random_scene` says.
        quality: How well the camera is set up, as `expose` says; scenes are the same.
    """

    labware: Stock
    seed: int = 0
    long_side_px: int = LONG_SIDE_PX
    view: View = "any"
    quality: Quality = "any"

    def picture(self, number: int) -> tuple[NDArray[np.uint8], list[Label]]:
        """Picture k, 8-bit RGB of shape (H, W, 3), and its labels."""
        scene_rng, light_rng, sensor_rng = np.random.default_rng([self.seed, number]).spawn(3)
        scene = random_scene(self.labware, self.long_side_px, scene_rng, self.view)
        rendered = render(scene.parts, scene.light, scene.intrinsics, light_rng)
        return expose(rendered.radiance, scene.sensor, sensor_rng, self.quality), label_objects(scene, rendered)

    def recipe(self) -> dict[str, Any]:
        """What tells this set from others, as `set.yaml` says it."""
        return {
            "seed": self.seed,
            "long_side_px": self.long_side_px,
            "view": self.view,
            "racks": sorted(rack.name for rack in self.labware.racks),
            "tubes": sorted(tube.name for tube in self.labware.tubes),
            "printed_caps": sorted(cap.name for cap in self.labware.caps),
            "labware_sha256": {item.name: labware_sha256(item) for item in self.labware.items},
            "variants": self.labware.variants,
            "held_out_grounds": self.labware.held_out,
            "simulated": True,
            **({"fill": list(self.labware.fill)} if self.labware.fill is not None else {}),
            **({"mixed": self.labware.mixed} if self.labware.mixed > 0 else {}),
            **({"quality": self.quality} if self.quality != "any" else {}),
        }


def write_images(
    out: Path, source: ImageSet, count: int, *, threads: int = 1, on_done: Callable[[int], None] = lambda _: None
) -> None:
    """Render pictures 0 to count - 1 of a set that are not there yet.

    Args:
        out: Folder of the set; a set of another recipe is refused.
        source: What to draw from.
        count: Pictures in all.
        threads: Processes.
        on_done: Called with the number of pictures that are there, now and then.

    Raises:
        DetectorError: The folder holds a set of another recipe, or something that is no set.
    """
    _claim(out, source)
    missing = [number for number in range(count) if not _paths(out, number)[1].is_file()]
    chunks = [(out, source, missing[k : k + _CHUNK]) for k in range(0, len(missing), _CHUNK)]
    there = count - len(missing)
    on_done(there)
    in_processes(_write_chunk, chunks, threads, lambda done: on_done(min(count, there + done * _CHUNK)))


def _claim(out: Path, source: ImageSet) -> None:
    file = out / RECIPE_FILE
    if file.is_file():
        known = yaml.safe_load(file.read_text(encoding="utf-8"))
        if known != source.recipe():
            raise DetectorError(f"{out}: holds pictures of another recipe ({RECIPE_FILE}); choose another folder")
        return
    if out.exists() and any(out.iterdir()):
        raise DetectorError(f"{out}: not empty and no set of pictures; choose an empty or new folder")
    (out / "labels").mkdir(parents=True, exist_ok=True)
    write_text(out / "classes.txt", "".join(f"{name}\n" for name in CLASSES))
    write_text(file, yaml.safe_dump(source.recipe(), sort_keys=False))


def _paths(out: Path, number: int) -> tuple[Path, Path, Path]:
    name = f"{number:06d}"
    return out / "images" / f"{name}.jpg", out / "labels" / f"{name}.txt", out / "visibility" / f"{name}.csv"


def _write_chunk(chunk: tuple[Path, ImageSet, Sequence[int]], _threads: int) -> None:
    out, source, numbers = chunk
    cv2.setNumThreads(1)
    for number in numbers:
        picture, labels = source.picture(number)
        quality = int(np.random.default_rng([source.seed, number, 1]).integers(*_QUALITY))
        image_file, label_file, visibility_file = _paths(out, number)
        with write_aside(image_file) as aside:
            cv2.imwrite(str(aside), picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        shares = [[label.class_name, round(label.visible, 4), round(label.inside, 4)] for label in labels]
        write_csv(visibility_file, pd.DataFrame(shares, columns=["class", "visible", "inside"]))
        size = (picture.shape[1], picture.shape[0])
        # The labels come last: a picture that has them is complete.
        write_yolo_txt(label_file, detections(labels, size), size, CLASSES)


def detections(labels: Sequence[Label], size: tuple[int, int]) -> list[Detection]:
    """Labels of a picture of a given width and height as boxes to write."""
    found = []
    for label in labels:
        box = box_from_edges(np.array(label.box_xyxy_px), size)
        if box is not None:
            found.append(Detection(label.class_name, 1.0, box, "rendered"))
    return found
