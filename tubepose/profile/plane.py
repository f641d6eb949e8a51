"""The plane of every closed cap's top: which way it faces, and how high it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.config import ProfileConfig
from tubepose.profile.plane_kernels import plane_rounds
from tubepose.transforms import FloatArray

EDGE_M = 1.0e-3
"""Points this near the end of a top are mixed with its background."""


@dataclass(frozen=True, slots=True, eq=False)
class TopPlanes:
    """Planes z = height + slope (xy - center), one per tube, shape (T, ...), rack frame.

    Attributes:
        height_m: Height of the plane above the rack's base at the given centre, shape (T,), metres; NaN without one.
        slope: Its rise along x and y, shape (T, 2).
        slope_var: Variance of each slope, shape (T,): by the scatter of the points, until `believed` raises it to what
            the sensor's noise leaves.
        height_var_m2: Variance of the height by the scatter of the points, shape (T,).
        rms_m: RMS distance of the points that count, shape (T,), metres; NaN without a plane.
        n_points: Points that count, shape (T,).
    """

    height_m: FloatArray
    slope: FloatArray
    slope_var: FloatArray
    height_var_m2: FloatArray
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

    The variances are those of independent points. Errors that neighbours share do not average out, and no single top
    shows them: its plane absorbs most of them. They are the sensor's, and `believed` adds them.

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
    planes, sigma, n = plane_rounds(
        label, offset_m, height_m, expected_m, config.top_band_m, inner_m, step, config.min_top_points / 4
    )
    enough = n >= config.min_top_points
    height_var = sigma**2 / np.maximum(n, 3)
    lever2 = np.maximum(inner_m, EDGE_M) ** 2 / 4
    return TopPlanes(
        np.where(enough, planes[:, 0], np.nan),
        np.where(enough[:, None], planes[:, 1:], np.nan),
        height_var / lever2,
        height_var,
        np.where(enough, sigma, np.nan),
        n.astype(np.intp),
    )


def unknown_planes(count: int) -> TopPlanes:
    """Planes that nothing is known of."""
    nothing = np.full(count, np.nan)
    return TopPlanes(nothing, np.full((count, 2), np.nan), nothing, nothing, nothing, np.zeros(count, np.intp))


def top_spacing_m(planes: TopPlanes, radius_m: FloatArray) -> FloatArray:
    """How far apart the points of tops of these radii (T,) lie, shape (T,), metres; NaN without a plane."""
    area_m2 = np.pi * np.maximum(radius_m - EDGE_M, 0.0) ** 2
    return np.where(np.isfinite(planes.height_m), np.sqrt(area_m2 / np.maximum(planes.n_points, 1)), np.nan)
