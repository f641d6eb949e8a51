"""The plane of every closed cap's top: which way it faces, and how high it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.config import ProfileConfig
from tubepose.profile.kernels import plane_sums
from tubepose.transforms import FloatArray

ROUNDS = 4
EDGE_M = 1.0e-3
"""Points this near the end of a top are mixed with its background."""
LEAST_SIGMA_M = 3.0e-5
"""No sensor is better: points on a perfect plane must not be thrown out for rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class TopPlanes:
    """Planes z = height + slope (xy - center), one per tube, shape (T, ...), rack frame.

    Attributes:
        height_m: Height of the plane above the rack's base at the given centre, shape (T,), metres; NaN without one.
        slope: Its rise along x and y, shape (T, 2).
        slope_var: Variance of each slope, shape (T,).
        rms_m: RMS distance of the points that count, shape (T,), metres; NaN without a plane.
        n_points: Points that count, shape (T,).
    """

    height_m: FloatArray
    slope: FloatArray
    slope_var: FloatArray
    rms_m: FloatArray
    n_points: NDArray[np.intp]


def fit_top_planes(
    label: NDArray[np.intp],
    offset_m: FloatArray,
    height_m: FloatArray,
    expected_m: FloatArray,
    radius_m: FloatArray,
    config: ProfileConfig,
) -> TopPlanes:
    """Fit the planes of all tops at once: least squares with Tukey's weights, from the median height.

    The rounds see `plane_points` of a top's points, the last one all of them.

    The variance of a slope has two parts: the noise of single points, which many points average out, and the error
    that points within `shared_error_reach_m` share, which they do not.

    Args:
        label: Tube of each point, shape (N,).
        offset_m: Offset of each point from its tube's centre, shape (N, 2), metres.
        height_m: Height of each point above the rack's base, shape (N,).
        expected_m: Height at which each top is expected, shape (T,).
        radius_m: Radius of each top, shape (T,): points of the outer 1 mm are mixed with the background and left out.
        config: Noise of a cap's top.
    """
    count = len(expected_m)
    inner_m = np.maximum(radius_m - EDGE_M, 0.0)
    step = max(1, len(height_m) // max(config.plane_points * count, 1))
    few = np.s_[:: 4 * step]
    inside = np.hypot(*offset_m[few].T) < inner_m[label[few]]
    inside &= np.abs(height_m[few] - expected_m[label[few]]) < config.top_band_m
    start = _median_per_label(label[few][inside], height_m[few][inside], expected_m)
    planes = np.column_stack([start, np.zeros((count, 2))])
    sigma = np.full(count, config.top_band_m / 3)
    n = np.zeros(count, np.intp)
    for every in (*[step] * ROUNDS, 1):
        sums = plane_sums(label, offset_m, height_m, expected_m, config.top_band_m, inner_m, planes, sigma, every)
        planes = _solve(sums, planes, config)
        sigma = np.maximum(np.sqrt(sums[:, 9] / np.maximum(sums[:, 0], 1e-9)), LEAST_SIGMA_M)
        n = sums[:, 10].astype(np.intp)
    enough = n >= config.min_top_points
    lever2 = radius_m**2 / 4
    # One independent shared error per patch of the error's reach.
    patches = np.maximum((radius_m / config.shared_error_reach_m) ** 2, 3.0)
    slope_var = (sigma**2 / np.maximum(n, 3) + config.shared_error_m**2 / patches) / lever2
    return TopPlanes(
        np.where(enough, planes[:, 0], np.nan),
        np.where(enough[:, None], planes[:, 1:], np.nan),
        slope_var,
        np.where(enough, sigma, np.nan),
        n,
    )


def top_spacing_m(planes: TopPlanes, radius_m: FloatArray) -> FloatArray:
    """How far apart the points of tops of these radii (T,) lie, shape (T,), metres; NaN without a plane."""
    area_m2 = np.pi * np.maximum(radius_m - EDGE_M, 0.0) ** 2
    return np.where(np.isfinite(planes.height_m), np.sqrt(area_m2 / np.maximum(planes.n_points, 1)), np.nan)


def _median_per_label(label: NDArray[np.intp], values: FloatArray, default: FloatArray) -> FloatArray:
    """Median of the values of each label, the default without any; shape (T,)."""
    order = np.lexsort((values, label))
    counts = np.bincount(label, minlength=len(default))
    ends = np.cumsum(counts)
    middle = np.minimum(ends - counts + counts // 2, max(len(values) - 1, 0))
    return np.where(counts > 0, values[order][middle], default) if len(values) else default.copy()


def _solve(sums: FloatArray, before: FloatArray, config: ProfileConfig) -> FloatArray:
    """Planes from the sums of `plane_sums`, shape (T, 3); as before where there are too few points."""
    normal = sums[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    usable = (sums[:, 0] >= config.min_top_points / 4) & (np.linalg.det(normal) > 0)
    normal[~usable] = np.eye(3)
    solved = np.linalg.solve(normal, sums[:, 6:9, None])[..., 0]
    return np.where(usable[:, None], solved, before)
