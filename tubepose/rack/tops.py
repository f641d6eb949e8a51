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
from tubepose.rack.fit_kernels import BOW_STD_M, bow_at
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
STEEPEST_M = 4e-3
# Those through tops that are on a line, or nearly, lean as they like.
LEAST_SPAN = 0.02
# A face is bowed by no more (real racks: 2 mm), and where so many are on a plane none is looked for.
MOST_BOW_M = 4e-3
MOST_ALIKE = 0.8
# Tops of one kind: caps sit crooked, and bottoms play on the floor. Two kinds that differ by little, in blocks of rows,
# would make a plane that leans, with rows off it on either side: less likely by chance than this, they are two.
ALIKE_M = 0.4e-3
LEAST_CHANCE = 1e-3
# A bow is one if it is less likely by chance than one in a thousand (chi-squared of 3).
FLAT_CHI2 = 16.27
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
        count: How many tops are on one surface.
        bow_m: Of that surface, and so of the face, shape (3,), metres (`Fit.bow_m`); 0 where it is not significant.
        bow_covariance: Of that, shape (3, 3).
    """

    T_camera_top: FloatArray
    covariance: FloatArray
    count: int
    bow_m: FloatArray
    bow_covariance: FloatArray


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
    half_m = rack.outline_m / 2
    alike = _one_kind(centers / half_m, heights)
    if np.count_nonzero(alike) < LEAST_TOPS:
        return None
    found, covariance, off = _surface(centers[alike] / half_m, heights[alike])
    turns, to_turns = np.array([found[1] / half_m[1], -found[0] / half_m[0]]), np.diag([1 / half_m[1], -1 / half_m[0]])
    covariance_turns = to_turns @ covariance[np.ix_([1, 0], [1, 0])] @ to_turns.T
    if np.sqrt(np.diag(covariance_turns).max()) > LARGEST_STD_RAD or _rows_differ(centers[alike], off):
        return None
    turn = make_transform(Rotation.from_rotvec([*np.arctan(turns), 0.0]).as_matrix(), np.zeros(3))
    T_level, bow_m = T_camera_top @ turn, found[3:]
    T_level = T_level @ translation([0, 0, _height(ribs_m, T_level, bow_m, rack)])
    return Level(T_level, covariance_turns, int(alike.sum()), bow_m, covariance[3:, 3:])


def _terms(uv: FloatArray) -> FloatArray:
    """Columns of a low-order surface at places (..., 2) that are 1 at the ends of the outline: shape (..., 6)."""
    u, v = uv[..., 0], uv[..., 1]
    return np.stack([u, v, np.ones_like(u), u * u, v * v, u * v], axis=-1)


def _surface(uv: FloatArray, heights_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Surface (6,) of tops (K,), its covariance (6, 6) and what is left (K,); a plane where a bow is not significant.

    The bow has the prior of a rack's face.
    """
    fits: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for bowed in (True, False):
        design = _terms(uv)
        prior = np.diag([0, 0, 0, *np.full(3, (ALIKE_M / (2 * BOW_STD_M)) ** 2 if bowed else 1e9)])
        normal = design.T @ design + prior
        found = np.linalg.solve(normal, design.T @ heights_m)
        off = heights_m - design @ found
        spare = max(len(off) - (6 if bowed else 3), 1)
        covariance = INFLATE**2 * float(off @ off) / spare * np.linalg.inv(normal)
        fits.append((np.asarray(found), np.asarray(covariance), np.asarray(off)))
    bowed_fit, flat_fit = fits
    bow = bowed_fit[0][3:]
    significant = bow @ np.linalg.solve(bowed_fit[1][3:, 3:], bow) > FLAT_CHI2
    if significant:
        return bowed_fit
    flat, covariance, off = flat_fit
    covariance[3:, 3:] = bowed_fit[1][3:, 3:]
    return np.concatenate([flat[:3], np.zeros(3)]), covariance, off


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


def _one_kind(uv: FloatArray, heights_m: FloatArray) -> NDArray[np.bool_]:
    """Which of the tops (K,) are on the surface that most of them are on, if it is nearly level and bowed as racks are.

    Planes are drawn through three tops first, and surfaces through six where planes leave too many.
    """
    rng = np.random.default_rng(0)
    places = _terms(uv)
    best = np.zeros(len(uv), bool)
    for count in (3, 6):
        few = rng.integers(0, len(uv), (DRAWS * count // 3, count))
        corners = places[few][..., :count]
        apart = np.abs(np.linalg.det(corners)) > LEAST_SPAN
        if not apart.any():
            continue
        surfaces = np.linalg.solve(corners[apart], heights_m[few[apart], None])[..., 0]
        level = np.hypot(surfaces[:, 0], surfaces[:, 1]) < STEEPEST_M
        level &= np.all(np.abs(surfaces[:, 3:]) < MOST_BOW_M, axis=1)
        alike = np.abs(surfaces[level] @ places[:, :count].T - heights_m) < ALIKE_M
        if len(alike) and alike.sum(axis=1).max() > best.sum():
            best = alike[alike.sum(axis=1).argmax()]
        if best.sum() > MOST_ALIKE * len(uv):
            break
    return best


def _height(ribs_m: FloatArray, T_camera_top: FloatArray, bow_m: FloatArray, rack: RackModel) -> float:
    """Height of the ribs that show, over the level of a frame: that of the highest peak that counts."""
    solid_m = top_field(rack).on_solid(ribs_m, T_camera_top, 2 * PEAK_REACH_M)
    solid_m[:, 2] -= bow_at(bow_m, *(solid_m[:, :2] / (rack.outline_m / 2)).T)
    edges = np.arange(-PEAK_REACH_M, PEAK_REACH_M + PEAK_BIN_M / 2, PEAK_BIN_M)
    counts = np.convolve(np.histogram(solid_m[:, 2], edges)[0], [0.5, 1, 1, 1, 0.5], "same")
    padded = np.pad(counts, 1)
    peaks = (counts > padded[:-2]) & (counts >= padded[2:]) & (counts >= PEAK_SHARE * counts.max())
    return float(edges[np.flatnonzero(peaks)[-1]] + PEAK_BIN_M / 2) if peaks.any() else 0.0
