"""What stands or lies on a rack and is no tube that is looked for: unknown types, tubes across it, second tubes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.labware import RackModel, TubeModel
from tubepose.profile.standing import OUTSIDE_M, Standing
from tubepose.transforms import FloatArray

CELL_M = 1.0e-3
CORE_SHARE = 0.6
"""Least filled share of a slot's middle for something to stand in it."""
LEVEL_M = 2.5e-3
LEVEL_SHARE = 0.6
"""A top is level: this share of its points lies this near their median height. Light behind glass is not."""
SAME_HEIGHT_M = 1.0e-3
"""Something this near to a type's height is no other type by its height."""
LYING_PITCHES = 1.6
"""Something longer than this many pitches stands in no slot."""

NO_TOP, STRANGE_TOP = -1, -2
"""Labels of points that are of no top, and of one that is of no given type."""


@dataclass(frozen=True, slots=True, eq=False)
class Leftover:
    """Something that is no known tube.

    Attributes:
        slot: Index of the slot that it stands in, or None.
        reason: What it looks like, in words.
        rows: Rows of the standing points that it is made of.
        code: What it looks like: ``unknown_type``, ``type_not_told``, ``lies_across``, ``second_top`` or
            ``part_of_top``.
    """

    slot: int | None
    reason: str
    rows: NDArray[np.intp]
    code: str = "unknown_type"


def find_leftovers(
    standing: Standing, label: NDArray[np.intp], taken: Sequence[int], rack: RackModel, tubes: Sequence[TubeModel]
) -> tuple[Leftover, ...]:
    """Groups of points that belong to no top and fill the middle of a slot, or lie across several.

    Light that went through a wall leaves points too, but thin ones: a group must be solid where it is judged.

    Args:
        standing: Points above the rack's top.
        label: Tube of each point, `NO_TOP` for none.
        taken: Slots that hold a tube, or a top of no given type.
        rack: The rack.
        tubes: The types that were looked for.
    """
    rest = np.flatnonzero(label == NO_TOP)
    if len(rest) == 0:
        return ()
    half = rack.outline_m / 2 + OUTSIDE_M
    cells = np.rint((standing.points_m[rest, :2] + half) / CELL_M).astype(np.intp)
    picture = np.zeros(np.ceil(2 * half / CELL_M).astype(int) + 2, np.uint8)
    picture[cells[:, 0], cells[:, 1]] = 1
    # Close the gaps of coarse scans, then drop what is thinner than 5 mm: walls' ghosts, slivers beside tops.
    solid = cv2.morphologyEx(picture, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    solid = cv2.morphologyEx(solid, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5)))
    count, groups = cv2.connectedComponents(solid)
    of = groups[cells[:, 0], cells[:, 1]]
    pitch = float(rack.pitches_m.min())
    found: list[Leftover] = []
    for group in range(1, count):
        rows = rest[of == group]
        if len(rows):
            entry = _judge(standing, rows, np.argwhere(groups == group), half, pitch, taken, rack, tubes)
            found += [entry] if entry is not None else []
    return tuple(found)


def _judge(
    standing: Standing,
    rows: NDArray[np.intp],
    cells: NDArray[np.intp],
    half: FloatArray,
    pitch_m: float,
    taken: Sequence[int],
    rack: RackModel,
    tubes: Sequence[TubeModel],
) -> Leftover | None:
    """What one group is; None if it is too small to be anything."""
    (_, _), sides, _ = cv2.minAreaRect(cells.astype(np.float32))
    length_m, width_m = max(sides) * CELL_M, min(sides) * CELL_M
    if length_m > LYING_PITCHES * pitch_m and width_m > 6e-3:
        size = f"{length_m * 1e3:.0f} x {width_m * 1e3:.0f} mm"
        return Leftover(
            None, f"lies across the rack: {size} seen from above, if no unknown tops touch", rows, "lies_across"
        )
    place_m = cells.mean(axis=0) * CELL_M - half
    distance = np.linalg.norm(rack.slot_centers_m - place_m, axis=1)
    slot = int(distance.argmin())
    area_m2 = len(cells) * CELL_M**2
    if area_m2 < CORE_SHARE * np.pi * (0.3 * pitch_m) ** 2 or distance[slot] > 0.6 * pitch_m:
        return None
    z = standing.points_m[rows, 2]
    if np.mean(np.abs(z - np.median(z)) < LEVEL_M) < LEVEL_SHARE:
        return None
    height_m = float(np.percentile(z, 95)) - rack.floor_m
    if slot in taken:
        if area_m2 < np.pi * (0.3 * pitch_m) ** 2:
            return None
        return Leftover(
            slot, f"a second top in slot {rack.all_slots[slot].name}, {height_m * 1e3:.1f} mm high", rows, "second_top"
        )
    alike = [tube.name for tube in tubes if abs(tube.height_m - height_m) < SAME_HEIGHT_M]
    if alike:
        reason = (
            f"{height_m * 1e3:.1f} mm high as {alike[0]} is, but no top of it: in part, another one, or a coarse scan"
        )
        return Leftover(slot, reason, rows, "part_of_top")
    heights = ", ".join(f"{tube.name} {tube.height_mm:g}" for tube in tubes)
    expected = f"expected (mm): {heights}; or it stands on something" if tubes else "no tube model given (--tubes)"
    return Leftover(slot, f"unknown type: {height_m * 1e3:.1f} mm high, {expected}", rows)
