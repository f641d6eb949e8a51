"""ROS 2 `sensor_msgs` as arrays: PointCloud2, Image and CompressedImage."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.compressed_depth import decode_compressed_depth, is_compressed_depth
from tubepose.capture.frame import CameraIntrinsics
from tubepose.capture.images import decode, depth_counts, to_picture
from tubepose.capture.message_types import COMPRESSED_IMAGE
from tubepose.capture.raw_pictures import ENCODINGS, Layout, to_colours
from tubepose.capture.registration import depth_to_metres
from tubepose.errors import CaptureError
from tubepose.transforms import FloatArray

# The two encodings that hold depth: counts of millimetres, and metres (REP 118).
DEPTH_ENCODINGS = ("16UC1", "32FC1")

_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


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
    with np.errstate(invalid="ignore"):  # some NaN are told of when they are cast
        xyz = np.stack([_field(message, fields[axis], where).astype(np.float64) for axis in "xyz"], axis=-1)
    packed = fields.get("rgb") or fields.get("rgba")
    channels = [fields[name] for name in ("red", "green", "blue") if name in fields and fields[name].datatype == 2]
    if len(channels) == 3:
        return xyz, np.stack([_field(message, channel, where).astype(np.uint8) for channel in channels], axis=-1)
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

    Of encodings that share colours among pixels (NV12 and the like) all rows are there, those of the colours below.

    Raises:
        CaptureError: An encoding that is not read, or fewer bytes than it needs.
    """
    layout = _layout(message, where)
    item = np.dtype((">" if message.is_bigendian else "<") + layout.kind)
    rows, width = layout.rows(message.height), message.width
    row_bytes = width * layout.channels * item.itemsize
    step = message.step or row_bytes
    _check_size(len(message.data), rows, row_bytes, step, where)
    shape: tuple[int, ...] = (rows, width, layout.channels)
    strides = (step, layout.channels * item.itemsize, item.itemsize)
    if 0 in shape:
        raise CaptureError(f"{where}: the image is {message.width} x {message.height} pixels; expected some")
    pixels: NDArray[np.generic] = np.ndarray(shape, item, message.data, 0, strides)
    return pixels[..., 0] if layout.channels == 1 else pixels


def _layout(message: Any, where: str) -> Layout:
    if message.encoding not in ENCODINGS:
        known = ", ".join(ENCODINGS)
        raise CaptureError(f"{where}: image encoding '{message.encoding}' is not read; record one of {known}")
    return ENCODINGS[message.encoding]


def picture(message: Any, schema: str, where: str) -> NDArray[np.uint8]:
    """An Image or CompressedImage as uint8 picture, gray or RGB.

    Raises:
        CaptureError: An encoding that is not read, or an image that is cut or damaged.
    """
    if schema == COMPRESSED_IMAGE:
        if is_compressed_depth(message.format):
            raise CaptureError(f"{where}: a compressed depth image is no picture; choose another --image-topic")
        pixels = decode(bytes(message.data), where)
        # A mosaic that was compressed as it is: 'bayer_rggb8; png compressed '.
        coded = ENCODINGS.get(message.format.partition(";")[0].strip())
        if coded is not None and coded.conversion is not None and pixels.ndim == 2 and coded.channels == 1:
            return to_picture(to_colours(pixels, coded, where), bgr=False)
        return to_picture(pixels, bgr=True)
    layout = _layout(message, where)
    return to_picture(to_colours(image_array(message, where), layout, where), bgr=layout.bgr)


def depth_image(message: Any, schema: str, where: str, metres_per_count: float, metres_per_number: float) -> FloatArray:
    """Depth (H, W) in metres of an Image or CompressedImage that holds depth; NaN for invalid pixels.

    Args:
        message: The message.
        schema: Its type.
        where: Start of error messages.
        metres_per_count: Scale of whole numbers.
        metres_per_number: Scale of floats.

    Raises:
        CaptureError: Fewer bytes than the layout needs, an encoding that is no depth's, or compressed depth that is cut
            or of a kind that is not read.
    """
    if schema == COMPRESSED_IMAGE:
        data = bytes(message.data)
        if is_compressed_depth(message.format):
            return decode_compressed_depth(message.format, data, where, metres_per_count, metres_per_number)
        pixels = depth_counts(decode(data, where), where)
        return depth_to_metres(pixels, metres_per_number if pixels.dtype.kind == "f" else metres_per_count)
    layout = _layout(message, where)
    if layout.channels != 1 or layout.conversion is not None or layout.kind == "u1":
        raise CaptureError(
            f"{where}: expected depth as {' or '.join(DEPTH_ENCODINGS)}, found '{message.encoding}'; name the depth "
            "with --depth-topic"
        )
    scale = metres_per_number if layout.kind.startswith("f") else metres_per_count
    return depth_to_metres(image_array(message, where), scale)


def is_calibrated(info: Any) -> bool:
    """Whether a CameraInfo holds a camera: a size, and K or P with what a camera can have (no zeros, no identity)."""
    return any(_pinhole(info, np.asarray(rows, dtype=float).reshape(3, -1)) for rows in (info.k, info.p))


def same_camera(one: Any, other: Any) -> bool:
    """Whether two CameraInfos say the same of the camera, whatever their stamps."""
    return all(
        np.array_equal(np.asarray(getattr(one, name)), np.asarray(getattr(other, name)))
        for name in ("k", "d", "p", "r", "width", "height", "distortion_model", "binning_x", "binning_y")
    ) and all(
        getattr(one.roi, name) == getattr(other.roi, name) for name in ("x_offset", "y_offset", "width", "height")
    )


def _pinhole(info: Any, matrix: FloatArray) -> bool:
    numbers = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    return bool(np.isfinite(matrix).all()) and not CameraIntrinsics(int(info.width), int(info.height), *numbers).fault
