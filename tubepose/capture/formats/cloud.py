"""A point cloud as a file holds it, whatever its format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.description import Unit
from tubepose.capture.images import to_picture
from tubepose.transforms import FloatArray

GRAYS = ("intensity", "gray", "grey", "Texture32", "texture", "scalar_Intensity", "scalar_intensity")
"""Names of one brightness for each point: PhoXi Control's is `Texture32`, CloudCompare's begin with `scalar_`."""


@dataclass(frozen=True, slots=True, eq=False)
class CloudFile:
    """The points of a file.

    Attributes:
        xyz: Array of shape (N, 3) in the file's unit; invalid points as the file has them.
        colours: Array of shape (N, 3), RGB, or (N,), gray, uint8; None without any.
        size: (width, height) of an organised cloud where the file says so and the number of its points agrees.
        unit: Of the coordinates, where the file or its writer says so.
        asks_unit: Whether files of this format are written in metres as often as in millimetres.
    """

    xyz: FloatArray
    colours: NDArray[np.uint8] | None
    size: tuple[int, int] | None
    unit: Unit | None = None
    asks_unit: bool = False


def colours_of(columns: Mapping[str, NDArray[np.generic]]) -> NDArray[np.uint8] | None:
    """Colours of points from named columns: red, green, blue (or r, g, b), else a gray.

    Bytes are taken as they are, floats of at most 1 as shares, all else is stretched as pictures of many bits are.

    Args:
        columns: Arrays of shape (N,) by name.
    """
    for names in (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")):
        if all(name in columns for name in names):
            return _levels(np.stack([columns[name] for name in names], axis=1))
    gray = next((columns[name] for name in GRAYS if name in columns), None)
    return None if gray is None else _levels(gray)


def packed_colours(packed: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """RGB (N, 3) from 0xAARRGGBB (N,), as PCL packs colours."""
    return np.stack([(packed >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)


def _levels(values: NDArray[np.generic]) -> NDArray[np.uint8]:
    if values.dtype == np.uint8:
        return values.astype(np.uint8)
    numbers = values.astype(np.float64)
    finite = numbers[np.isfinite(numbers)]
    if values.dtype.kind == "f" and finite.size and finite.min() >= 0 and finite.max() <= 1:
        return np.asarray(np.rint(np.nan_to_num(numbers) * 255), dtype=np.uint8)
    whole = finite.size and (finite == np.rint(finite)).all() and finite.min() >= 0 and finite.max() <= 255
    if whole and values.ndim == 2:  # bytes that were written as text
        return np.asarray(np.nan_to_num(numbers), dtype=np.uint8)
    return np.asarray(to_picture(numbers[None], bgr=False)[0])
