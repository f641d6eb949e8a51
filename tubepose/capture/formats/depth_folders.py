"""Folders with a depth image and a picture for each frame: the layouts of Open3D and of FoundationPose.

Open3D: `color/`, `depth/` and `intrinsic.json` (or `camera_intrinsic.json`). FoundationPose: `rgb/`, `depth/` and
`cam_K.txt`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tubepose.capture.formats.depth_images import DEPTH_SUFFIXES
from tubepose.capture.formats.depth_sequences import DepthView, GivenScale, camera_matrix, read_views
from tubepose.capture.formats.text_numbers import read_numbers
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.images import read_bytes
from tubepose.errors import CaptureError
from tubepose.labware.reading import read_json
from tubepose.transforms import FloatArray

_DEPTH = "depth"
_PICTURES = ("color", "rgb", "image")
_OPEN3D = ("intrinsic.json", "camera_intrinsic.json", "intrinsics.json")
_FOUNDATION_POSE = ("cam_K.txt",)
_PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_FOUNDATION_HINT = ", which FoundationPose's own reader expects"
_FARTHEST_COUNTS = 1e6
"""Counts of a metre beyond which a `depth_scale` is none."""


def is_depth_folder(path: Path) -> bool:
    """True for a folder with `depth/` beside a camera file, or beside `color/` or `rgb/` with pictures of their own."""
    if not (path / _DEPTH).is_dir():
        return False
    if any((path / name).is_file() for name in (*_OPEN3D, *_FOUNDATION_POSE)):
        return True
    pictures = next((path / name for name in _PICTURES if (path / name).is_dir()), None)
    return pictures is not None and bool(
        _images(path / _DEPTH, DEPTH_SUFFIXES) and _images(pictures, _PICTURE_SUFFIXES)
    )


@dataclass(frozen=True, slots=True)
class DepthFolder:
    """Frames of a folder, in the order of their file names.

    Attributes:
        name: As the tables show it.
        path: The folder.
        given: What the user says about the depth; without it Open3D's `depth_scale` counts, counts per metre.
    """

    name: str
    path: Path
    given: GivenScale

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield the frames in order.

        Raises:
            CaptureError: No camera, no depth, a unit that nobody says, or pictures that fit no depth image; of frames
                that cannot be read after the last one.
        """
        file = next((self.path / name for name in (*_OPEN3D, *_FOUNDATION_POSE) if (self.path / name).is_file()), None)
        if file is None:
            raise CaptureError(
                f"{self.path}: depth images without a camera; write {_FOUNDATION_POSE[0]} beside {_DEPTH}/, 3 lines: "
                "fx 0 cx, 0 fy cy, 0 0 1"
            )
        known = _open3d_camera(file) if file.suffix == ".json" else (_text_camera(file), None, None)
        K, size, scale = known
        hint = _FOUNDATION_HINT if file.suffix == ".txt" else ""
        views = [DepthView(i, depth, picture, K, size, scale) for i, (depth, picture) in enumerate(_pairs(self.path))]
        yield from read_views(views, self.name, self.path, self.given, hint)


def _open3d_camera(file: Path) -> tuple[FloatArray, tuple[int, int] | None, float | None]:
    """Camera matrix, size and metres per count of an `intrinsic.json`."""
    data = read_json(file, CaptureError)
    if "intrinsic_matrix" not in data:
        raise CaptureError(
            f"{file}: expected Open3D's keys width, height and intrinsic_matrix, found "
            f"{', '.join(data)[:120] or 'none'}"
        )
    K = camera_matrix(data["intrinsic_matrix"], file)
    sides = (data.get("width"), data.get("height"))
    if any(not isinstance(side, int) or side <= 0 for side in sides):
        raise CaptureError(f"{file}: expected width and height in pixels, found {str(sides)[:60]}")
    counts = data.get("depth_scale")
    if counts is None:
        return K, (data["width"], data["height"]), None
    if not isinstance(counts, int | float) or isinstance(counts, bool) or not 1 <= counts <= _FARTHEST_COUNTS:
        raise CaptureError(f"{file}: depth_scale is the number of counts in a metre, found {str(counts)[:40]}")
    return K, (data["width"], data["height"]), 1 / counts


def _text_camera(file: Path) -> FloatArray:
    data = read_bytes(file)
    try:
        numbers = read_numbers(data.replace(b",", b" "))
    except ValueError:
        return camera_matrix(data[:120].decode("latin-1"), file)
    return camera_matrix(numbers.tolist(), file)


def _pairs(folder: Path) -> list[tuple[Path, Path | None]]:
    """Depth images and their pictures: of the same name, else of the same first number, else one by one as Open3D does.

    Raises:
        CaptureError: No depth image, or pictures that cannot be told to belong to one.
    """
    depths = _images(folder / _DEPTH, DEPTH_SUFFIXES)
    if not depths:
        raise CaptureError(f"{folder / _DEPTH}: no depth image; expected files ending in {', '.join(DEPTH_SUFFIXES)}")
    place = next((folder / name for name in _PICTURES if (folder / name).is_dir()), None)
    pictures = _images(place, _PICTURE_SUFFIXES) if place is not None else []
    if not pictures:
        return [(depth, None) for depth in depths]
    for key in (_stem, _number):
        named = {key(picture): picture for picture in pictures}
        keys = [key(depth) for depth in depths]
        if len(named) == len(pictures) and len(set(keys)) == len(keys) and "" not in keys and set(keys) & named.keys():
            return [(depth, named.get(key(depth))) for depth in depths]
    if len(pictures) == len(depths):
        return list(zip(depths, pictures, strict=True))
    raise CaptureError(
        f"{folder}: {len(depths)} depth images and {len(pictures)} pictures with other names; give those that belong "
        "together one name"
    )


def _images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and not path.name.startswith(".") and path.is_file()
    )


def _stem(path: Path) -> str:
    return path.stem


def _number(path: Path) -> str:
    """The first digits of a name without zeros before them."""
    found = re.search(r"[0-9]+", path.stem)
    return found[0].lstrip("0") or "0" if found else ""
