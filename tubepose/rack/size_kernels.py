"""How far a face's edges lie from where a rack's file has them, compiled: one logistic regression over its cells."""

from __future__ import annotations

import math

import numpy as np

from tubepose.compiled import compiled, solved
from tubepose.rack.fit_kernels import EDGE_SHIFT_M, WRONG_SHARE, cluster_sums

# Unknowns: yaw, shift along x and y; stretch of the openings' places along x and y; how far the openings' edges lie
# outside of where they should, and those of the outline along x and along y.
UNKNOWNS = 8
# Beyond so many blurs from an edge nothing pulls.
REACH = 7.0
# Cells so far inside the solid part tell how often what is solid looks open: beside tubes light is bent. Before any was
# counted `WRONG_SHARE` is assumed, worth so many cells; no more than the largest share is believed.
INSIDE_M, PRIOR_CELLS, MOST_SUNK = 1.0e-3, 20.0, 0.5


@compiled
def _looked_up(x, y, low_m, cell_m, shape, table):
    """Distance and gradient of a field at a place; beyond its grid those of its border."""
    u, v = (x - low_m[0]) / cell_m, (y - low_m[1]) / cell_m
    i = min(max(math.floor(u + 0.5), 0), shape[0] - 1)
    j = min(max(math.floor(v + 0.5), 0), shape[1] - 1)
    cell = i * shape[1] + j
    along, across = table[cell, 1], table[cell, 2]
    return table[cell, 0] + cell_m * ((u - i) * along + (v - j) * across), along, across


@compiled
def size_step(xy_m, solid, missed, wrong, shaded, sunk, weight, found, blur_m, low_m, cell_m, shape, openings, outline):
    """Information (8, 8) and scores (N, 8) of cells (N, 2) with a share of solid (N,), at some unknowns (8,).

    Cell by cell: P(solid) = w + (1 - e - w - m) logistic((shift - d) / blur), d the signed distance to the solid part,
    w the share of open cells that look solid, m that of solid cells that are missed, 0 where something is shown, e that
    of solid cells that look open: `sunk` (2,), beside what stands (`shaded`, (N,)) and elsewhere. The last is counted
    anew: how many cells well inside the solid part there are, and how many of them look open, shape (2, 2).
    """
    information, scores = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros((len(xy_m), UNKNOWNS))
    design, inside = np.zeros(UNKNOWNS), np.zeros((2, 2))
    cos, sin = math.cos(found[0]), math.sin(found[0])
    for k in range(len(xy_m)):
        x, y = xy_m[k, 0] - found[1], xy_m[k, 1] - found[2]
        x, y = cos * x + sin * y, cos * y - sin * x
        inner, ix, iy = _looked_up(x / (1.0 + found[3]), y / (1.0 + found[4]), low_m, cell_m, shape, openings)
        outer, ox, oy = _looked_up(x, y, low_m, cell_m, shape, outline)
        inner += found[5]
        outer -= ox * ox * found[6] + oy * oy * found[7]
        distance = max(inner, outer)
        zone = int(shaded[k])
        if distance < -INSIDE_M and missed[k] == 0.0:
            inside[zone, 0] += 1.0
            inside[zone, 1] += 1.0 - solid[k]
        eta = (EDGE_SHIFT_M - distance) / blur_m
        if abs(eta) > REACH:
            continue
        plain = 1.0 / (1.0 + math.exp(-eta))
        gain = 1.0 - sunk[zone] - wrong[k] - missed[k]
        if gain <= 0.0:
            continue
        chance, rate = wrong[k] + gain * plain, gain * plain * (1.0 - plain)
        gx, gy = (ix, iy) if inner >= outer else (ox, oy)
        design[0], design[1], design[2] = gx * y - gy * x, -gx, -gy
        for i in range(3, UNKNOWNS):
            design[i] = 0.0
        if inner >= outer:
            design[3], design[4], design[5] = -gx * x, -gy * y, 1.0
        else:
            design[6], design[7] = -gx * gx, -gy * gy
        pull = -(solid[k] - chance) / (chance * (1.0 - chance)) * rate / blur_m * weight
        firm = rate * rate / (chance * (1.0 - chance)) / blur_m**2 * weight
        first, last = (3, 6) if inner >= outer else (6, UNKNOWNS)
        for i in range(UNKNOWNS):
            if i >= 3 and not first <= i < last:
                continue
            scores[k, i] = pull * design[i]
            for j in range(i + 1):
                information[i, j] += firm * design[i] * design[j]
    for i in range(UNKNOWNS):
        for j in range(i):
            information[j, i] = information[i, j]
    return information, scores, inside


@compiled
def sizes(
    xy_m,
    solid,
    missed,
    wrong,
    shaded,
    weight,
    blurs_m,
    rounds,
    prior,
    longest,
    side_m,
    low_m,
    cell_m,
    shape,
    openings,
    outline,
):
    """Fisher scoring from 0 with a Gaussian prior (information (8,)): unknowns (8,), covariance (8, 8), squares.

    The blur narrows round by round; no step is longer than `longest` (8,). How often what is solid looks open is
    counted anew in every round. The covariance is that of residuals alike within squares of `side_m`, and no less than
    what the likelihood says.
    """
    found, sunk = np.zeros(UNKNOWNS), np.full(2, WRONG_SHARE)
    information = np.zeros((UNKNOWNS, UNKNOWNS))
    scores = np.zeros((len(xy_m), UNKNOWNS))
    for blur_m in blurs_m:
        for _ in range(rounds):
            information, scores, inside = size_step(
                xy_m, solid, missed, wrong, shaded, sunk, weight, found, blur_m, low_m, cell_m, shape, openings, outline
            )
            for zone in range(2):
                share = (inside[zone, 1] + WRONG_SHARE * PRIOR_CELLS) / (inside[zone, 0] + PRIOR_CELLS)
                sunk[zone] = min(max(share, WRONG_SHARE), MOST_SUNK)
            total = np.zeros(UNKNOWNS)
            for i in range(UNKNOWNS):
                information[i, i] += prior[i]
                total[i] = -prior[i] * found[i]
                for k in range(len(scores)):
                    total[i] += scores[k, i]
            step = solved(information, total)
            share = 1.0
            for i in range(UNKNOWNS):
                share = min(share, longest[i] / max(abs(step[i]), 1e-12))
            for i in range(UNKNOWNS):
                found[i] += share * step[i]
    products, count = cluster_sums(xy_m, scores, side_m)
    return found, information, products, count
