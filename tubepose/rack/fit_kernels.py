"""One round of a rack's fit, compiled: the plane of its top, its bow, and its edges; see `kernels`.

Heights of points on the solid part give the plane and the bow. The edges give the rest: a point at the top's height
must lie on the solid part, whose signed distance says how far off it is, less the blur of the sensor. Points on
opposite edges of ribs push in opposite directions: a blur that makes every rib look wider, or thinner, moves no pose.
"""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled, solved
from tubepose.rack.kernels import in_frame, laid, numbers

# Where heights scatter more than a good sensor's, wider ones count.
WIDEST_M = 2.0e-3
# Points this far inside the solid part are on the plane; nearer to an edge, pixels mix two depths.
INSIDE_M = 0.3e-3
# Points of the top's height that lie this far from its solid part are astray.
STRAY_M = 1.2e-3
# A pixel that is half on a rib is still at its height: edges seem that much farther out.
EDGE_SHIFT_M = 0.2e-3
# Share of pixels that say the wrong thing wherever they are: bounds what one of them can do.
WRONG_SHARE = 0.05
# Neighbours share their depth's error: squares of this length count as one, if they have this many points.
SHARED_LENGTH_M = 3e-3
FULL_SQUARE = 12
# No step shifts a pose by more.
LONGEST_STEP_M = 1e-3
# Two of two real racks are bowed by 1 to 2 mm at the ends of their outline; beyond it a face goes on for so much of it.
BOW_STD_M = 1.5e-3
BOW_ENDS = 1.2
# A face is never known to be smoother than this: what makes the prior of its bow count for something.
SMOOTH_M = 0.1e-3
# Bins that a median is counted in: it is exact to the range of values over this.
MEDIAN_BINS = 2048
# Bins per half window that the densest height is looked for in.
MODE_BINS = 20


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
    for k in range(len(xy_m)):
        counts[cells[k, 0] - low_x, cells[k, 1] - low_y] += 1
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
    columns = scores.shape[1]
    sums, products = np.zeros(((high_x - low_x + 1) * rows, columns)), np.zeros((columns, columns))
    filled, count = np.zeros(len(sums), np.bool_), 0
    for k in range(len(xy_m)):
        i, j = math.floor(xy_m[k, 0] / side_m), math.floor(xy_m[k, 1] / side_m)
        cell = (i - low_x) * rows + j - low_y
        filled[cell] = True
        for m in range(columns):
            sums[cell, m] += scores[k, m]
    for cell in range(len(sums)):
        count += filled[cell]
        for m in range(columns):
            for n in range(columns):
                products[m, n] += sums[cell, m] * sums[cell, n]
    return products, count


@compiled
def bow_at(bow_m, along, across):
    """Height of a bowed face over the plane at its centre; `along` and `across` are 1 at the ends of the outline."""
    return bow_m[0] * along * along + bow_m[1] * across * across + bow_m[2] * along * across


@compiled
def _face_column(column, x, y, half_x, half_y):
    """How the height of a face at a place changes with turns about x and y, its height, and the three parts of bow."""
    if column == 0:
        return y
    if column == 1:
        return -x
    if column == 2:
        return 1.0
    along, across = x / half_x, y / half_y
    return along * along if column == 3 else across * across if column == 4 else along * across


@compiled
def face_step(points_m, off_m, balance, reach_m, normal, half_m):
    """One reweighted step of a face: adds to its normal equations (K, K) in place, and returns its right side (K,)."""
    columns = len(normal)
    right, design = np.zeros(columns), np.empty(columns)
    half_x, half_y = half_m[0], half_m[1]
    for k in range(len(points_m)):
        u = off_m[k] / reach_m
        if abs(u) < 1.0:
            weight = balance[k] * (1.0 - u * u) ** 2
            for i in range(columns):
                design[i] = _face_column(i, points_m[k, 0], points_m[k, 1], half_x, half_y)
                right[i] += weight * off_m[k] * design[i]
                for j in range(i + 1):
                    normal[j, i] += weight * design[i] * design[j]
    for i in range(columns):
        for j in range(i):
            normal[i, j] = normal[j, i]
    return right


@compiled
def face_steps(points_m, balance, widths_m, held, bow_m, half_m, columns):
    """Face of points (N, 3) where heights are densest, windows narrowed: turns about x and y, height, bow; scatter.

    Of `columns` 3 the bow stays as it is; of 6 it is fitted, with a prior: real racks are bowed by `BOW_STD_M`. Where
    the level is held, the height (and bow) alone move. Returns the K unknowns, of the bow what it changes by, with the
    last normal equations (K, K) and the scores (N, K) of the points where the steps ended.
    """
    found, normal = np.zeros(columns), np.zeros((columns, columns))
    off, scores = np.empty(len(points_m)), np.zeros((len(points_m), columns))
    half_x, half_y = half_m[0], half_m[1]
    for k in range(len(points_m)):
        off[k] = points_m[k, 2]
    found[2] = densest(off, widths_m[0])
    scatter = widths_m[0]
    reach = scatter
    for width in widths_m:
        for k in range(len(points_m)):
            off[k] = points_m[k, 2]
            for i in range(columns):
                off[k] -= found[i] * _face_column(i, points_m[k, 0], points_m[k, 1], half_x, half_y)
        scatter = 1.4826 * median_size(off, max(width, 2 * scatter))
        reach = max(width, min(2 * scatter, WIDEST_M))
        for i in range(columns):
            for j in range(columns):
                normal[i, j] = 0.0
        normal[0, 0] = normal[1, 1] = 1e9 if held else 1e-9
        normal[2, 2] = 1e-6
        prior = (max(scatter, SMOOTH_M) / BOW_STD_M) ** 2
        for i in range(3, columns):
            normal[i, i] = prior
        right = face_step(points_m, off, balance, reach, normal, half_m)
        for i in range(3, columns):
            right[i] -= prior * (bow_m[i - 3] + found[i])
        step = solved(normal, right)
        for i in range(columns):
            found[i] += step[i]
    for k in range(len(points_m)):
        u = off[k] / reach
        if abs(u) < 1.0:
            now = points_m[k, 2]
            for i in range(columns):
                now -= found[i] * _face_column(i, points_m[k, 0], points_m[k, 1], half_x, half_y)
            score = balance[k] * (1.0 - u * u) ** 2 * now
            for i in range(columns):
                scores[k, i] = score * _face_column(i, points_m[k, 0], points_m[k, 1], half_x, half_y)
    return found, scatter, normal, scores


@compiled
def edge_step(points_m, distance_m, slope, window_m, blur_m):
    """Information (3, 3) and scores (N, 3) of edges about yaw and shift, and their places (N, 2).

    Of points (K, 3) whose heights are within the window, with their distance to the solid part and its gradient.
    """
    information, design, wrong = np.zeros((3, 3)), np.zeros(3), WRONG_SHARE
    scores, xy = np.empty((len(points_m), 3)), np.empty((len(points_m), 2))
    kept = 0
    for k in range(len(points_m)):
        eta = (EDGE_SHIFT_M - distance_m[k]) / blur_m
        if not (abs(points_m[k, 2]) < window_m and abs(eta) < 6.0):
            continue
        plain = 1.0 / (1.0 + math.exp(-eta))
        chance, rate = wrong + (1.0 - 2.0 * wrong) * plain, (1.0 - 2.0 * wrong) * plain * (1.0 - plain)
        x, y = points_m[k, 0], points_m[k, 1]
        gx, gy = slope[k, 0] / blur_m, slope[k, 1] / blur_m
        design[0], design[1], design[2] = gy * x - gx * y, gx, gy
        weight, score = rate * rate / (chance * (1.0 - chance)), rate / chance
        for a in range(3):
            scores[kept, a] = score * design[a]
            for b in range(a, 3):
                information[a, b] += weight * design[a] * design[b]
        xy[kept, 0], xy[kept, 1] = x, y
        kept += 1
    for a in range(3):
        for b in range(a):
            information[a, b] = information[b, a]
    return information, scores[:kept], xy[:kept]


@compiled
def edge_move(local_m, distance_m, slope, window_m, blur_m):
    """One step of Fisher scoring about yaw and shift; `edge_step` that it is made from."""
    information, scores, xy = edge_step(local_m, distance_m, slope, window_m, blur_m)
    total = np.zeros(3)
    for i in range(3):
        information[i, i] += 1e5 if i >= 1 else 1e1
        for k in range(len(scores)):
            total[i] += scores[k, i]
    step = solved(information, total)
    share = min(1.0, LONGEST_STEP_M / max(abs(step[1]), abs(step[2]), 1e-12))
    for i in range(3):
        step[i] *= share
    return step, (information, scores, xy)


@compiled
def round_step(
    points_m, rotation, origin_m, window_m, blur_m, widths_m, held, bow_m, columns, half_m, low_m, cell_m, shape, table
):
    """One round over points (N, 3), camera frame, for a top's frame.

    The heights that count are narrowed step by step, so that the face ends on the mode and not on the mean: light that
    goes astray sinks or lifts whole stretches of ribs. Places count alike, not points: a wall at the outline has most.

    Returns:
        What `face_steps` gives, and its points (K, 3); what `edge_move` gives; the share of points astray.
    """
    sag_m = abs(bow_m[0]) + abs(bow_m[1]) + abs(bow_m[2])
    height_m = max(window_m, widths_m[0]) + 1.5 * sag_m
    local, distance, slope = laid(points_m, rotation, origin_m, height_m, low_m, cell_m, shape, table)
    inside, count, astray, total = np.empty((len(local), 3)), 0, 0, 0
    for k in range(len(local)):
        local[k, 2] -= bow_at(bow_m, local[k, 0] / half_m[0], local[k, 1] / half_m[1])
        if distance[k] < -INSIDE_M:
            inside[count, 0], inside[count, 1], inside[count, 2] = local[k, 0], local[k, 1], local[k, 2]
            count += 1
        if abs(local[k, 2]) < window_m:
            total += 1
            astray += distance[k] > STRAY_M
    inside = inside[:count]
    crowd, balance = square_counts(inside, SHARED_LENGTH_M), np.empty(count)
    for k in range(count):
        balance[k] = 1.0 / max(crowd[k], FULL_SQUARE)
    face = face_steps(inside, balance, widths_m, held, bow_m, half_m, columns)
    return face, inside, edge_move(local, distance, slope, window_m, blur_m), astray / max(total, 1)


@compiled
def laid_flat(points_m, rotation, origin_m, camera_m, half_m, bow_m):
    """Points (N, 3), camera frame, moved along a face's normal by its bow where their lines of sight cross it."""
    frame = numbers(rotation, origin_m)
    camera, flat = (camera_m[0], camera_m[1], camera_m[2]), np.empty_like(points_m)
    for k in range(len(points_m)):
        right, ahead, up = in_frame(frame, points_m[k, 0], points_m[k, 1], points_m[k, 2])
        drop = 0.0
        if up < 0.9 * camera[2]:
            share = up / (up - camera[2])
            along = (right + share * (camera[0] - right)) / half_m[0]
            across = (ahead + share * (camera[1] - ahead)) / half_m[1]
            # Beyond the outline nothing is known of a face.
            along, across = min(max(along, -BOW_ENDS), BOW_ENDS), min(max(across, -BOW_ENDS), BOW_ENDS)
            drop = bow_at(bow_m, along, across)
        for i in range(3):
            flat[k, i] = points_m[k, i] - drop * rotation[i, 2]
    return flat
