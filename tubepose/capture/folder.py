"""Captures as folders: `capture.yaml` beside a cloud or a depth image."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.description import (
    CAPTURE_FILE,
    CLOUD_FILE,
    CLOUD_FILES,
    DEPTH_FILE,
    DEPTH_FILES,
    IMAGE_FILES,
    CaptureFile,
    Unit,
)
from tubepose.capture.formats.cloud import CloudFile
from tubepose.capture.formats.cloud_files import read_cloud, unit_of
from tubepose.capture.formats.depth_images import read_depth
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.images import read_picture
from tubepose.capture.registration import METRES_PER_UNIT, clean_cloud, depth_to_metres, project_cloud
from tubepose.capture.regular import leaves, require_inside, require_regular
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
        depth_scale_m: Metres per count of a depth image where the user gave them; they go before all else.
        allow_outside: Whether the files that `capture.yaml` names may lie out of the folder.
    """

    name: str
    path: Path
    unit: Unit | None = None
    depth_scale_m: float | None = None
    allow_outside: bool = False

    @property
    def outside(self) -> tuple[Path, ...]:
        """The files out of the folder that `capture.yaml` names; none where it cannot be read."""
        if not self.allow_outside or not (self.path / CAPTURE_FILE).is_file():
            return ()
        try:
            found = _described(self.path)
        except CaptureError:
            return ()
        names = (name for name in (found.cloud, found.depth, found.image) if name is not None)
        return tuple(self.path / name for name in names if leaves(name))

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield the one frame.

        Raises:
            CaptureError: A file is missing, cut, or does not fit the others.
        """
        found = _described(self.path) if (self.path / CAPTURE_FILE).is_file() else _guessed(self.path)
        for kind, file in (("cloud", found.cloud), ("depth", found.depth), ("image", found.image)):
            if file is not None:
                if not self.allow_outside:
                    require_inside(self.path, file, f"{CAPTURE_FILE}: {kind}")
                require_regular(self.path / file, CaptureError)
        if self.unit is not None and (found.depth is None or self.unit != "m"):  # no depth count is a metre
            found = found.model_copy(update={"unit": self.unit})
        image = read_picture(self.path / found.image) if found.image is not None else None
        if found.depth is not None:
            cloud, scale = _depth_cloud(self.path / found.depth, found, self.depth_scale_m), METRES_PER_UNIT[found.unit]
        else:
            cloud, colours, scale = self._cloud(found, image)
            image = colours if image is None else image
        yield self._frame(found, image, cloud, scale)

    def _cloud(
        self, found: CaptureFile, image: NDArray[np.uint8] | None
    ) -> tuple[FloatArray, NDArray[np.uint8] | None, float]:
        """The cloud in metres, organised where that is known, its colours as an image, and metres per unit."""
        path = self.path / (found.cloud or CLOUD_FILE)
        file = read_cloud(path)
        described = (self.path / CAPTURE_FILE).is_file()
        scale = METRES_PER_UNIT[unit_of(path, file, found.unit if described else self.unit)]
        size = _organised_size(path, found, file, image)
        cloud = _reshape(clean_cloud(file.xyz, scale), size)
        # Colours belong to the cloud's own pixels; after a projection they would not be an image.
        return cloud, _colour_image(file, size) if found.T_image_cloud is None else None, scale

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


def is_capture_folder(path: Path) -> bool:
    """True for a folder with `capture.yaml`, `cloud.ply` or `depth.png`, or one of these in another format."""
    return any((path / name).is_file() for name in (CAPTURE_FILE, *CLOUD_FILES, *DEPTH_FILES))


def is_remains(path: Path) -> bool:
    """True for a folder with a file of a capture, its name in capitals or not."""
    usual = {CAPTURE_FILE, *CLOUD_FILES, *DEPTH_FILES, *IMAGE_FILES}
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
            f"{folder}: {files['depth']} without {CAPTURE_FILE}; write one with 'unit: mm' (or depth_scale_m) and "
            "'intrinsics: {width: , height: , fx: , fy: , cx: , cy: }'"
        )
    return CaptureFile(unit="m", cloud=files["cloud"], image=files.get("image"))


def _usual_files(folder: Path) -> dict[str, str]:
    kinds = (("cloud", CLOUD_FILES), ("depth", DEPTH_FILES), ("image", IMAGE_FILES))
    found = {kind: [name for name in names if (folder / name).is_file()] for kind, names in kinds}
    return {kind: names[0] for kind, names in found.items() if names}


def _cloud_or_depth(folder: Path, files: dict[str, str]) -> dict[str, Any]:
    there: dict[str, Any] = {kind: files[kind] for kind in ("cloud", "depth") if kind in files}
    if len(there) == 1:
        return there
    if there:
        raise CaptureError(
            f"{folder}: both {files['cloud']} and {files['depth']}; name one by 'cloud:' or 'depth:' in {CAPTURE_FILE}"
        )
    raise CaptureError(
        f"{folder}: neither {CLOUD_FILE} nor {DEPTH_FILE}; name the file by 'cloud:' or 'depth:' in {CAPTURE_FILE}"
    )


def _depth_cloud(path: Path, found: CaptureFile, given_scale_m: float | None) -> FloatArray:
    camera = found.cloud_intrinsics or found.intrinsics
    if camera is None:
        raise CaptureError(
            f"{path}: a depth image needs the camera's intrinsics; write into {CAPTURE_FILE}: "
            "'intrinsics: {width: , height: , fx: , fy: , cx: , cy: }'"
        )
    counts = read_depth(path)
    known = (given_scale_m, found.depth_scale_m, METRES_PER_UNIT[found.unit])
    scale = next(value for value in known if value is not None)
    if scale == 1 and counts.dtype.kind != "f":
        raise CaptureError(
            f"{path}: {counts.dtype.itemsize * 8}-bit counts cannot be whole metres; write 'unit: mm', or "
            f"'depth_scale_m:' (metres per count) into {CAPTURE_FILE}"
        )
    key = "cloud_intrinsics" if found.cloud_intrinsics is not None else "intrinsics"
    _same_size(path.parent, path.name, counts.shape, key, (camera.height, camera.width))
    return camera.camera().backproject(depth_to_metres(counts, scale))


def _organised_size(
    path: Path, found: CaptureFile, file: CloudFile, image: NDArray[np.uint8] | None
) -> tuple[int, int] | None:
    """(width, height) of a cloud: as `capture.yaml` says, as the file says, as the image is where that fits."""
    if found.cloud_width is not None and found.cloud_height is not None:
        size = (found.cloud_width, found.cloud_height)
        if size[0] * size[1] != len(file.xyz):
            raise CaptureError(
                f"{path}: {CAPTURE_FILE} says cloud_width {size[0]} and cloud_height {size[1]}, that is "
                f"{size[0] * size[1]} points; the file holds {len(file.xyz)}"
            )
        return size
    if file.size is None and image is not None and image.shape[0] * image.shape[1] == len(file.xyz):
        return image.shape[1], image.shape[0]
    return file.size


def _reshape(points_m: FloatArray, size: tuple[int, int] | None) -> FloatArray:
    width, height = size if size is not None else (len(points_m), 1)
    return points_m.reshape(height, width, 3)


def _colour_image(file: CloudFile, size: tuple[int, int] | None) -> NDArray[np.uint8] | None:
    if file.colours is None or size is None:
        return None
    return file.colours.reshape(size[1], size[0], *file.colours.shape[1:])


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
