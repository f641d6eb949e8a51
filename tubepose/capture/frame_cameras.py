"""Cameras of a recorded frame: whose CameraInfo holds for its cloud, its depth and its picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.alignment import Views
from tubepose.capture.calibration import camera_at, info_at, is_rectified
from tubepose.capture.lens import PixelCamera
from tubepose.capture.message_types import POINT_CLOUD
from tubepose.capture.recording import StampedMessage
from tubepose.capture.topics import Chosen, Topic
from tubepose.errors import CaptureError


def told_lenses(chosen: Chosen, views: Views) -> list[str]:
    """What is to be told of images that are called rectified and have a lens all the same."""
    cameras = {chosen.source.base_name: views.source_camera if views.is_depth else None}
    if chosen.image is not None:
        cameras[chosen.image.base_name] = views.image_camera
    named = [name for name, camera in cameras.items() if is_rectified(name) and camera is not None and camera.model]
    return [
        f"{name} is called rectified, but its D is not zero and its P equals K: its lens was removed" for name in named
    ]


def _camera(
    info: Topic | None, topic: Topic, message: StampedMessage, size: tuple[int, int] | None, where: str
) -> PixelCamera | None:
    try:
        return camera_at(info, topic, message.stamp_ns, size)
    except CaptureError as problem:
        raise CaptureError(f"{where}: {problem}") from None


def optional_camera(
    info: Topic | None, topic: Topic, message: StampedMessage, size: tuple[int, int] | None, where: str
) -> PixelCamera | None:
    """The camera beside a point cloud, which has its points without it; None for a lens that is not read."""
    try:
        return _camera(info, topic, message, size, where)
    except CaptureError:
        return None


def picture_camera(
    chosen: Chosen, shot: StampedMessage | None, image: NDArray[np.uint8] | None, where: str
) -> PixelCamera | None:
    """Camera of the picture; None for one that is not calibrated.

    Raises:
        CaptureError: There is a calibration, but for another size.
    """
    if image is None or shot is None or chosen.image is None:
        return None
    size = (image.shape[0], image.shape[1])
    find = optional_camera if chosen.source.schema == POINT_CLOUD else _camera
    camera = find(chosen.image_info, chosen.image, shot, size, where)
    if camera is None and chosen.image_info is not None:
        _refuse_size(chosen.image_info, f"image of {chosen.image.name}", size, shot.stamp_ns, where)
    return camera


def _refuse_size(info: Topic, what: str, size: tuple[int, int], stamp_ns: int | None, where: str) -> None:
    """Say so where a topic has CameraInfos, but none for an image's size."""
    other = info_at(info, stamp_ns, None)
    if other is not None and info_at(info, stamp_ns, size) is None:
        raise CaptureError(
            f"{where}: the {what} is {size[1]} x {size[0]} pixels, its CameraInfo {other.width} x {other.height}; "
            "name the one that fits with --info-topic"
        )


def _no_camera_text(chosen: Chosen, size: tuple[int, int], where: str) -> str:
    info = chosen.source_info
    if info is not None:
        other = info_at(info, None, None)
        if other is not None and (int(other.height), int(other.width)) != size:
            return (
                f"{where}: the depth image is {size[1]} x {size[0]} pixels, its CameraInfo {other.width} x "
                f"{other.height}; name the one that fits with --info-topic"
            )
    found = "none" if info is None else f"{info.name}, without calibration (zeros, or numbers that no camera has)"
    return (
        f"{where}: a depth image needs the CameraInfo of its camera, found {found}; record it with the depth, or "
        "name it with --info-topic"
    )


def _if_size(camera: PixelCamera, size: tuple[int, int]) -> PixelCamera | None:
    return camera if (camera.pinhole.height, camera.pinhole.width) == size else None


def _same_frame(chosen: Chosen, message: StampedMessage) -> bool:
    return chosen.image is not None and chosen.image.frame_id == str(message.fields.header.frame_id)


def depth_camera(
    chosen: Chosen, message: StampedMessage, image_camera: PixelCamera | None, size: tuple[int, int], where: str
) -> PixelCamera:
    """Camera of a depth image of a size (height, width): its own, else the picture's if both are in one frame.

    Raises:
        CaptureError: There is none, or one with a lens that is not read.
    """
    camera = _camera(chosen.source_info, chosen.source, message, size, where)
    if camera is None and image_camera is not None and _same_frame(chosen, message):
        camera = _if_size(image_camera, size)  # aligned depth whose own CameraInfo is of another resolution
    if camera is None:
        raise CaptureError(_no_camera_text(chosen, size, where))
    return camera
