"""Scenes of the BOP benchmark for 6D object pose estimation (bop_toolkit, docs/bop_datasets_format.md)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tubepose.capture.formats.depth_images import DEPTH_SUFFIXES
from tubepose.capture.formats.depth_sequences import DepthView, GivenScale, camera_matrix, read_views
from tubepose.capture.formats.text_numbers import whole_number
from tubepose.capture.frame import RgbdFrame
from tubepose.errors import CaptureError
from tubepose.labware.reading import read_json

CAMERA_FILES = "scene_camera*.json"
_PREFIX = "scene_camera"
_PICTURE_FOLDERS = ("rgb", "gray")
_PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")


def bop_cameras(folder: Path) -> list[Path]:
    """The `scene_camera.json` of a folder, or those of several sensors (`scene_camera_photoneo.json`), sorted."""
    return sorted(path for path in folder.glob(CAMERA_FILES) if path.is_file())


def is_bop_camera(path: Path) -> bool:
    """True for a `scene_camera.json` or that of one sensor."""
    return path.is_file() and path.match(CAMERA_FILES)


@dataclass(frozen=True, slots=True)
class BopScene:
    """One scene, its frames numbered by `im_id`.

    Attributes:
        name: As the tables show it.
        path: The folder of the scene, or the camera file of one of its sensors.
        given: What the user says about the depth; without it the file's `depth_scale` counts, millimetres per count.
    """

    name: str
    path: Path
    given: GivenScale

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield the frames by `im_id`.

        Raises:
            CaptureError: The camera file is damaged; or, after the last frame, some frame could not be read.
        """
        cameras = [self.path] if self.path.is_file() else bop_cameras(self.path)
        if len(cameras) > 1:
            raise CaptureError(
                f"{self.path}: a BOP scene of several sensors; give one of its camera files: "
                f"{', '.join(file.name for file in cameras)}"
            )
        file = cameras[0]
        sensor = file.stem.removeprefix(_PREFIX)
        views, problems = [], []
        for key, entry in sorted(read_json(file, CaptureError).items(), key=lambda item: (len(item[0]), item[0])):
            try:
                views.append(_view(file, sensor, key, entry))
            except CaptureError as problem:
                problems.append(str(problem))
        yield from read_views(views, self.name, file.parent, self.given)
        if problems or not views:
            raise CaptureError(problems[0] if problems else f"{file}: no frame in it")


def _view(file: Path, sensor: str, key: str, entry: object) -> DepthView:
    index = whole_number(key)
    if index is None or not isinstance(entry, dict) or "cam_K" not in entry:
        raise CaptureError(f"{file}: expected im_id: {{'cam_K': [9 numbers], 'depth_scale': mm}}, found {key[:40]!r}")
    scale = entry.get("depth_scale")
    known = isinstance(scale, int | float) and not isinstance(scale, bool) and 0 < scale <= 1000
    if scale is not None and not known:
        raise CaptureError(f"{file}: im_id {index}: depth_scale is in millimetres per count, found {str(scale)[:40]}")
    depth = _numbered(file.parent / f"depth{sensor}", index, DEPTH_SUFFIXES)
    if depth is None:
        raise CaptureError(f"{file.parent}: no depth image depth{sensor}/{index:06d}.png for im_id {index}")
    pictures = [_numbered(file.parent / f"{kind}{sensor}", index, _PICTURE_SUFFIXES) for kind in _PICTURE_FOLDERS]
    picture = next((found for found in pictures if found is not None), None)
    K = camera_matrix(entry["cam_K"], file)
    return DepthView(index, depth, picture, K, None, scale * 1e-3 if known and scale is not None else None)


def _numbered(folder: Path, index: int, suffixes: tuple[str, ...]) -> Path | None:
    """File of a number; BOP writes 6 digits."""
    names = [f"{index:06d}{suffix}" for suffix in suffixes] + [f"{index}{suffix}" for suffix in suffixes]
    return next((folder / name for name in names if (folder / name).is_file()), None)
