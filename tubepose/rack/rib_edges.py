"""Ribs of a rack's face, one by one: their middles tell the pitch (least squares over all pairs of neighbours).

A sensor that loses the edges of a rib, or sees its walls, does so for all ribs alike: what counts is how their middles
lie apart. Ribs beside something that stands up are left out: it hides one side of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tubepose.labware import RackModel, SlotModel
from tubepose.transforms import FloatArray

BAND = 0.35
"""Half of the length of a rib that is looked at, as a share of the openings beside it."""
LEAST_POINTS, LEAST_RIBS = 15, 4
BESIDE = 0.4
"""How far beside its place a rib's points may lie, as a share of its width."""
STANDING_M, STANDING_POINTS = 3e-3, 25
PLACES_M = 1e-3
"""Slots in one line differ by less across it."""
CLUSTERS = 2.0
"""Neighbouring ribs share their errors: so many count as one."""


@dataclass(frozen=True, slots=True, eq=False)
class RibStretch:
    """What ribs say of a rack's pitch, axis by axis; NaN where too few are seen.

    Attributes:
        stretch: By how much slots lie farther apart than defined along x and y, shares, shape (2,).
        std: Standard deviations, shape (2,).
    """

    stretch: FloatArray
    std: FloatArray


def measure_ribs(local_m: FloatArray, rack: RackModel, window_m: float) -> RibStretch:
    """Measure how far the ribs of a face lie apart.

    Args:
        local_m: Points, shape (N, 3), rack frame, metres; of a bowed rack those that were laid flat.
        rack: A definition that is nearly right.
        window_m: Points this near to the face's height are of it.
    """
    over = local_m[:, 2] - rack.height_m
    inside = np.all(np.abs(local_m[:, :2]) < rack.outline_m / 2, axis=1)
    face = local_m[inside & (np.abs(over) < window_m), :2]
    free = _free_slots(local_m[inside & (over > STANDING_M), :2], rack)
    rows = [_axis(face, rack, free, axis) for axis in range(2)]
    return RibStretch(np.array([row[0] for row in rows]), np.array([row[1] for row in rows]))


def _free_slots(standing: FloatArray, rack: RackModel) -> frozenset[str]:
    """Slots over which, and a little beside which, nothing stands up."""
    reaches = [(slot, slot.half_size_m + 2 * STANDING_M) for slot in rack.all_slots]
    return frozenset(
        slot.name
        for slot, reach in reaches
        if np.count_nonzero(np.all(np.abs(standing - slot.center_m) < reach, axis=1)) < STANDING_POINTS
    )


def _axis(face: FloatArray, rack: RackModel, free: frozenset[str], axis: int) -> tuple[float, float]:
    """Stretch along an axis and its standard deviation."""
    found = [
        pair
        for slot, other in _neighbours(rack, axis)
        if slot.name in free and other.name in free and (pair := _middle(face, slot, other, axis)) is not None
    ]
    if len(found) < LEAST_RIBS:
        return np.nan, np.nan
    defined, middles = np.array(found).T
    places = defined - defined.mean()
    if np.ptp(places) < PLACES_M:
        return np.nan, np.nan
    slope = float(places @ middles / (places @ places))
    rest = middles - middles.mean() - slope * places
    std = float(np.sqrt(rest @ rest / max(len(rest) - 2, 1)))
    return slope - 1, std * float(np.sqrt(CLUSTERS / (places @ places)))


def _neighbours(rack: RackModel, axis: int) -> Iterator[tuple[SlotModel, SlotModel]]:
    """Pairs of slots that are next to each other in a line along an axis."""
    centers = rack.slot_centers_m
    for slot, center in zip(rack.all_slots, centers, strict=True):
        line = np.abs(centers[:, 1 - axis] - center[1 - axis]) < PLACES_M
        ahead = line & (centers[:, axis] > center[axis] + PLACES_M)
        if ahead.any():
            yield slot, rack.all_slots[int(np.flatnonzero(ahead)[np.argmin(centers[ahead, axis])])]


def _half_width(slot: SlotModel, axis: int, across_m: FloatArray) -> FloatArray:
    if slot.shape == "round":
        return np.asarray(np.sqrt(np.maximum(slot.half_size_m[0] ** 2 - across_m**2, 0)))
    return np.full(len(across_m), slot.half_size_m[axis])


def _middle(face: FloatArray, slot: SlotModel, other: SlotModel, axis: int) -> tuple[float, float] | None:
    """Defined and measured middle of a rib where it is narrowest, metres; None where too little of it is seen."""
    across = face[:, 1 - axis] - slot.center_m[1 - axis]
    band = BAND * min(slot.half_size_m[1 - axis], other.half_size_m[1 - axis])
    some = (np.abs(across) < band) & (face[:, axis] > slot.center_m[axis]) & (face[:, axis] < other.center_m[axis])
    left = slot.center_m[axis] + _half_width(slot, axis, across[some])
    right = other.center_m[axis] - _half_width(other, axis, across[some])
    middle, width = (left + right) / 2, right - left
    off = face[some, axis] - middle
    for _ in range(2):
        near = np.abs(off - np.median(off)) < (0.5 + BESIDE) * width if len(off) else np.zeros(0, bool)
        if np.count_nonzero(near) < LEAST_POINTS:
            return None
        off, width, middle = off[near], width[near], middle[near]
    place = float(slot.center_m[axis] + other.center_m[axis]) / 2
    place += float(slot.half_size_m[axis] - other.half_size_m[axis]) / 2
    return place, place + float(off.mean())
