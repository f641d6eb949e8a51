"""The loops over sectors of circles and their points, compiled; see `kernels`, whose promises these keep."""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled, median, solved

DENSITY_BAND_M = 1.0e-3
"""The ring inside of where a sector's end is looked for, where the density of points is taken from."""
COARSE_BAND_M = 2.5e-3
MIN_CORE_POINTS = 6.0
"""A coarse scan has no more points than this of a sector in that ring: it gets a wider one, and less trust."""
ROUNDS = 6
"""Of the reweighted least squares of circles."""
HUBER = 1.5
"""Residuals larger than this many standard deviations count as if they were that large."""


@compiled
def sectors_of(x, y, tangents):
    """Sectors (N,) of directions (N,), counted from -x over -y: four times one more than tangents of their borders.

    In plain passes without branches: which way a point lies is not to be guessed.
    """
    along, across, sector = np.empty(len(x)), np.empty(len(x)), np.empty(len(x), np.intp)
    for k in range(len(x)):
        sign = 1.0 if y[k] > 0.0 else -1.0
        right, ahead = sign * x[k], sign * y[k]
        quarter = right <= 0.0
        along[k] = ahead if quarter else right
        across[k] = -right if quarter else ahead
        sector[k] = ((2 if sign > 0.0 else 0) + (1 if quarter else 0)) * (len(tangents) + 1)
    for tangent in tangents:
        for k in range(len(x)):
            sector[k] += across[k] >= tangent * along[k]
    return sector


@compiled
def sector_counts(label, offset_m, shift_m, lower_m, low_m, high_m, sectors):
    """Points of every tube and sector between `lower` and `low`, and between `low` and `high`: (2 T, sectors).

    The sectors, four or a multiple of it, are counted from -x over -y.
    """
    tangents, tubes = np.empty(sectors // 4 - 1), len(low_m)
    for s in range(len(tangents)):
        tangents[s] = math.tan((s + 1) * (2.0 * math.pi / sectors))
    lower2, low2, high2 = np.empty(tubes), np.empty(tubes), np.empty(tubes)
    for t in range(tubes):
        lower2[t], low2[t], high2[t] = lower_m[t] * abs(lower_m[t]), low_m[t] * low_m[t], high_m[t] * high_m[t]
    x, y, row = np.empty(len(label)), np.empty(len(label)), np.empty(len(label), np.intp)
    count = 0
    for k in range(len(label)):
        t = label[k]
        right, ahead = offset_m[k, 0] - shift_m[t, 0], offset_m[k, 1] - shift_m[t, 1]
        rho2 = right * right + ahead * ahead
        x[count], y[count] = right, ahead
        row[count] = t + (tubes if rho2 > low2[t] else 0)
        count += (rho2 > lower2[t]) & (rho2 <= high2[t])
    counts = np.zeros((2 * tubes, sectors), np.intp)
    sector = sectors_of(x[:count], y[:count], tangents)
    for k in range(count):
        counts[row[k], sector[k]] += 1
    return counts


@compiled
def usual_count(counts, some):
    """Median of counts (S,), with room (S,) to put them in order."""
    for s in range(len(counts)):
        some[s] = counts[s]
    return median(some)


@compiled
def sector_ends(label, offset_m, shift_m, radius_m, inside_m, outside_m, sectors):
    """Radius at which each sector of discs ends (T, S), metres, and whether it is filled up to there (T, S).

    The end is where the points of the sector would end if they lay as dense as those further in; NaN where it is not
    filled. The last is what counting few points adds to its error (T,), metres: 0 but in a coarse scan.
    """
    width, tubes = 2.0 * math.pi / sectors, len(radius_m)
    lower, low, high = np.empty(tubes), np.empty(tubes), np.empty(tubes)
    for t in range(tubes):
        low[t], high[t] = radius_m[t] - inside_m, radius_m[t] + outside_m
        lower[t] = low[t] - DENSITY_BAND_M
    counts = sector_counts(label, offset_m, shift_m, lower, low, high, sectors)
    usual, coarse, some = np.empty(tubes), np.zeros(tubes, np.bool_), np.empty(sectors)
    any_coarse = False
    for t in range(tubes):
        usual[t] = usual_count(counts[t], some)
        coarse[t] = usual[t] <= MIN_CORE_POINTS
        if coarse[t]:
            lower[t], any_coarse = low[t] - COARSE_BAND_M, True
    core = sector_counts(label, offset_m, shift_m, lower, low, high, sectors) if any_coarse else counts
    end, seen = np.full((tubes, sectors), np.nan), np.zeros((tubes, sectors), np.bool_)
    counting = np.zeros(tubes)
    for t in range(tubes):
        least = 0.8
        if coarse[t]:
            least, half, total, filled = 0.5, 0.5 * usual_count(core[t], some), 0, 0
            for s in range(sectors):
                if core[t, s] > half:
                    total += core[t, s]
                    filled += 1
            usual[t] = total / max(filled, 1)
        density = usual[t] / (0.5 * width * (low[t] ** 2 - lower[t] ** 2))
        if coarse[t] and density > 0.0:
            counting[t] = 0.5 * math.sqrt(inside_m / (width * density * radius_m[t]))
        for s in range(sectors):
            seen[t, s] = core[t, s] > least * usual[t] and usual[t] > MIN_CORE_POINTS / 3.0
            if seen[t, s]:
                end[t, s] = math.sqrt(low[t] ** 2 + 2.0 * counts[tubes + t, s] / (width * density))
    return end, seen, counting


@compiled
def circle_rounds(excess_m, seen, sigma_m, design, prior, least_seen):
    """Huber regression of the excess radii (T, S) that are seen on a design (S, M), with a prior of information (M, M).

    Returns the solutions (T, M), the covariances of their first two unknowns (T, 2, 2), the sums of squared residuals
    (T,) and how many sectors are seen (T,); where fewer than the least, nothing is solved.
    """
    tubes, sectors = excess_m.shape
    unknowns = design.shape[1]
    solution, squares = np.zeros((tubes, unknowns)), np.zeros(tubes)
    covariance, counts = np.zeros((tubes, 2, 2)), np.zeros(tubes, np.intp)
    normal, weight, right = np.empty((unknowns, unknowns)), np.empty(sectors), np.empty(unknowns)
    for t in range(tubes):
        for s in range(sectors):
            counts[t] += seen[t, s]
            weight[s] = 1.0 / sigma_m[t] ** 2 if seen[t, s] else 0.0
        if counts[t] < least_seen:
            covariance[t, 0, 0], covariance[t, 1, 1] = 1.0, 1.0
            continue
        for _ in range(ROUNDS):
            for i in range(unknowns):
                right[i] = 0.0
                for j in range(unknowns):
                    normal[i, j] = prior[i, j]
            for s in range(sectors):
                if seen[t, s]:
                    for i in range(unknowns):
                        scaled = weight[s] * design[s, i]
                        right[i] += scaled * excess_m[t, s]
                        for j in range(unknowns):
                            normal[i, j] += scaled * design[s, j]
            best = solved(normal, right)
            squares[t] = 0.0
            for s in range(sectors):
                if seen[t, s]:
                    residual = excess_m[t, s]
                    for i in range(unknowns):
                        residual -= design[s, i] * best[i]
                    size = abs(residual)
                    squares[t] += residual * residual
                    weight[s] = min(1.0, HUBER * sigma_m[t] / max(size, 1e-9)) / sigma_m[t] ** 2
        for i in range(unknowns):
            solution[t, i] = best[i]
            right[i] = 0.0
        for i in range(2):
            right[i] = 1.0
            row = solved(normal, right)
            covariance[t, i, 0], covariance[t, i, 1], right[i] = row[0], row[1], 0.0
    return solution, covariance, squares, counts
