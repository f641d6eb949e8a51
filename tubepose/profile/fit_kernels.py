"""The loops over samples, points of walls and rings, compiled; see `kernels`, whose promises these keep."""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled, mean_square, median
from tubepose.profile.kernels import between

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
def even_rings(picture, places, shifts, around, ring, outside, inside, least_seen, noise):
    """Evenness (S,) of the most even ring about places (S, 2), and which of the shifts (M, 2) has it (S,).

    A ring is even where it has one gray along its directions `around` (D, 2), at the radii `ring` (R,), and what lies
    beside it, at the radii `outside` and `inside`, has others: 1 less the variance along it over that beside it, about
    the ring's mean, the outside counted twice; noise has a variance of its own. Directions that meet a NaN do not
    count; with fewer than `least_seen` of them there is no ring, nor where one leaves the picture.
    """
    evenness, best = np.full(len(places), -np.inf), np.zeros(len(places), np.intp)
    cells, columns = picture.reshape(-1), picture.shape[1]
    for s in range(len(places)):
        for m in range(len(shifts)):
            x, y = places[s, 0] + shifts[m, 0], places[s, 1] + shifts[m, 1]
            if not (outside < min(x, y) and max(x - picture.shape[0], y - picture.shape[1]) < -outside - 2.0):
                continue
            seen, own, own2, outer, outer2, inner, inner2 = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for d in range(len(around)):
                right, up = around[d, 0], around[d, 1]
                beyond = between(cells, columns, x + outside * right, y + outside * up)
                within = between(cells, columns, x + inside * right, y + inside * up)
                along, along2 = 0.0, 0.0
                for radius in ring:
                    value = between(cells, columns, x + radius * right, y + radius * up)
                    along += value
                    along2 += value * value
                if math.isfinite(beyond + within + along):
                    seen += 1
                    own, own2 = own + along, own2 + along2
                    outer, outer2 = outer + beyond, outer2 + beyond * beyond
                    inner, inner2 = inner + within, inner2 + within * within
            if seen < least_seen:
                continue
            gray, own2 = own / (seen * len(ring)), own2 / (seen * len(ring))
            apart = (outer2 - 2.0 * gray * outer) / seen + gray * gray + noise
            deep = (inner2 - 2.0 * gray * inner) / seen + gray * gray + noise
            even = 1.0 - (own2 - gray * gray + noise) / (apart * apart * deep) ** (1.0 / 3.0)
            if even > evenness[s]:
                evenness[s], best[s] = even, m
    return evenness, best


@compiled
def ring_sides(picture, places, around, ring, beside, differs, noise):
    """What rings about places (S, 2) are like beside them, shape (S, 5); arguments are those of `even_rings`.

    Shares of directions whose outside differs from the ring's median gray, and whose inside does, both by more than
    `differs`; and where one of them does by more than the ring's own standard deviation. Then the logarithm of how much
    less even the gray is at the last of the radii `beside` (outside, inside, further inside) than at the one before.
    Last, where the ring's gray lies between those of its sides, as on an edge, the variance along it over that of the
    outside; else 0.
    """
    found = np.zeros((len(places), 5))
    cells, columns = picture.reshape(-1), picture.shape[1]
    along, known = np.empty(len(around) * len(ring)), np.empty(len(around) * len(ring))
    sides, mean, variance = np.empty((3, len(around))), np.empty(3), np.empty(3)
    for s in range(len(places)):
        count = 0
        for d in range(len(around)):
            right, up = around[d, 0], around[d, 1]
            for r in range(len(ring)):
                value = between(cells, columns, places[s, 0] + ring[r] * right, places[s, 1] + ring[r] * up)
                along[d * len(ring) + r] = value
                if not math.isnan(value):
                    known[count] = value
                    count += 1
            for r in range(3):
                sides[r, d] = between(cells, columns, places[s, 0] + beside[r] * right, places[s, 1] + beside[r] * up)
        if count == 0:
            continue
        gray = median(known[:count])
        scatter = math.sqrt(mean_square(along, gray)[0])
        for r in range(3):
            mean[r] = mean_square(sides[r], 0.0)[1]
            variance[r] = mean_square(sides[r], mean[r])[0]
        for d in range(len(around)):
            outer, inner = abs(sides[0, d] - gray), abs(sides[1, d] - gray)
            found[s, 0] += (outer > differs) / len(around)
            found[s, 1] += (inner > differs) / len(around)
            found[s, 2] += (max(outer, inner) > scatter) / len(around)
        found[s, 3] = math.log((variance[2] + noise) / (variance[1] + noise))
        if (mean[0] - gray) * (gray - mean[1]) > 0.0:
            found[s, 4] = (scatter * scatter + noise) / (variance[0] + noise)
    return found


@compiled
def edge_shares(slope_x, slope_y, places, around, edges, least):
    """How much of the slopes of gray at edges of circles about places (S, 2) is along their radii, 0 to 1, shape (S,).

    Of every direction (D, 2) the largest share ``(n . g)^2 / (|g|^2 + least^2)`` at the radii `edges` (R,) counts.
    """
    shares = np.zeros(len(places))
    cells_x, cells_y, columns = slope_x.reshape(-1), slope_y.reshape(-1), slope_x.shape[1]
    for s in range(len(places)):
        for d in range(len(around)):
            most = 0.0
            for radius in edges:
                x, y = places[s, 0] + radius * around[d, 0], places[s, 1] + radius * around[d, 1]
                across, along = between(cells_x, columns, x, y), between(cells_y, columns, x, y)
                radial = across * around[d, 0] + along * around[d, 1]
                share = radial * radial / (across * across + along * along + least * least)
                if share > most:  # False for NaN
                    most = share
            shares[s] += most / len(around)
    return shares


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
