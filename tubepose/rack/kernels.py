"""The loops over points of a rack's registration, compiled: one pass each instead of a dozen arrays.

Sums are made in the order of the points, so results do not depend on threads; arguments are changed in none of them.
The machine code is kept (`cache=True`).
"""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled, solved

# Bins that a median is counted in: it is exact to the range of values over this.
MEDIAN_BINS = 2048
# Bins per half window that the densest height is looked for in.
MODE_BINS = 20


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
def densest(values, window):
    """Middle of the fullest bin within +-`window`, smoothed over its neighbours."""
    bins = 2 * MODE_BINS
    counts = np.zeros(bins)
    for value in values:
        place = math.floor((value + window) / window * MODE_BINS)
        if 0 <= place < bins:
            counts[place] += 1.0
    best, most = 0, -1.0
    for i in range(bins):
        near = counts[i]
        for k in (1, 2):
            weight = 1.0 if k == 1 else 0.5
            near += weight * ((counts[i - k] if i >= k else 0.0) + (counts[i + k] if i + k < bins else 0.0))
        if near > most:
            best, most = i, near
    return -window + (best + 0.5) * window / MODE_BINS


@compiled
def median_size(values, limit):
    """Median of the absolute values below a limit, counted in bins; the limit itself where there is none."""
    counts = np.zeros(MEDIAN_BINS, np.intp)
    total = 0
    scale = MEDIAN_BINS / limit
    for value in values:
        size = abs(value)
        if size < limit:
            counts[min(int(size * scale), MEDIAN_BINS - 1)] += 1
            total += 1
    passed = 0
    for i in range(MEDIAN_BINS):
        if passed + counts[i] > 0 and 2 * (passed + counts[i]) >= total:
            return (i + (0.5 * total - passed) / counts[i]) / scale
        passed += counts[i]
    return limit


@compiled
def square_counts(xy_m, side_m):
    """For every place (N, 2 or more) the number of places in its square of a grid."""
    low_x, low_y, high_x, high_y = 0, 0, 0, 0
    cells = np.empty((len(xy_m), 2), np.intp)
    for k in range(len(xy_m)):
        i, j = math.floor(xy_m[k, 0] / side_m + 0.5), math.floor(xy_m[k, 1] / side_m + 0.5)
        cells[k, 0], cells[k, 1] = i, j
        low_x, low_y, high_x, high_y = min(low_x, i), min(low_y, j), max(high_x, i), max(high_y, j)
    counts = np.zeros((high_x - low_x + 1, high_y - low_y + 1), np.intp)
    for i, j in cells:
        counts[i - low_x, j - low_y] += 1
    found = np.empty(len(xy_m), np.intp)
    for k in range(len(xy_m)):
        found[k] = counts[cells[k, 0] - low_x, cells[k, 1] - low_y]
    return found


@compiled
def cluster_sums(xy_m, scores, side_m):
    """Products (M, M) of the sums of scores (N, M) over the squares of a grid, and how many squares have places."""
    low_x, low_y, high_x, high_y = 0, 0, 0, 0
    for k in range(len(xy_m)):
        i, j = math.floor(xy_m[k, 0] / side_m), math.floor(xy_m[k, 1] / side_m)
        low_x, low_y, high_x, high_y = min(low_x, i), min(low_y, j), max(high_x, i), max(high_y, j)
    rows = high_y - low_y + 1
    sums = np.zeros(((high_x - low_x + 1) * rows, scores.shape[1]))
    filled = np.zeros(len(sums), np.bool_)
    for k in range(len(xy_m)):
        i, j = math.floor(xy_m[k, 0] / side_m), math.floor(xy_m[k, 1] / side_m)
        cell = (i - low_x) * rows + j - low_y
        filled[cell] = True
        for m in range(scores.shape[1]):
            sums[cell, m] += scores[k, m]
    return sums.T @ sums, filled.sum()


@compiled
def plane_step(points_m, off_m, balance, reach_m, normal):
    """One reweighted step of a plane: adds to its normal equations in place, and returns its right side (3,)."""
    right = np.zeros(3)
    for k in range(len(points_m)):
        u = off_m[k] / reach_m
        if abs(u) < 1.0:
            weight = balance[k] * (1.0 - u * u) ** 2
            d0, d1 = points_m[k, 1], -points_m[k, 0]
            normal[0, 0] += weight * d0 * d0
            normal[0, 1] += weight * d0 * d1
            normal[0, 2] += weight * d0
            normal[1, 1] += weight * d1 * d1
            normal[1, 2] += weight * d1
            normal[2, 2] += weight
            right[0] += weight * off_m[k] * d0
            right[1] += weight * off_m[k] * d1
            right[2] += weight * off_m[k]
    normal[1, 0], normal[2, 0], normal[2, 1] = normal[0, 1], normal[0, 2], normal[1, 2]
    return right


@compiled
def plane_steps(points_m, balance, widths_m, widest_m, held):
    """Plane of points (N, 3) where heights are densest, windows narrowed: turns about x, y and height; scatter.

    Returns them with the last normal equations (3, 3) and the scores (N, 3) of the points where the steps ended. Where
    the level is held, the height alone moves.
    """
    stiff = 1e9 if held else 1e-9
    found = np.array([0.0, 0.0, densest(points_m[:, 2], widths_m[0])])
    off, scores = np.empty(len(points_m)), np.zeros((len(points_m), 3))
    scatter = widths_m[0]
    normal = np.zeros((3, 3))
    reach = scatter
    for width in widths_m:
        for k in range(len(points_m)):
            off[k] = points_m[k, 2] - points_m[k, 1] * found[0] + points_m[k, 0] * found[1] - found[2]
        scatter = 1.4826 * median_size(off, max(width, 2 * scatter))
        reach = max(width, min(2 * scatter, widest_m))
        normal = np.diag(np.array([stiff, stiff, 1e-6]))
        found = found + solved(normal, plane_step(points_m, off, balance, reach, normal))
    for k in range(len(points_m)):
        u = off[k] / reach
        if abs(u) < 1.0:
            now = points_m[k, 2] - points_m[k, 1] * found[0] + points_m[k, 0] * found[1] - found[2]
            score = balance[k] * (1.0 - u * u) ** 2 * now
            scores[k, 0], scores[k, 1], scores[k, 2] = score * points_m[k, 1], -score * points_m[k, 0], score
    return found, scatter, normal, scores


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


@compiled
def edge_step(points_m, distance_m, slope, window_m, shift_m, blur_m, wrong, count):
    """Information (M, M) and scores (N, M) of edges about yaw, shift and, for M = 5, stretch; places (N, 2) of them.

    Of points (K, 3) whose heights are within the window, with their distance to the solid part and its gradient.
    """
    information, design = np.zeros((count, count)), np.zeros(5)
    scores, xy = np.empty((len(points_m), count)), np.empty((len(points_m), 2))
    kept = 0
    for k in range(len(points_m)):
        eta = (shift_m - distance_m[k]) / blur_m
        if not (abs(points_m[k, 2]) < window_m and abs(eta) < 6.0):
            continue
        plain = 1.0 / (1.0 + math.exp(-eta))
        chance, rate = wrong + (1.0 - 2.0 * wrong) * plain, (1.0 - 2.0 * wrong) * plain * (1.0 - plain)
        x, y = points_m[k, 0], points_m[k, 1]
        gx, gy = slope[k, 0] / blur_m, slope[k, 1] / blur_m
        design[0], design[1], design[2], design[3], design[4] = gy * x - gx * y, gx, gy, gx * x, gy * y
        weight, score = rate * rate / (chance * (1.0 - chance)), rate / chance
        for a in range(count):
            scores[kept, a] = score * design[a]
            for b in range(a, count):
                information[a, b] += weight * design[a] * design[b]
        xy[kept, 0], xy[kept, 1] = x, y
        kept += 1
    for a in range(count):
        for b in range(a):
            information[a, b] = information[b, a]
    return information, scores[:kept], xy[:kept]
