"""The loops over samples, points of walls and rings, compiled; see `kernels`, whose promises these keep."""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled

LARGEST = 200.0
"""Exponents are cut here: the product of three such powers is still a number."""


@compiled
def doubt(x):
    """1 + exp(-x): one over the chance of something that is certain far above 0, and impossible far below."""
    return 1.0 + math.exp(min(-x, LARGEST))


@compiled
def room_m(x, y, opening):
    """Distance of a place, from a slot's centre, to its opening's edge, positive inside.

    An opening is half its size along x and y, its corners' radius, and whether it is round.
    """
    if opening[3] > 0.0:
        return opening[0] - math.sqrt(x * x + y * y)
    corner_m = opening[2]
    right, ahead = abs(x) - (opening[0] - corner_m), abs(y) - (opening[1] - corner_m)
    outside = math.sqrt(max(right, 0.0) ** 2 + max(ahead, 0.0) ** 2)
    return corner_m - outside - min(max(right, ahead), 0.0)


@compiled
def weighted_samples(mean, root, normal, spread, play_m, openings_m, levers_m, radii_m, soft_m):
    """Mean (T, 4), covariance (T, 4, 4) and mean chance (T,) of Gaussian samples that slots allow, T tubes.

    Samples are ``mean + root z`` for standard normal z (M, 4), weighted by what is allowed over a Gaussian about 0 of
    standard deviations `spread` (T, 4): the foot within the play, the axis inside the slot's opening (T, 4), as
    `room_m` has it, at two heights `levers_m` (T, 2) above the foot, where the body has `radii_m` (T, 2). Edges are as
    soft as `soft_m`.
    """
    tubes, samples = len(mean), len(normal)
    middle, covariance, allowed = np.zeros((tubes, 4)), np.zeros((tubes, 4, 4)), np.zeros(tubes)
    x, weight = np.empty((samples, 4)), np.empty(samples)
    for t in range(tubes):
        most = -np.inf
        for m in range(samples):
            gaussian = 0.0
            for i in range(4):
                value = mean[t, i]
                for j in range(i + 1):
                    value += root[t, i, j] * normal[m, j]
                x[m, i] = value
                gaussian += (value / spread[t, i]) ** 2
            doubts = doubt((play_m[t] - math.sqrt(x[m, 0] ** 2 + x[m, 1] ** 2)) / soft_m)
            for k in range(2):
                right, ahead = x[m, 0] + levers_m[t, k] * x[m, 2], x[m, 1] + levers_m[t, k] * x[m, 3]
                doubts *= doubt((room_m(right, ahead, openings_m[t]) - radii_m[t, k]) / soft_m)
            allowed[t] += 1.0 / (doubts * samples)
            weight[m] = 0.5 * gaussian - math.log(doubts)
            most = max(most, weight[m])
        total = 0.0
        for m in range(samples):
            weight[m] = math.exp(weight[m] - most)
            total += weight[m]
        for m in range(samples):
            weight[m] /= total
            for i in range(4):
                middle[t, i] += weight[m] * x[m, i]
        for m in range(samples):
            for i in range(4):
                scaled = weight[m] * (x[m, i] - middle[t, i])
                for j in range(i + 1):
                    covariance[t, i, j] += scaled * (x[m, j] - middle[t, j])
        for i in range(4):
            for j in range(i):
                covariance[t, j, i] = covariance[t, i, j]
    return middle, covariance, allowed


@compiled
def wall_rows(points_m, label, camera_m, pose, centers_m, floor_m, held_m, skirt_m, body_m, ends_m, reach_m):
    """Residual (N,), direction from the axis (N, 2), height above the foot (N,) and tube (N,) of points near a wall.

    Of points (K, 3) below the skirt of their tube, on the camera's side of it, and within a reach of its radius. Bodies
    have two radii `body_m` (T, 2) at two heights `ends_m` (T, 2) above the bottom, and are straight between them.
    """
    residual, normal = np.empty(len(points_m)), np.empty((len(points_m), 2))
    above, of = np.empty(len(points_m)), np.empty(len(points_m), np.intp)
    count = 0
    for k in range(len(points_m)):
        t = label[k]
        if t < 0 or not points_m[k, 2] - floor_m < skirt_m[t]:
            continue
        up = points_m[k, 2] - floor_m - held_m[t]
        x = points_m[k, 0] - centers_m[t, 0] - pose[t, 0] - up * pose[t, 2]
        y = points_m[k, 1] - centers_m[t, 1] - pose[t, 1] - up * pose[t, 3]
        rho = math.sqrt(x * x + y * y)
        share = (up + held_m[t] - ends_m[t, 0]) / (ends_m[t, 1] - ends_m[t, 0])
        off = rho - (body_m[t, 0] + min(max(share, 0.0), 1.0) * (body_m[t, 1] - body_m[t, 0]))
        faces = x * (camera_m[0] - points_m[k, 0]) + y * (camera_m[1] - points_m[k, 1]) > 0.0
        if abs(off) < reach_m and faces:
            residual[count], above[count], of[count] = off, up, t
            normal[count, 0], normal[count, 1] = x / rho, y / rho
            count += 1
    return residual[:count], normal[:count], above[:count], of[:count]


@compiled
def wall_sums(residual_m, normal, above_m, of, pose, weight, near_m):
    """Normal equations (T, 5, 5) and right sides (T, 5) of rows of `wall_rows` about (u, v, a, b, radius).

    A row's weight is its tube's (T,), and falls to 0 at a distance `near_m` from the wall.
    """
    matrix, vector = np.zeros((len(weight), 5, 5)), np.zeros((len(weight), 5))
    row = np.ones(5)
    for k in range(len(of)):
        t = of[k]
        u = residual_m[k] / near_m
        if abs(u) >= 1.0:
            continue
        w = weight[t] * (1.0 - u * u) ** 2
        row[0], row[1] = -normal[k, 0], -normal[k, 1]
        row[2], row[3] = row[0] * above_m[k], row[1] * above_m[k]
        target = -residual_m[k]
        for i in range(4):
            target += row[i] * pose[t, i]
        for i in range(5):
            vector[t, i] += w * row[i] * target
            for j in range(5):
                matrix[t, i, j] += w * row[i] * row[j]
    return matrix, vector


@compiled
def ring_votes(picture, cells, shifts, ring, inside, outside, least):
    """Most votes (S, 2) for a bright and for a dark ring about cells (S, 2), and with which of the shifts (M, 2) each.

    `ring`, `inside` and `outside` are cells (D, 2) of directions from a middle. A direction votes by how much brighter
    its cell on the ring is than the two beside it, over their differences, a least one included: 1 if it is brighter
    than both, -1 if darker, near 0 on an edge. Directions that leave the picture, or meet a NaN, do not vote.
    """
    votes, best = np.full((len(cells), 2), -1.0), np.zeros((len(cells), 2), np.intp)
    height, width = picture.shape
    for s in range(len(cells)):
        for m in range(len(shifts)):
            i, j = cells[s, 0] + shifts[m, 0], cells[s, 1] + shifts[m, 1]
            total = 0.0
            for d in range(len(ring)):
                if not (0 <= i + outside[d, 0] < height and 0 <= j + outside[d, 1] < width):
                    continue
                middle = picture[i + ring[d, 0], j + ring[d, 1]]
                inner = middle - picture[i + inside[d, 0], j + inside[d, 1]]
                outer = middle - picture[i + outside[d, 0], j + outside[d, 1]]
                vote = (inner + outer) / (abs(inner) + abs(outer) + least)
                if vote == vote:
                    total += vote
            share = total / len(ring)
            if share > votes[s, 0]:
                votes[s, 0], best[s, 0] = share, m
            if -share > votes[s, 1]:
                votes[s, 1], best[s, 1] = -share, m
    return votes, best


@compiled
def shift_scores(correlation, blocked, moved):
    """Sums (T, K) of the correlations (T, S, M) that are above 0 over sectors that are not blocked (T, S).

    `moved` (K, S) tells by which of the M moves each of K shifts of a ring moves each sector.
    """
    total = np.zeros((len(correlation), len(moved)))
    for t in range(len(correlation)):
        for s in range(correlation.shape[1]):
            if not blocked[t, s]:
                for k in range(len(moved)):
                    total[t, k] += max(correlation[t, s, moved[k, s]], 0.0)
    return total


@compiled
def ring_heights(points_m, camera_m, level_m, centers_m, inner_m, outer_m, low_m, bin_m, bins, sectors):
    """Points (T, B, sectors) that are seen on rings of a level, by height, in bins from `low_m` on, and direction."""
    counts = np.zeros((len(centers_m), bins, sectors), np.intp)
    for k in range(len(points_m)):
        height = int((points_m[k, 2] - low_m) / bin_m)
        if not 0 <= height < bins:
            continue
        along = (level_m - camera_m[2]) / (points_m[k, 2] - camera_m[2])
        x = camera_m[0] + (points_m[k, 0] - camera_m[0]) * along
        y = camera_m[1] + (points_m[k, 1] - camera_m[1]) * along
        for t in range(len(centers_m)):
            right, ahead = x - centers_m[t, 0], y - centers_m[t, 1]
            rho2 = right * right + ahead * ahead
            if inner_m * inner_m < rho2 < outer_m * outer_m:
                sector = int((math.atan2(ahead, right) + math.pi) / (2.0 * math.pi) * sectors) % sectors
                counts[t, height, sector] += 1
    return counts
