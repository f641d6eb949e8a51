"""Where tops of tubes lie over a rack's slots: a lattice that is seen where caps hide the rack's own.

Every tube leans as it likes, but all of them lean about their slots: how their tops' middles go away from the slots'
centres along the rack tells another pitch, and that they lie about the centres at all tells that the slots are there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from tubepose.labware import RackModel
from tubepose.preprocessing import thin
from tubepose.rack import kernels as kernels
from tubepose.rack.fit import bow_slopes, to_frame
from tubepose.transforms import FloatArray, parts

# What stands out of a rack is looked for from here to there above its top.
LOW_M, HIGH_M = 5e-3, 0.15
POINTS_PER_SLOT = 80
# A top is the fullest height within this share of the distance to the next slot, and all of that height within a half;
# it has so many points there, and this share of them.
CORE, WINDOW = 0.3, 0.5
BIN_M = 2e-3
LEAST_POINTS, LEAST_SHARE = 20, 0.7
# A top is moved onto its own points' middle so often.
SHIFTS = 4
# So many tops in two rows or columns tell a pitch.
LEAST_TOPS = 6
# Tubes lean: no set of tops is told to scatter less.
LEAST_SCATTER_M = 0.4e-3
# Tops farther off the others than so many of their standard deviations are of leaning tubes or of none.
CLIP = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class TopsInSlots:
    """Tops over slots.

    Attributes:
        count: How many there are.
        median_share: How far their middles lie from the slots' centres, median, as a share of the distance of slots;
            NaN without any.
        stretch: By how much they lie farther apart than the slots along x and y, shape (2,); 0 where they tell none.
        std: Standard deviations of that, shape (2,); infinite where they tell none.
    """

    count: int
    median_share: float
    stretch: FloatArray
    std: FloatArray


def tops_in_slots(points_m: FloatArray, T_camera_top: FloatArray, bow_m: FloatArray, rack: RackModel) -> TopsInSlots:
    """Find the tops over a rack's slots.

    Args:
        points_m: Points near the rack, camera frame, shape (N, 3), metres; of a bowed rack as they are.
        T_camera_top: Frame of its top, shape (4, 4), metres.
        bow_m: Of its face (`Fit.bow_m`), shape (3,), metres: tubes stand along its normal.
        rack: The rack.
    """
    reach_m = rack.outline_m / 2 + 5e-3
    above = kernels.in_box(np.ascontiguousarray(points_m, float), *parts(T_camera_top), reach_m, LOW_M, HIGH_M)
    centers, pitches = rack.slot_centers_m, rack.pitches_m
    local = to_frame(thin(above, POINTS_PER_SLOT * len(centers)), T_camera_top)
    slopes = bow_slopes(bow_m, centers, rack)
    found, offsets = [], []
    tree = cKDTree(local[:, :2])
    for k, near in enumerate(tree.query_ball_point(centers, 1.5 * WINDOW * pitches, p=np.inf, return_sorted=True)):
        offset = _middle(local[near, :2] - centers[k], local[near, 2], float(pitches[k]))
        if offset is not None:
            found.append(k)
            offsets.append(offset[:2] + offset[2] * slopes[k])
    if not found:
        return TopsInSlots(0, float("nan"), np.zeros(2), np.full(2, np.inf))
    off, share = np.array(offsets), np.array(offsets) / pitches[found][:, None]
    median = float(np.median(np.hypot(*share.T)))
    measured = [_stretch(centers[found], off, axis) for axis in range(2)]
    return TopsInSlots(len(found), median, np.array([m[0] for m in measured]), np.array([m[1] for m in measured]))


def _middle(apart_m: FloatArray, heights_m: FloatArray, pitch_m: float) -> FloatArray | None:
    """Middle of the top over a slot, off its centre, and its height, (3,), metres; None where there is none."""
    core = (apart_m**2).sum(axis=1) < (CORE * pitch_m) ** 2
    if np.count_nonzero(core) < LEAST_POINTS:
        return None
    counts = np.bincount((heights_m[core] / BIN_M).astype(int))
    level = (int(counts.argmax()) + 0.5) * BIN_M
    # Light behind clear walls comes from all heights.
    if np.mean(np.abs(heights_m[core] - level) < BIN_M) < LEAST_SHARE:
        return None
    at = apart_m[np.abs(heights_m - level) < BIN_M]
    middle = np.zeros(2)
    for _ in range(SHIFTS):
        inside = ((at - middle) ** 2).sum(axis=1) < (WINDOW * pitch_m) ** 2
        if np.count_nonzero(inside) < LEAST_POINTS:
            return None
        middle = at[inside].mean(axis=0)
    return np.array([*middle, level])


def _stretch(centers_m: FloatArray, off_m: FloatArray, axis: int) -> tuple[float, float]:
    """Stretch along an axis and its standard deviation, by least squares of what is not far off the others."""
    lines = np.unique(np.rint(centers_m[:, axis] * 1e3))
    if len(centers_m) < LEAST_TOPS or len(lines) < 2:
        return 0.0, float("inf")
    kept = np.ones(len(centers_m), bool)
    design = np.column_stack([np.ones(len(centers_m)), centers_m])
    found, scatter = np.zeros(3), LEAST_SCATTER_M
    for _ in range(3):
        normal = design[kept].T @ design[kept] + 1e-12 * np.eye(3)
        found = np.linalg.solve(normal, design[kept].T @ off_m[kept, axis])
        left = off_m[:, axis] - design @ found
        scatter = max(float(np.sqrt((left[kept] ** 2).sum() / max(kept.sum() - 3, 1))), LEAST_SCATTER_M)
        kept = np.abs(left) < CLIP * scatter
        if kept.sum() < LEAST_TOPS or len(np.unique(np.rint(centers_m[kept, axis] * 1e3))) < 2:
            return 0.0, float("inf")
    normal = design[kept].T @ design[kept] + 1e-12 * np.eye(3)
    variance = scatter**2 * np.linalg.inv(normal)[1 + axis, 1 + axis]
    # Where caps touch, those at the ends lean outwards by as much as tubes lean: more tops do not take that away.
    leaning = (scatter / float(np.abs(centers_m[:, axis]).max())) ** 2
    return float(found[1 + axis]), float(np.sqrt(variance + leaning))
