"""Class words and box conventions that every source of boxes with pixels shares.

Files and networks give continuous edges, where pixel 0 covers 0 to 1. `Detection.box_xyxy_px` names the first and the
last pixel, both included. The conversion is in this module and nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import RgbdFrame
from tubepose.errors import DetectorError
from tubepose.labware.tubes import RACK_CLASS

Box = tuple[float, float, float, float]


def class_word(name: str, class_map: Mapping[str, str] | None = None) -> str:
    """The word that a detection carries for a class of a model or of a file of boxes.

    An entry of `class_map` wins (so that `tracked` need not be a rack); otherwise every name with "rack" in it, in
    any case, is a rack; all other names are kept without the blanks around them.
    """
    name = name.strip()
    mapped = {key.strip(): word.strip() for key, word in (class_map or {}).items()}
    if name in mapped:
        word = mapped[name]
        return RACK_CLASS if word.lower() == RACK_CLASS else word
    return RACK_CLASS if "rack" in name.lower() else name


def class_words(names: tuple[str, ...], class_map: Mapping[str, str] | None, where: str) -> tuple[str, ...]:
    """`class_word` of every name.

    Raises:
        DetectorError: `class_map` speaks of a class that is not among the names.
    """
    known = [name.strip() for name in names]
    unknown = [key for key in class_map or {} if key.strip() not in known]
    if unknown:
        raise DetectorError(f"{where}: class_map names unknown class '{unknown[0]}'; known classes: {', '.join(known)}")
    return tuple(class_word(name, class_map) for name in names)


def image_size_px(frame: RgbdFrame) -> tuple[int, int] | None:
    """Width and height that boxes of a frame refer to; None when the frame has no pixels."""
    if frame.image is not None:
        return int(frame.image.shape[1]), int(frame.image.shape[0])
    if frame.organised:
        return int(frame.cloud_m.shape[1]), int(frame.cloud_m.shape[0])
    return None


def box_from_edges(edges_xyxy: NDArray[np.floating], image_size: tuple[int, int]) -> Box | None:
    """First and last pixel of a box, cut at the image; None when nothing of the box is in the image.

    Args:
        edges_xyxy: Array of shape (4,): continuous left, top, right, bottom edges in image pixels.
        image_size: Width and height of the image in pixels.
    """
    limits = np.array(image_size, dtype=float)
    low = np.clip(np.asarray(edges_xyxy[:2], dtype=float), 0.0, limits)
    high = np.clip(np.asarray(edges_xyxy[2:], dtype=float), 0.0, limits)
    if not np.all(high > low):
        return None
    # A box thinner than a pixel still names the pixel that it lies in.
    low = np.minimum(low, limits - 1.0)
    last = np.maximum(high - 1.0, low)
    return float(low[0]), float(low[1]), float(last[0]), float(last[1])


def edges_from_box(box_xyxy_px: Box) -> Box:
    """Continuous edges of a box that names its first and last pixel: the inverse of `box_from_edges`."""
    left, top, right, bottom = box_xyxy_px
    return left, top, right + 1.0, bottom + 1.0
