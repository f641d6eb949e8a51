"""Planes through discs of a level surface: their scatter is the error of a plane through a cap of that size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tubepose.config import SensorConfig
from tubepose.sensor import disc_kernels as kernels
from tubepose.sensor.noise import DiscNoise
from tubepose.sensor.surfaces import LevelSurface
from tubepose.transforms import FloatArray

FULL = 0.8
"""Share of the points of a full disc that a disc must have: edges and things on the table cut into others."""
ROUND = 0.15
"""How far a disc's centre of mass may be off, in radii, and its second moments, as shares of a full disc's."""
LEAST_IN_DISC = 12
"""Points of a disc: a plane through fewer says more of itself than of them."""
WINSOR_SHARE = 0.9
WINSOR_GAIN = 0.8314
"""Mean square of a normal variable whose absolute values above their 90th percentile (1.645) are set to it."""


def measure_discs(surface: LevelSurface, config: SensorConfig) -> tuple[tuple[DiscNoise, ...], float, float]:
    """Lay discs on a surface, fit a plane to each, and take the scatter of their slopes and heights.

    Args:
        surface: The surface; what is of low order has been taken out of it.
        config: The radii, and how many discs.

    Returns:
        The radii on which discs enough were laid; the area per point, square metres, and the share of points off the
        surface, both of the discs of the radius with most of them (NaN without any).
    """
    found, area_m2, outliers, most = [], np.nan, np.nan, 0
    for radius in config.radii_m:
        sums = _full_discs(_laid(surface, radius, config), radius)
        if len(sums) < max(config.least_discs, 2):
            continue
        slopes, heights = _planes(sums)
        n_values = 2 * len(sums)
        # Winsorised mean squares are 0.9 times as efficient as plain ones; of heights there are half as many.
        known = 1 / np.sqrt(2 * 0.9 * n_values)
        found.append(DiscNoise(radius, spread(slopes), spread(heights), len(sums), float(known)))
        if len(sums) > most:
            most = len(sums)
            area_m2 = float(np.pi * radius**2 / np.median(sums[:, 0]))
            outliers = float(np.sum(sums[:, 10]) / np.sum(sums[:, [0, 10]]))
    return tuple(found), area_m2, outliers


def _laid(surface: LevelSurface, radius_m: float, config: SensorConfig) -> FloatArray:
    """Sums of the discs of one radius, shape (D, 11), on a grid that is wide enough for no more than are wanted."""
    low = surface.low_m
    size = surface.high_m - low
    # Discs of equal pixels are larger where the surface is farther.
    least = 2 * radius_m * surface.farthest_m / surface.distance_m
    seen_m2 = float(np.prod(size))
    pitch = max(least, float(np.sqrt(seen_m2 / (2 * config.discs))))
    shape = np.maximum(np.floor(size / pitch), 1).astype(int)
    grid = (surface.clip_m, low, pitch, (int(shape[0]), int(shape[1])), radius_m, surface.distance_m)
    sums = kernels.disc_sums(surface.rows, surface.off_m, *grid)
    return np.asarray(sums.reshape(-1, 11))


def _full_discs(sums: FloatArray, radius_m: float) -> FloatArray:
    """Those that nothing cuts into, shape (D, 11)."""
    sums = sums[sums[:, 0] >= LEAST_IN_DISC]
    if not len(sums):
        return sums
    n = sums[:, 0]
    center = np.hypot(sums[:, 1], sums[:, 2]) / n / radius_m
    quarter = radius_m**2 / 4
    moments = (sums[:, 3:6] / n[:, None] - [quarter, 0, quarter]) / quarter
    whole = (center < ROUND) & (np.abs(moments) < 2 * ROUND).all(axis=1)
    whole &= sums[:, 10] < (1 - FULL) * n
    if not whole.any():
        return sums[:0]
    return np.asarray(sums[whole & (n >= FULL * np.median(n[whole]))])


def _planes(sums: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Slopes (2 D,) of the least-squares planes through discs, and their mean heights (D,), metres."""
    n, x, y, xx, xy, yy, h, hx, hy = sums[:, :9].T
    normal: FloatArray = np.stack([n, x, y, x, xx, xy, y, xy, yy], axis=-1).reshape(-1, 3, 3)
    planes = np.linalg.solve(normal, np.stack([h, hx, hy], axis=-1)[..., None])[..., 0]
    return planes[:, 1:].ravel(), h / n


def spread(values: FloatArray) -> float:
    """Standard deviation about zero from winsorised mean squares: medians read 0 on depth that comes in steps.

    Args:
        values: Numbers, shape (N,); without any it is 0.
    """
    size: NDArray[np.float64] = np.abs(values)
    if not len(size):
        return 0.0
    bound = np.quantile(size, WINSOR_SHARE)
    return float(np.sqrt(np.mean(np.minimum(size, bound) ** 2) / WINSOR_GAIN))
