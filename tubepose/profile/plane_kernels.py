"""The loops over points of the planes of tops, compiled; see `kernels`, whose promises these keep."""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled, put_in_order, solved

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
    kept, ends = np.empty((len(label) + step - 1) // step, np.intp), np.zeros(len(expected_m) + 1, np.intp)
    count = 0
    for k in range(0, len(label), step):
        t = label[k]
        x, y = offset_m[k, 0], offset_m[k, 1]
        if x * x + y * y < radius_m[t] * radius_m[t] and abs(height_m[k] - expected_m[t]) < band_m:
            kept[count] = k
            count += 1
            ends[t + 1] += 1
    for t in range(len(expected_m)):
        ends[t + 1] += ends[t]
    free, ordered = ends.copy(), np.empty(count)
    for i in range(count):
        t = label[kept[i]]
        ordered[free[t]] = height_m[kept[i]]
        free[t] += 1
    heights = expected_m.copy()
    for t in range(len(expected_m)):
        if ends[t + 1] > ends[t]:
            put_in_order(ordered[ends[t] : ends[t + 1]])
            heights[t] = ordered[ends[t] + (ends[t + 1] - ends[t]) // 2]
    return heights


@compiled
def plane_rounds(label, offset_m, height_m, expected_m, band_m, radius_m, step, least):
    """Planes (T, 3) by Tukey's weights, from the median height; their RMS residuals (T,) and numbers of points (T,).

    The rounds see every `step`-th point, the median every fourth of those, and one more round all of them. Planes with
    a weight of less than the least stay as they were.
    """
    planes, sigma_m, points = np.zeros((len(expected_m), 3)), np.empty(len(expected_m)), np.empty(len(expected_m))
    heights = median_heights(label, offset_m, height_m, expected_m, band_m, radius_m, 4 * step)
    for t in range(len(planes)):
        planes[t, 0], sigma_m[t] = heights[t], band_m / 3.0
    normal = np.empty((3, 3))
    for again in range(ROUNDS, -1, -1):
        sums = plane_sums(
            label, offset_m, height_m, expected_m, band_m, radius_m, planes, sigma_m, step if again else 1
        )
        for t in range(len(planes)):
            w, x, y = sums[t, 0], sums[t, 1], sums[t, 2]
            xx, xy, yy = sums[t, 3], sums[t, 4], sums[t, 5]
            determinant = w * (xx * yy - xy * xy) - x * (x * yy - xy * y) + y * (x * xy - xx * y)
            if w >= least and determinant > 0.0:
                normal[0, 0], normal[0, 1], normal[0, 2] = w, x, y
                normal[1, 0], normal[1, 1], normal[1, 2] = x, xx, xy
                normal[2, 0], normal[2, 1], normal[2, 2] = y, xy, yy
                plane = solved(normal, sums[t, 6:9])
                planes[t, 0], planes[t, 1], planes[t, 2] = plane[0], plane[1], plane[2]
            points[t] = sums[t, 10]
            sigma_m[t] = max(math.sqrt(sums[t, 9] / max(w, 1e-9)), LEAST_SIGMA_M)
    return planes, sigma_m, points
