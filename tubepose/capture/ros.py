"""ROS 2 `sensor_msgs` as arrays: PointCloud2, Image, CompressedImage and CameraInfo."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.capture.compressed_depth import decode_compressed_depth, is_compressed_depth
from tubepose.capture.frame import CameraIntrinsics
from tubepose.capture.images import decode, to_picture
from tubepose.capture.message_types import COMPRESSED_IMAGE
from tubepose.capture.registration import depth_to_metres
from tubepose.errors import CaptureError
from tubepose.transforms import FloatArray

# Metres per count of the two encodings that hold depth (REP 118).
DEPTH_ENCODINGS = {"16UC1": 1.0e-3, "32FC1": 1.0}

_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_PICTURES = {
    "mono8": ("u1", 1), "8UC1": ("u1", 1), "mono16": ("u2", 1), "16UC1": ("u2", 1), "32FC1": ("f4", 1),
    "rgb8": ("u1", 3), "bgr8": ("u1", 3), "8UC3": ("u1", 3), "rgba8": ("u1", 4), "bgra8": ("u1", 4),
}  # fmt: skip
_MAX_DISTORTION_PX = 1.0


def cloud_arrays(message: Any, where: str) -> tuple[FloatArray, NDArray[np.uint8] | None]:
    """Coordinates (height, width, 3) of a PointCloud2 in its own unit, and its colours (same shape) or None.

    Every point keeps its place; `point_step`, `row_step` and `is_bigendian` are honoured.

    Raises:
        CaptureError: No x, y, z, or fewer bytes than the layout needs.
    """
    fields = {field.name: field for field in message.fields}
    if any(axis not in fields for axis in "xyz"):
        raise CaptureError(
            f"{where}: expected the fields x, y and z in a PointCloud2, found {', '.join(fields) or 'none'}"
        )
    xyz = np.stack([_field(message, fields[axis], where).astype(np.float64) for axis in "xyz"], axis=-1)
    packed = fields.get("rgb") or fields.get("rgba")
    if packed is None or packed.datatype not in (5, 6, 7):
        return xyz, None
    colours = _field(message, packed, where, "u4").astype(np.uint32)
    return xyz, np.stack([(colours >> shift) & 255 for shift in (16, 8, 0)], axis=-1).astype(np.uint8)


def _field(message: Any, field: Any, where: str, kind: str | None = None) -> NDArray[np.generic]:
    """One field of every point, shape (height, width): a view into the message's bytes."""
    kind = kind or _FIELD_TYPES.get(field.datatype)
    if kind is None or field.count > 1:
        raise CaptureError(
            f"{where}: field {field.name} has type {field.datatype} and count {field.count}; expected one number"
        )
    item = np.dtype((">" if message.is_bigendian else "<") + kind)
    height, width, step = message.height, message.width, message.point_step
    row_step = message.row_step if height > 1 else width * step
    _check_size(len(message.data), height, width * step, row_step, where)
    if field.offset + item.itemsize > step:
        raise CaptureError(
            f"{where}: field {field.name} ends at byte {field.offset + item.itemsize} of points of {step} bytes"
        )
    if height * width == 0:
        return np.empty((height, width), item)
    return np.ndarray((height, width), item, message.data, field.offset, (row_step, step))


def _check_size(found: int, rows: int, row_bytes: int, row_step: int, where: str) -> None:
    expected = (rows - 1) * row_step + row_bytes if rows else 0
    if row_step < row_bytes or found < expected:
        raise CaptureError(
            f"{where}: the message holds {found} bytes, its {rows} rows of {row_bytes} bytes at a step of {row_step} "
            f"need {expected}; it is cut, or its layout is wrong"
        )


def image_array(message: Any, where: str) -> NDArray[np.generic]:
    """Pixels of an Image as stored, shape (height, width) or (height, width, channels).

    Raises:
        CaptureError: An encoding that is not read, or fewer bytes than it needs.
    """
    if message.encoding not in _PICTURES:
        known = ", ".join(_PICTURES)
        raise CaptureError(f"{where}: image encoding '{message.encoding}' is not read; record one of {known}")
    kind, channels = _PICTURES[message.encoding]
    item = np.dtype((">" if message.is_bigendian else "<") + kind)
    row_bytes = message.width * channels * item.itemsize
    step = message.step or row_bytes
    _check_size(len(message.data), message.height, row_bytes, step, where)
    shape: tuple[int, ...] = (message.height, message.width, channels)
    strides = (step, channels * item.itemsize, item.itemsize)
    if 0 in shape:
        raise CaptureError(f"{where}: the image is {message.width} x {message.height} pixels; expected some")
    pixels: NDArray[np.generic] = np.ndarray(shape, item, message.data, 0, strides)
    return pixels[..., 0] if channels == 1 else pixels


def picture(message: Any, schema: str, where: str) -> NDArray[np.uint8]:
    """An Image or CompressedImage as uint8 picture, gray or RGB."""
    if schema == COMPRESSED_IMAGE:
        if is_compressed_depth(message.format):
            raise CaptureError(f"{where}: a compressed depth image is no picture; choose another --image-topic")
        return to_picture(decode(bytes(message.data), where), bgr=True)
    return to_picture(image_array(message, where), bgr=message.encoding.startswith("bgr") or message.encoding == "8UC3")


def depth_image(message: Any, schema: str, where: str) -> FloatArray:
    """Depth (H, W) in metres of an Image or CompressedImage that holds depth; NaN for invalid pixels.

    Raises:
        CaptureError: Fewer bytes than the layout needs, or compressed depth that is cut or of a kind that is not read.
    """
    if schema == COMPRESSED_IMAGE:
        return decode_compressed_depth(message.format, bytes(message.data), where)
    return depth_to_metres(image_array(message, where), DEPTH_ENCODINGS[message.encoding])


def camera_of(info: Any, *, rectified: bool) -> CameraIntrinsics | None:
    """Pinhole intrinsics of a CameraInfo.

    Args:
        info: The message.
        rectified: Whether the image is the rectified one (``image_rect``): then P holds, and no distortion is left.

    Returns:
        The intrinsics; None for an uncalibrated camera, or one whose lens moves a pixel at the border by more
        than 1 px: such an image is no pinhole image.
    """
    matrix = (
        np.array(info.p, dtype=float).reshape(3, 4)[:, :3] if rectified else np.array(info.k, dtype=float).reshape(3, 3)
    )
    if not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1], info.width, info.height) <= 0:
        return None
    distortion = np.array(info.d, dtype=float)
    if not (rectified or not distortion.any() or _distortion_px(info, matrix, distortion) <= _MAX_DISTORTION_PX):
        return None
    (fx, _, cx), (_, fy, cy) = matrix[0].tolist(), matrix[1].tolist()
    return CameraIntrinsics(int(info.width), int(info.height), fx, fy, cx, cy)


def _distortion_px(info: Any, matrix: FloatArray, distortion: FloatArray) -> float:
    """Largest shift of the image's corners and edge centres by the lens, pixels."""
    if info.distortion_model not in ("plumb_bob", "rational_polynomial"):
        return float("inf")
    u, v = np.meshgrid((0, (info.width - 1) / 2, info.width - 1), (0, (info.height - 1) / 2, info.height - 1))
    seen = np.stack([u.ravel(), v.ravel()], axis=1)
    ideal = cv2.undistortPoints(seen[:, None], matrix, distortion, P=matrix)
    return float(np.abs(np.asarray(ideal)[:, 0] - seen).max())
