"""The loops over points of the measurement of noise, compiled.

Points are rows (x, y, z, depth): place in the rack frame and depth along the optical axis, metres.
"""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled


@compiled
def beside(points, rotation, translation, half, near, far, top):
    """Rows (N, 4) of the points beside a rack's outline, between two distances from it, and below a height."""
    rows = np.empty((len(points), 4))
    count = 0
    for k in range(len(points)):
        depth = points[k, 2]
        if math.isnan(depth):
            continue
        a, b, c = points[k, 0] - translation[0], points[k, 1] - translation[1], depth - translation[2]
        z = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * c
        if z >= top:
            continue
        x = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * c
        y = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * c
        out = max(abs(x) - half[0], abs(y) - half[1])
        if near < out < far:
            rows[count, 0], rows[count, 1], rows[count, 2], rows[count, 3] = x, y, z, depth
            count += 1
    return rows[:count]


@compiled
def within(points, rotation, translation, low, cell, solid, height, band):
    """Rows (N, 4) of the points within a band about a height whose cell of a map (X, Y) is solid."""
    rows = np.empty((len(points), 4))
    count = 0
    for k in range(len(points)):
        depth = points[k, 2]
        if math.isnan(depth):
            continue
        a, b, c = points[k, 0] - translation[0], points[k, 1] - translation[1], depth - translation[2]
        z = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * c
        if abs(z - height) >= band:
            continue
        x = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * c
        y = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * c
        i, j = math.floor((x - low[0]) / cell + 0.5), math.floor((y - low[1]) / cell + 0.5)
        if 0 <= i < solid.shape[0] and 0 <= j < solid.shape[1] and solid[i, j]:
            rows[count, 0], rows[count, 1], rows[count, 2], rows[count, 3] = x, y, z, depth
            count += 1
    return rows[:count]


@compiled
def extent(rows):
    """Least and greatest place (2,) of points in the rack's xy plane, and their greatest depth."""
    low, high, depth = rows[0, :2].copy(), rows[0, :2].copy(), 0.0
    for k in range(len(rows)):
        for axis in range(2):
            low[axis] = min(low[axis], rows[k, axis])
            high[axis] = max(high[axis], rows[k, axis])
        depth = max(depth, rows[k, 3])
    return low, high, depth


@compiled
def off_surface(rows, surface):
    """Distance (N,) of points along the normal of a surface c0 + c1 x + c2 y + c3 xx + c4 xy + c5 yy."""
    off = np.empty(len(rows))
    scale = 1.0 / math.sqrt(1.0 + surface[1] * surface[1] + surface[2] * surface[2])
    for k in range(len(rows)):
        x, y = rows[k, 0], rows[k, 1]
        level = surface[0] + x * (surface[1] + surface[3] * x + surface[4] * y) + y * (surface[2] + surface[5] * y)
        off[k] = (rows[k, 2] - level) * scale
    return off


@compiled
def surface_sums(rows, off, clip):
    """Normal equations of a quadratic surface through the distances of points from another one: (6, 6) and (6,)."""
    matrix, right, terms = np.zeros((6, 6)), np.zeros(6), np.ones(6)
    for k in range(len(rows)):
        if abs(off[k]) > clip:
            continue
        x, y = rows[k, 0], rows[k, 1]
        terms[1], terms[2], terms[3], terms[4], terms[5] = x, y, x * x, x * y, y * y
        for i in range(6):
            right[i] += terms[i] * off[k]
            for j in range(i + 1):
                matrix[i, j] += terms[i] * terms[j]
    for i in range(6):
        for j in range(i):
            matrix[j, i] = matrix[i, j]
    return matrix, right


@compiled
def disc_sums(rows, off, clip, low, pitch, shape, radius, distance):
    """Sums over discs on a square grid, shape (X, Y, 11), of equal angular size: their radius holds at a distance.

    In order: n, x, y, xx, xy, yy, h, hx, hy, hh of the points on the surface, and how many points are not.
    """
    sums = np.zeros((shape[0], shape[1], 11))
    for k in range(len(rows)):
        i, j = math.floor((rows[k, 0] - low[0]) / pitch), math.floor((rows[k, 1] - low[1]) / pitch)
        if i < 0 or j < 0 or i >= shape[0] or j >= shape[1]:
            continue
        scale = distance / rows[k, 3]
        x = (rows[k, 0] - low[0] - (i + 0.5) * pitch) * scale
        y = (rows[k, 1] - low[1] - (j + 0.5) * pitch) * scale
        if x * x + y * y >= radius * radius:
            continue
        row, h = sums[i, j], off[k] * scale
        if abs(off[k]) > clip:
            row[10] += 1.0
            continue
        row[0] += 1.0
        row[1] += x
        row[2] += y
        row[3] += x * x
        row[4] += x * y
        row[5] += y * y
        row[6] += h
        row[7] += h * x
        row[8] += h * y
        row[9] += h * h
    return sums


@compiled
def cell_sums(rows, off, clip, low, cell, shape):
    """Number, sum and sum of squares of the distances from the surface, per square cell, shape (X, Y, 3)."""
    sums = np.zeros((shape[0], shape[1], 3))
    for k in range(len(rows)):
        if abs(off[k]) > clip:
            continue
        i, j = math.floor((rows[k, 0] - low[0]) / cell), math.floor((rows[k, 1] - low[1]) / cell)
        if i < 0 or j < 0 or i >= shape[0] or j >= shape[1]:
            continue
        row, h = sums[i, j], off[k]
        row[0] += 1.0
        row[1] += h
        row[2] += h * h
    return sums


@compiled
def off_cells(rows, off, clip, low, cell, sums):
    """Distance (N,) of points from the mean of their cell, each as a free one has it; 0 of a lone point, NaN off it."""
    left = np.full(len(rows), np.nan)
    for k in range(len(rows)):
        if abs(off[k]) > clip:
            continue
        i, j = math.floor((rows[k, 0] - low[0]) / cell), math.floor((rows[k, 1] - low[1]) / cell)
        n = sums[i, j, 0]
        left[k] = 0.0
        if n > 1.0:
            left[k] = (off[k] - sums[i, j, 1] / n) * math.sqrt(n / (n - 1.0))
    return left
