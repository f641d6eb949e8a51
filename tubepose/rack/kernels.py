"""The loops over points of a rack's registration, compiled: one pass each instead of a dozen arrays.

Sums are made in the order of the points, so results do not depend on threads; arguments are changed in none of them.
The machine code is kept (`cache=True`).
"""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled


@compiled
def numbers(rotation, origin_m):
    """A frame as twelve numbers: read from arrays point by point, they would be fetched again after every write."""
    x = (rotation[0, 0], rotation[1, 0], rotation[2, 0])
    y = (rotation[0, 1], rotation[1, 1], rotation[2, 1])
    z = (rotation[0, 2], rotation[1, 2], rotation[2, 2])
    return x, y, z, (origin_m[0], origin_m[1], origin_m[2])


@compiled
def in_frame(frame, right, down, ahead):
    """A place of the camera's frame in another one, which is given by its `numbers`."""
    x, y, z, origin = frame
    u, v, w = right - origin[0], down - origin[1], ahead - origin[2]
    return x[0] * u + x[1] * v + x[2] * w, y[0] * u + y[1] * v + y[2] * w, z[0] * u + z[1] * v + z[2] * w


@compiled
def in_box(points_m, rotation, origin_m, reach_m, low_m, high_m):
    """Points (N, 3) within a box on a frame's axes, unchanged: half sides `reach_m` (2,), between two heights."""
    frame, reach_x, reach_y = numbers(rotation, origin_m), reach_m[0], reach_m[1]
    kept = np.empty_like(points_m)
    count = 0
    for k in range(len(points_m)):
        right, ahead, up = in_frame(frame, points_m[k, 0], points_m[k, 1], points_m[k, 2])
        if low_m < up < high_m and abs(right) < reach_x and abs(ahead) < reach_y:
            kept[count, 0], kept[count, 1], kept[count, 2] = points_m[k, 0], points_m[k, 1], points_m[k, 2]
            count += 1
    return kept[:count]


@compiled
def look_up(xy_m, low_m, cell_m, shape, table):
    """Distance (N,), gradient (N, 2) and whether it is known (N,), of places (N, 2 or more) on a field's grid."""
    distance, slope = np.empty(len(xy_m)), np.empty((len(xy_m), 2))
    known = np.empty(len(xy_m), np.bool_)
    for k in range(len(xy_m)):
        x, y = (xy_m[k, 0] - low_m[0]) / cell_m, (xy_m[k, 1] - low_m[1]) / cell_m
        known[k] = -0.5 <= x < shape[0] - 0.5 and -0.5 <= y < shape[1] - 0.5
        i, j = (math.floor(x + 0.5), math.floor(y + 0.5)) if known[k] else (0, 0)
        cell = table[i * shape[1] + j]
        slope[k, 0], slope[k, 1] = cell[1], cell[2]
        distance[k] = cell[0] + cell_m * ((x - i) * cell[1] + (y - j) * cell[2])
    return distance, slope, known


@compiled
def laid(points_m, rotation, origin_m, height_m, low_m, cell_m, shape, table):
    """Of points (N, 3) within a height of a frame's plane and on a field's grid: place, distance and gradient."""
    frame, low_x, low_y = numbers(rotation, origin_m), low_m[0], low_m[1]
    rows, columns = shape[0], shape[1]
    local, distance, slope = np.empty((len(points_m), 3)), np.empty(len(points_m)), np.empty((len(points_m), 2))
    count = 0
    for k in range(len(points_m)):
        right, ahead, up = in_frame(frame, points_m[k, 0], points_m[k, 1], points_m[k, 2])
        if not abs(up) < height_m:
            continue
        u, v = (right - low_x) / cell_m, (ahead - low_y) / cell_m
        if -0.5 <= u < rows - 0.5 and -0.5 <= v < columns - 0.5:
            i, j = math.floor(u + 0.5), math.floor(v + 0.5)
            cell = i * columns + j
            along, across = table[cell, 1], table[cell, 2]
            local[count, 0], local[count, 1], local[count, 2] = right, ahead, up
            slope[count, 0], slope[count, 1] = along, across
            distance[count] = table[cell, 0] + cell_m * ((u - i) * along + (v - j) * across)
            count += 1
    return local[:count], distance[:count], slope[:count]


@compiled
def slot_heights(points_m, rotation, origin_m, centers_m, axis_m, between_m, low_m, high_m, bin_m):
    """Points above slots (S, 2) in bins of height (S, B), within `axis_m` of their axes: how many, and sum of heights.

    And how many are farther than `between_m` (S,) from the nearest of them, where a tube's top does not reach.
    """
    frame, slots = numbers(rotation, origin_m), len(centers_m)
    center_x, center_y = centers_m[:, 0].copy(), centers_m[:, 1].copy()
    counts = np.zeros((slots, int((high_m - low_m) / bin_m) + 1))
    sums, between, distance2 = np.zeros_like(counts), np.zeros_like(counts), np.empty(slots)
    for k in range(len(points_m)):
        right, ahead, up = in_frame(frame, points_m[k, 0], points_m[k, 1], points_m[k, 2])
        if not low_m < up < high_m:
            continue
        for s in range(slots):
            distance2[s] = (right - center_x[s]) ** 2 + (ahead - center_y[s]) ** 2
        nearest = np.argmin(distance2)
        least = distance2[nearest]
        place = int((up - low_m) / bin_m)
        if least < axis_m * axis_m:
            counts[nearest, place] += 1.0
            sums[nearest, place] += up
        elif least > between_m[nearest] ** 2:
            between[nearest, place] += 1.0
    return counts, sums, between
