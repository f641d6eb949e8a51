"""The loops over points of a rack's search and of what speaks for a pose, compiled; see `kernels`."""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled
from tubepose.rack.kernels import in_frame, numbers


@compiled
def on_plane(right, ahead, up, camera):
    """Where the line of sight to a place of a frame crosses the frame's plane."""
    share = up / (up - camera[2])
    return right + share * (camera[0] - right), ahead + share * (camera[1] - ahead)


@compiled
def labelled(points_m, rotation, origin_m, camera_m, reach_m, window_m, through_m):
    """Points within `window_m` of a frame's plane (N, 3), and where sight to those far below crosses it (M, 2)."""
    frame, reach_x, reach_y = numbers(rotation, origin_m), reach_m[0], reach_m[1]
    camera = (camera_m[0], camera_m[1], camera_m[2])
    solid, free = np.empty_like(points_m), np.empty((len(points_m), 2))
    solids, frees = 0, 0
    for k in range(len(points_m)):
        right, ahead, up = in_frame(frame, points_m[k, 0], points_m[k, 1], points_m[k, 2])
        if not (abs(up) < window_m or up < -through_m):
            continue
        if up < -through_m:
            right, ahead = on_plane(right, ahead, up, camera)
        if abs(right) < reach_x and abs(ahead) < reach_y:
            if up < -through_m:
                free[frees, 0], free[frees, 1] = right, ahead
                frees += 1
            else:
                solid[solids, 0], solid[solids, 1], solid[solids, 2] = right, ahead, up
                solids += 1
    return solid[:solids], free[:frees]


@compiled
def face_cells(points_m, rotation, origin_m, camera_m, low_m, cell_m, shape, window_m, through_m):
    """Points at a frame's plane, below it, above it, and others, counted in cells (5, X, Y); last, what stands there.

    And the sums of places (2, X, Y) of those at the plane or below it.

    Points within `window_m` of the plane lie where they are, all others where their line of sight crosses it; above are
    those more than `through_m` higher. Those are counted where they stand, too.
    """
    frame, low_x, low_y = numbers(rotation, origin_m), low_m[0] - 0.5 * cell_m, low_m[1] - 0.5 * cell_m
    camera = (camera_m[0], camera_m[1], camera_m[2])
    counts, sums = np.zeros((5, shape[0], shape[1]), np.int32), np.zeros((2, shape[0], shape[1]))
    for k in range(len(points_m)):
        right, ahead, up = in_frame(frame, points_m[k, 0], points_m[k, 1], points_m[k, 2])
        if up > 0.9 * camera[2]:
            continue
        kind = 0 if abs(up) < window_m else 1 if up < -through_m else 2 if up > through_m else 3
        if kind == 2:
            u, v = (right - low_x) / cell_m, (ahead - low_y) / cell_m
            if 0 <= u < shape[0] and 0 <= v < shape[1]:
                counts[4, int(u), int(v)] += 1
        if kind > 0:
            right, ahead = on_plane(right, ahead, up, camera)
        u, v = (right - low_x) / cell_m, (ahead - low_y) / cell_m
        if 0 <= u < shape[0] and 0 <= v < shape[1]:
            counts[kind, int(u), int(v)] += 1
            if kind < 2:
                sums[0, int(u), int(v)] += right
                sums[1, int(u), int(v)] += ahead
    return counts, sums


@compiled
def cells_crossed(points_m, step, rotation, origin_m, camera_m, side_m, shape):
    """Which cells of a rectangle about a frame's origin the lines of sight to every `step`-th point cross."""
    frame, side_x, side_y = numbers(rotation, origin_m), side_m[0], side_m[1]
    camera = (camera_m[0], camera_m[1], camera_m[2])
    hit = np.zeros((shape[0], shape[1]), np.bool_)
    for k in range(0, len(points_m), step):
        right, ahead, up = in_frame(frame, points_m[k, 0], points_m[k, 1], points_m[k, 2])
        right, ahead = on_plane(right, ahead, up, camera)
        u, v = right / side_x + 0.5, ahead / side_y + 0.5
        if 0 <= u < 1 and 0 <= v < 1:
            hit[int(u * shape[0]), int(v * shape[1])] = True
    return hit


@compiled
def seen_through(points_m, rotation, origin_m, camera_m, reach_m):
    """Points (N, 3), unchanged, whose lines of sight cross a frame's plane within `reach_m` (2,) of its origin."""
    frame, reach_x, reach_y = numbers(rotation, origin_m), reach_m[0], reach_m[1]
    camera_x, camera_y, camera_z = camera_m[0], camera_m[1], camera_m[2]
    kept = np.empty_like(points_m)
    count = 0
    for k in range(len(points_m)):
        right, ahead, up = in_frame(frame, points_m[k, 0], points_m[k, 1], points_m[k, 2])
        along = camera_z / (camera_z - up)
        u, v = camera_x + along * (right - camera_x), camera_y + along * (ahead - camera_y)
        if abs(u) < reach_x and abs(v) < reach_y:
            kept[count, 0], kept[count, 1], kept[count, 2] = points_m[k, 0], points_m[k, 1], points_m[k, 2]
            count += 1
    return kept[:count]


@compiled
def table_sums(xy_m, shifts_m, low_m, cell_m, shape, table, values, step_m):
    """Sums (S,) over places (N, 2), less each shift (S, 2), on a field's grid, of values tabled over the distance.

    Values lie `step_m` apart, the middle one at distance 0; between them it is linear, beyond them constant.
    """
    totals, middle, last = np.zeros(len(shifts_m)), len(values) // 2, len(values) - 1.001
    for s in range(len(shifts_m)):
        low_x, low_y = low_m[0] + shifts_m[s, 0], low_m[1] + shifts_m[s, 1]
        for k in range(len(xy_m)):
            x, y = (xy_m[k, 0] - low_x) / cell_m, (xy_m[k, 1] - low_y) / cell_m
            if -0.5 <= x < shape[0] - 0.5 and -0.5 <= y < shape[1] - 0.5:
                i, j = math.floor(x + 0.5), math.floor(y + 0.5)
                cell = table[i * shape[1] + j]
                distance = cell[0] + cell_m * ((x - i) * cell[1] + (y - j) * cell[2])
                place = min(max(distance / step_m + middle, 0.0), last)
                m = int(place)
                totals[s] += values[m] + (place - m) * (values[m + 1] - values[m])
    return totals


@compiled
def close_counts(values, offsets, distance):
    """How many values of every row (N, M) are within a distance of the row's offset (N,)."""
    counts = np.empty(len(values), np.intp)
    for k in range(len(values)):
        # As wide as the values: several are compared at once.
        count, row, offset = np.int32(0), values[k], offsets[k]
        for i in range(len(row)):
            count += np.int32(abs(row[i] - offset) < distance)
        counts[k] = count
    return counts


@compiled
def cell_counts(xy_m, turn, low_m, cell_m, size):
    """Places (N, 2), turned by a matrix that they are multiplied with from the left, counted in square cells."""
    image = np.zeros((size, size), np.float32)
    for k in range(len(xy_m)):
        i = math.floor((xy_m[k, 0] * turn[0, 0] + xy_m[k, 1] * turn[1, 0] - low_m[0]) / cell_m)
        j = math.floor((xy_m[k, 0] * turn[0, 1] + xy_m[k, 1] * turn[1, 1] - low_m[1]) / cell_m)
        if 0 <= i < size and 0 <= j < size:
            image[i, j] += np.float32(1.0)
    return image


@compiled
def median_count(image):
    """Median of the whole numbers of a picture that are above 0; 1 at least."""
    counts = np.zeros(int(image.max()) + 1, np.intp)
    for row in image:
        for value in row:
            if value > 0:
                counts[int(value)] += 1
    total, passed, lower = counts.sum(), 0, 0
    for value in range(1, len(counts)):
        passed += counts[value]
        if lower == 0 and 2 * passed >= total:
            lower = value
        if 2 * passed > total:
            return max(1.0, 0.5 * (lower + value))
    return 1.0


@compiled
def clipped(hits, misses, weight, full):
    """Hits less misses, which have a weight, both counted up to `full`."""
    picture = np.empty_like(hits)
    for i in range(hits.shape[0]):
        for j in range(hits.shape[1]):
            picture[i, j] = min(hits[i, j], full) - min(misses[i, j] * weight, full)
    return picture


@compiled
def band_places(points_m, rotation, origin_m, height_m):
    """Places (N, 2) in a frame of the points (M, 3) within a height of its plane."""
    frame, flat = numbers(rotation, origin_m), np.empty((len(points_m), 2))
    count = 0
    for k in range(len(points_m)):
        right, ahead, up = in_frame(frame, points_m[k, 0], points_m[k, 1], points_m[k, 2])
        if abs(up) < height_m:
            flat[count, 0], flat[count, 1] = right, ahead
            count += 1
    return flat[:count]


@compiled
def crossed(points_m, step, rotation, origin_m, camera_m):
    """Where the lines of sight to every `step`-th point (N, 3) cross a frame's plane, shape (M, 2)."""
    frame, at = numbers(rotation, origin_m), np.empty(((len(points_m) + step - 1) // step, 2))
    camera = (camera_m[0], camera_m[1], camera_m[2])
    for k in range(len(at)):
        right, ahead, up = in_frame(frame, points_m[k * step, 0], points_m[k * step, 1], points_m[k * step, 2])
        at[k, 0], at[k, 1] = on_plane(right, ahead, up, camera)
    return at


@compiled
def gained(kinds, shares, rows, other, own, tables, nothing_tables, square, missed):
    """How much likelier cells `rows` (K,) are with other chances of being solid than with their own, (K,) levels each.

    Chances are levels of `tables` (8, 2, L): log likelihoods by kind of cell, of being solid and of being open, and of
    `nothing_tables` (4, L), by zone. `kinds` says what a cell is: its row of `tables`, 8 more for nothing in a zone, 16
    for no news. What cells without a return gain is added to `missed`, by their square; the rest is returned.
    """
    total = 0.0
    for k in range(len(rows)):
        row = rows[k]
        kind = kinds[row]
        if kind < 8:
            share = shares[row]
            table = tables[kind]
            solid = table[0, other[k]] - table[0, own[row]]
            total += share * solid + (1.0 - share) * (table[1, other[k]] - table[1, own[row]])
        elif kind < 16:
            zone = kind - 8
            missed[square[row]] += nothing_tables[zone, other[k]] - nothing_tables[zone, own[row]]
    return total


@compiled
def whole(kinds, shares, own, tables, nothing_tables):
    """Log likelihood of all cells, each with its chance of being solid; arguments as of `gained`."""
    total = 0.0
    for row in range(len(kinds)):
        kind = kinds[row]
        if kind < 8:
            share = shares[row]
            total += share * tables[kind, 0, own[row]] + (1.0 - share) * tables[kind, 1, own[row]]
        elif kind < 16:
            total += nothing_tables[kind - 8, own[row]]
    return total
