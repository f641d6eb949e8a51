"""From CameraInfo messages to cameras: the one of a moment, K or P, binning, region of interest, contradictions.

Rules of `sensor_msgs/CameraInfo` and of `image_geometry`, which is how ROS reads it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tubepose.capture.frame import CameraIntrinsics
from tubepose.capture.lens import (
    LENS_MODELS,
    PixelCamera,
    coefficients_of,
    lens_model,
    without_idle_lens,
)
from tubepose.capture.topics import Topic
from tubepose.errors import CaptureError
from tubepose.transforms import FloatArray

# A CameraInfo goes with an image whose stamp is that near; drivers stamp both alike, most of them exactly.
_SAME_MOMENT_NS = 5_000_000
# P of a rectified picture differs from K by more than this, relative; equal ones tell that nothing was rectified.
_SAME_MATRIX = 1e-6
# Two cameras of one picture differ by less, pixels; cameras of two pictures by more, as a share of the width.
_SAME_PX = 0.5
_OTHER_SHARE = 0.03


def info_at(topic: Topic, stamp_ns: int | None, size: tuple[int, int] | None) -> Any | None:
    """The CameraInfo of a moment: of those that fit an image's size, the one of its stamp, else the last one before.

    Args:
        topic: Of CameraInfo messages.
        stamp_ns: Of the image.
        size: Its height and width; None takes any.

    Returns:
        The message; None where none is calibrated, or none fits.
    """
    fitting = [(stamp, info) for stamp, info in topic.infos if size is None or _size_fits(info, size)]
    if not fitting:
        return None
    moment = stamp_ns or 0
    nearest = min(fitting, key=lambda one: abs(one[0] - moment))
    if abs(nearest[0] - moment) <= _SAME_MOMENT_NS:
        return nearest[1]
    before = [one for one in fitting if one[0] <= moment]
    return max(before, key=lambda one: one[0])[1] if before else min(fitting, key=lambda one: one[0])[1]


def camera_at(
    topic: Topic | None, image: Topic, stamp_ns: int | None, size: tuple[int, int] | None
) -> PixelCamera | None:
    """The camera of an image at a moment by a topic of CameraInfo; None where there is none.

    Args:
        topic: Of CameraInfo messages.
        image: The image's topic; its name tells whether it is the rectified one.
        stamp_ns: Of the image.
        size: Its height and width.

    Raises:
        CaptureError: A distortion that is not read.
    """
    info = info_at(topic, stamp_ns, size) if topic is not None else None
    return camera_of(info, rectified=is_rectified(image.base_name), size=size) if info is not None else None


def is_rectified(name: str) -> bool:
    """Whether an image's topic calls it the rectified one."""
    return "rect" in name.rsplit("/", 1)[-1]


def camera_of(info: Any, *, rectified: bool, size: tuple[int, int] | None = None) -> PixelCamera | None:
    """Camera of a CameraInfo.

    Args:
        info: The message.
        rectified: Whether the image is called a rectified one (``image_rect``). P holds for such an image, and no lens
            is left, if P differs from K. Where both are equal and D is not zero, nothing was rectified whatever the
            name says: a RealSense D405 publishes its distorted picture as ``image_rect_raw``.
        size: Height and width of the image, which tells whether binning and region of interest are to be counted.

    Returns:
        The camera; None for one that is not calibrated.

    Raises:
        CaptureError: A distortion of a model that is not read.
    """
    K, P = _matrix(info.k, 3), _matrix(info.p, 4)
    distortion = np.asarray(info.d, dtype=float)
    distorts = bool(np.any(distortion))
    if not np.isfinite(distortion).all():
        return None
    turned = not np.allclose(np.asarray(info.r, dtype=float), np.eye(3).ravel(), atol=1e-9) and bool(np.any(info.r))
    rectifies = P is not None and (K is None or turned or not np.allclose(P, K, rtol=_SAME_MATRIX, atol=0))
    if distorts and not (rectified and rectifies):
        if K is None:
            return None
        return without_idle_lens(_with_lens(_pinhole(info, K, size), str(info.distortion_model), distortion))
    matrix = (P if P is not None else K) if rectified else (K if K is not None else P)
    return PixelCamera(_pinhole(info, matrix, size)) if matrix is not None else None


def contradiction_px(one: PixelCamera, other: PixelCamera, *, claimed: bool) -> float | None:
    """By how many pixels two cameras of one and the same picture contradict each other; None where they do not.

    Args:
        one: A camera.
        other: Another one, in the same place.
        claimed: Whether the pictures are said to go pixel to pixel. Otherwise cameras that are quite different are
            taken for those of two pictures.
    """
    size = (one.pinhole.width, one.pinhole.height)
    if size != (other.pinhole.width, other.pinhole.height):
        return None
    rays = one.rays()[::4, ::4]
    v, u = np.mgrid[: size[1] : 4, : size[0] : 4]
    off = np.abs(other.project(rays) - np.stack([u, v], axis=-1)).max(axis=-1)
    worst = float(np.nanmax(off, initial=0))
    if worst <= _SAME_PX or (not claimed and worst > _OTHER_SHARE * size[0]):
        return None
    return worst


def picture_size(info: Any) -> tuple[int, int]:
    """Height and width of the images of a CameraInfo, by its region of interest and its binning."""
    x, y = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    height, width = int(info.roi.height) or int(info.height), int(info.roi.width) or int(info.width)
    return height // y, width // x


def _size_fits(info: Any, size: tuple[int, int]) -> bool:
    return size in (picture_size(info), (int(info.height), int(info.width)))


def _pinhole(info: Any, matrix: FloatArray, size: tuple[int, int] | None) -> CameraIntrinsics:
    """Pinhole camera of the images: K moved by the region of interest, then scaled by the binning.

    Images of the full size that a CameraInfo states are neither cut nor binned, whatever else it says.
    """
    (fx, _, cx), (_, fy, cy) = matrix[0].tolist(), matrix[1].tolist()
    full = (int(info.height), int(info.width))
    if size is not None and size == full:
        return CameraIntrinsics(full[1], full[0], fx, fy, cx, cy)
    x, y = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    height, width = picture_size(info)
    left, top = (int(info.roi.x_offset), int(info.roi.y_offset)) if int(info.roi.width) else (0, 0)
    return CameraIntrinsics(width, height, fx / x, fy / y, (cx - left) / x, (cy - top) / y)


def _with_lens(pinhole: CameraIntrinsics, name: str, distortion: FloatArray) -> PixelCamera:
    model = lens_model(name)
    coefficients = coefficients_of(model, distortion) if model is not None else None
    if model is None or coefficients is None:
        raise CaptureError(
            f"a lens of the model '{name}' with {len(distortion)} coefficients is not read; expected one of "
            f"{', '.join(LENS_MODELS)}; record the rectified images"
        )
    return PixelCamera(pinhole, model, coefficients)


def _matrix(numbers: Sequence[float], columns: int) -> FloatArray | None:
    """The first three columns of K or P; None without focal lengths."""
    matrix = np.asarray(numbers, dtype=float).reshape(3, columns)[:, :3]
    good = np.isfinite(matrix).all() and min(matrix[0, 0], matrix[1, 1]) > 0
    return matrix if good and not np.array_equal(matrix[:, :3], np.eye(3)) else None
