"""Captures as folders (`capture.yaml` beside a cloud or a depth image) and as single PLY files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.description import CAPTURE_FILE, CLOUD_FILE, DEPTH_FILE, IMAGE_FILES, CaptureFile, Unit
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.images import read_depth_counts, read_picture
from tubepose.capture.ply import PlyCloud, read_ply
from tubepose.capture.registration import METRES_PER_UNIT, clean_cloud, depth_to_metres, project_cloud
from tubepose.errors import CaptureError
from tubepose.labware.reading import read_yaml, validate
from tubepose.transforms import FloatArray

# Names of files that are told.
MOST_TOLD = 3


@dataclass(frozen=True, slots=True)
class FolderCapture:
    """One frame in a folder.

    Attributes:
        name: As the tables show it.
        path: The folder.
        unit: Unit of the cloud where the user gave one; it goes before `capture.yaml`. ``mm`` is the unit of depth
            counts without a scale too.
    """

    name: str
    path: Path
    unit: Unit | None = None

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield the one frame.

        Raises:
            CaptureError: A file is missing, cut, or does not fit the others.
        """
        found = _described(self.path) if (self.path / CAPTURE_FILE).is_file() else _guessed(self.path)
        if self.unit is not None and (found.depth is None or self.unit != "m"):  # no depth count is a metre
            found = found.model_copy(update={"unit": self.unit})
        scale = METRES_PER_UNIT[found.unit]
        image = read_picture(self.path / found.image) if found.image is not None else None
        if found.depth is not None:
            cloud = _depth_cloud(self.path / found.depth, found)
        else:
            cloud, colours = _ply_cloud(self.path / (found.cloud or CLOUD_FILE), found, image, scale)
            image = colours if image is None else image
        yield self._frame(found, image, cloud, scale)

    def _frame(self, found: CaptureFile, image: NDArray[np.uint8] | None, cloud: FloatArray, scale: float) -> RgbdFrame:
        intrinsics = found.intrinsics.camera() if found.intrinsics is not None else None
        if image is not None and intrinsics is not None:
            _same_size(self.path, "the image", image.shape, "intrinsics", (intrinsics.height, intrinsics.width))
        organised = cloud.shape[0] > 1
        if found.T_image_cloud is not None and intrinsics is not None:
            T_image_cloud = np.array(found.T_image_cloud)
            T_image_cloud[:3, 3] *= scale
            cloud, organised = project_cloud(cloud, T_image_cloud, intrinsics), True
        elif image is not None and cloud.shape[:2] != image.shape[:2]:
            raise _not_pixel_to_pixel(self.path, image, cloud)
        if not organised:
            intrinsics = None
        elif intrinsics is not None:
            _same_size(self.path, "the cloud", cloud.shape, "intrinsics", (intrinsics.height, intrinsics.width))
        return RgbdFrame(
            cloud_m=cloud,
            image=image,
            intrinsics=intrinsics,
            timestamp_ns=found.timestamp_ns,
            capture=self.name,
            organised=organised,
            sensor=found.sensor,
            simulated=found.simulated,
        )


@dataclass(frozen=True, slots=True)
class PlyCapture:
    """One frame in a PLY file of its own; metres unless the user gave a unit.

    Attributes:
        name: As the tables show it.
        path: The file.
        unit: Unit of the coordinates; None means metres.
    """

    name: str
    path: Path
    unit: Unit | None = None

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield the one frame; its picture comes from the vertex colours of an organised cloud.

        Raises:
            CaptureError: The file is missing, cut, or no PLY.
        """
        ply = read_ply(self.path)
        cloud = clean_cloud(ply.xyz, METRES_PER_UNIT[self.unit or "m"])
        organised = ply.size is not None
        yield RgbdFrame(
            cloud_m=_reshape(cloud, ply.size),
            image=_colour_image(ply, ply.size),
            intrinsics=None,
            timestamp_ns=None,
            capture=self.name,
            organised=organised,
        )


def is_capture_folder(path: Path) -> bool:
    """True for a folder with `capture.yaml`, `cloud.ply` or `depth.png`."""
    return any((path / name).is_file() for name in (CAPTURE_FILE, CLOUD_FILE, DEPTH_FILE))


def is_remains(path: Path) -> bool:
    """True for a folder with a file of a capture, its name in capitals or not."""
    usual = {CAPTURE_FILE, CLOUD_FILE, DEPTH_FILE, *IMAGE_FILES}
    return any(entry.name.casefold() in usual and entry.is_file() for entry in path.iterdir())


def _described(folder: Path) -> CaptureFile:
    """What `capture.yaml` says; files that it does not name are looked for under their usual names."""
    where = folder / CAPTURE_FILE
    found = validate(CaptureFile, read_yaml(where, CaptureError), str(where), CaptureError)
    files = _usual_files(folder)
    update: dict[str, Any] = {}
    if found.cloud is None and found.depth is None:
        update = _cloud_or_depth(folder, files)
    if found.image is None:
        update["image"] = files.get("image")
    return found.model_copy(update=update)


def _guessed(folder: Path) -> CaptureFile:
    files = _usual_files(folder)
    if "cloud" not in files and "depth" not in files:
        there = ", ".join(sorted(entry.name for entry in folder.iterdir())[:MOST_TOLD])
        raise CaptureError(
            f"{folder}: no capture: {there} without {CLOUD_FILE}, {DEPTH_FILE} or {CAPTURE_FILE} beside it"
        )
    if "cloud" not in files:
        raise CaptureError(
            f"{folder}: {DEPTH_FILE} without {CAPTURE_FILE}; write one with 'unit: mm' (or depth_scale_m) and "
            "'intrinsics: {width: , height: , fx: , fy: , cx: , cy: }'"
        )
    return CaptureFile(unit="m", cloud=files["cloud"], image=files.get("image"))


def _usual_files(folder: Path) -> dict[str, str]:
    kinds = (("cloud", (CLOUD_FILE,)), ("depth", (DEPTH_FILE,)), ("image", IMAGE_FILES))
    found = {kind: [name for name in names if (folder / name).is_file()] for kind, names in kinds}
    return {kind: names[0] for kind, names in found.items() if names}


def _cloud_or_depth(folder: Path, files: dict[str, str]) -> dict[str, Any]:
    there: dict[str, Any] = {kind: files[kind] for kind in ("cloud", "depth") if kind in files}
    if len(there) == 1:
        return there
    if there:
        raise CaptureError(
            f"{folder}: both {CLOUD_FILE} and {DEPTH_FILE}; name one by 'cloud:' or 'depth:' in {CAPTURE_FILE}"
        )
    raise CaptureError(
        f"{folder}: neither {CLOUD_FILE} nor {DEPTH_FILE}; name the file by 'cloud:' or 'depth:' in {CAPTURE_FILE}"
    )


def _depth_cloud(path: Path, found: CaptureFile) -> FloatArray:
    camera = found.cloud_intrinsics or found.intrinsics
    if camera is None:
        raise CaptureError(
            f"{path}: a depth image needs the camera's intrinsics; write into {CAPTURE_FILE}: "
            "'intrinsics: {width: , height: , fx: , fy: , cx: , cy: }'"
        )
    scale = found.depth_scale_m if found.depth_scale_m is not None else METRES_PER_UNIT[found.unit]
    if scale == 1:
        raise CaptureError(
            f"{path}: 16-bit counts cannot be whole metres; write 'unit: mm', or 'depth_scale_m:' (metres per count) "
            f"into {CAPTURE_FILE}"
        )
    counts = read_depth_counts(path)
    key = "cloud_intrinsics" if found.cloud_intrinsics is not None else "intrinsics"
    _same_size(path.parent, path.name, counts.shape, key, (camera.height, camera.width))
    return camera.camera().backproject(depth_to_metres(counts, scale))


def _ply_cloud(
    path: Path, found: CaptureFile, image: NDArray[np.uint8] | None, scale: float
) -> tuple[FloatArray, NDArray[np.uint8] | None]:
    """The cloud, organised where that is known, and its colours as an image."""
    ply = read_ply(path)
    size = ply.size
    if found.cloud_width is not None and found.cloud_height is not None:
        size = (found.cloud_width, found.cloud_height)
        if size[0] * size[1] != len(ply.xyz):
            raise CaptureError(
                f"{path}: {CAPTURE_FILE} says cloud_width {size[0]} and cloud_height {size[1]}, that is "
                f"{size[0] * size[1]} points; the file holds {len(ply.xyz)}"
            )
    elif size is None and image is not None and image.shape[0] * image.shape[1] == len(ply.xyz):
        size = (image.shape[1], image.shape[0])
    cloud = _reshape(clean_cloud(ply.xyz, scale), size)
    # Colours belong to the cloud's own pixels; after a projection they would not be an image.
    return cloud, _colour_image(ply, size) if found.T_image_cloud is None else None


def _reshape(points_m: FloatArray, size: tuple[int, int] | None) -> FloatArray:
    width, height = size if size is not None else (len(points_m), 1)
    return points_m.reshape(height, width, 3)


def _colour_image(ply: PlyCloud, size: tuple[int, int] | None) -> NDArray[np.uint8] | None:
    if ply.rgb is None or size is None:
        return None
    return ply.rgb.reshape(size[1], size[0], 3)


def _same_size(
    folder: Path, first: str, first_shape: tuple[int, ...], second: str, second_shape: tuple[int, ...]
) -> None:
    if first_shape[:2] != second_shape[:2]:
        raise CaptureError(
            f"{folder}: {first} is {first_shape[1]} x {first_shape[0]} pixels, {second} {second_shape[1]} x "
            f"{second_shape[0]}; both must be of the same picture"
        )


def _not_pixel_to_pixel(folder: Path, image: NDArray[np.uint8], cloud: FloatArray) -> CaptureError:
    size = f"{cloud.shape[1]} x {cloud.shape[0]}" if cloud.shape[0] > 1 else f"{cloud.shape[1]} points in no order"
    return CaptureError(
        f"{folder}: the image is {image.shape[1]} x {image.shape[0]} pixels, the cloud {size}; give 'intrinsics' and "
        f"'T_image_cloud' in {CAPTURE_FILE} to project the cloud into the image, or record both at one size"
    )
