"""The loops over points, compiled: one pass each instead of a dozen arrays. The machine code is kept (`cache=True`).

Sums are made in the order of the points, so results do not depend on threads. No argument is changed but the pictures
that `level_pictures` fills.
"""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled


@compiled
def points_over(cloud_m, rotation, translation_m, lowest_m, highest_m, half_m):
    """Points of a cloud (H, W, 3) in the rack's frame, shape (N, 3), between two heights and over the outline."""
    height, width = cloud_m.shape[0], cloud_m.shape[1]
    points = np.empty((height * width, 3))
    count = 0
    up_x, up_y, up_z, above_m = rotation[2, 0], rotation[2, 1], rotation[2, 2], translation_m[2]
    for i in range(height):
        for j in range(width):
            x, y, z = cloud_m[i, j, 0], cloud_m[i, j, 1], cloud_m[i, j, 2]
            up = up_x * x + up_y * y + up_z * z + above_m
            # False for NaN.
            if lowest_m < up < highest_m:
                right = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation_m[0]
                ahead = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation_m[1]
                if abs(right) < half_m[0] and abs(ahead) < half_m[1]:
                    points[count, 0], points[count, 1], points[count, 2] = right, ahead, up
                    count += 1
    return points[:count].copy()


@compiled
def level_pictures(points_m, step, camera_m, level_m, below_m, above_m, half_m, cell_m, filled, off):
    """Fill two pictures (X, Y) of the points near a level as seen from above: 1 where there is one, and its height.

    Every `step`-th point counts, at the place where its line of sight crosses the level; heights are above it. The
    pictures are empty ones of the caller's; their first cell has its middle at `-half_m`.
    """
    for k in range(0, len(points_m), step):
        height = points_m[k, 2] - level_m
        if -below_m < height < above_m:
            along = (level_m - camera_m[2]) / (points_m[k, 2] - camera_m[2])
            x = camera_m[0] + (points_m[k, 0] - camera_m[0]) * along
            y = camera_m[1] + (points_m[k, 1] - camera_m[1]) * along
            if abs(x) < half_m[0] and abs(y) < half_m[1]:
                i, j = int((x + half_m[0]) / cell_m + 0.5), int((y + half_m[1]) / cell_m + 0.5)
                filled[i, j] = 1.0
                off[i, j] = height


@compiled
def best_places(score, low, high, wanted, close, near):
    """Best score in every wanted window [low, high) of a picture, and its place in cells: shape (S, 3).

    Several cells are as good: the place is the middle of those `close` to the best score and `near` its first cell.
    Windows are cut at the picture's edge; -inf where nothing is left of one or it is not wanted.
    """
    found = np.full((len(low), 3), -np.inf)
    for s in range(len(low)):
        if not wanted[s]:
            continue
        peak, first_i, first_j = -np.inf, 0, 0
        i_low, i_high = max(low[s, 0], 0), min(high[s, 0], score.shape[0])
        j_low, j_high = max(low[s, 1], 0), min(high[s, 1], score.shape[1])
        for i in range(i_low, i_high):
            for j in range(j_low, j_high):
                if score[i, j] > peak:
                    peak, first_i, first_j = score[i, j], i, j
        if peak == -np.inf:
            continue
        least = np.float32(peak - close)
        count, sum_i, sum_j = 0, 0, 0
        for i in range(i_low, i_high):
            for j in range(j_low, j_high):
                if score[i, j] >= least and math.hypot(i - first_i, j - first_j) < near:
                    count += 1
                    sum_i += i
                    sum_j += j
        found[s, 0], found[s, 1], found[s, 2] = peak, sum_i / count, sum_j / count
    return found


@compiled
def nearest_tops(centers_m, radii_m, near_m, low_m, cell_m, shape):
    """Top whose middle is nearest to each cell of a picture (X, Y) whose cell 0, 0 lies at `low_m`; -1 outside of all.

    Outside is what is farther than `near_m` from the end of every top.
    """
    label = np.full((shape[0], shape[1]), -1, np.intp)
    nearest = np.full((shape[0], shape[1]), np.inf)
    for t in range(len(centers_m)):
        reach = radii_m[t] + near_m
        cells = int(reach / cell_m) + 2
        i, j = int((centers_m[t, 0] - low_m[0]) / cell_m), int((centers_m[t, 1] - low_m[1]) / cell_m)
        for a in range(max(i - cells, 0), min(i + cells + 1, shape[0])):
            x = low_m[0] + a * cell_m - centers_m[t, 0]
            for b in range(max(j - cells, 0), min(j + cells + 1, shape[1])):
                y = low_m[1] + b * cell_m - centers_m[t, 1]
                distance = math.sqrt(x * x + y * y)
                if distance < reach and distance < nearest[a, b]:
                    nearest[a, b], label[a, b] = distance, t
    return label


@compiled
def crowded_ends(centers_m, radii_m, normals, gap_m, sure):
    """Which ends of circles (T, S), along normals (S, 2), are nearer than a gap to another `sure` (T,) circle."""
    crowded = np.zeros((len(radii_m), len(normals)), np.bool_)
    for t in range(len(radii_m)):
        for other in range(len(radii_m)):
            right, ahead = centers_m[t, 0] - centers_m[other, 0], centers_m[t, 1] - centers_m[other, 1]
            reach = radii_m[t] + radii_m[other] + gap_m
            if other == t or not sure[other] or right * right + ahead * ahead >= reach * reach:
                continue
            for s in range(len(normals)):
                x, y = right + radii_m[t] * normals[s, 0], ahead + radii_m[t] * normals[s, 1]
                crowded[t, s] |= math.sqrt(x * x + y * y) - radii_m[other] < gap_m
    return crowded


@compiled
def grouped(points_m, label, count):
    """Points (N, 3) ordered by their labels from 0 to count - 1, those without one left out, and where each ends."""
    ends = np.zeros(count + 1, np.intp)
    for k in range(len(label)):
        if label[k] >= 0:
            ends[label[k] + 1] += 1
    ends = np.cumsum(ends)
    free = ends[:-1].copy()
    ordered = np.empty((ends[-1], 3))
    for k in range(len(label)):
        t = label[k]
        if t >= 0:
            for i in range(3):
                ordered[free[t], i] = points_m[k, i]
            free[t] += 1
    return ordered, ends


@compiled
def cell_values(points_m, low_m, cell_m, picture):
    """Values (N,) of the cells of points in a picture (X, Y) whose cell 0, 0 lies at `low_m`; the border is outside."""
    values = np.empty(len(points_m), picture.dtype)
    for k in range(len(points_m)):
        # Left of the picture too: what is cut towards 0 is outside.
        x = int((points_m[k, 0] - low_m[0]) / cell_m + 0.5)
        y = int((points_m[k, 1] - low_m[1]) / cell_m + 0.5)
        x = min(max(x, 0), picture.shape[0] - 1)
        y = min(max(y, 0), picture.shape[1] - 1)
        values[k] = picture[x, y]
    return values


@compiled
def near_planes(points_m, label, centers_m, levels_m, band_m, usable):
    """Rows of the points whose tube is usable and whose height is near its level; their tubes and offsets (N, 2)."""
    rows = np.empty(len(points_m), np.intp)
    count = 0
    for k in range(len(points_m)):
        t = label[k]
        if t >= 0 and usable[t] and abs(points_m[k, 2] - levels_m[t]) < band_m:
            rows[count] = k
            count += 1
    rows = rows[:count].copy()
    of = np.empty(count, np.intp)
    offset_m = np.empty((count, 2))
    for i in range(count):
        k = rows[i]
        of[i] = label[k]
        offset_m[i, 0] = points_m[k, 0] - centers_m[of[i], 0]
        offset_m[i, 1] = points_m[k, 1] - centers_m[of[i], 1]
    return rows, of, offset_m


@compiled
def ends_on_planes(points_m, rows, of, offset_m, planes, least_m, near_m, centers_m, camera_m):
    """Points of tops that are far enough out and on their planes (T, 3): their tubes, and their offsets (N, 2).

    The offset is where the line of sight crosses the plane's height there, from the tube's centre.
    """
    kept = np.empty(len(rows), np.intp)
    flat_m = np.empty((len(rows), 2))
    count = 0
    for i in range(len(rows)):
        t = of[i]
        x, y = offset_m[i, 0], offset_m[i, 1]
        if x * x + y * y > least_m[t] * least_m[t]:
            k = rows[i]
            height = planes[t, 0] + planes[t, 1] * x + planes[t, 2] * y
            # False for a plane that is not known.
            if abs(points_m[k, 2] - height) < near_m:
                along = (height - camera_m[2]) / (points_m[k, 2] - camera_m[2])
                kept[count] = t
                flat_m[count, 0] = camera_m[0] + (points_m[k, 0] - camera_m[0]) * along - centers_m[t, 0]
                flat_m[count, 1] = camera_m[1] + (points_m[k, 1] - camera_m[1]) * along - centers_m[t, 1]
                count += 1
    return kept[:count].copy(), flat_m[:count].copy()


@compiled
def between(cells, columns, x, y):
    """A picture between its cells (bilinear), which are given row by row (N,), at a place well inside of it."""
    i, j = int(x), int(y)
    right, up = x - i, y - j
    at = i * columns + j
    lower = cells[at] * (1.0 - up) + cells[at + 1] * up
    upper = cells[at + columns] * (1.0 - up) + cells[at + columns + 1] * up
    return lower * (1.0 - right) + upper * right


@compiled
def radial_brightness(
    picture, camera, rotation, translation_m, centers_m, levels_m, radii_m, steps_m, sectors, per_sector
):
    """Mean brightness (T, sectors, B) of a picture (H, W) around level circles, at their radius plus every step.

    `camera` is (fx, fy, cx, cy). The picture is read between its pixels, where points of the circle's level are seen;
    outside of it those of its border count.
    """
    height, width = picture.shape
    cells = picture.reshape(-1)
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    sums = np.zeros((len(centers_m), sectors, len(steps_m)))
    middle, outwards = np.empty(3), np.empty(3)
    u, v = np.empty(len(steps_m)), np.empty(len(steps_m))
    for t in range(len(centers_m)):
        for i in range(3):
            row = rotation[i]
            middle[i] = row[0] * centers_m[t, 0] + row[1] * centers_m[t, 1] + row[2] * levels_m[t] + translation_m[i]
        right, ahead, far, radius_m = middle[0], middle[1], middle[2], radii_m[t]
        for a in range(sectors * per_sector):
            angle = (a + 0.5) / (sectors * per_sector) * 2.0 * math.pi - math.pi
            cos, sin = math.cos(angle), math.sin(angle)
            for i in range(3):
                outwards[i] = rotation[i, 0] * cos + rotation[i, 1] * sin
            more_right, more_ahead, farther = outwards[0], outwards[1], outwards[2]
            ray = sums[t, a // per_sector]
            # Several places are computed at once where nothing is read between them.
            for b in range(len(steps_m)):
                r = radius_m + steps_m[b]
                nearness = 1.0 / (far + r * farther)
                u[b] = fx * (right + r * more_right) * nearness + cx
                v[b] = fy * (ahead + r * more_ahead) * nearness + cy
            for b in range(len(steps_m)):
                x, y = min(max(u[b], 0.0), width - 1.001), min(max(v[b], 0.0), height - 1.001)
                ray[b] += between(cells, width, y, x)
    return sums / per_sector
