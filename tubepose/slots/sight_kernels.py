"""The loops over lines of sight and over silhouettes, compiled: one pass instead of a dozen arrays."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tubepose.compiled import compiled
from tubepose.transforms import FloatArray

PASSED, STANDING, FILLED, AT_FACE, HIDDEN, SILENT = range(6)
"""What became of a line of sight (`SlotLook` says what each means)."""
KINDS = 6


class Pixels(NamedTuple):
    """Pixels whose lines of sight are followed.

    Attributes:
        cloud_m: Array of shape (H, W, 3), camera frame, metres.
        first: Column and row of its first pixel in the image.
        step: Every so many-th pixel of both directions is followed.
        camera_px: Focal lengths along u and v and principal point, pixels; zeros where pixels without a return have
            no known direction.
    """

    cloud_m: FloatArray
    first: tuple[int, int]
    step: int
    camera_px: tuple[float, float, float, float]


class Heights(NamedTuple):
    """Heights above the rack's base, metres.

    Attributes:
        face: The rack's face.
        band: What is nearer to the face than this is neither above nor below it.
        slack: What is higher than an empty slot's end of a line of sight by more than this is something in it.
    """

    face: float
    band: float
    slack: float


@compiled
def place_of(x_m, y_m, low_m, cell_m, shape):
    """Grid place of a point, (x, y); (-1, -1) beside the grid."""
    x, y = math.floor((x_m - low_m[0]) / cell_m), math.floor((y_m - low_m[1]) / cell_m)
    if 0 <= x < shape[0] and 0 <= y < shape[1]:
        return x, y
    return -1, -1


@compiled
def kind_of(end_m, own, empty_m, heights):
    """What became of a line of sight that ended at a height; NaN where it did not return.

    Args:
        end_m: Height of its end, metres.
        own: Whether its end is in the column of the slot whose opening it crosses.
        empty_m: Height at which it ends in an empty slot, metres; NaN where it crosses no opening.
        heights: The `Heights`.
    """
    if math.isnan(end_m):
        return SILENT
    if end_m > heights.face + heights.band:
        return STANDING if own else HIDDEN
    if math.isnan(empty_m):
        return PASSED
    if end_m > empty_m + heights.slack:
        return FILLED
    return PASSED if end_m < heights.face - heights.band else AT_FACE


@compiled
def follow_lines(pixels, rotation, camera_m, heights, low_m, cell_m, owner, empty_m):
    """What became of lines of sight, by the grid place at which they cross the rack's face.

    Args:
        pixels: The `Pixels`.
        rotation: Of the camera in the rack's frame, shape (3, 3).
        camera_m: Its centre, rack frame, shape (3,), metres; above the face.
        heights: The `Heights`.
        low_m: Corner of the grid, shape (2,), metres.
        cell_m: Its cells, metres.
        owner: Slot whose column a place is in, shape (X, Y); -1 in none.
        empty_m: Height at which a line through a place ends in an empty slot, shape (X, Y), metres; NaN in no opening.

    Returns:
        Number of lines per place and kind, shape (X, Y, 6), where those that cross no opening have passed (they ended
        at the face or below), are hidden or silent; and the height of the highest point above the face at each place,
        shape (X, Y), metres, NaN without one.
    """
    counts = np.zeros((*owner.shape, KINDS))
    highest = np.full(owner.shape, np.nan)
    fx, fy, cx, cy = pixels.camera_px
    for i in range(0, pixels.cloud_m.shape[0], pixels.step):
        for j in range(0, pixels.cloud_m.shape[1], pixels.step):
            x, y, z = pixels.cloud_m[i, j, 0], pixels.cloud_m[i, j, 1], pixels.cloud_m[i, j, 2]
            returned = not math.isnan(z)
            if not returned:
                if fx == 0:
                    continue
                x, y, z = (j + pixels.first[0] - cx) / fx, (i + pixels.first[1] - cy) / fy, 1.0
            right = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
            ahead = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
            up = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
            end, end_x, end_y = np.nan, -1, -1
            if returned:
                end = camera_m[2] + up
                end_x, end_y = place_of(camera_m[0] + right, camera_m[1] + ahead, low_m, cell_m, owner.shape)
                if end > heights.face + heights.band and end_x >= 0 and not end <= highest[end_x, end_y]:
                    highest[end_x, end_y] = end
            # A line that goes up crosses nothing.
            if up < 0:
                along = (heights.face - camera_m[2]) / up
                at_x, at_y = place_of(
                    camera_m[0] + right * along, camera_m[1] + ahead * along, low_m, cell_m, owner.shape
                )
                if at_x >= 0:
                    empty = empty_m[at_x, at_y]
                    own = end_x >= 0 and owner[end_x, end_y] == owner[at_x, at_y] and not math.isnan(empty)
                    counts[at_x, at_y, kind_of(end, own, empty, heights)] += 1
    return counts, highest


@compiled
def least_passing(summed, middle, radius):
    """Least sum of a picture over silhouettes, of all ways to stand, per slot.

    A silhouette is the hull, row by row, of discs, one per level; a place is in it where its middle is.

    Args:
        summed: Sums of the picture from the first place of each row, shape (X + 1, Y).
        middle: Middles of the discs, shape (L, W, S, 2): levels, ways to stand, slots; in places.
        radius: Their radii, shape (L, S), in places.

    Returns:
        Shape (S,).
    """
    n_levels, n_ways, n_slots = middle.shape[0], middle.shape[1], middle.shape[2]
    found = np.full(n_slots, np.inf)
    for slot in range(n_slots):
        for way in range(n_ways):
            first, last = np.inf, -np.inf
            for level in range(n_levels):
                first = min(first, middle[level, way, slot, 1] - radius[level, slot])
                last = max(last, middle[level, way, slot, 1] + radius[level, slot])
            total = 0.0
            for row in range(max(math.floor(first), 0), min(math.ceil(last), summed.shape[1])):
                low, high = np.inf, -np.inf
                for level in range(n_levels):
                    off = row + 0.5 - middle[level, way, slot, 1]
                    chord2 = radius[level, slot] ** 2 - off * off
                    if chord2 > 0:
                        low = min(low, middle[level, way, slot, 0] - math.sqrt(chord2))
                        high = max(high, middle[level, way, slot, 0] + math.sqrt(chord2))
                if low < high:
                    start = min(max(math.ceil(low - 0.5), 0), summed.shape[0] - 1)
                    end = min(max(math.floor(high - 0.5) + 1, start), summed.shape[0] - 1)
                    total += summed[end, row] - summed[start, row]
            found[slot] = min(found[slot], total)
    return found
