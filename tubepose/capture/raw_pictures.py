"""Encodings of uncompressed pictures as ROS and Foxglove name them, and the conversion of those that are not plain.

Names: `sensor_msgs/image_encodings.hpp`; conversions by OpenCV. OpenCV names a mosaic by the second row's second and
third pixel, ROS by the first row's first two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.errors import CaptureError


@dataclass(frozen=True, slots=True)
class Layout:
    """How the bytes of an encoding lie.

    Attributes:
        kind: NumPy's name of a number without its order of bytes.
        channels: Numbers per pixel.
        bgr: Whether blue comes first.
        conversion: OpenCV's code that makes RGB of it; None for plain pixels.
        colour_rows: Rows of shared colours below the picture, as a share of its height.
    """

    kind: str
    channels: int
    bgr: bool = False
    conversion: int | None = None
    colour_rows: float = 0.0

    def rows(self, height: int) -> int:
        """Rows that are stored for a picture of a height."""
        return height + int(height * self.colour_rows)


_PLAIN = {
    "mono8": Layout("u1", 1), "8UC1": Layout("u1", 1), "mono16": Layout("u2", 1), "16UC1": Layout("u2", 1),
    "16SC1": Layout("i2", 1), "32FC1": Layout("f4", 1), "64FC1": Layout("f8", 1),
    "rgb8": Layout("u1", 3), "bgr8": Layout("u1", 3, bgr=True), "8UC3": Layout("u1", 3, bgr=True),
    "rgba8": Layout("u1", 4), "bgra8": Layout("u1", 4, bgr=True), "8UC4": Layout("u1", 4, bgr=True),
    "rgb16": Layout("u2", 3), "bgr16": Layout("u2", 3, bgr=True), "16UC3": Layout("u2", 3, bgr=True),
    "rgba16": Layout("u2", 4), "bgra16": Layout("u2", 4, bgr=True),
}  # fmt: skip
_MOSAICS = {
    f"bayer_{pattern}{bits}": Layout(kind, 1, conversion=code)
    for pattern, code in (
        ("rggb", cv2.COLOR_BayerBG2RGB),
        ("bggr", cv2.COLOR_BayerRG2RGB),
        ("gbrg", cv2.COLOR_BayerGR2RGB),
        ("grbg", cv2.COLOR_BayerGB2RGB),
    )
    for bits, kind in (("8", "u1"), ("16", "u2"))
}
_SHARED = {
    "yuv422": Layout("u1", 2, conversion=cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": Layout("u1", 2, conversion=cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": Layout("u1", 2, conversion=cv2.COLOR_YUV2RGB_YUYV),
    "yuyv": Layout("u1", 2, conversion=cv2.COLOR_YUV2RGB_YUYV),
    "nv12": Layout("u1", 1, conversion=cv2.COLOR_YUV2RGB_NV12, colour_rows=0.5),
    "nv21": Layout("u1", 1, conversion=cv2.COLOR_YUV2RGB_NV21, colour_rows=0.5),
    "i420": Layout("u1", 1, conversion=cv2.COLOR_YUV2RGB_I420, colour_rows=0.5),
}
ENCODINGS: dict[str, Layout] = {**_PLAIN, **_MOSAICS, **_SHARED}
"""All encodings that are read."""


def to_colours(pixels: NDArray[Any], layout: Layout, where: str) -> NDArray[Any]:
    """Pixels as they are stored, as plain ones: mosaics and shared colours become RGB, shape (H, W, 3).

    Raises:
        CaptureError: A size that the encoding cannot have (an odd number of columns, say).
    """
    if layout.conversion is None:
        return pixels
    native = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("="))
    try:
        return np.asarray(cv2.cvtColor(native, layout.conversion))
    except cv2.error:
        raise CaptureError(
            f"{where}: {pixels.shape[1]} x {pixels.shape[0]} stored pixels do not fit their encoding; expected an even "
            "number of columns and rows"
        ) from None
