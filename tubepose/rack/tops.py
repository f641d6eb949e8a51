"""How level a full rack stands, by the tops of what stands in it.

Between caps that nearly touch, light goes from one to the next before it comes back, and lifts or sinks the ribs that
show there by millimetres: a plane through them leans by degrees. The caps' own tops are seen without that. Those of one
kind of tube are on a plane that is as level as the rack, whatever the kind is and however each of its tubes leans.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from tubepose.labware import RackModel
from tubepose.preprocessing import thin
from tubepose.rack import kernels as kernels
from tubepose.rack.field import top_field
from tubepose.transforms import FloatArray, make_transform, parts, translation

# What stands out of a rack is looked for from here to there above its top, and this near the axis of its slot.
LOW_M, HIGH_M = 5e-3, 0.15
AXIS_M = 5e-3
# A top is the fullest of these heights above a slot, if so many points have it, and this share of those above the slot:
# less is an opening, or a sensor too rough to tell a level. Its height is the mean of both bins.
BIN_M = 1e-3
LEAST_POINTS = 20
LEAST_SHARE = 0.7
POINTS_PER_SLOT = 240
# Tubes stand apart: no part of a top is farther from the axes of all slots than this share of the distance to the next
# slot. A plate has points there too, as close together as above the slots; with this share of them it is one.
BETWEEN = 0.6
PLATE_SHARE = 0.5
AREA_STEP_M = 0.5e-3
# Planes are drawn through three tops; no farther off the level of the ribs than stray light can lift one side of them.
DRAWS = 200
STEEPEST = 0.06
# Tops of one kind: caps sit crooked, and bottoms play on the floor. Two kinds that differ by little, in blocks of rows,
# would make a plane that leans, with rows off it on either side: less likely by chance than this, they are two.
ALIKE_M = 0.4e-3
LEAST_CHANCE = 1e-3
# So many of one kind hold a rack, if its level is known as well by them.
LEAST_TOPS = 12
LARGEST_STD_RAD = 3e-3
# Caps of one batch err alike, and so do neighbours.
INFLATE = 1.3
# Ribs that show are at the height of the highest peak, if it has this share of the fullest one: stray light sinks more
# of them than it lifts. What a peak is told by, and where it is looked for.
PEAK_SHARE = 0.3
PEAK_BIN_M = 0.2e-3
PEAK_REACH_M = 4e-3


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """How level a rack stands, by the tops of what stands in it.

    Attributes:
        T_camera_top: Frame of the rack's top, turned level with them, shape (4, 4), metres.
        covariance: Of its turns about x and y, shape (2, 2), rad^2.
        count: How many tops are on one plane.
    """

    T_camera_top: FloatArray
    covariance: FloatArray
    count: int


def level_by_tops(points_m: FloatArray, ribs_m: FloatArray, T_camera_top: FloatArray, rack: RackModel) -> Level | None:
    """The level of a rack by the tops in its slots, and the height that its ribs have there; None where they tell none.

    Args:
        points_m: What stands in the rack, shape (N, 3), camera frame, metres.
        ribs_m: Points within some millimetres of the rack's top, shape (M, 3), camera frame, metres.
        T_camera_top: Frame of the rack's top, a few degrees off its level at most, shape (4, 4), metres.
        rack: The rack.
    """
    centers, heights, plate = _tops(points_m, T_camera_top, rack)
    if plate or len(centers) < LEAST_TOPS:
        return None
    alike = _one_kind(centers, heights)
    if np.count_nonzero(alike) < LEAST_TOPS:
        return None
    turns, covariance, off = _level(centers[alike], heights[alike])
    if np.sqrt(np.diag(covariance).max()) > LARGEST_STD_RAD or _rows_differ(centers[alike], off):
        return None
    turn = make_transform(Rotation.from_rotvec([*turns, 0.0]).as_matrix(), np.zeros(3))
    T_level = T_camera_top @ turn
    T_level = T_level @ translation([0, 0, _height(ribs_m, T_level, rack)])
    return Level(T_level, covariance, int(alike.sum()))


def _level(centers_m: FloatArray, heights_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Turns about x and y (2,) that put tops (K,) on a level plane, their covariance (2, 2), and what is left (K,)."""
    design = np.column_stack([centers_m[:, 1], -centers_m[:, 0], np.ones(len(centers_m))])
    normal = design.T @ design
    found = np.linalg.solve(normal, design.T @ heights_m)
    off = heights_m - design @ found
    variance = float(off @ off) / (len(off) - 3)
    return np.arctan(found[:2]), INFLATE**2 * variance * np.linalg.inv(normal)[:2, :2], off


def _rows_differ(centers_m: FloatArray, off_m: FloatArray) -> bool:
    """Whether what a plane leaves of tops (K,) goes by rows or columns (F test): they are of two kinds that differ."""
    for axis in range(2):
        row = np.unique(np.rint(centers_m[:, axis] / BIN_M), return_inverse=True)[1]
        count = np.bincount(row)
        between, within = len(count) - 2, len(off_m) - len(count) - 1
        if between < 1 or within < 1:
            continue
        explained = float((np.bincount(row, off_m) ** 2 / count).sum())
        ratio = (explained / between) / max((float(off_m @ off_m) - explained) / within, 1e-12)
        if fdtrc(between, within, ratio) < LEAST_CHANCE:
            return True
    return False


def _tops(points_m: FloatArray, T_camera_top: FloatArray, rack: RackModel) -> tuple[FloatArray, FloatArray, bool]:
    """Centres (K, 2) of slots with a top above them, its height (K,) above the rack's; whether they hang together."""
    (R, origin_m), centers = parts(T_camera_top), rack.slot_centers_m
    points_m = np.ascontiguousarray(points_m, float)
    above_m = kernels.in_box(points_m, R, origin_m, rack.outline_m / 2, LOW_M, HIGH_M)
    few_m = thin(above_m, POINTS_PER_SLOT * len(centers))
    between_m, areas_m2 = _between(rack)
    counts, sums, beside = kernels.slot_heights(few_m, R, origin_m, centers, AXIS_M, between_m, LOW_M, HIGH_M, BIN_M)
    # Two bins side by side: a top that leans, or stands on their edge, fills both.
    both, total = counts[:, :-1] + counts[:, 1:], sums[:, :-1] + sums[:, 1:]
    slot, fullest = np.arange(len(centers)), both.argmax(axis=1)
    most = both[slot, fullest]
    full = (most >= LEAST_POINTS) & (most >= LEAST_SHARE * counts.sum(axis=1))
    joined = (beside[:, :-1] + beside[:, 1:])[slot, fullest]
    plate = joined[full].sum() > PLATE_SHARE * (most * areas_m2 / (np.pi * AXIS_M**2))[full].sum()
    return centers[full], (total[slot, fullest] / np.maximum(most, 1))[full], bool(plate)


@lru_cache(maxsize=32)
def _between(rack: RackModel) -> tuple[FloatArray, FloatArray]:
    """How far from a slot's axis no tube's top reaches (S,), metres, and the area nearest to it beyond (S,), m^2."""
    between_m = BETWEEN * rack.pitches_m
    axes = [np.arange(-side / 2, side / 2, AREA_STEP_M) for side in rack.outline_m]
    xy = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    distance, nearest = cKDTree(rack.slot_centers_m).query(xy)
    beyond = np.asarray(nearest)[np.asarray(distance) > between_m[nearest]]
    return between_m, np.asarray(np.bincount(beyond, minlength=len(between_m)) * AREA_STEP_M**2)


def _one_kind(centers_m: FloatArray, heights_m: FloatArray) -> NDArray[np.bool_]:
    """Which of the tops (K,) are on the plane that most of them are on, if it is nearly level."""
    rng = np.random.default_rng(0)
    three = rng.integers(0, len(centers_m), (DRAWS, 3))
    places = np.concatenate([centers_m, np.ones((len(centers_m), 1))], axis=1)
    corners = places[three]
    apart = np.abs(np.linalg.det(corners)) > 1e-4 * np.ptp(centers_m, axis=0).max()
    planes = np.linalg.solve(corners[apart], heights_m[three[apart], None])[..., 0]
    planes = planes[np.hypot(planes[:, 0], planes[:, 1]) < STEEPEST]
    alike = np.abs(planes @ places.T - heights_m) < ALIKE_M
    return alike[alike.sum(axis=1).argmax()] if len(alike) else np.zeros(len(centers_m), bool)


def _height(ribs_m: FloatArray, T_camera_top: FloatArray, rack: RackModel) -> float:
    """Height of the ribs that show, over the level of a frame: that of the highest peak that counts."""
    solid_m = top_field(rack).on_solid(ribs_m, T_camera_top, PEAK_REACH_M)
    edges = np.arange(-PEAK_REACH_M, PEAK_REACH_M + PEAK_BIN_M / 2, PEAK_BIN_M)
    counts = np.convolve(np.histogram(solid_m[:, 2], edges)[0], [0.5, 1, 1, 1, 0.5], "same")
    padded = np.pad(counts, 1)
    peaks = (counts > padded[:-2]) & (counts >= padded[2:]) & (counts >= PEAK_SHARE * counts.max())
    return float(edges[np.flatnonzero(peaks)[-1]] + PEAK_BIN_M / 2) if peaks.any() else 0.0
