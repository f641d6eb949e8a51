"""The loops over the windows of an image, compiled."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from tubepose.compiled import compiler

BINS = 48
"""Steps of a quarter of a surface's thickness in which that level is looked for before all samples are sorted."""

_kernel = compiler([Path(__file__)], error_model="numpy", nogil=True)


@_kernel
def windows(inverse, texture, share, least, half, step, same):
    """Inverse depth (H, W) that every window takes.

    Args:
        inverse: Exact inverse depth, shape (H, W); NaN where nothing is.
        texture: Weight of each pixel, shape (H, W).
        share: Share of a window's weight that a nearer surface must have, shape (H, W).
        least: Mean weight that a window must have, shape (H, W).
        half: Half of the window, pixels.
        step: Distance of the samples, pixels.
        same: Inverse depths that differ by less are one surface.
    """
    height, width = inverse.shape
    result = np.full((height, width), np.nan)
    most = (2 * half // step + 1) ** 2
    q, w, du, dv = np.empty(most), np.empty(most), np.empty(most), np.empty(most)
    bins = np.empty(BINS)
    for v in range(height):
        for u in range(width):
            count, total, places, low, high = 0, 0.0, 0, np.inf, -np.inf
            for y in range(-half, half + 1, step):
                if v + y < 0 or v + y >= height:
                    continue
                for x in range(-half, half + 1, step):
                    if u + x < 0 or u + x >= width:
                        continue
                    places += 1
                    here = inverse[v + y, u + x]
                    if math.isnan(here):
                        continue
                    q[count], w[count], du[count], dv[count] = here, texture[v + y, u + x], x, y
                    total += w[count]
                    low, high = min(low, here), max(high, here)
                    count += 1
            if count == 0 or total < least[v, u] * places:
                continue
            level = high
            if high - low > same:
                level = _level(q, w, count, share[v, u] * total, high, same / 4, bins)
            result[v, u] = _at_centre(q, w, du, dv, count, level, same)
    return result


@_kernel
def _level(q, w, count, wanted, high, width, bins):
    """Inverse depth that the nearest samples of a given weight reach: by a histogram from the nearest one down."""
    bins[:] = 0.0
    for k in range(count):
        bins[min(int((high - q[k]) / width), BINS - 1)] += w[k]
    weight = 0.0
    for place in range(BINS - 1):
        weight += bins[place]
        if weight >= wanted:
            return high - (place + 0.5) * width
    order = np.argsort(-q[:count])
    weight = 0.0
    for k in order:
        weight += w[k]
        if weight >= wanted:
            return q[k]
    return q[order[count - 1]]


@_kernel
def _at_centre(q, w, du, dv, count, level, same):
    """Plane through the samples of one surface (weighted least squares), at the window's centre."""
    n, x, y, xx, xy, yy, z, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    low, high = np.inf, -np.inf
    for k in range(count):
        if abs(q[k] - level) > same:
            continue
        n, x, y, z = n + w[k], x + w[k] * du[k], y + w[k] * dv[k], z + w[k] * (q[k] - level)
        xx, xy, yy = xx + w[k] * du[k] * du[k], xy + w[k] * du[k] * dv[k], yy + w[k] * dv[k] * dv[k]
        xz, yz = xz + w[k] * du[k] * (q[k] - level), yz + w[k] * dv[k] * (q[k] - level)
        low, high = min(low, q[k]), max(high, q[k])
    mx, my, mz = x / n, y / n, z / n
    sxx, sxy, syy = xx / n - mx * mx, xy / n - mx * my, yy / n - my * my
    sxz, syz = xz / n - mx * mz, yz / n - my * mz
    bottom = sxx * syy - sxy * sxy
    value = level + mz
    if bottom > 1e-3 * (sxx + syy) ** 2:
        value -= (mx * (syy * sxz - sxy * syz) + my * (sxx * syz - sxy * sxz)) / bottom
    # A plane through few samples of a round surface is not followed far beyond them.
    return min(max(value, low - 0.5 * same), high + 0.5 * same)
