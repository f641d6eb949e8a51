"""The loops over points of a rack's registration, compiled: one pass each instead of a dozen arrays.

Sums are made in the order of the points, so results do not depend on threads; arguments are changed in none of them.
The machine code is kept (`cache=True`).
"""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled


@compiled
def in_frame(point_m, rotation, origin_m):
    """A point of the camera's frame in another one."""
    x, y, z = point_m[0] - origin_m[0], point_m[1] - origin_m[1], point_m[2] - origin_m[2]
    right = rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z
    ahead = rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z
    return right, ahead, rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z


@compiled
def in_box(points_m, rotation, origin_m, reach_m, low_m, high_m):
    """Points (N, 3) within a box on a frame's axes, unchanged: half sides `reach_m` (2,), between two heights."""
    kept = np.empty_like(points_m)
    count = 0
    for k in range(len(points_m)):
        right, ahead, up = in_frame(points_m[k], rotation, origin_m)
        if low_m < up < high_m and abs(right) < reach_m[0] and abs(ahead) < reach_m[1]:
            kept[count] = points_m[k]
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
    local, distance, slope = np.empty((len(points_m), 3)), np.empty(len(points_m)), np.empty((len(points_m), 2))
    count = 0
    for k in range(len(points_m)):
        right, ahead, up = in_frame(points_m[k], rotation, origin_m)
        if not abs(up) < height_m:
            continue
        u, v = (right - low_m[0]) / cell_m, (ahead - low_m[1]) / cell_m
        if -0.5 <= u < shape[0] - 0.5 and -0.5 <= v < shape[1] - 0.5:
            i, j = math.floor(u + 0.5), math.floor(v + 0.5)
            cell = table[i * shape[1] + j]
            local[count, 0], local[count, 1], local[count, 2] = right, ahead, up
            slope[count, 0], slope[count, 1] = cell[1], cell[2]
            distance[count] = cell[0] + cell_m * ((u - i) * cell[1] + (v - j) * cell[2])
            count += 1
    return local[:count], distance[:count], slope[:count]


@compiled
def slot_heights(points_m, rotation, origin_m, centers_m, axis_m, between_m, low_m, high_m, bin_m):
    """Points above slots (S, 2) in bins of height (S, B), within `axis_m` of their axes: how many, and sum of heights.

    And how many are farther than `between_m` (S,) from the nearest of them, where a tube's top does not reach.
    """
    counts = np.zeros((len(centers_m), int((high_m - low_m) / bin_m) + 1))
    sums, between = np.zeros_like(counts), np.zeros_like(counts)
    for k in range(len(points_m)):
        right, ahead, up = in_frame(points_m[k], rotation, origin_m)
        if not low_m < up < high_m:
            continue
        nearest, least = 0, np.inf
        for s in range(len(centers_m)):
            distance2 = (right - centers_m[s, 0]) ** 2 + (ahead - centers_m[s, 1]) ** 2
            if distance2 < least:
                nearest, least = s, distance2
        place = int((up - low_m) / bin_m)
        if least < axis_m * axis_m:
            counts[nearest, place] += 1.0
            sums[nearest, place] += up
        elif least > between_m[nearest] ** 2:
            between[nearest, place] += 1.0
    return counts, sums, between
