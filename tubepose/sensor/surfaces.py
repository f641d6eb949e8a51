"""Surfaces that a capture has for sure: the table beside the rack, and the solid part of the rack's top."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import RgbdFrame
from tubepose.config import SensorConfig
from tubepose.labware import RackModel
from tubepose.sensor import disc_kernels as kernels
from tubepose.transforms import FloatArray, parts

MAP_CELL_M = 2.5e-4
"""Side of the cells in which the top is solid or not: a third of the finest point spacing."""
BELOW_TOP_M = 5e-3
"""What lies this far below the rack's top is not its top: twice the bow of REAL racks."""
BIN_M = 4e-3
"""Bin of heights in which the densest level is looked for: a table 1 deg off the rack's base rises 4 mm in 230 mm."""
FIRST_BAND_M = 1.2e-2
"""Half of the band about the densest bin in which the table is looked for first: that table's rise over the reach."""
LEAST_SIGMA_M = 2e-5
"""No sensor is better: points of a perfect surface must not be thrown out for rounding."""
CLIP = 4.0
"""Points farther off than this many standard deviations are not of the surface (normal errors: 1 of 16 000)."""
FITTED_POINTS = 6_000
"""Points that tell what is of the surface; all of them then tell where it lies."""
STEP_M = 1e-3
"""Points this far off a plane can be of it without any noise: the coarsest step in which cameras publish depth."""
DRAWS, DRAWN_FROM = 100, 1000
"""Planes that are drawn in search of the table (half of the points off it: one in 10^5 searches misses), and points."""
BLOCK_M = 0.02
"""Side of the blocks whose mean heights decide whether a surface is curved: twice the radius of the largest disc."""
SIGNIFICANT_F = 5.0
"""A curved surface must explain the blocks' heights by this ratio of variances (one flat one in 400 does)."""


@dataclass(frozen=True, slots=True, eq=False)
class LevelSurface:
    """Points of a level surface, and the low-order surface through them.

    Attributes:
        rows: Points, shape (N, 4): x, y, z in the rack frame and depth along the optical axis, metres.
        off_m: Distance of each from the surface along its normal, shape (N,), metres.
        clip_m: Points farther off than this are not of the surface.
        surface: Coefficients of z = c0 + c1 x + c2 y + c3 x x + c4 x y + c5 y y, rack frame, shape (6,); the quadratic
            ones are 0 unless they are significant.
        low_m: Least x and y of the points, shape (2,), metres.
        high_m: Greatest x and y of the points, shape (2,), metres.
        distance_m: Median depth.
        farthest_m: Greatest depth.
        std_m: Standard deviation of the points of the surface about it.
    """

    rows: FloatArray
    off_m: FloatArray
    clip_m: float
    surface: FloatArray
    low_m: FloatArray
    high_m: FloatArray
    distance_m: float
    farthest_m: float
    std_m: float

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """Height of the surface over the rack's base at places (..., 2) of the rack frame, metres."""
        return np.asarray(_terms(xy_m[..., 0], xy_m[..., 1]) @ self.surface)


def table_beside(
    frame: RgbdFrame, T_camera_rack: FloatArray, rack: RackModel, config: SensorConfig
) -> LevelSurface | None:
    """The densest level beside a rack and below its top; None where too few points lie there.

    Args:
        frame: The frame, with pixels or without.
        T_camera_rack: Pose of the rack, shape (4, 4), metres.
        rack: The rack.
        config: Its margins.
    """
    reach, top_m = (config.margin_m, config.reach_m), rack.height_m - BELOW_TOP_M
    rows = kernels.beside(frame.points_m, *parts(T_camera_rack), rack.outline_m / 2, *reach, top_m)
    if len(rows) < config.least_points:
        return None
    thin = rows[:: max(1, len(rows) // FITTED_POINTS)]
    bins = np.floor(thin[:, 2] / BIN_M).astype(int)
    level = (bins.min() + int(np.argmax(np.bincount(bins - bins.min()))) + 0.5) * BIN_M
    return fitted_surface(rows, _most_level(thin[np.abs(thin[:, 2] - level) < FIRST_BAND_M]), config)


def _most_level(thin: FloatArray) -> FloatArray:
    """The points near the plane that holds most of them (RANSAC): other things may stand within the band."""
    some = thin[:: max(1, len(thin) // DRAWN_FROM)]
    if len(some) < 3:
        return some
    # Drawn anew from the same seed: the same frame has the same answer.
    chosen = some[np.random.default_rng(0).integers(len(some), size=(DRAWS, 3)), :3]
    terms = np.concatenate([np.ones((DRAWS, 3, 1)), chosen[..., :2]], axis=-1)
    sound = np.abs(np.linalg.det(terms)) > BLOCK_M**2
    if not sound.any():
        return thin
    planes = np.linalg.solve(terms[sound], chosen[sound, :, 2:])[..., 0]
    off = np.abs(some[:, 2] - planes[:, :1] - planes[:, 1:2] * some[:, 0] - planes[:, 2:] * some[:, 1])
    near = STEP_M + _local_std_m(some)
    plane = planes[np.argmax(np.sum(off < near, axis=1))]
    off_plane = thin[:, 2] - plane[0] - thin[:, :2] @ plane[1:]
    return np.asarray(thin[np.abs(off_plane) < CLIP * near])


def _local_std_m(rows: FloatArray) -> float:
    """Median over blocks of the standard deviation of heights within them: what one surface has of noise and tilt."""
    block = np.floor(rows[:, :2] / BLOCK_M).astype(int)
    _, place = np.unique(block, axis=0, return_inverse=True)
    count = np.bincount(place.ravel())
    mean = np.bincount(place.ravel(), rows[:, 2]) / count
    squares = np.bincount(place.ravel(), (rows[:, 2] - mean[place.ravel()]) ** 2)
    full = count > 3
    return float(np.median(np.sqrt(squares[full] / (count[full] - 1)))) if full.any() else 0.0


def top_of_rack(
    frame: RgbdFrame, T_camera_rack: FloatArray, rack: RackModel, config: SensorConfig
) -> LevelSurface | None:
    """The solid part of a rack's top, away from every edge; None where too few points lie there.

    Args as of `table_beside`.
    """
    low, solid = solid_map(rack, config.inside_m)
    pose, band = parts(T_camera_rack), (rack.height_m, config.max_bow_m)
    rows = kernels.within(frame.points_m, *pose, low, MAP_CELL_M, solid, *band)
    return fitted_surface(rows, rows[:: max(1, len(rows) // FITTED_POINTS)], config)


@lru_cache(maxsize=32)
def solid_map(rack: RackModel, inside_m: float) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Where a rack's top is solid, and so far from any edge: place of the first cell (2,), metres, and cells (X, Y)."""
    # A point is half a diagonal of a cell from its centre at most.
    inside = inside_m + MAP_CELL_M / np.sqrt(2)
    half = rack.outline_m / 2
    x, y = (np.arange(-n, n + 1) * MAP_CELL_M for n in np.ceil(half / MAP_CELL_M).astype(int))
    solid = (np.abs(x) < half[0] - inside)[:, None] & (np.abs(y) < half[1] - inside)
    for slot in rack.all_slots:
        window = []
        for axis, values in enumerate((x, y)):
            reach = slot.half_size_m[axis] + inside + MAP_CELL_M
            window.append(slice(*np.searchsorted(values, slot.center_m[axis] + np.array([-reach, reach]))))
        place = tuple(window)
        xy = np.stack(np.meshgrid(x[place[0]], y[place[1]], indexing="ij"), axis=-1)
        solid[place] &= slot.signed_distance_m(xy) > inside
    return np.array([x[0], y[0]]), solid


def _terms(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def fitted_surface(rows: FloatArray, thin: FloatArray, config: SensorConfig) -> LevelSurface | None:
    """The low-order surface through points: least squares, points more than `CLIP` standard deviations off left out.

    Args:
        rows: Points, shape (N, 4): x and y along the surface, z along its normal, and depth, metres.
        thin: Some of them, which tell what is of the surface.
        config: How many there must be.

    Returns:
        The surface; None where too few points are of it.
    """
    surface = np.zeros(6)
    for _ in range(8):
        if len(thin) < config.least_points / 10 or len(rows) < config.least_points:
            return None
        surface = low_order_surface(thin)
        off = kernels.off_surface(thin, surface)
        clip = CLIP * max(float(np.sqrt(np.mean(off**2))), LEAST_SIGMA_M)
        kept = np.abs(off) <= clip
        if kept.all():
            break
        thin = thin[kept]
    off = kernels.off_surface(rows, surface)
    # All points now: thinned ones leave an error that is seen in the mean heights of discs.
    surface = surface + _left_over(rows, off, clip, 6 if surface[3:].any() else 3) * np.hypot(
        1, np.hypot(*surface[1:3])
    )
    off = kernels.off_surface(rows, surface)
    near = np.abs(off) <= clip
    if np.count_nonzero(near) < config.least_points:
        return None
    std, distance = float(np.sqrt(np.mean(off[near] ** 2))), float(np.median(thin[:, 3]))
    low, high, farthest = kernels.extent(rows)
    return LevelSurface(rows, off, clip, surface, low, high, distance, farthest, std)


def _left_over(rows: FloatArray, off_m: FloatArray, clip_m: float, n_terms: int) -> FloatArray:
    """Surface (6,) through what is left about another one, of its first 3 or of all 6 terms."""
    matrix, right = kernels.surface_sums(rows, off_m, clip_m)
    change = np.zeros(6)
    if matrix[0, 0] > n_terms:
        change[:n_terms] = np.linalg.lstsq(matrix[:n_terms, :n_terms], right[:n_terms], rcond=None)[0]
    return change


def low_order_surface(rows: FloatArray) -> FloatArray:
    """Coefficients (6,) of a plane, or of a quadratic surface where the mean heights of blocks call for one (F test).

    Without a bow the quadratic costs: it takes away some of what is measured.

    Args:
        rows: Points, shape (N, 4): x, y, z and depth, metres.
    """
    low = rows[:, :2].min(axis=0)
    i, j = np.floor((rows[:, :2] - low) / BLOCK_M).astype(int).T
    block = i * (j.max() + 1) + j
    count = np.bincount(block)
    full = count >= max(3, np.median(count[count > 0]) / 2)
    means = [np.bincount(block, rows[:, axis])[full] / count[full] for axis in range(3)]
    blocks = np.stack(means, axis=-1)
    flat, curved = np.zeros(6), None
    flat[:3] = np.linalg.lstsq(_terms(rows[:, 0], rows[:, 1])[:, :3], rows[:, 2], rcond=None)[0]
    spare = len(blocks) - 6
    if spare >= 6:
        terms = _terms(blocks[:, 0], blocks[:, 1])
        left = [float(np.sum((blocks[:, 2] - terms[:, :n] @ _solved(terms[:, :n], blocks[:, 2])) ** 2)) for n in (3, 6)]
        if (left[0] - left[1]) / 3 > SIGNIFICANT_F * left[1] / spare:
            curved = np.asarray(np.linalg.lstsq(_terms(rows[:, 0], rows[:, 1]), rows[:, 2], rcond=None)[0])
    return flat if curved is None else curved


def _solved(terms: FloatArray, values: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(terms, values, rcond=None)[0])
