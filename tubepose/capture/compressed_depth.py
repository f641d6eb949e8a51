"""Depth in ROS's `compressedDepth`: a header of 12 bytes, then a PNG of 16 bits.

Depth of 32 bits (metres) is stored as counts of inverse depth, ``count = A / depth + B``, with A and B in the header
and 0 for an invalid pixel. Depth of 16 bits (millimetres) is stored as it is; its header says nothing.
"""

from __future__ import annotations

import re
import struct

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.images import decode, depth_counts, encode_depth_png
from tubepose.capture.registration import depth_to_metres
from tubepose.errors import CaptureError
from tubepose.transforms import FloatArray

FORMAT = "32FC1; compressedDepth png"
DEPTH_STEP_M = 5.0e-5

_FORMAT = re.compile(r"(16UC1|32FC1)\s*;\s*compressedDepth(?:\s+png)?\s*", re.IGNORECASE)
# Kind of compression (0: inverse depth), A, B; little endian, as every computer that runs ROS writes it.
_HEADER = struct.Struct("<iff")
_MAX_COUNT = 65535


def is_compressed_depth(form: str) -> bool:
    """Whether the format of a CompressedImage names depth instead of a picture."""
    return "compresseddepth" in form.lower()


def encode_compressed_depth(depth_m: FloatArray, where: str, step_m: float = DEPTH_STEP_M) -> bytes:
    """Data of a `compressedDepth` message of the format `FORMAT`.

    Args:
        depth_m: Array of shape (H, W), metres; NaN for invalid pixels.
        where: Start of error messages.
        step_m: Difference of neighbouring counts at the farthest point. Nearer it is finer, with the square of depth.

    Raises:
        CaptureError: 16 bits do not reach from the nearest to the farthest point.
    """
    valid = np.isfinite(depth_m)
    near, far = (float(depth_m[valid].min()), float(depth_m[valid].max())) if valid.any() else (1.0, 1.0)
    # Whole numbers survive the float32 of the header. The farthest point gets the count 1 or 2.
    a = float(np.ceil(far**2 / step_m))
    b = 2.0 - np.floor(a / far)
    if np.rint(a / near + b) > _MAX_COUNT:
        least = far**2 * (1 / near - 1 / far) / (_MAX_COUNT - 2)
        raise CaptureError(
            f"{where}: depth from {near:.3f} to {far:.3f} m does not fit into 16 bits at a step of "
            f"{step_m * 1e3:g} mm; allow a step of {least * 1e3:.2g} mm, or write depth that is not compressed"
        )
    counts = np.zeros(depth_m.shape, dtype=np.uint16)
    counts[valid] = np.rint(a / depth_m[valid] + b)
    return _HEADER.pack(0, a, b) + encode_depth_png(counts)


def decode_compressed_depth(
    form: str, data: bytes, where: str, metres_per_count: float = 1.0e-3, metres_per_number: float = 1.0
) -> FloatArray:
    """Depth (H, W) in metres of a `compressedDepth` message; NaN for invalid pixels.

    Args:
        form: The message's format, for example ``16UC1; compressedDepth png``.
        data: The message's data.
        where: Start of error messages.
        metres_per_count: Scale of depth of 16 bits.
        metres_per_number: Scale of depth of 32 bits.

    Raises:
        CaptureError: A format that is not read, a header that is too short or makes no depth, or no whole PNG of depth.
    """
    known = _FORMAT.fullmatch(form.strip())
    if known is None:
        raise CaptureError(
            f"{where}: compressed depth of the format '{form}' is not read; expected 16UC1 or 32FC1 as png, set the "
            "publisher's parameter format to png or record the raw depth"
        )
    if len(data) <= _HEADER.size:
        raise CaptureError(
            f"{where}: the compressed depth holds {len(data)} bytes, expected a header of {_HEADER.size} bytes and a "
            "PNG after it; record it again"
        )
    counts = depth_counts(decode(data[_HEADER.size :], where), where).astype(np.uint16, copy=False)
    if known[1].upper() == "16UC1":
        return depth_to_metres(counts, metres_per_count)
    _, a, b = _HEADER.unpack_from(data)
    return metres_per_number * _from_inverse(counts, a, b, where)


def _from_inverse(counts: NDArray[np.uint16], a: float, b: float, where: str) -> FloatArray:
    if not (np.isfinite(b) and np.isfinite(a) and a > 0):
        raise CaptureError(
            f"{where}: the compressed depth's header has A = {a:g} and B = {b:g}; expected numbers with A above 0, "
            "record the raw depth"
        )
    inverse = counts - np.float64(b)
    with np.errstate(divide="ignore"):
        depth = a / inverse
    return np.asarray(np.where((counts > 0) & (inverse > 0), depth, np.nan))
