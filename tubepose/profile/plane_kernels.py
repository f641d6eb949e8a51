"""The loops over points of the planes of tops, compiled; see `kernels`, whose promises these keep."""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled, solved

ROUNDS = 4
LEAST_SIGMA_M = 3.0e-5
"""No sensor is better: points on a perfect plane must not be thrown out for rounding."""


@compiled
def plane_sums(label, offset_m, height_m, expected_m, band_m, radius_m, planes, sigma_m, step):
    """Sums of Tukey's weights w about planes (T, 3), shape (T, 11): of every `step`-th point.

    Points farther out than their tube's radius, or farther than the band from its expected height, do not count.

    In order: w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz, w times the squared residual, and the number of points.
    """
    sums = np.zeros((len(planes), 11))
    for k in range(0, len(label), step):
        t = label[k]
        x, y, z = offset_m[k, 0], offset_m[k, 1], height_m[k]
        if x * x + y * y >= radius_m[t] * radius_m[t] or abs(z - expected_m[t]) >= band_m:
            continue
        residual = z - planes[t, 0] - planes[t, 1] * x - planes[t, 2] * y
        u = residual / (4.0 * sigma_m[t])
        if abs(u) < 1.0:
            w = (1.0 - u * u) ** 2
            row = sums[t]
            row[0] += w
            row[1] += w * x
            row[2] += w * y
            row[3] += w * x * x
            row[4] += w * x * y
            row[5] += w * y * y
            row[6] += w * z
            row[7] += w * x * z
            row[8] += w * y * z
            row[9] += w * residual * residual
            row[10] += 1.0
    return sums


@compiled
def median_heights(label, offset_m, height_m, expected_m, band_m, radius_m, step):
    """Median height (T,) of every `step`-th point that `plane_sums` would count; what is expected without any."""
    kept, counts = np.empty((len(label) + step - 1) // step, np.intp), np.zeros(len(expected_m), np.intp)
    count = 0
    for k in range(0, len(label), step):
        t = label[k]
        x, y = offset_m[k, 0], offset_m[k, 1]
        if x * x + y * y < radius_m[t] * radius_m[t] and abs(height_m[k] - expected_m[t]) < band_m:
            kept[count] = k
            count += 1
            counts[t] += 1
    ends = np.cumsum(counts)
    free, ordered = ends - counts, np.empty(count)
    for k in kept[:count]:
        ordered[free[label[k]]] = height_m[k]
        free[label[k]] += 1
    median = expected_m.copy()
    for t in range(len(counts)):
        if counts[t]:
            median[t] = np.sort(ordered[ends[t] - counts[t] : ends[t]])[counts[t] // 2]
    return median


@compiled
def plane_rounds(label, offset_m, height_m, expected_m, band_m, radius_m, step, least):
    """Planes (T, 3) by Tukey's weights, from the median height; their RMS residuals (T,) and numbers of points (T,).

    The rounds see every `step`-th point, the median every fourth of those, and one more round all of them. Planes with
    a weight of less than the least stay as they were.
    """
    planes, sigma_m = np.zeros((len(expected_m), 3)), np.full(len(expected_m), band_m / 3.0)
    planes[:, 0] = median_heights(label, offset_m, height_m, expected_m, band_m, radius_m, 4 * step)
    normal = np.empty((3, 3))
    for again in range(ROUNDS, -1, -1):
        sums = plane_sums(
            label, offset_m, height_m, expected_m, band_m, radius_m, planes, sigma_m, step if again else 1
        )
        for t in range(len(planes)):
            w, x, y, xx, xy, yy = sums[t, :6]
            determinant = w * (xx * yy - xy * xy) - x * (x * yy - xy * y) + y * (x * xy - xx * y)
            if w >= least and determinant > 0.0:
                normal[0, 0], normal[0, 1], normal[0, 2] = w, x, y
                normal[1, 0], normal[1, 1], normal[1, 2] = x, xx, xy
                normal[2, 0], normal[2, 1], normal[2, 2] = y, xy, yy
                planes[t] = solved(normal, sums[t, 6:9])
            sigma_m[t] = max(math.sqrt(sums[t, 9] / max(w, 1e-9)), LEAST_SIGMA_M)
    return planes, sigma_m, sums[:, 10]
