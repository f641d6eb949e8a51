"""From a frame's image to the tensor that a YOLO network expects, and from its pixels back to the image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.errors import DetectorError
from tubepose.transforms import FloatArray

BORDER = 114
"""Gray of the border in the training of all YOLO families."""


@dataclass(frozen=True, slots=True)
class Letterbox:
    """How an image lies in the network's input: resized with (nearly) equal scales, the rest is border.

    Attributes:
        net_size: Width and height of the network's input, pixels.
        resized: Width and height of the image after resizing, pixels.
        pad: Border left of and above the image, pixels.
        scale: Network pixels per image pixel, along x and y; they differ by the rounding of `resized`.
    """

    net_size: tuple[int, int]
    resized: tuple[int, int]
    pad: tuple[int, int]
    scale: tuple[float, float]

    def apply(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Resize an image (H, W, 3) and put the border around it; shape (net height, net width, 3)."""
        canvas = np.full((self.net_size[1], self.net_size[0], 3), BORDER, dtype=np.uint8)
        (left, top), (width, height) = self.pad, self.resized
        canvas[top : top + height, left : left + width] = cv2.resize(
            image, (width, height), interpolation=cv2.INTER_LINEAR
        )
        return canvas

    def to_image(self, edges_xyxy: FloatArray) -> FloatArray:
        """Map box edges (N, 4) from network pixels to image pixels."""
        return np.asarray((edges_xyxy - np.tile(self.pad, 2)) / np.tile(self.scale, 2))


def fit_letterbox(image_size: tuple[int, int], net_size: tuple[int, int], *, centred: bool) -> Letterbox:
    """Letterbox of an image, rounded as the families do in training.

    Args:
        image_size: Width and height of the image, pixels.
        net_size: Width and height of the network's input, pixels.
        centred: True for YOLOv5 and v8 (border on both sides), False for YOLOX (border right and below).
    """
    ratio = min(net_size[0] / image_size[0], net_size[1] / image_size[1])
    width, height = (max(1, round(side * ratio) if centred else int(side * ratio)) for side in image_size)
    # Half of an odd border goes down to the left and top side, as in training.
    left, top = (round((net_size[0] - width) / 2 - 0.1), round((net_size[1] - height) / 2 - 0.1)) if centred else (0, 0)
    scale = (width / image_size[0], height / image_size[1])
    return Letterbox(net_size, (width, height), (left, top), scale)


def to_8bit_rgb(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """An image of any depth as 8-bit RGB, shape (H, W, 3).

    8-bit values stay as they are. Other depths are scaled by their 1st and 99th percentile, so that a few glints do not
    darken the rest; this is done over all channels at once, which keeps the colours. Gray is repeated three times.

    Raises:
        DetectorError: The image is empty or has neither one nor three channels.
    """
    data = np.asarray(image)
    if data.ndim == 3 and data.shape[2] == 1:
        data = data[:, :, 0]
    if data.size == 0 or data.ndim not in (2, 3) or (data.ndim == 3 and data.shape[2] != 3):
        raise DetectorError(f"image of shape {data.shape}: expected (H, W) or (H, W, 3); convert the capture's image")
    if data.dtype != np.uint8:
        data = _scale_to_8bit(data.astype(float))
    if data.ndim == 2:
        data = np.repeat(data[:, :, None], 3, axis=2)
    return np.ascontiguousarray(data, dtype=np.uint8)


def _scale_to_8bit(values: FloatArray) -> NDArray[np.uint8]:
    finite = np.isfinite(values)
    low, high = np.percentile(values[finite], (1, 99)) if finite.any() else (0.0, 0.0)
    if high <= low:  # a nearly flat image: the few pixels that differ are all there is
        low, high = (values[finite].min(), values[finite].max()) if finite.any() else (0.0, 0.0)
    span = high - low if high > low else 1.0
    scaled = np.clip((np.where(finite, values, low) - low) / span, 0.0, 1.0)
    return np.asarray(np.round(scaled * 255.0), dtype=np.uint8)


def to_tensor(canvas: NDArray[np.uint8], *, yolox: bool, dtype: type[np.floating]) -> NDArray[np.floating]:
    """Network input of shape (1, 3, H, W) from an RGB canvas (H, W, 3).

    YOLOX takes BGR from 0 to 255; the other families take RGB from 0 to 1.
    """
    planes = canvas[:, :, ::-1].astype(np.float32) if yolox else canvas.astype(np.float32) / np.float32(255.0)
    return np.ascontiguousarray(planes.transpose(2, 0, 1)[None], dtype=dtype)
